"""The samples of a sentence, and the stream of lead-in, samples and silence that one player is fed.

Nothing here waits. The playback decides which samples come next and what a failure means.
"""

from __future__ import annotations

import time
from array import array

from talkcli.engine.players import PIECE_S, SAMPLE_BYTES
from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from talkcli.engine.child.players.base import Player
    from talkcli.engine.child.words import WordClock

#: Least sound that a player holds between taking and playing it. Asked to hold 60 ms, aplay was seen to hold 42 to 78,
#: and pacat 25 to 60.
MIN_PLAYER_BUFFER_S = 0.02

#: Loudest sample that counts as silence, out of 32,768: 66 dB below the loudest. libespeak-ng adds 235 to 275 ms of
#: zeros at the end of a sentence. With a voice that has an echo ("f3"), about the last 100 ms are quiet.
MAX_QUIET_LEVEL = 16


class SentenceSamples:
    """The samples of one sentence that may still be needed.

    Places are in bytes from the beginning of the sentence. Samples are added at the end and dropped from the beginning
    once they were heard, so that a text of minutes takes no more memory than a word.
    """

    def __init__(self) -> None:
        self._kept = bytearray()
        #: whether there was any sound, or a word that should have made some
        self.audible = False
        #: place of the first sample that is kept
        self.begin = 0
        #: bytes of silence at the end, including dropped ones
        self._quiet = 0

    @property
    def end(self) -> int:
        """Place after the last sample so far."""
        return self.begin + len(self._kept)

    def add(self, samples: bytes) -> None:
        """Add samples at the end."""
        self._kept += samples
        self.audible = self.audible or samples.count(0) != len(samples)
        backwards = reversed(array("h", samples))
        quiet_count = next((count for count, each in enumerate(backwards) if abs(each) > MAX_QUIET_LEVEL), None)
        self._quiet = self._quiet + len(samples) if quiet_count is None else quiet_count * SAMPLE_BYTES

    def leading_zeros(self) -> int:
        """Return the number of bytes of zero samples at the beginning."""
        return (len(self._kept) - len(self._kept.lstrip(b"\0"))) // SAMPLE_BYTES * SAMPLE_BYTES

    def part(self, begin: int, end: int) -> memoryview:
        """Return the samples between two places. Release the view before adding or dropping samples."""
        return memoryview(self._kept)[begin - self.begin : end - self.begin]

    def drop_until(self, place: int) -> None:
        """Drop the samples before this place."""
        del self._kept[: place - self.begin]
        self.begin = place

    def trailing_silence(self, limit: int) -> int:
        """Return the number of bytes of silence at the end, but at most `limit`."""
        return min(self._quiet, limit, len(self._kept))


class PlayerFeed:
    """The stream of one player. It counts what was written and taken, and drives the word clock with that."""

    def __init__(self, player: Player, rate: int, clock: WordClock, begin: float, lead_in: float) -> None:
        """Begin the stream.

        Args:
            player: the player, which was just opened.
            rate: samples per second.
            clock: the word clock, which is reset.
            begin: position in the sentence's audio from which this player plays it, in seconds.
            lead_in: seconds of silence before the first sample.
        """
        self.player = player
        #: most bytes to offer at once
        self.piece_bytes = int(PIECE_S * rate) * SAMPLE_BYTES
        #: bytes that the player had consumed by the last look, including silence
        self.consumed = 0
        #: bytes that were written to it, including silence
        self.written = 0
        #: when it last took samples or consumed all that it had; from then on a stall is measured
        self.progress_at = time.monotonic()
        self._rate = rate
        self._zeros = bytes(self.piece_bytes)
        self._clock = clock
        self._first_write_at = 0.0
        #: when all that was written will have been heard
        self._heard_at = 0.0
        #: bytes of silence that are still to be written before the first sample
        self.lead_in = int(lead_in * rate) * SAMPLE_BYTES if player.real_time else 0
        clock.reset(begin)

    def offer(self, samples: memoryview) -> int:
        """Offer at most `piece_bytes` of samples to the player, and return how many bytes it took."""
        taken = self.player.offer(samples)
        if taken:
            now = time.monotonic()
            if self.written == 0:
                self._first_write_at = now
                self._clock.start(now)
            self.written += taken
            self.progress_at = now
            self._heard_at = now + self.buffered(now)
        return taken

    def offer_silence(self, position: float, limit: int | None = None) -> int:
        """Offer a piece of silence, at most `limit` bytes, and return how many bytes the player took.

        `position` is the position in the audio of the sample that follows.
        """
        taken = self.offer(memoryview(self._zeros)[:limit])
        if taken:
            self._clock.add_silence(position, self._seconds(taken))
        return taken

    def update(self, now: float, *, complete: bool) -> None:
        """Bring the clock up to date. `complete` means that nothing more will be written."""
        consumed = self.player.consumed()
        if consumed > self.consumed:
            if self.consumed == 0:  # the player has opened its device; before that, samples waited in its pipe
                self._clock.start(now)
            self.consumed = consumed
            if consumed >= self.written:  # a player that takes a few bytes at a time makes no progress
                self.progress_at = now
        heard = self.player.heard()
        if heard is not None:
            self._clock.set_elapsed(now, heard)
        elif self.player.real_time and not (complete and consumed >= self.written):
            self._clock.limit_elapsed(now, max(0.0, self._seconds(consumed) - MIN_PLAYER_BUFFER_S))

    def buffered(self, now: float) -> float:
        """Return the seconds of sound that were written but not heard yet."""
        return max(0.0, self.time_left(self.written, now))

    def time_left(self, written: int, now: float) -> float:
        """Return the seconds until this byte of the stream is heard. Negative if it was heard already."""
        return self._seconds(written) - self._clock.elapsed(now)

    def silent_for(self, now: float) -> float:
        """Return the seconds since all that was written was heard; 0 before that."""
        if self.written == 0 or self.time_left(self.written, now) > MIN_PLAYER_BUFFER_S:
            return 0.0
        return max(0.0, now - self._heard_at)

    def missing(self, now: float) -> float:
        """Return how many seconds too early the player would end if it ended now."""
        return self._first_write_at + self._seconds(self.written) - now

    def _seconds(self, length: int) -> float:
        return length / (self._rate * SAMPLE_BYTES)
