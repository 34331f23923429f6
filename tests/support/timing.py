"""Checks of documented time limits, on machines that may be overloaded.

Limits are asserted with the documented value, and nothing is retried. Meanwhile, a control (usually the start of a bare
process) is timed again and again, and several times right after a late result, because the times in between may miss
what made the result late. The control is late if it once took at least twice as long as on the quiet machine. If the
late control explains a late result, the result counts as not measured: the test continues, and is listed at the end of
the test run. Any other late result fails.
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

#: Time between two controls, so that they use about 1/30 of a processor.
_INTERVAL_S = 0.25
#: Ratio to its usual duration from which a control is late.
_LATE = 2.0
#: Number of controls right after a late result.
_AFTER_LATE = 10
#: Most process starts that a result can take as long as (a sentence after a crash), and fewest (a result of a few
#: milliseconds still involves several processes, which all wait for the processor, and a killed one must run to end).
_MOST_STARTS, _FEWEST_STARTS = 10, 5
#: Number of controls for the time on the quiet machine, which is the shortest of them.
_CALIBRATIONS = 5
#: The environment variable that passes this time to the workers of a test run.
_QUIET = "TALK_TEST_PROCESS_START"


@dataclass(slots=True)
class Block:
    """A block whose limits are judged together."""

    control: Callable[[], float]
    controls: list[float] = field(default_factory=list)
    late: list[tuple[str, float, float]] = field(default_factory=list)  # name, seconds, limit
    failure: BaseException | None = None  # of the control


#: The shortest time of each control in this test run, and the unmeasured results since `take_unmeasured`.
_usual: dict[Callable[[], float], float] = {}
_unmeasured: list[str] = []
_blocks: list[Block] = []


def process_start() -> float:
    """Return the seconds that the start of a bare process takes (about 0.01 on a quiet machine)."""
    started_at = time.monotonic()
    subprocess.run([sys.executable, "-S", "-E", "-c", "pass"], env=clean_environment(tempfile.gettempdir()), check=True)
    return time.monotonic() - started_at


def calibrate() -> None:
    """Time a process start before tests make the machine busy."""
    if _QUIET not in os.environ:
        os.environ[_QUIET] = str(min(process_start() for _ in range(_CALIBRATIONS)))


@contextlib.contextmanager
def limits(control: Callable[[], float] = process_start) -> Iterator[None]:
    """Time the control during the block. At its end, fail if a result was later than the control explains."""
    block = Block(control)
    if control is process_start:
        _usual.setdefault(control, float(os.environ[_QUIET]))
    elif control not in _usual:
        _usual[control] = min(control() for _ in range(_CALIBRATIONS))
    over = threading.Event()
    thread = threading.Thread(target=_time, args=(block, over), name="control", daemon=True)
    thread.start()
    _blocks.append(block)
    try:
        yield
    finally:
        _blocks.remove(block)
        over.set()
        thread.join()
    _judge(block)


def assert_within(seconds: float, limit: float, name: str) -> None:
    """Assert that a result took no longer than its limit. Inside `limits`, the check is at the end of the block."""
    if seconds <= limit:
        return
    assert _blocks, f"{name} took {seconds:.3f} s, the limit is {limit} s"
    block = _blocks[-1]
    block.late.append((name, seconds, limit))
    block.controls += [block.control() for _ in range(_AFTER_LATE)]


def take_unmeasured() -> list[str]:
    """Return the results that were not measured since the last call."""
    results = _unmeasured.copy()
    _unmeasured.clear()
    return results


def _time(block: Block, over: threading.Event) -> None:
    try:
        block.controls.append(block.control())
        while not over.wait(_INTERVAL_S):
            block.controls.append(block.control())
    except Exception as error:  # noqa: BLE001 - raised by `_judge`
        block.failure = error


def _judge(block: Block) -> None:
    if block.failure:
        raise block.failure
    usual = _usual[block.control] = min(_usual[block.control], *block.controls)
    worst = max(block.controls)
    for name, seconds, limit in block.late:
        line = f"{name} took {seconds:.3f} s, the limit is {limit} s; "
        line += f"the control took {worst:.3f} s, usually {usual:.3f} s"
        times_late = max(limit, _FEWEST_STARTS * usual) * worst / usual
        explained = min(times_late, limit + _MOST_STARTS * (worst - usual)) if worst >= _LATE * usual else limit
        assert seconds <= explained, line
        _unmeasured.append(line)
