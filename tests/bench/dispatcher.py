"""speech-dispatcher in the foreground, private: its own directory, socket and settings, playing into a sink of ours."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
import uuid
from typing import TYPE_CHECKING

from tests.bench.failure import FailedError
from tests.support.surroundings import MARK, assert_none_left, clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.sink import Sink

_START = 10.0
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
#: As Debian has it, but for the rate, which is talk's, espeak-ng's (-s 200) and pyttsx3's here: all say the same thing
#: equally fast.
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


@contextlib.contextmanager
def dispatcher(sink: Sink) -> Iterator[dict[str, str]]:
    """Run a speech-dispatcher until the end of the block; gives the environment in which `spd-say` finds it."""
    mark = uuid.uuid4().hex
    with short_directory("spd-") as home:
        os.mkdir(f"{home}/modules")
        _write(f"{home}/speechd.conf", _SETTINGS.format(directory=home))
        _write(f"{home}/modules/espeak-ng.conf", _MODULE)
        address = f"{home}/s.sock"
        env = clean_environment(home, {**sink.env, "SPEECHD_ADDRESS": f"unix_socket:{address}", MARK: mark})
        command = ["speech-dispatcher", "-s", "-t", "0", "-C", home, "-S", address, "-P", f"{home}/pid"]
        with open(f"{home}/log", "wb") as log:
            process = subprocess.Popen(
                dying_with_parent(command), env=env, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        try:
            end = time.monotonic() + _START
            while not os.path.exists(address):
                if process.poll() is not None or time.monotonic() > end:
                    with open(f"{home}/log", encoding="utf-8", errors="replace") as said:
                        raise FailedError(f"speech-dispatcher does not start: {said.read()[-1000:]}")
                time.sleep(0.02)  # a socket's appearance is no event
            yield env
        finally:
            process.terminate()
            try:
                process.wait(3)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            # Its modules end when it does; what would not is killed.
            with contextlib.suppress(AssertionError):
                assert_none_left(mark, 2.0)


def _write(path: str, text: str) -> None:
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
