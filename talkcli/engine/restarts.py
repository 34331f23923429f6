"""When the next engine process may be started, and why none gets ready, while that is so.

Pure: the time comes in as an argument (monotonic seconds).
"""

from __future__ import annotations

#: Seconds before the next start, by the number of processes in a row that died before they were of use.
BACK_OFF = (0.0, 0.1, 0.5, 2.0, 10.0)

#: A ready process that dies sooner than this, with no goal in hand, was of no use.
SHORT_LIFE = 1.0


class Restarts:
    """The back-off between two starts, and what is said to goals meanwhile."""

    def __init__(self) -> None:
        #: when the next process may be started
        self.due_at = 0.0
        #: why no process gets ready, while that is so: no goal waits for one then
        self.error: str | None = None
        self._failures = 0

    def died(self, now: float, *, age: float, had_goal: bool) -> None:
        """Plan the start after a process that had been ready; one that died over a goal costs no wait."""
        if had_goal or age > SHORT_LIFE:
            self._failures = 0
            self.due_at = now
        else:
            self._wait_longer(now)

    def failed(self, now: float, words: str, *, explained: bool) -> None:
        """Plan the start after a process that was never ready.

        A single one that died and nobody knows why is no reason to turn goals away: the next one may do.
        """
        first = self._failures == 0
        self._wait_longer(now)
        if explained or not first:
            self.error = words

    def _wait_longer(self, now: float) -> None:
        self.due_at = now + BACK_OFF[min(self._failures, len(BACK_OFF) - 1)]
        self._failures += 1
