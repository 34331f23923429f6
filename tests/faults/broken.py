"""What the tests of broken engines, players and sound servers share: the server meanwhile, the next goal as heard."""

from __future__ import annotations

import contextlib
import os
import time
from typing import TYPE_CHECKING

import numpy as np

import talkcli
from tests.conformance.hearing import HOME
from tests.conformance.stopped import DROPPED
from tests.support import census
from tests.support.compare import assert_heard, compare, extent
from tests.support.reference import RATE, render
from tests.support.timing import assert_within

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conformance.hearing import Samples
    from tests.support.processes import Talk
    from tests.support.recording import Recording
    from tests.support.sink import Sink

#: Seconds within which `status` is answered, whatever is broken.
ANSWER = 0.1
#: Words per minute of the goal that is heard again, the fastest there are.
RATE_AGAIN = 450
#: Seconds by which that may be longer or shorter than a fresh engine's.
ALIKE = 0.05
#: Samples that are zero before a sentence, at least; and those by which one may be longer whose player ran dry.
SILENCE, RUN_DRY = RATE // 50, RATE // 5
#: kB by which a server may have grown after a fault: what it keeps of one goal and its log is a few.
GROWTH = 4096

#: Keeps an engine process in its start for as long as a file is there; for `PYTHONPATH`, as the server's environment
#: is the engine's. Its argument is the file.
SLOW_START = """
import os, sys, time
while "talkcli.engine.main" in "".join(sys.orig_argv) and os.path.exists({flag!r}):
    time.sleep(0.001)
"""


def assert_answers(talk: Talk) -> None:
    """Assert that the server answers in time, whatever is broken."""
    with talk.connect() as wire:
        asked = time.monotonic()
        assert wire.request("status")["ok"]
        assert_within(time.monotonic() - asked, ANSWER, "`status`")


def await_end(talk: Talk, goal_id: str, within: float) -> str:
    """Return the state in which a goal ended; the server was asked for its status meanwhile, again and again."""
    end = time.monotonic() + within
    while True:
        with contextlib.suppress(AssertionError):  # not yet
            return talk.watcher.wait_for_terminal(goal_id, 0.25)
        assert time.monotonic() < end, f"{goal_id} did not end within {within} s: {talk.watcher.states(goal_id)}"
        assert_answers(talk)


@contextlib.contextmanager
def nothing_left(talk: Talk) -> Iterator[None]:
    """Assert that an idle server has no process, descriptor or thread more than before, once it is idle again."""
    assert talk.run("voices").code == 0  # so that the engine is ready
    before = census.count(talk.pid)
    yield
    census.assert_as_before(talk.pid, before, GROWTH)


def began(recording: Recording, whole: Samples) -> float:
    """Assert that a sentence was heard whole, and last; return when its sound began."""
    samples = recording.samples
    offset = compare(samples, whole).offset
    # Where the player ran dry in it, what is most like it is a later part: it begins behind one of the silences before.
    for start in _behind_silence(samples, offset - RUN_DRY, offset):
        with contextlib.suppress(AssertionError):
            (found,) = assert_heard(samples[start:], [whole])
            return recording.time_of(start + found.offset)
    start = max(0, offset - DROPPED)
    (found,) = assert_heard(samples[start:], [whole])
    return recording.time_of(start + found.offset)


def _behind_silence(samples: Samples, first: int, last: int) -> list[int]:
    """Return where something begins between two samples, behind a silence, each with some samples before it."""
    loud = np.flatnonzero(samples)
    begins = loud[np.diff(loud, prepend=-SILENCE - 1) > SILENCE]
    return [max(0, int(each) - DROPPED) for each in begins if first <= each <= last + DROPPED]


def heard_again(talk: Talk, sink: Sink) -> float:
    """Assert that a goal that is sent now is heard whole, and return when its sound began.

    After a sentence that was stopped in its middle the library makes something else of the next, so only its length is
    compared, without the zeros of a player that ran dry.
    """
    with sink.record() as recording:
        recording.wait_until_quiet(0.2)  # what a frozen sound server had is heard when it goes on
        start = len(recording)
        assert talk.run("say", "--wait", "--rate", str(RATE_AGAIN), "--", HOME).code == 0
        recording.wait_until_quiet(0.2)
    heard, expected = recording.samples[start:], render([HOME], rate=RATE_AGAIN)[0]
    found = extent(heard)
    assert found
    seconds, usual = (np.count_nonzero(each) / RATE for each in (heard, expected))
    assert abs(seconds - usual) < ALIKE, (seconds, usual)
    return recording.time_of(start + found[0])


def told(what: str, seconds: float) -> None:
    """Leave a measured time where `pytest -s` shows it."""
    print(f"measured: {what}: {seconds:.3f} s")


def python_path(first: Path) -> dict[str, str]:
    """Return a server's environment with a directory that is searched before all others, talk's own behind it."""
    return {"PYTHONPATH": os.pathsep.join([str(first), os.path.dirname(os.path.dirname(talkcli.__file__))])}


def write(path: Path, text: str, mode: int = 0o644) -> Path:
    """Write a file and return its path."""
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)
    return path
