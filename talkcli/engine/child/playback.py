"""The playback of one sentence: it feeds a player, holds the sentence on request, and judges whether all was heard.

It only waits in `GoalRunner.wait`, where a stop or a hold can arrive, and tells the runner once the sentence is silent.
It knows nothing about synthesis or processes. A player reports what it takes, and the playback decides what that means.
`SentenceSamples` and `PlayerFeed` never wait.
"""

from __future__ import annotations

import select
import time
from array import array

from talkcli.engine.child.players.base import CannotEnd, CannotSpeak, Stopped
from talkcli.engine.child.words import TimedWord, WordClock
from talkcli.engine.players import PIECE_S, SAMPLE_BYTES
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.engine.child.players.base import Interest, Player
    from talkcli.engine.child.runner import GoalRunner

#: Limit for a player to take the first sound. A sleeping Bluetooth or USB device needs one or two seconds, and a null
#: sink that nobody records up to two.
FIRST_SOUND_LIMIT_S = 5.0

#: Longest time without any sound taken, after which a player has stalled. Healthy waits are below 0.04 s on a busy
#: machine, and up to 2 s on a null sink that nobody records.
STALL_LIMIT_S = 3.0

#: Interval for checking how much a player has taken. The start of a stall is known as exactly as this.
PROGRESS_CHECK_INTERVAL_S = 0.1

#: Time that a player may take beyond the rest of the audio to drain and end, for the same reasons.
DRAIN_LIMIT_S = 3.0

#: Most that a sentence may end before its audio does. Clocks of sound cards differ, and players cut trailing silence.
#: The pause at the end of a sentence is longer than this, so nothing audible can be missing.
EARLY_END_LIMIT_S = 0.25

#: Time for which a busy device is tried again, so that the sound of another program, or `talk doctor --silent`, doesn't
#: cost a sentence.
DEVICE_BUSY_LIMIT_S = 1.0
DEVICE_RETRY_INTERVAL_S = 0.05

#: Most zeros that can be left out before a sentence. libespeak-ng makes 0 to 11 ms. More silence is intended, as from a
#: voice with volume 0.
LEADING_ZEROS_LIMIT_S = 0.1

#: Limit for a killed player to be gone. It takes 1 ms unless the player hangs in a device driver.
PLAYER_KILL_LIMIT_S = 1.0

#: Limit for a held sentence to be silent. A player has 42 to 98 ms of sound left. A player that has more, or stands
#: still, is ended, and the sentence later goes on with another.
HOLD_SILENCE_LIMIT_S = 0.15

#: Most that the word clock may be ahead of what is heard. 4 to 8 ms were measured.
CLOCK_ERROR_S = 0.01

#: Longest silence within a sentence that doesn't count as a gap when its sound is not made in time. Clocks are no more
#: exact, and nobody hears it.
INAUDIBLE_GAP_S = 0.05

#: Sound that is repeated after a player had to be ended before all it held was heard, so that nothing is lost. The
#: clock is no more exact.
REPEATED_SOUND_S = 0.03

#: Length of a hold after which the player is released. Up to then, the next sample is heard at once after a short
#: question. After a longer hold, other programs can use the device, and it can sleep.
RELEASE_DELAY_S = 10.0

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


class _PlayerReleased(Exception):
    """The player was released because its sentence is held. The step is repeated with another player later."""


class Playback:
    """One sentence on its way to the player. The synthesizer writes to it.

    Every method may raise Stopped or CannotSpeak, except `stop` and `silence`, which the synthesizer doesn't call.
    """

    def __init__(self, runner: GoalRunner, on_word: Callable[[TimedWord], None]) -> None:
        """Prepare the playback. `on_word` is called with each word when it begins to be heard."""
        self._runner = runner
        self._players = runner.players
        self._wait = runner.wait
        self._on_word = on_word
        self._rate = 0
        #: functions that open the players not tried yet, best first; None to try all
        self._untried: Iterator[Callable[[], Player]] | None = None
        self._feed: PlayerFeed | None = None
        self._first_error: CannotSpeak | None = None
        self._clock = WordClock()
        #: all samples until a player is proven, then those not heard yet
        self._samples = SentenceSamples()
        self._complete = False  # whether no more samples will come
        self._begin = 0  # place of the first sample that this player got
        self._sent = 0  # place after the last sample that a player took
        self._began = False  # whether any sound is known to be heard
        self._stopped = False
        #: whether it is decided where the sound begins, and how many bytes of zeros before it are left out
        self._start_known = False
        self._left_out = 0
        #: monotonic time until which a busy device is tried again; 0 before it was found busy
        self._busy_until = 0.0
        #: whether the samples are made in another thread, and may be late
        self._made_elsewhere = False
        #: seconds of each audible gap in the sentence, caused by late samples
        self.gaps: list[float] = []
        #: since when the player of a held sentence has got nothing but silence
        self._silent_at: float | None = None

    # -- methods for the synthesizer

    def begin(self, rate: int, voice: str, fallback_reason: str | None = None) -> None:
        """Set the samples per second and the voice, and start a player.

        The player takes 1 to 15 ms to start, while the first samples are made. Its errors are raised by `write`.
        """
        if self._feed is not None and rate != self._rate:
            self._release_player(0)  # it was started for another rate
        self._rate = rate
        self._runner.report_voice(voice, fallback_reason)
        if self._players.takes_time and not self._runner.hold_number:
            try:
                self._with_player(lambda _: None)
            except CannotSpeak:
                self._untried = self._first_error = None

    def word(self, start: int, length: int, position: float) -> None:
        """Report this word when it is heard."""
        self._samples.audible = True
        self._clock.add(TimedWord(start, length, position))

    def write(self, samples: bytes) -> None:
        """Play samples. Return when the player has taken them, or at once as long as there is nothing audible."""
        self._samples.add(samples)
        self._wait((), 0.0)  # playing to a file never waits otherwise, and must be stoppable too
        self._check_stopped()
        if self._samples.audible and self._find_start():
            self._with_player(self._send_all)

    def wait(self, descriptor: int) -> None:
        """Play on until the descriptor is readable or something else has happened, while more samples are made.

        If the player runs out of sound in this time, that is no stall.
        """
        self._made_elsewhere = True
        more = (descriptor, select.POLLIN)
        if self._feed is not None:
            self._with_player(lambda feed: self._await_samples(feed, more))
            return
        self._await_continue()
        self._wait((more,), None)
        self._check_stopped()

    # -- methods for the driver

    def finish(self) -> float:
        """Play to the end and return the length in seconds. It only returns if everything was heard."""
        if not self._samples.audible:
            raise CannotSpeak(Reason.NOTHING_TO_SAY, "nothing in the text can be spoken")
        self._complete = self._start_known = True
        self._with_player(self._drain)
        self._report_words(self._clock.take_rest())
        if self._feed is not None:
            name, now = self._feed.player.name, time.monotonic()
            self._players.last_player = name
            self._players.handovers.sentence_ended(name, now + self._feed.time_left(self._feed.written, now))
        return self._seconds(self._sent - self._left_out)

    def stop(self) -> None:
        """Be silent now. Whatever waits raises Stopped."""
        self._stopped = True
        if self._feed is not None:
            self._feed.player.kill()

    def silence(self) -> None:
        """Release the player, and return when nothing can be heard any more.

        Raises:
            CannotEnd: the player could not be ended.
        """
        if self._feed is None:
            return
        player = self._feed.player
        if player.proven:
            self._players.update_output(player)
        player.kill()
        deadline = time.monotonic() + PLAYER_KILL_LIMIT_S
        while not player.gone():
            if time.monotonic() >= deadline:
                raise CannotEnd(f"{player.name} could not be ended within {PLAYER_KILL_LIMIT_S:g} s")
            self._wait((), time.monotonic() + PIECE_S)
        if player.real_time and player.proven:
            self._players.device_released(self._silent_at)
        self._feed = None

    # -- choosing a player

    def _with_player(self, step: Callable[[PlayerFeed], None]) -> None:
        """Take a step. If a player fails before it took any sound, or is released, repeat the step with the next."""
        while True:
            self._check_stopped()
            try:
                if self._feed is None:
                    self._await_continue()
                    if 0 < self._begin == self._samples.end:  # it was held at its very end
                        return
                    self._feed = self._open()
                step(self._feed)
                return
            except _PlayerReleased:
                pass
            except CannotSpeak as error:
                self._next_player(error)

    def _open(self) -> PlayerFeed:
        self._untried = self._untried or self._players.candidates(self._rate)
        player = next(self._untried)()
        self._sent = self._begin
        self._silent_at = None
        lead_in = self._players.lead_in_seconds(begins=self._begin == self._left_out)
        return PlayerFeed(player, self._rate, self._clock, self._seconds(self._begin), lead_in)

    def _next_player(self, error: CannotSpeak) -> None:
        """Give up this player. If there is no other or sound was taken, raise the first player's error."""
        feed = self._feed
        if feed is not None and feed.player.real_time and self._runner.hold_number:
            self._rewind(feed)  # the held sentence goes on with another player later, and fails then if there is none
            return
        first = self._first_error
        if first is None or first.reason == Reason.NO_PLAYER:  # a player that fails says more than a missing one
            first = self._first_error = error
        proven = feed is not None and feed.player.proven
        lost = proven or error.final or (feed is not None and error.reason == Reason.AUDIO_STALLED)
        others = list(self._untried or ())
        self._untried = iter(others) if others else None
        if lost or not (others or self._is_busy(first)):
            if feed is not None:
                self._players.update_output(feed.player)
            raise error if lost else first
        self.silence()
        if not others:
            self._wait((), time.monotonic() + DEVICE_RETRY_INTERVAL_S)

    def _is_busy(self, error: CannotSpeak) -> bool:
        """Return whether the device is busy and should be tried again."""
        if error.reason != Reason.AUDIO_DEVICE or "busy" not in str(error).lower():
            return False
        self._busy_until = self._busy_until or time.monotonic() + DEVICE_BUSY_LIMIT_S
        return time.monotonic() < self._busy_until

    def _release_player(self, begin: int) -> None:
        """End the player. Any player may go on from the place `begin`."""
        feed, self._begin, self._sent = self._feed, begin, begin
        if feed is not None and feed.player.proven:
            self._players.last_player = feed.player.name  # tried first again
        self._untried = self._first_error = None
        self.silence()

    def _rewind(self, feed: PlayerFeed) -> None:
        """End a player that holds sound that wasn't heard. The next player begins there."""
        feed.update(time.monotonic(), complete=False)
        self._release_player(self._unheard_begin() if feed.player.proven else self._begin)

    # -- steps

    def _send_all(self, feed: PlayerFeed) -> None:
        """Send all samples that there are to the player."""
        if feed.written == 0:
            feed.progress_at = time.monotonic()  # before that, it had nothing to take
        while True:
            if self._runner.hold_number:
                self._keep_silent(feed)
            if self._sent == self._audible_end(feed):
                self._update(feed)  # the next samples may take long
                return
            taken = self._offer(feed)
            self._update(feed)
            if taken:
                continue
            limit = FIRST_SOUND_LIMIT_S if feed.consumed == 0 else STALL_LIMIT_S
            due = feed.progress_at + limit if feed.player.real_time else None  # the reader of a file may take any time
            self._wait_for(feed, due)
            if due and time.monotonic() >= due and not self._runner.hold_number and not self._offer(feed):
                raise CannotSpeak(Reason.AUDIO_STALLED, f"{feed.player.name} took no sound for {limit:g} s")

    def _await_samples(self, feed: PlayerFeed, more: Interest) -> None:
        """Wait once for more samples, while the player plays what it has."""
        if self._runner.hold_number:
            self._keep_silent(feed)
        self._update(feed)
        feed.player.ended()  # raises if the player is gone, which would wake nobody later
        self._wait_for(feed, None, more)
        self._update(feed)
        feed.progress_at = time.monotonic()  # before that, it had nothing to take

    def _drain(self, feed: PlayerFeed) -> None:
        """Send the rest of the samples, close the player's input and wait for the end of the player."""
        self._send_all(feed)
        player = feed.player
        player.close()
        now = time.monotonic()
        deadline = now + feed.buffered(now) + DRAIN_LIMIT_S
        while not player.ended():
            self._update(feed)
            now = time.monotonic()
            # A player with less sound left ends as soon as it could be held.
            if self._runner.hold_number and feed.buffered(now) > HOLD_SILENCE_LIMIT_S:
                self._rewind(feed)
                raise _PlayerReleased
            if now >= deadline:
                raise CannotSpeak(
                    Reason.AUDIO_STALLED, f"{player.name} did not end {DRAIN_LIMIT_S:g} s after the sound"
                )
            self._wait_for(feed, deadline)
        missing = feed.missing(time.monotonic())
        if player.real_time and missing > EARLY_END_LIMIT_S - self._seconds(self._samples.end - self._sent):
            raise CannotSpeak(Reason.AUDIO_LOST, f"{player.name} ended {missing:.1f} s before the sound did")

    # -- samples

    def _find_start(self) -> bool:
        """Find where the sound begins, and return whether that is known yet.

        Zeros before it are left out, because nobody hears them. Zeros after another sentence belong to the pause
        between the two, and a file gets all samples.
        """
        if self._start_known:
            return True
        zeros = self._samples.leading_zeros()
        all_zeros = zeros == self._samples.end
        if all_zeros and self._seconds(zeros) < LEADING_ZEROS_LIMIT_S:
            return False
        self._start_known = True
        if not all_zeros and self._players.takes_time and not self._players.handovers.follows and self._sent == 0:
            self._left_out = self._begin = self._sent = zeros
            self._clock.skip_until(self._seconds(zeros))
            if self._feed is not None:
                self._clock.reset(self._seconds(zeros))
        return True

    def _offer(self, feed: PlayerFeed) -> int:
        """Offer a piece of the lead-in or of the samples to the player, and return how many bytes it took."""
        if feed.lead_in:
            taken = feed.offer_silence(self._seconds(self._begin), feed.lead_in)
            feed.lead_in -= taken
            return taken
        with self._samples.part(self._sent, min(self._audible_end(feed), self._sent + feed.piece_bytes)) as part:
            silent = feed.silent_for(time.monotonic())
            taken = feed.offer(part)
        if taken and silent > INAUDIBLE_GAP_S and self._made_elsewhere and feed.player.real_time:
            self.gaps.append(silent)
        self._sent += taken
        return taken

    def _audible_end(self, feed: PlayerFeed) -> int:
        """Return the end of the samples to play. Some silence is left out if a goal waits, or may still come."""
        if not feed.player.real_time or (self._complete and not self._players.handovers.next_waits):
            return self._samples.end
        limit = int(self._players.handovers.silence_to_cut(feed.player.name) * self._rate) * SAMPLE_BYTES
        return max(self._sent, self._samples.end - self._samples.trailing_silence(limit))

    def _update(self, feed: PlayerFeed) -> None:
        """Bring the clock up to date, report the words that have begun, and drop the samples that were heard."""
        now = time.monotonic()
        sent_all = self._complete and self._sent == self._audible_end(feed)
        feed.update(now, complete=sent_all and not self._runner.hold_number)
        player = feed.player
        if not player.proven:
            return
        self._players.update_output(player)
        if feed.consumed and not self._began:
            self._began = True
            self._players.handovers.sentence_started(
                player.name, now - self._clock.elapsed(now), neural=self._made_elsewhere
            )
        self._samples.drop_until(self._unheard_begin() if player.real_time else self._sent)
        self._report_words(self._clock.take_begun(now) if player.real_time else self._clock.take_rest())

    def _report_words(self, words: list[TimedWord]) -> None:
        """Report words, at their positions in the sound that is played."""
        for word in words:
            self._on_word(replace(word, position=word.position - self._seconds(self._left_out)))

    def _unheard_begin(self) -> int:
        """Return the place of the first of this player's samples that may not have been heard."""
        heard = self._clock.heard_position(time.monotonic()) - REPEATED_SOUND_S
        return min(self._sent, max(self._begin, self._samples.begin, int(max(0.0, heard) * self._rate) * SAMPLE_BYTES))

    def _seconds(self, length: int) -> float:
        return length / (self._rate * SAMPLE_BYTES)

    # -- holding

    def _keep_silent(self, feed: PlayerFeed) -> None:
        """Play silence while the sentence is held.

        Raises:
            _PlayerReleased: the player failed, or was held for too long.
        """
        if not feed.player.real_time:
            self._await_continue()
            return
        self._await_silence(feed)
        self._silent_at = time.monotonic()
        release_at = self._silent_at + RELEASE_DELAY_S
        while self._runner.hold_number:
            self._runner.confirm_hold()
            taken = 0
            try:
                taken = self._offer_silence(feed)
            except CannotSpeak:
                release_at = 0.0  # a failure during a hold is no reason to end the sentence
            due = min(release_at, feed.progress_at + STALL_LIMIT_S)
            if time.monotonic() >= due:
                self._release_player(self._sent)  # all that it held was heard
                raise _PlayerReleased
            if not taken:
                self._wait_for(feed, due)
        self._silent_at = None
        feed.progress_at = time.monotonic()

    def _await_silence(self, feed: PlayerFeed) -> None:
        """Wait until the player has played what it has of a held sentence, or the sentence goes on."""
        self._update(feed)
        written, now = feed.written, time.monotonic()
        deadline = now + HOLD_SILENCE_LIMIT_S
        too_late = feed.consumed == 0 or feed.time_left(written, now) > HOLD_SILENCE_LIMIT_S
        while self._runner.hold_number and (left := feed.time_left(written, now) + CLOCK_ERROR_S) > 0:
            if too_late or now >= deadline:
                self._rewind(feed)
                raise _PlayerReleased
            if not self._offer_silence(feed):
                self._wait_for(feed, min(deadline, now + left))
            self._update(feed)
            now = time.monotonic()

    def _offer_silence(self, feed: PlayerFeed) -> int:
        """Offer a piece of silence, unless the player has enough. Without this limit, some would take it endlessly."""
        feed.player.ended()  # raises if the player is gone
        taken = 0 if self._has_enough_silence(feed) else feed.offer_silence(self._seconds(self._sent))
        self._update(feed)
        return taken

    def _has_enough_silence(self, feed: PlayerFeed) -> bool:
        return bool(self._runner.hold_number) and feed.buffered(time.monotonic()) >= HOLD_SILENCE_LIMIT_S

    # -- waiting

    def _await_continue(self) -> None:
        """Wait without a player while the sentence is held."""
        while self._runner.hold_number:
            self._runner.confirm_hold()
            self._wait((), None)
            self._check_stopped()

    def _wait_for(self, feed: PlayerFeed, until: float | None, more: Interest | None = None) -> None:
        """Wait for the player or a monotonic time. With `more`, nothing is to be written, and wait for that too."""
        player, now = feed.player, time.monotonic()
        idle = more is not None or self._has_enough_silence(feed)
        moments = [until, now + PIECE_S if idle else player.wake_at()]
        moments.append(self._clock.next_word_at() if player.proven else None)
        if feed.consumed < feed.written:  # poll doesn't report that a player has taken only a part
            moments.append(now + PROGRESS_CHECK_INTERVAL_S)
        # If there is nothing to write, don't wait for room to write.
        interests = [each for each in player.interests() if not (idle and each[1] == select.POLLOUT)]
        interests += [] if more is None else [more]
        self._wait(interests, min((moment for moment in moments if moment is not None), default=None))
        self._check_stopped()

    def _check_stopped(self) -> None:
        if self._stopped:
            raise Stopped
