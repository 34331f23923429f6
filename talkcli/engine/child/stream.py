"""The samples of a sentence, and the stream that one player is fed: lead-in, samples, silence, as they are heard.

The stream counts what was written and taken and drives the word clock by that. It never waits, and it knows nothing of
what the samples are: which come next, and what a failure means, is the playback's to say.
"""

from __future__ import annotations

import time
from array import array

from talkcli.engine.players import PIECE_S, SAMPLE_BYTES

TYPE_CHECKING = False
if TYPE_CHECKING:
    from talkcli.engine.child.players.base import Player
    from talkcli.engine.child.words import WordClock

#: Seconds of sound that a player holds at least between taking and playing it: of the 60 ms it is asked for, aplay was
#: seen to hold 42 to 78, pacat 25 to 60.
PLAYER_HOLDS = 0.02

#: A sample no louder than this, of 32,768, is silence: it is 66 dB below the loudest. libespeak-ng adds 235 to 275 ms
#: of zeros behind a sentence; with a voice that has an echo ("f3") the last 100 ms or so are silence.
QUIET = 16


class Samples:
    """The samples of one sentence that may still be needed, by their place in it, in bytes from its beginning.

    Added at the end and forgotten from the beginning, when they were heard: so a text of minutes takes no more room
    than a word.
    """

    def __init__(self) -> None:
        self._kept = bytearray()
        #: whether there was any sound, or a word that should have made some
        self.speaks = False
        #: bytes that were forgotten
        self.begin = 0
        #: bytes at the end that are silence, forgotten ones included
        self._quiet = 0

    @property
    def end(self) -> int:
        """Where the samples that there are so far end."""
        return self.begin + len(self._kept)

    def add(self, samples: bytes) -> None:
        """Add samples at the end."""
        self._kept += samples
        self.speaks = self.speaks or samples.count(0) != len(samples)
        last = reversed(array("h", samples))
        loud = next((number for number, each in enumerate(last) if abs(each) > QUIET), None)
        self._quiet = self._quiet + len(samples) if loud is None else loud * SAMPLE_BYTES

    def zeros(self) -> int:
        """Return how many bytes at the beginning are zero samples."""
        return (len(self._kept) - len(self._kept.lstrip(b"\0"))) // SAMPLE_BYTES * SAMPLE_BYTES

    def part(self, begin: int, end: int) -> memoryview:
        """Return the samples between two places. It must be released before more are added or forgotten."""
        return memoryview(self._kept)[begin - self.begin : end - self.begin]

    def forget(self, until: int) -> None:
        """Forget the samples before this place."""
        del self._kept[: until - self.begin]
        self.begin = until

    def quiet_end(self, most: int) -> int:
        """Return how many bytes at the end are silence, counting no more than `most`."""
        return min(self._quiet, most, len(self._kept))


class Stream:
    """A player's stream; `begin` is the position in the sentence's audio, in seconds, at which it takes over."""

    def __init__(self, player: Player, rate: int, clock: WordClock, begin: float, lead_in: float) -> None:
        self.player = player
        #: bytes that are offered at once
        self.piece = int(PIECE_S * rate) * SAMPLE_BYTES
        #: bytes that the player has taken, by its own count, when it last grew; silence included, as in the next
        self.taken = 0
        #: bytes that were written to it
        self.written = 0
        #: when it last took a whole piece, or was given one
        self.progress_at = time.monotonic()
        self._rate = rate
        self._zeros = bytes(self.piece)
        self._clock = clock
        self._first_write = 0.0
        #: when all of it will have been heard
        self._over_at = 0.0
        #: bytes of silence that are to be written before the first sample
        self.lead_in = int(lead_in * rate) * SAMPLE_BYTES if player.real_time else 0
        self.begin(begin)

    def begin(self, position: float) -> None:
        """Take over at that position of the audio, before anything was written."""
        self._clock.begin(position)

    def offer(self, samples: memoryview) -> int:
        """Offer samples, no more than a piece; return the bytes that were taken."""
        taken = self.player.offer(samples)
        if taken:
            now = time.monotonic()
            if self.written == 0:
                self._first_write = now
                self._clock.start(now)
            self.written += taken
            self.progress_at = now
            self._over_at = now + self.ahead(now)
        return taken

    def offer_silence(self, position: float, most: int | None = None) -> int:
        """Offer a piece of silence before that position of the audio, no more than `most`; return the bytes taken."""
        taken = self.offer(memoryview(self._zeros)[:most])
        if taken:
            self._clock.insert(position, self._seconds(taken))
        return taken

    def tick(self, now: float, last: bool) -> None:
        """Bring the clock up to date; `last` says that nothing more waits to be written."""
        consumed = self.player.consumed()
        if consumed > self.taken:
            if self.taken == 0:  # it has opened its device: the clock starts here, not with what waited in the pipe
                self._clock.start(now)
            self.taken = consumed
            if consumed >= self.written:  # one that nibbles would never be done
                self.progress_at = now
        heard = self.player.heard()
        if heard is not None:
            self._clock.tell(now, heard)
        elif self.player.real_time and not (last and consumed >= self.written):
            self._clock.hold(now, max(0.0, self._seconds(consumed) - PLAYER_HOLDS))

    def ahead(self, now: float) -> float:
        """Return the seconds of its stream that were written and not heard yet."""
        return max(0.0, self.unheard(self.written, now))

    def unheard(self, mark: int, now: float) -> float:
        """Return the seconds until the stream up to that byte is heard; negative if it has been."""
        return self._seconds(mark) - self._clock.elapsed(now)

    def silent_for(self, now: float) -> float:
        """Return the seconds since all that was written has been heard; 0 before that."""
        if self.written == 0 or self.unheard(self.written, now) > PLAYER_HOLDS:
            return 0.0
        return max(0.0, now - self._over_at)

    def missing(self, now: float) -> float:
        """Return by how many seconds it would be too early for the stream to be over."""
        return self._first_write + self._seconds(self.written) - now

    def _seconds(self, length: int) -> float:
        return length / (self._rate * SAMPLE_BYTES)
