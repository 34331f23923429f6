"""How often something may be said that may happen many times a second.

Pure: the time comes in as an argument.
"""

from __future__ import annotations


class Quota:
    """Lets `most` through in `seconds`, from the first of them on, and counts those that it held back."""

    def __init__(self, most: int, seconds: float) -> None:
        self._most = most
        self._seconds = seconds
        self._since = float("-inf")
        self._passed = 0
        self._held_back = 0

    def take(self, now: float) -> int | None:
        """Return None where there is no room for one more; else how many were held back and not told of before it."""
        if now >= self._since + self._seconds:
            held_back, self._held_back = self._held_back, 0
            self._since, self._passed = now, 1
            return held_back
        if self._passed < self._most:
            self._passed += 1
            return 0
        self._held_back += 1
        return None
