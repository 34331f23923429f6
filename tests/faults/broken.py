"""Shared by the tests of faults: the server meanwhile, and the sound of the next goal."""

from __future__ import annotations

import contextlib
import os
import time
from typing import TYPE_CHECKING

import numpy as np

import talkcli
from tests.conformance.hearing import HELP, QUICK, render_quick
from tests.conformance.stopped import likeliest
from tests.support import usage
from tests.support.compare import assert_heard, extent
from tests.support.reference import RATE
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
#: Seconds by which the goal that is heard again may be longer or shorter than a fresh engine's.
ALIKE = 0.05
#: kB by which a server may have grown after a fault; a goal and its log take a few.
GROWTH = 4096


def assert_answers(talk: Talk) -> None:
    """Assert that the server answers in time, whatever is broken."""
    started_at = time.monotonic()  # before it connects: the greeting takes its time as well
    assert talk.request("status")["ok"]
    assert_within(time.monotonic() - started_at, ANSWER, "`status`")


def await_end(talk: Talk, goal_id: str, within: float) -> str:
    """Return the state in which a goal ended; the server must answer its status meanwhile."""
    end = time.monotonic() + within
    while True:
        with contextlib.suppress(AssertionError):  # not yet
            return talk.watcher.wait_for_terminal(goal_id, 0.05)
        assert time.monotonic() < end, f"{goal_id} did not end within {within} s: {talk.watcher.states(goal_id)}"
        assert_answers(talk)


@contextlib.contextmanager
def nothing_left(talk: Talk) -> Iterator[None]:
    """Assert that an idle server has no process, descriptor or thread more than before, once it is idle again."""
    assert talk.run("voices").code == 0  # so that the engine is ready
    before = usage.count(talk.pid)
    yield
    usage.assert_not_grown(talk.pid, before, GROWTH)


def began(recording: Recording, whole: Samples) -> float:
    """Assert that a sentence was heard whole, and last; return when its sound began."""
    samples = recording.samples
    start, _ = next(likeliest(samples, [[whole]]), (0, [whole]))
    (found,) = assert_heard(samples[start:], [whole])
    return recording.time_of(start + found.offset)


def heard_again(talk: Talk, sink: Sink) -> float:
    """Assert that a goal that is sent now is heard whole, and return when its sound began.

    After a stopped sentence the library makes other samples of the next one, so only its length is compared, without
    the zeros of a player that ran dry. LOW and LONG, which are lost at the faults, have other lengths.
    """
    with sink.record() as recording:
        recording.wait_until_quiet(0.2)  # a frozen sound server plays its buffer when it goes on
        start = len(recording)
        assert talk.run("say", "--wait", "--rate", str(QUICK), "--", HELP).code == 0
        recording.wait_until_quiet(0.2)
    heard, expected = recording.samples[start:], render_quick([HELP])[0]
    bounds = extent(heard)
    assert bounds
    seconds, expected_seconds = (np.count_nonzero(samples) / RATE for samples in (heard, expected))
    assert abs(seconds - expected_seconds) < ALIKE, (seconds, expected_seconds)
    return recording.time_of(start + bounds[0])


def python_path(first: Path) -> dict[str, str]:
    """Return an environment in which Python searches a directory before talk's own."""
    return {"PYTHONPATH": os.pathsep.join([str(first), os.path.dirname(os.path.dirname(talkcli.__file__))])}


def write(path: Path, text: str, mode: int = 0o644) -> Path:
    """Write a file and return its path."""
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)
    return path
