"""Engine processes that were killed and are not known to be gone: what they spoke may still be heard.

It only keeps book; the time comes in as an argument (monotonic seconds).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.engine.spawn import EngineProcess

_NEVER = float("inf")


class Dying:
    """The killed processes, each with the time by which it must be gone."""

    def __init__(self) -> None:
        self._limits: dict[EngineProcess, float] = {}

    def __iter__(self) -> Iterator[EngineProcess]:
        return iter(list(self._limits))

    def __bool__(self) -> bool:
        return bool(self._limits)

    def add(self, process: EngineProcess, limit: float) -> None:
        """Take a process that was killed just now, and when it must be gone."""
        self._limits[process] = limit

    def deadlines(self) -> list[float]:
        """Return the times at which one is overdue."""
        return [limit for limit in self._limits.values() if limit != _NEVER]

    def overdue(self, now: float) -> list[EngineProcess]:
        """Return those that should have been gone by now, each once; they are kept, to be reaped when they go."""
        found = [process for process, limit in self._limits.items() if now >= limit]
        for process in found:
            self._limits[process] = _NEVER
        return found

    def remove(self, process: EngineProcess) -> bool:
        """Forget a process that is gone, and return whether it went in time."""
        return self._limits.pop(process) != _NEVER
