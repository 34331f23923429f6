"""The samples of one sentence that may still be needed, by their place in it, in bytes from its beginning.

It knows no player and no time. What was heard is forgotten, so that a text of minutes takes no more room than a word.
"""

from __future__ import annotations

from array import array

from talkcli.engine.players.base import SAMPLE

#: A sample no louder than this, of 32,768, is silence: it is 66 dB below the loudest. libespeak-ng adds 235 to 275 ms
#: of zeros behind a sentence; with a voice that has an echo ("f3") the last 100 ms or so are silence.
QUIET = 16


class Samples:
    """Samples, added at the end and forgotten from the beginning."""

    def __init__(self) -> None:
        self._kept = bytearray()
        #: whether there was any sound, or a word that should have made some
        self.speaks = False
        #: bytes that were forgotten
        self.begin = 0
        #: the end, and the most that was asked about, for which `_quiet` was found
        self._looked_at = (0, 0)
        self._quiet = 0

    @property
    def end(self) -> int:
        """Where the samples that there are so far end."""
        return self.begin + len(self._kept)

    def add(self, samples: bytes) -> None:
        """Add samples at the end."""
        self._kept += samples
        self.speaks = self.speaks or samples.count(0) != len(samples)

    def part(self, begin: int, end: int) -> memoryview:
        """Return the samples between two places. It must be released before more are added or forgotten."""
        return memoryview(self._kept)[begin - self.begin : end - self.begin]

    def forget(self, until: int) -> None:
        """Forget the samples before this place."""
        del self._kept[: until - self.begin]
        self.begin = until

    def quiet_end(self, most: int) -> int:
        """Return how many bytes at the end are silence, counting no more than `most`."""
        if self._looked_at != (self.end, most):
            self._looked_at = (self.end, most)
            self._quiet = self._count_quiet(most)
        return self._quiet

    def _count_quiet(self, most: int) -> int:
        last = array("h", bytes(self._kept[max(0, len(self._kept) - most) :]))
        loud = next((number for number, each in enumerate(reversed(last)) if abs(each) > QUIET), len(last))
        return loud * SAMPLE
