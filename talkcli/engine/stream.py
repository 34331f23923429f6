"""One player and the stream that it is fed: lead-in, samples, silence, in the order in which they are heard.

It counts what was written and taken and drives the word clock by that. It never waits, and it knows nothing of what the
samples are: which come next, and what a failure means, is the playback's to say.
"""

from __future__ import annotations

import select
import time

from talkcli.engine.players.base import PIECE, SAMPLE

TYPE_CHECKING = False
if TYPE_CHECKING:
    from talkcli.engine.clock import WordClock
    from talkcli.engine.players.base import Interest, Player

#: Seconds of sound that a player holds at least between taking and playing it: of the 60 ms it is asked for, aplay was
#: seen to hold 42 to 78, pacat 25 to 60.
PLAYER_HOLDS = 0.02


class Stream:
    """A player's stream; `begin` is the position in the sentence's audio, in seconds, at which it takes over."""

    def __init__(self, player: Player, rate: int, clock: WordClock, begin: float, lead_in: float) -> None:
        self.player = player
        #: bytes that are offered at once
        self.piece = int(PIECE * rate) * SAMPLE
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
        self._begin = begin
        self._lead_in = int(lead_in * rate) * SAMPLE if player.real_time else 0
        clock.begin(begin)

    @property
    def leading_in(self) -> bool:
        """Whether there is silence to be written before the first sample."""
        return self._lead_in > 0

    def lead_in(self) -> int:
        """Offer a piece of that silence; return the bytes that were taken."""
        taken = self._offer_silence(self._begin, self._lead_in)
        self._lead_in -= taken
        return taken

    def offer(self, samples: memoryview) -> int:
        """Offer samples, no more than a piece; return the bytes that were taken."""
        taken = self.player.offer(samples)
        if taken:
            self._wrote(taken)
        return taken

    def offer_silence(self, position: float) -> int:
        """Offer a piece of silence before that position of the audio; return the bytes that were taken."""
        return self._offer_silence(position, self.piece)

    def tick(self, now: float, last: bool) -> None:
        """Bring the clock up to date; `last` says that nothing more waits to be written."""
        consumed = self.player.consumed()
        if consumed > self.taken:
            if self.taken == 0:  # it has opened its device: the clock starts here, not with what waited in the pipe
                self._clock.start(now)
            self.taken = consumed
            if consumed >= self.written:  # one that nibbles would never be done
                self.progress_at = now
        if self.player.real_time and not (last and consumed >= self.written):
            self._clock.hold(now, max(0.0, self._seconds(consumed) - PLAYER_HOLDS))

    def ahead(self, now: float) -> float:
        """Return the seconds of its stream that were written and not heard yet."""
        return max(0.0, self.unheard(self.written, now))

    def unheard(self, mark: int, now: float) -> float:
        """Return the seconds until the stream up to that byte is heard; negative if it has been."""
        return self._seconds(mark) - self._clock.elapsed(now)

    def missing(self, now: float) -> float:
        """Return by how many seconds it would be too early for the stream to be over."""
        return self._first_write + self._seconds(self.written) - now

    def began_at(self, now: float) -> float:
        """Return when its stream began to be heard, or would have if the clock were exact."""
        return now - self._clock.elapsed(now)

    def over_at(self, now: float) -> float:
        """Return when all that was written is heard, or was."""
        return now + self.unheard(self.written, now)

    def interests(self, full: bool) -> list[Interest]:
        """Return what to poll for; where nothing is to be written, not for room to write."""
        return [each for each in self.player.interests() if not (full and each[1] == select.POLLOUT)]

    def _offer_silence(self, position: float, length: int) -> int:
        taken = self.player.offer(memoryview(self._zeros)[:length])
        if taken:
            self._wrote(taken)
            self._clock.insert(position, self._seconds(taken))
        return taken

    def _wrote(self, length: int) -> None:
        now = time.monotonic()
        if self.written == 0:
            self._first_write = now
            self._clock.start(now)
        self.written += length
        self.progress_at = now

    def _seconds(self, length: int) -> float:
        return length / (self._rate * SAMPLE)
