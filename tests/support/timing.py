"""Limits that are promises, on machines that are sometimes late themselves.

A limit is asserted as written, and nothing is tried again. What was late is judged against a control, something that
has nothing to do with what is tested, timed beside it over and over: bare process starts. The control is late where one
of these took twice as long as they do on this machine when it is quiet, or longer. What was later than its limit by no
more than that explains counts as not measured: the test goes on, and is listed at the end of the run. Anything else
that is late fails.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: Seconds between two controls: so they take a thirtieth of a processor.
_EVERY = 0.25
#: Times its usual duration from which a control is late.
_LATE = 2.0
#: Process starts, at most, of which what has a limit consists: a sentence after a crash waits for about so much work.
_WORK = 10
#: … and at least: what has a limit of milliseconds goes through as many processes, each of which waits for its turn.
_LEAST_WORK = 3
#: Controls that tell how long one takes when the machine is quiet: the shortest of them.
_FIRST = 5
#: The variable that tells the workers of a run how long a process start took before they began.
_QUIET = "TALK_TEST_PROCESS_START"


@dataclass(slots=True)
class Watched:
    """A block whose limits are judged together."""

    control: Callable[[], float]
    controls: list[float] = field(default_factory=list)
    late: list[tuple[str, float, float]] = field(default_factory=list)  # what, how long it took, its limit
    failure: BaseException | None = None  # of the control


#: The shortest that each control has taken in this run, and what could not be measured since `take_unmeasured`.
_usual: dict[Callable[[], float], float] = {}
_unmeasured: list[str] = []
_watched: list[Watched] = []


def process_start() -> float:
    """Return the seconds that a bare process start takes, about 10 ms where nothing else runs."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-S", "-E", "-c", "pass"], env=clean_environment(tempfile.gettempdir()), check=True)
    return time.monotonic() - began


def calibrate() -> None:
    """Find out how long a process start takes, before tests make the machine busy."""
    if _QUIET not in os.environ:
        os.environ[_QUIET] = str(min(process_start() for _ in range(_FIRST)))


@contextlib.contextmanager
def limits(control: Callable[[], float] = process_start) -> Iterator[None]:
    """Time the control beside the block, and judge against it what `assert_within` finds late there.

    AssertionError at the end of the block if something was later than the control explains.
    """
    watched = Watched(control)
    if control is process_start:
        _usual.setdefault(control, float(os.environ[_QUIET]))
    elif control not in _usual:
        _usual[control] = min(control() for _ in range(_FIRST))
    over = threading.Event()
    beside = threading.Thread(target=_time, args=(watched, over), name="control", daemon=True)
    beside.start()
    _watched.append(watched)
    try:
        yield
    finally:
        _watched.remove(watched)
        over.set()
        beside.join()
    _judge(watched)


def assert_within(seconds: float, limit: float, what: str) -> None:
    """Assert that something took no longer than its limit; inside `limits`, at the end of the block."""
    if seconds <= limit:
        return
    assert _watched, f"{what} took {seconds:.3f} s, the limit is {limit} s"
    _watched[-1].late.append((what, seconds, limit))


def take_unmeasured() -> list[str]:
    """Return what could not be measured since this was called the last time."""
    found = _unmeasured.copy()
    _unmeasured.clear()
    return found


def _time(watched: Watched, over: threading.Event) -> None:
    try:
        watched.controls.append(watched.control())
        while not over.wait(_EVERY):
            watched.controls.append(watched.control())
    except Exception as error:  # noqa: BLE001 - raised again where it is judged
        watched.failure = error


def _judge(watched: Watched) -> None:
    if watched.failure:
        raise watched.failure
    usual = _usual[watched.control] = min(_usual[watched.control], *watched.controls)
    worst = max(watched.controls)
    told = f"the control took {max(watched.controls):.3f} s, usually {usual:.3f} s"
    for what, seconds, limit in watched.late:
        line = f"{what} took {seconds:.3f} s, the limit is {limit} s; {told}"
        times_late = max(limit, _LEAST_WORK * usual) * worst / usual
        explained = min(times_late, limit + _WORK * (worst - usual)) if worst >= _LATE * usual else limit
        assert seconds <= explained, line
        _unmeasured.append(line)
