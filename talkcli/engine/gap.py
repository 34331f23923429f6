"""What lies between two sentences, and how much silence is left out at the end of the first for it.

A sentence ends in a pause of its own. Behind that its player drains and ends, the server is told, and the next one is
started: 25 to 40 ms by which a queue would be slower than it should sound. So where another goal waits, as much as the
last changes took is left out of the silence at the end, of samples that nobody can hear: the playback does so, in
`_audible_end`. A sentence that nothing follows is played to its last sample.

Pure: the time comes in as an argument (monotonic seconds). Nothing is guessed: until two sentences have followed each
other by the same player, nothing is left out.
"""

from __future__ import annotations

from collections import deque

#: Changes by which the next is judged, by their median: one that was late, on a busy machine, changes nothing.
REMEMBERED = 5

#: Seconds that are left out at most: half of a sentence's own pause stays on any machine, as it tells sentences apart.
MOST = 0.12

#: A change that took longer was none: the goal that had waited was recalled, or held, and another came later.
LONGEST = 0.5


class Gap:
    """How long it takes from one sentence to the next, by the players' names."""

    def __init__(self) -> None:
        #: whether another goal waits behind the one in hand
        self.followed = False
        self._took: dict[str, deque[float]] = {}
        #: the player of the sentence before, and when its last sample was to be heard; None if nothing waited behind it
        self._before: tuple[str, float] | None = None

    def allowance(self, player: str) -> float:
        """Return the seconds of silence that can be left out at the end of a sentence by this player."""
        took = sorted(self._took.get(player, ()))
        return min(MOST, took[len(took) // 2]) if took else 0.0

    def ended(self, player: str, over_at: float) -> None:
        """Take note that a sentence was played to its end, and when the last of its samples was to be heard."""
        self._before = (player, over_at) if self.followed else None

    def began(self, player: str, at: float) -> None:
        """Take note that a sentence begins, and when its player took the first of its samples."""
        before, self._before = self._before, None
        if before is not None and before[0] == player and 0 < at - before[1] < LONGEST:
            self._took.setdefault(player, deque(maxlen=REMEMBERED)).append(at - before[1])
