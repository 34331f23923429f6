"""The player "null": silent, but it takes as long as the sound would.

For robots in simulation and for CI, where scripts must keep their timing. It opens no device and starts no program.
"""

from __future__ import annotations

import time

from talkcli.engine.child.players.base import BuiltIn
from talkcli.engine.players import SAMPLE_BYTES

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

#: Seconds of sound that it takes ahead of its clock, as much as a real player's buffer holds.
AHEAD = 0.06


class NullPlayer(BuiltIn):
    """Takes samples at the pace of the clock."""

    name = "null"
    real_time = True

    def __init__(
        self,
        rate: int,
        _device: str | None = None,
        _audible: bool = False,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self._bytes_per_second = rate * SAMPLE_BYTES
        self._clock = clock
        self._started: float | None = None

    def offer(self, data: memoryview) -> int:
        """Take all of it if there is room, else nothing."""
        now = self._clock()
        if self._started is None:
            self._started = now
        self._started += max(0.0, now - self._heard_at())  # it ran dry, and was silent meanwhile
        if self._taken + len(data) > (now - self._started + AHEAD) * self._bytes_per_second:
            return 0
        self._taken += len(data)
        return len(data)

    def ended(self) -> bool:
        """Return True when the last sample would have been heard."""
        return self._closed and (self._started is None or self._clock() >= self._heard_at())

    def wake_at(self) -> float | None:
        """Return when the next samples fit, or when the sound ends."""
        if self._started is None:
            return self._clock()
        # A third of what it holds fits then: no more wake-ups than a real player causes.
        return self._heard_at() if self._closed else self._heard_at() - AHEAD * 2 / 3

    def _heard_at(self) -> float:
        return (self._started or 0.0) + self._taken / self._bytes_per_second
