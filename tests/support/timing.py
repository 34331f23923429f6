"""Limits that are promises, on machines that are sometimes late themselves.

A limit is asserted as written. Only where a control, something that has nothing to do with what is tested, was late at
the same time is a late attempt tried again.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.support.company import company
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Callable

#: Seconds of a bare `python -c pass`, measured as 12 ms, above which the machine counts as late.
PROCESS_START_LIMIT = 0.08
#: Seconds of `talk status` on an idle server, above which it does.
STATUS_LIMIT = 0.25
_TRIES = 3


class LateError(AssertionError):
    """Something took longer than its limit: the only failure that `retry_if_late` may try again."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt: its controls before and after in seconds, and what was late (None: nothing)."""

    before: float
    after: float | None
    late: str | None


def assert_within(seconds: float, limit: float, what: str) -> None:
    """Assert that something took no longer than its limit."""
    if seconds > limit:
        raise LateError(f"{what} took {seconds:.3f} s, the limit is {limit} s")


def process_start() -> float:
    """Return the seconds that a bare process start takes: a control for what starts a process."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-S", "-c", "pass"], env=clean_environment(tempfile.gettempdir()), check=True)
    return time.monotonic() - began


def retry_if_late(
    attempt: Callable[[], None],
    control: Callable[[], float] = process_start,
    control_limit: float = PROCESS_START_LIMIT,
) -> list[Attempt]:
    """Run an attempt, at most three times, again only where it was late and so was the control before or after it.

    An attempt that raises `LateError` while the control was in time fails, as does any other failure at once, and the
    third late one. Every attempt's times are in the message, and returned where one was in time at last. One that was
    late beside other tests, where no control tells what those did meanwhile, does not count: the next are made alone.
    """
    attempts: list[Attempt] = []
    while True:
        before = control()
        try:
            attempt()
        except LateError as error:
            if not company.alone:
                company.stay_alone()
                continue
            after = control()
            attempts.append(Attempt(before, after, str(error)))
            in_time = max(before, after) <= control_limit
            if in_time or len(attempts) == _TRIES:
                why = "the control was in time" if in_time else "the control was late too"
                raise AssertionError(f"{error}; {why} (limit {control_limit} s): {attempts}") from error
        else:
            attempts.append(Attempt(before, None, None))
            return attempts
