"""Limits that are promises, on machines that are sometimes late themselves.

A limit is asserted as written, and nothing is tried again. A control, a bare process start, is timed beside the test
over and over. The control is late if it once took at least twice as long as on this machine when quiet. A result that
is late by no more than that explains counts as not measured: the test goes on, and is listed at the end of the run. Any
other late result fails.
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
#: The most process starts that a result consists of, as a sentence after a crash does; and the least, as a result of
#: milliseconds goes through some processes, each of which waits for its turn.
_WORK, _LEAST_WORK = 10, 3
#: Number of controls of which the shortest is the time on a quiet machine.
_FIRST = 5
#: The variable by which the workers of a run inherit that time.
_QUIET = "TALK_TEST_PROCESS_START"


@dataclass(slots=True)
class Watched:
    """A block whose limits are judged together."""

    control: Callable[[], float]
    controls: list[float] = field(default_factory=list)
    late: list[tuple[str, float, float]] = field(default_factory=list)  # name, seconds, limit
    failure: BaseException | None = None  # of the control


#: The shortest time of each control in this run, and the results not measured since `take_unmeasured`.
_usual: dict[Callable[[], float], float] = {}
_unmeasured: list[str] = []
_watched: list[Watched] = []


def process_start() -> float:
    """Return the seconds that a bare process start takes, about 10 ms on a quiet machine."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-S", "-E", "-c", "pass"], env=clean_environment(tempfile.gettempdir()), check=True)
    return time.monotonic() - began


def calibrate() -> None:
    """Time a process start before tests make the machine busy."""
    if _QUIET not in os.environ:
        os.environ[_QUIET] = str(min(process_start() for _ in range(_FIRST)))


@contextlib.contextmanager
def limits(control: Callable[[], float] = process_start) -> Iterator[None]:
    """Time the control beside the block, and fail at its end if a result was later than the control explains."""
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
    """Assert that a result took no longer than its limit; inside `limits`, at the end of the block."""
    if seconds <= limit:
        return
    assert _watched, f"{what} took {seconds:.3f} s, the limit is {limit} s"
    _watched[-1].late.append((what, seconds, limit))


def take_unmeasured() -> list[str]:
    """Return the results that were not measured since the last call."""
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
