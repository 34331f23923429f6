"""Helpers for tests of faults: checks of the server during a fault, and of the next goal's sound."""

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

#: Limit in seconds for the reply to `status` during a fault.
ANSWER = 0.1
#: Allowed difference in seconds between the next goal's sound and that of a new engine.
ALIKE = 0.05
#: Allowed growth of a server's memory after a fault, in kB. A goal and its log take a few kB.
GROWTH = 4096


def assert_answers(talk: Talk) -> None:
    """Assert that the server answers `status` in time."""
    started_at = time.monotonic()  # before connecting, because the greeting takes time, too
    assert talk.request("status")["ok"]
    assert_within(time.monotonic() - started_at, ANSWER, "`status`")


def await_end(talk: Talk, goal_id: str, within: float) -> str:
    """Wait for a goal to end while the server keeps answering `status`; return the end state."""
    end = time.monotonic() + within
    while True:
        with contextlib.suppress(AssertionError):  # not yet
            return talk.watcher.wait_for_terminal(goal_id, 0.05)
        assert time.monotonic() < end, f"{goal_id} did not end within {within} s: {talk.watcher.states(goal_id)}"
        assert_answers(talk)


@contextlib.contextmanager
def no_leaks(talk: Talk) -> Iterator[None]:
    """Assert that the block leaves an idle server without additional processes, descriptors or threads."""
    assert talk.run("voices").code == 0  # so that the engine is ready
    before = usage.count(talk.pid)
    yield
    usage.assert_not_grown(talk.pid, before, GROWTH)


def assert_heard_last(recording: Recording, sentence: Samples) -> float:
    """Assert that the last sentence was heard whole, and return when its sound started."""
    samples = recording.samples
    start, _ = next(likeliest(samples, [[sentence]]), (0, [sentence]))
    (compared,) = assert_heard(samples[start:], [sentence])
    return recording.time_of(start + compared.offset)


def assert_heard_again(talk: Talk, sink: Sink) -> float:
    """Send a goal, assert that it is heard whole, and return when its sound started.

    After a stopped sentence, libespeak-ng renders the next one differently. So only the length is compared, without
    the zeros of a player underrun. LOW and LONG, which the faults interrupt, have other lengths.
    """
    with sink.record() as recording:
        recording.wait_until_quiet(0.2)  # a frozen sound server plays its buffer when it resumes
        start = len(recording)
        assert talk.run("say", "--wait", "--rate", str(QUICK), "--", HELP).code == 0
        recording.wait_until_quiet(0.2)
    heard = recording.samples[start:]
    bounds = extent(heard)
    assert bounds
    seconds, expected = (np.count_nonzero(samples) / RATE for samples in (heard, render_quick([HELP])[0]))
    assert abs(seconds - expected) < ALIKE, (seconds, expected)
    return recording.time_of(start + bounds[0])


def python_path(first: Path) -> dict[str, str]:
    """Return an environment in which Python searches this directory before that of talk."""
    return {"PYTHONPATH": os.pathsep.join([str(first), os.path.dirname(os.path.dirname(talkcli.__file__))])}


def write(path: Path, text: str, mode: int = 0o644) -> Path:
    """Write a file and return its path."""
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)
    return path
