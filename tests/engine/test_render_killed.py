"""What renders a file is killed at any moment: there is the whole file or none, and no process is left."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
import uuid
from typing import TYPE_CHECKING

import pytest

from tests.engine.test_render import BEFORE, samples
from tests.support.reference import render as reference
from tests.support.surroundings import MARK, assert_none_left

if TYPE_CHECKING:
    from pathlib import Path

#: A program that renders, and dies with whoever started it.
PROGRAM = """
import sys
sys.path[:] = {path!r}
from talkcli.engine.render import render
print("begun", flush=True)
render(sys.argv[1], sys.argv[2])
"""


@pytest.mark.parametrize("times", [5, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_killed_at_any_moment_there_is_no_half_file_and_no_process(
    tmp_path: Path, how: signal.Signals, times: int
) -> None:
    text = "one two three four five. " * 20
    (expected,) = reference([text])
    path = tmp_path / "x.wav"
    command = [sys.executable, "-c", PROGRAM.format(path=sys.path), text, str(path)]
    began = time.monotonic()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True, timeout=60)
    whole = time.monotonic() - began
    moments = random.Random(how)
    outcomes = set()
    for _ in range(times):
        path.write_bytes(BEFORE)
        mark = uuid.uuid4().hex
        with subprocess.Popen(
            command, env={**os.environ, MARK: mark}, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        ) as program:
            assert program.stdout is not None
            program.stdout.readline()
            time.sleep(moments.uniform(0, whole))  # any moment is the point, there is nothing to wait for
            program.send_signal(how)
        assert_none_left(mark, 2)
        hidden = [each for each in os.listdir(tmp_path) if each != "x.wav"]
        if how == signal.SIGKILL:
            assert len(hidden) <= 1
            for each in hidden:
                assert each.startswith(".talk-")
                os.unlink(tmp_path / each)
        else:
            assert hidden == []
        done = path.read_bytes() != BEFORE
        outcomes.add(done)
        if done:
            assert samples(path) == expected.tobytes()
    assert False in outcomes
