"""How long something takes, as well as a busy machine can tell: the least of several tries."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


def least_seconds(step: Callable[[], object], *, tries: int = 7, times: int = 8) -> float:
    """Return the seconds for `times` steps in the fastest of `tries`."""
    least = float("inf")
    for _ in range(tries):
        began = perf_counter()
        for _ in range(times):
            step()
        least = min(least, perf_counter() - began)
    return least
