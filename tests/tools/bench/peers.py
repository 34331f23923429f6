"""A private speech-dispatcher that plays to the benchmark's sink."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

from tests.support.surroundings import MARK, assert_none_left, clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.sink import Sink

#: The programs that talk is compared with.
PROGRAMS = ("espeak-ng", "spd-say", "speech-dispatcher")
_START_S = 10.0
_SETTINGS = """\
LogLevel 1
LogDir "{directory}"
CommunicationMethod "unix_socket"
AudioOutputMethod "pulse"
AddModule "espeak-ng" "sd_espeak-ng" "espeak-ng.conf"
DefaultModule espeak-ng
DefaultVolume 100
DisableAutoSpawn
"""
#: Debian's settings, except for the rate, which is the same as for talk, espeak-ng and pyttsx3.
_MODULE = """\
Debug 0
EspeakMinRate 80
EspeakNormalRate 200
EspeakMaxRate 449
EspeakAudioChunkSize 300
EspeakAudioQueueMaxSize 441000
EspeakIndexing 1
EspeakMbrola 0
"""


def installed() -> bool:
    return all(map(shutil.which, PROGRAMS))


@contextlib.contextmanager
def dispatcher(sink: Sink) -> Iterator[dict[str, str]]:
    """Run speech-dispatcher during the block. Yield the variable with which `spd-say` finds it."""
    mark = uuid.uuid4().hex
    with short_directory("spd-") as home:
        Path(home, "modules").mkdir()
        Path(home, "speechd.conf").write_text(_SETTINGS.format(directory=home))
        Path(home, "modules", "espeak-ng.conf").write_text(_MODULE)
        address = f"{home}/s.sock"
        variable = {"SPEECHD_ADDRESS": f"unix_socket:{address}"}
        env = clean_environment(home, {**sink.env, **variable, MARK: mark})
        command = ["speech-dispatcher", "-s", "-t", "0", "-C", home, "-S", address, "-P", f"{home}/pid"]
        with open(f"{home}/log", "wb") as log:
            process = subprocess.Popen(
                dying_with_parent(command), env=env, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        try:
            end = time.monotonic() + _START_S
            while not os.path.exists(address):
                running = process.poll() is None and time.monotonic() < end
                assert running, f"speech-dispatcher does not start: {Path(home, 'log').read_text()[-1000:]}"
                time.sleep(0.02)  # a new socket sends no event
            yield variable
        finally:
            process.kill()
            process.wait()
            with contextlib.suppress(AssertionError):  # kills its modules if they don't end with it
                assert_none_left(mark, 2.0)
