"""When the next engine process may be started, and whether goals wait for it.

What may pass is waited out: no memory, no descriptors, a process that was killed in its start. What is known to stay
(no library, no such driver) ends each goal at once, until a process gets ready all the same.

Pure: the time comes in as an argument (monotonic seconds).
"""

from __future__ import annotations

#: Seconds before the next start, by the number of processes in a row that died before they were of use.
BACK_OFF = (0.0, 0.1, 0.5, 2.0, 10.0)

#: A ready process that dies sooner than this, with no goal in hand, was of no use.
SHORT_LIFE = 1.0

#: Seconds without a ready process after which each start that fails costs a goal: nobody waits for ever.
PATIENCE = 10.0


class Restarts:
    """The back-off between two starts, and what is said to goals meanwhile."""

    def __init__(self, now: float) -> None:
        #: when the next process may be started
        self.due_at = 0.0
        #: why the last start failed, where that is known to stay: no goal waits for another one then
        self.error: str | None = None
        self._failures = 0
        #: since when there has been no ready process
        self._missing_since = now

    def ready(self) -> None:
        """Take note that a process is ready."""
        self.error = None

    def died(self, now: float, *, age: float, had_goal: bool) -> None:
        """Plan the start after a process that had been ready; one that died over a goal costs no wait."""
        self._missing_since = now
        if had_goal or age > SHORT_LIFE:
            self._failures = 0
            self.due_at = now
        else:
            self._wait_longer(now)

    def failed(self, now: float, began: float, lasting: str | None) -> bool:
        """Plan the start after one that failed, begun at that time, and return whether it costs a goal.

        `lasting`: the cause in words, where it is known to stay.
        """
        self._wait_longer(now)
        self.error = lasting
        return lasting is None and began >= self._missing_since + PATIENCE

    def _wait_longer(self, now: float) -> None:
        self.due_at = now + BACK_OFF[min(self._failures, len(BACK_OFF) - 1)]
        self._failures += 1
