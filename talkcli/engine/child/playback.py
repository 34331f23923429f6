"""Playback of one sentence, including pauses.

`Playback` waits only in `GoalRunner.wait`, so that a `Stop` or a `Hold` can arrive at any time. `SentenceSamples` and
`PlayerFeed` never wait. Nothing here depends on how the samples are synthesized or which kind of player plays them.
"""

from __future__ import annotations

import select
import time
from array import array

from talkcli.engine.child.players.base import CannotKillPlayer, CannotSpeak, EndedEarly, Stopped
from talkcli.engine.child.words import TimedWord, WordClock
from talkcli.engine.players import PIECE_S, SAMPLE_BYTES
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.reasons import Reason
from talkcli.polling import NEVER

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from talkcli.engine.child.players.base import Interest, Player
    from talkcli.engine.child.runner import GoalRunner
    from talkcli.engine.pronunciation import SpokenText

#: Time allowed for a player to play its first sound. A sleeping Bluetooth or USB device needs one to two seconds, and a
#: null sink that isn't being recorded needs up to two.
FIRST_SOUND_LIMIT_S = 5.0

#: A player counts as stalled if it accepts no samples for this long. Normally, a player accepts samples within 0.04 s,
#: even on a busy machine. A null sink that isn't being recorded may take 2 s.
STALL_LIMIT_S = 3.0

#: How often to check how much a player has consumed. Stalls are detected with the same precision.
PROGRESS_CHECK_INTERVAL_S = 0.1

#: Time allowed for a player to exit after the end of the audio. It covers the same delays as `STALL_LIMIT_S`.
DRAIN_LIMIT_S = 3.0

#: How long before the calculated time a player may finish. Sound cards have inexact clocks, and players cut off silence
#: at the end. The silence at the end of a sentence is longer than this, so nothing audible is missing.
EARLY_END_LIMIT_S = 0.25

#: How long to keep trying to open a busy device. Another program, such as `talk doctor --silent`, may be using it only
#: briefly.
DEVICE_BUSY_LIMIT_S = 1.0
DEVICE_RETRY_INTERVAL_S = 0.05

#: Maximum duration of the zero samples to skip at the beginning of a sentence. libespeak-ng produces 0 to 11 ms of
#: zeros. Longer silence is intentional, for example at volume 0.
LEADING_ZEROS_LIMIT_S = 0.1

#: Time allowed for a killed player to exit. It usually takes 1 ms, unless the player hangs in a device driver.
PLAYER_KILL_LIMIT_S = 1.0

#: Time allowed for a paused sentence to become silent. Players usually have 42 to 98 ms of sound buffered. A player
#: that has buffered more or has stalled is killed, and a new player continues the sentence later.
HOLD_SILENCE_LIMIT_S = 0.15

#: How far the word clock may run ahead of the sound. Measurements show 4 to 8 ms.
CLOCK_ERROR_S = 0.01

#: The minimum length of a silence that counts as a gap. A shorter silence is inaudible, and the clock can't measure it
#: precisely.
INAUDIBLE_GAP_S = 0.05

#: How much sound to repeat after a player was killed with sound in its buffer. The clock isn't exact, so some sound
#: could otherwise be lost.
REPEATED_SOUND_S = 0.03

#: The player is released if a pause lasts longer than this, so that other programs can use the device and the device
#: can sleep. After a shorter pause, the sentence continues immediately.
RELEASE_DELAY_S = 10.0

#: Minimum amount of sound in a player's buffer while it plays. With a buffer of 60 ms, aplay was measured to hold 42 to
#: 78 ms, and pacat 25 to 60 ms.
MIN_PLAYER_BUFFER_S = 0.02

#: Length of the fade at the end of an interrupted word. Without it, a click would be heard.
FADE_S = 0.005

#: Samples up to this absolute value count as silence. This is 66 dB below the loudest possible sample (32,768).
#: libespeak-ng ends a sentence with 235 to 275 ms of zeros. If the voice has an echo ("f3"), the last 100 ms or so are
#: quiet, but not zero.
MAX_QUIET_LEVEL = 16


class SentenceSamples:
    """A buffer for the samples of one sentence.

    Offsets are in bytes from the beginning of the sentence. Samples are added at the end, and dropped from the front
    after they were heard. A long text therefore takes no more memory than a short one.
    """

    def __init__(self) -> None:
        self._kept = bytearray()
        #: whether any sound or word has been added so far
        self.audible = False
        #: offset of the first sample in the buffer
        self.begin = 0
        #: number of bytes of silence at the end, including samples already dropped
        self._quiet = 0

    @property
    def end(self) -> int:
        """The offset just after the last sample."""
        return self.begin + len(self._kept)

    def add(self, samples: bytes) -> None:
        """Append samples to the buffer."""
        self._kept += samples
        self.audible = self.audible or samples.count(0) != len(samples)
        backwards = reversed(array("h", samples))
        quiet_count = next((count for count, each in enumerate(backwards) if abs(each) > MAX_QUIET_LEVEL), None)
        self._quiet = self._quiet + len(samples) if quiet_count is None else quiet_count * SAMPLE_BYTES

    def leading_zeros(self) -> int:
        """Return the number of zero bytes at the start of the buffer."""
        return (len(self._kept) - len(self._kept.lstrip(b"\0"))) // SAMPLE_BYTES * SAMPLE_BYTES

    def view(self, begin: int, end: int) -> memoryview:
        """Return a view of the samples between two offsets.

        Release it before adding or dropping samples.
        """
        return memoryview(self._kept)[begin - self.begin : end - self.begin]

    def end_at(self, offset: int, fade_begin: int) -> None:
        """Drop the samples after an offset, and fade out those between `fade_begin` and the offset."""
        faded = array("h", bytes(self.view(fade_begin, offset)))
        count = len(faded)
        faded = array("h", (int(each * (count - 1 - at) / count) for at, each in enumerate(faded)))
        del self._kept[fade_begin - self.begin :]
        self._quiet = 0
        self.add(faded.tobytes())

    def drop_until(self, offset: int) -> None:
        """Drop the samples before this offset."""
        del self._kept[: offset - self.begin]
        self.begin = offset

    def trailing_silence(self, max_bytes: int) -> int:
        """Return the number of silent bytes at the end of the buffer, up to `max_bytes`."""
        return min(self._quiet, max_bytes, len(self._kept))


class PlayerFeed:
    """Sends samples to one player, and keeps the word clock in step with the player."""

    def __init__(self, player: Player, rate: int, clock: WordClock, begin: float, lead_in: float) -> None:
        """Start a stream, and reset the word clock.

        Args:
            player: the player, which was just opened.
            rate: samples per second.
            clock: the word clock.
            begin: position in the sentence's audio at which the stream begins, in seconds.
            lead_in: seconds of silence to play first.
        """
        self.player = player
        #: maximum number of bytes to offer at once
        self.piece_bytes = int(PIECE_S * rate) * SAMPLE_BYTES
        #: number of bytes consumed at the last check, including silence
        self.consumed = 0
        #: number of bytes written to the player, including silence
        self.written = 0
        #: time at which the player last made progress
        self.progress_at = time.monotonic()
        self._rate = rate
        self._clock = clock
        #: time at which the stream began. Each wait for missing text moves this time forward by the length of the wait.
        self.began_at = 0.0
        #: time at which all written samples will have been heard
        self._heard_at = 0.0
        #: bytes of silence to write before the first sample
        self.lead_in = int(lead_in * rate) * SAMPLE_BYTES if player.real_time else 0
        clock.reset(begin)

    def offer(self, samples: memoryview) -> int:
        """Offer samples to the player and record its progress. Return the number of bytes accepted.

        The first samples start the clock.
        """
        taken = self.player.offer(samples)
        if taken:
            now = time.monotonic()
            if self.written == 0:
                self.began_at = now
                self._clock.start(now)
            self.written += taken
            self.progress_at = now
            self._heard_at = now + self.buffered(now)
        return taken

    def offer_silence(self, audio_position: float, max_bytes: int | None = None) -> int:
        """Offer silence to play before the next sample. Return the number of bytes accepted.

        Args:
            audio_position: position of that sample in the audio, in seconds.
            max_bytes: maximum number of bytes to offer, or None for a whole piece.
        """
        taken = self.offer(memoryview(bytes(self.piece_bytes))[:max_bytes])
        if taken:
            self._clock.add_silence(audio_position, self._seconds(taken))
        return taken

    def record_progress(self, now: float, *, all_written: bool) -> None:
        """Record how much the player has consumed, and adjust the word clock to its progress.

        Set `all_written` if nothing more will be written.
        """
        consumed = self.player.consumed()
        if consumed > self.consumed:
            if self.consumed == 0:  # until the device is open, samples wait in the player's pipe
                self._clock.start(now)
            self.consumed = consumed
            if consumed >= self.written:  # consuming a few bytes now and then doesn't count as progress
                self.progress_at = now
        heard = self.player.heard()
        if heard is not None:
            self._clock.set_elapsed(now, heard)
        elif self.player.real_time and not (all_written and consumed >= self.written):
            self._clock.limit_elapsed(now, max(0.0, self._seconds(consumed) - MIN_PLAYER_BUFFER_S))

    def buffered(self, now: float) -> float:
        """Return how many seconds of sound have been written but not heard yet."""
        return max(0.0, self.time_left(self.written, now))

    def time_left(self, byte_count: int, now: float) -> float:
        """Return how many seconds remain until the stream's first `byte_count` bytes have been heard.

        The result is negative if they have already been heard.
        """
        return self._seconds(byte_count) - self._clock.elapsed(now)

    def silent_for(self, now: float) -> float:
        """Return how many seconds the player has been without sound to play."""
        if self.written == 0 or self.time_left(self.written, now) > MIN_PLAYER_BUFFER_S:
            return 0.0
        return max(0.0, now - self._heard_at)

    def unplayed_seconds(self, now: float) -> float:
        """Return how many seconds of audio would be lost if the player ended now."""
        return self.began_at + self._seconds(self.written) - now

    def _seconds(self, byte_count: int) -> float:
        """Return the duration of this many bytes of samples."""
        return byte_count / (self._rate * SAMPLE_BYTES)


class _PlayerReleased(Exception):
    """Raised if the player was released during a pause.

    After the pause, a new player repeats the current step.
    """


class Playback:
    """Plays one sentence from the samples of a synthesizer.

    All public methods except `stop` and `release_player` may raise Stopped or CannotSpeak.
    """

    def __init__(self, runner: GoalRunner, on_word: Callable[[TimedWord], None]) -> None:
        """Create a playback without opening a player.

        Args:
            runner: the runner of the current goal.
            on_word: called with each word when the word starts to be heard.
        """
        self._runner = runner
        self._players = runner.players
        self._on_word = on_word
        self._rate = 0
        #: functions that open the remaining players, best first; None means all players
        self._untried: Iterator[Callable[[], Player]] | None = None
        self._feed: PlayerFeed | None = None
        self._first_error: CannotSpeak | None = None
        self._clock = WordClock()
        #: all samples of the sentence; once the player is known to work, only those not heard yet
        self._samples = SentenceSamples()
        self._complete = False  # whether all samples were written
        self._begin = 0  # offset of the current player's first sample
        self._sent = 0  # offset after the last sample accepted by the player
        self._stopped = False
        #: whether `_skipped` is final
        self._start_known = False
        #: number of bytes of zero samples skipped at the beginning
        self._skipped = 0
        #: monotonic time at which to stop retrying a busy device; 0 if no device was busy
        self._busy_until = 0.0
        #: whether another thread synthesizes the samples, which may then arrive late
        self._in_background = False
        #: whether the player may have run out of samples because text was missing. Such a silence doesn't count as a
        #: gap.
        self._text_was_missing = False
        #: the part of the text that is being synthesized
        self._part: SpokenText | None = None
        #: offset in the samples at which the part begins
        self._part_begin = 0
        #: whether another part may follow. That part can be synthesized during the pause after the current one.
        self._part_follows = False
        #: lengths in seconds of the gaps caused by late samples
        self.gaps: list[float] = []
        #: time at which the player began to play silence during a pause
        self._silent_at: float | None = None
        #: seconds of the sentence that were heard; None until the sentence has ended or was stopped
        self._heard: float | None = None

    # -- methods for the synthesizer

    def begin(self, rate: int, voice: str, fallback_reason: str | None = None) -> None:
        """Set the sample rate, report the voice, and start a player unless speech is paused.

        A player that writes to a file is started later. Any other player starts in 1 to 15 ms, while the synthesizer
        produces the first samples. `write` raises its errors.

        Args:
            rate: samples per second.
            voice: ID of the voice that speaks.
            fallback_reason: human-readable reason for a fallback voice, or None for the requested voice.
        """
        if self._feed is not None and rate != self._rate:
            self._release_and_continue_at(0)  # the player was started with a different sample rate
        self._rate = rate
        self._runner.report_voice(voice, fallback_reason)
        if self._players.takes_time and not self._runner.hold_number:
            try:
                self._with_player(lambda _: None)
            except CannotSpeak:
                self._untried = self._first_error = None

    def begin_sound(self, rate: int) -> None:
        """Begin a sound instead of speech. Silence at the beginning of the sound is not skipped."""
        self._samples.audible = self._start_known = True
        self.begin(rate, "")

    def word(self, start: int, length: int, audio_start: float) -> None:
        """If a word is new, schedule it to be reported when it is heard.

        Args:
            start: offset of the word in the current part of the text, as it is said.
            length: number of characters.
            audio_start: start of the word in the audio of this part, in seconds.
        """
        self._samples.audible = True
        located = self._part.locate(start, length) if self._part else (start, length)
        if found := self._runner.find_word(*located):
            self._clock.add(TimedWord(*found, self._seconds(self._part_begin) + audio_start))

    def write(self, samples: bytes) -> None:
        """Send samples except silence at the end, and wait until the player has accepted them.

        If all samples so far are silent, they are stored until the first sound follows.
        """
        self._samples.add(samples)
        self._wait(until=0.0)  # check for a stop here, because writing to a file never waits
        if self._samples.audible and self._skip_leading_zeros():
            self._with_player(self._send_all)

    def wait(self, descriptor: int) -> None:
        """Keep playing until the descriptor is readable. This method may return early.

        If the player runs out of samples in the meantime, it doesn't count as stalled.
        """
        self._in_background = True
        self._keep_playing([(descriptor, select.POLLIN)])

    # -- methods for the driver

    def begin_part(self, part: SpokenText, *, is_last: bool) -> None:
        """Begin a new part of the text. The next samples belong to this part."""
        self._part, self._part_begin, self._part_follows = part, self._samples.end, not is_last

    def buffered(self) -> float:
        """Return how many seconds of synthesized sound are still to be played.

        The result is 0 if the sound goes into a file.
        """
        if self._feed is None or not self._feed.player.real_time:
            return 0.0
        unsent = self._seconds(self._sendable_end(self._feed) - self._sent)  # silence that is held back doesn't count
        # The clock doesn't count the last milliseconds as heard until all samples have been sent.
        return max(0.0, self._feed.buffered(time.monotonic()) + unsent - MIN_PLAYER_BUFFER_S)

    def await_text(self, until: float) -> None:
        """Keep playing while waiting for more text, but not after the time `until`."""
        self._text_was_missing = True
        self._keep_playing(until=until)

    def finish(self) -> float:
        """Play all samples to their end. Return their length in seconds.

        If any part of the sentence wasn't heard, this method raises CannotSpeak.
        """
        if not self._samples.audible:
            raise CannotSpeak(Reason.NOTHING_TO_SAY, "nothing in the text can be spoken")
        self._complete = self._start_known = True
        self._with_player(self._drain)
        self._report_words(self._clock.pop_all())
        if self._feed is not None:
            feed, now = self._feed, time.monotonic()
            self._players.handovers.sentence_ended(feed.player.name, now + feed.time_left(feed.written, now))
        self._heard = self._seconds(self._sent - self._skipped)
        return self._heard

    @property
    def started(self) -> bool:
        """Whether any samples of the sentence were sent to a player."""
        return self._sent > self._skipped

    def heard(self) -> float:
        """Return how many seconds of the sentence were heard or written to a file."""
        if self._heard is not None:
            return self._heard
        if not self._rate:
            return 0.0
        position = self._seconds(self._sent)
        if self._feed is not None and self._feed.player.real_time:
            position = min(position, self._clock.heard_seconds(time.monotonic()))
        return max(0.0, position - self._seconds(self._skipped))

    def stop(self) -> None:
        """Stop playing at once. The method that is currently running raises Stopped."""
        self._heard = self.heard()
        self._stopped = True
        if self._feed is not None:
            self._feed.player.kill()

    def release_player(self) -> None:
        """Kill the player, and wait until it is silent and has released its resources.

        Raises:
            CannotKillPlayer: the player has not exited in time.
        """
        if self._feed is None:
            return
        player = self._feed.player
        if player.proven:
            self._players.record_output(player)
        player.kill()
        deadline = time.monotonic() + PLAYER_KILL_LIMIT_S
        while not player.gone():
            if time.monotonic() >= deadline:
                raise CannotKillPlayer(f"{player.name} could not be stopped within {PLAYER_KILL_LIMIT_S:g} s")
            self._runner.wait(until=time.monotonic() + PIECE_S)
        if player.real_time and player.proven:
            self._players.silent_since = self._silent_at or time.monotonic()
        self._feed = None

    # -- choosing a player

    def _with_player(self, step: Callable[[PlayerFeed], None]) -> None:
        """Call `step` with the current player's feed. If that player fails, try the next one.

        The next player is tried only if no sound was heard yet, or if the sentence is paused. If the player was
        released during a pause, a new one is opened.
        """
        while True:
            self._raise_if_ended()
            try:
                if self._feed is None:
                    self._wait_for_continue()
                    if 0 < self._begin == self._samples.end:  # the sentence was paused at its very end
                        return
                    self._feed = self._open_next_player()
                step(self._feed)
                return
            except _PlayerReleased:
                pass
            except CannotSpeak as error:
                self._release_failed_player(error)

    def _open_next_player(self) -> PlayerFeed:
        """Open the next player, and return a feed that starts at the first unheard sample."""
        self._untried = self._untried or self._players.candidates(self._rate)
        player = next(self._untried)()
        self._sent = self._begin
        self._silent_at = None
        lead_in = self._players.lead_in_seconds(at_beginning=self._begin == self._skipped)
        return PlayerFeed(player, self._rate, self._clock, self._seconds(self._begin), lead_in)

    def _release_failed_player(self, error: CannotSpeak) -> None:
        """Release the failed player, so that another can replace it. If there is none, raise an error.

        There is no replacement if some of the sound may have been heard, or if no other player is left.
        """
        feed = self._feed
        if feed is not None and feed.player.real_time and self._runner.hold_number:
            self._release_and_rewind(feed)  # another player continues the sentence after the pause
            return
        first = self._first_error
        if first is None or first.reason == Reason.NO_PLAYER:  # prefer any other error to NO_PLAYER
            first = self._first_error = error
        lost = error.final or error.reason == Reason.AUDIO_STALLED or (feed is not None and feed.player.proven)
        others = list(self._untried or ())
        self._untried = iter(others) if others else None
        if lost or not (others or self._may_retry_busy_device(first)):
            if feed is not None:
                self._players.record_output(feed.player)
            raise error if lost else first
        self.release_player()
        if not others:
            self._wait(until=time.monotonic() + DEVICE_RETRY_INTERVAL_S)

    def _may_retry_busy_device(self, error: CannotSpeak) -> bool:
        """Return whether to retry a busy device. The first call starts the time limit."""
        if error.reason != Reason.AUDIO_DEVICE or "busy" not in str(error).lower():
            return False
        self._busy_until = self._busy_until or time.monotonic() + DEVICE_BUSY_LIMIT_S
        return time.monotonic() < self._busy_until

    def _release_and_continue_at(self, offset: int) -> None:
        """Kill the player. The best available player will continue the sentence at this offset."""
        self._begin = self._sent = offset
        self._untried = self._first_error = None
        self.release_player()

    def _release_and_rewind(self, feed: PlayerFeed) -> None:
        """Kill a player. Rewind the sentence to the first sound that was perhaps not heard."""
        feed.record_progress(time.monotonic(), all_written=False)
        self._release_and_continue_at(self._find_unheard_offset() if feed.player.proven else self._begin)

    # -- steps

    def _send_all(self, feed: PlayerFeed) -> None:
        """Send all samples except silence at the end, and wait until the player has accepted them.

        Play silence during a pause.
        """
        if feed.written == 0:
            feed.progress_at = time.monotonic()  # until now, the player had nothing to play
        while True:
            if self._runner.hold_number:
                self._keep_silent(feed)
            if self._sent == self._sendable_end(feed) or (self._part_follows and self._only_silence_is_unsent()):
                self._update_progress(feed)  # the next samples may not arrive for a long time
                return
            taken = self._offer_next(feed)
            self._update_progress(feed)
            if taken:
                continue
            limit = FIRST_SOUND_LIMIT_S if feed.consumed == 0 else STALL_LIMIT_S
            due = feed.progress_at + limit if feed.player.real_time else NEVER  # the reader of a pipe may be slow
            self._wait_for_player(feed, due)
            if time.monotonic() >= due and not self._runner.hold_number and not self._offer_next(feed):
                raise CannotSpeak(Reason.AUDIO_STALLED, f"{feed.player.name} accepted no sound for {limit:g} s")

    def _offer_and_wait(self, feed: PlayerFeed, interests: Sequence[Interest], until: float) -> None:
        """Offer unsent samples. Then wait once for the player, a descriptor or the time limit.

        This is called while the next samples or more text are late, so the player doesn't count as stalled. If the
        sentence is paused, the method first plays silence until the pause ends.
        """
        if self._runner.hold_number:
            self._keep_silent(feed)
        feed.player.ended()  # check for a failure here, because the wait below doesn't report it
        if self._sent < self._sendable_end(feed):
            self._offer_next(feed)
        self._wait_for_player(feed, until, interests, has_samples=self._sent < self._sendable_end(feed))
        self._update_progress(feed)
        feed.progress_at = time.monotonic()  # until now, the player had nothing to play

    def _drain(self, feed: PlayerFeed) -> None:
        """Send the remaining samples, and wait until the player has finished."""
        self._send_all(feed)
        player = feed.player
        player.close()
        now = time.monotonic()
        deadline = now + feed.buffered(now) + DRAIN_LIMIT_S
        while not player.ended():
            self._update_progress(feed)
            now = time.monotonic()
            # If little sound is left, let the player finish instead of killing it for a pause.
            if self._runner.hold_number and feed.buffered(now) > HOLD_SILENCE_LIMIT_S:
                self._release_and_rewind(feed)
                raise _PlayerReleased
            if now >= deadline:
                message = f"{player.name} did not exit within {DRAIN_LIMIT_S:g} s after the sound"
                raise CannotSpeak(Reason.AUDIO_STALLED, message)
            self._wait_for_player(feed, deadline)
        missing = feed.unplayed_seconds(time.monotonic())
        if player.real_time and missing > EARLY_END_LIMIT_S - self._seconds(self._samples.end - self._sent):
            raise CannotSpeak(Reason.AUDIO_LOST, f"{player.name} ended {missing:.1f} s before the end of the sound")

    # -- samples

    def _skip_leading_zeros(self) -> bool:
        """Skip zeros that would delay the first sound. Return False if more samples are needed first.

        Zeros before the first sound are skipped, so that the sentence is heard earlier. They are kept in a file. They
        are also kept after another sentence, because they are part of the silence between the two sentences.
        """
        if self._start_known:
            return True
        zeros = self._samples.leading_zeros()
        all_zeros = zeros == self._samples.end
        if all_zeros and self._seconds(zeros) < LEADING_ZEROS_LIMIT_S:
            return False
        self._start_known = True
        if not all_zeros and self._players.takes_time and not self._players.handovers.goal_was_waiting:
            self._skipped = self._begin = self._sent = zeros
            self._clock.delay_words_until(self._seconds(zeros))
            self._clock.reset(self._seconds(zeros))
        return True

    def _offer_next(self, feed: PlayerFeed) -> int:
        """Offer initial silence or the next samples to the player. Return the number of bytes accepted."""
        if feed.lead_in:
            taken = feed.offer_silence(self._seconds(self._begin), feed.lead_in)
            feed.lead_in -= taken
            return taken
        with self._samples.view(self._sent, min(self._sendable_end(feed), self._sent + feed.piece_bytes)) as piece:
            silent, was_playing = feed.silent_for(time.monotonic()), feed.player.real_time and feed.player.proven
            taken = feed.offer(piece)
        if taken and self._text_was_missing:
            self._text_was_missing = False
            feed.began_at += silent
        elif taken and self._in_background and was_playing and silent > INAUDIBLE_GAP_S:
            self.gaps.append(silent)
        self._sent += taken
        return taken

    def _only_silence_is_unsent(self) -> bool:
        """Return whether all unsent samples are silent."""
        unsent = self._samples.end - self._sent
        return self._samples.trailing_silence(unsent) == unsent

    def _sendable_end(self, feed: PlayerFeed) -> int:
        """Return the offset up to which samples may be sent now.

        Silence at the end is held back, because it is shortened if another goal is waiting.
        """
        if not feed.player.real_time or (self._complete and not self._players.handovers.next_waits):
            return self._samples.end
        limit = int(self._players.handovers.silence_to_cut(feed.player.name) * self._rate) * SAMPLE_BYTES
        return max(self._sent, self._samples.end - self._samples.trailing_silence(limit))

    def _update_progress(self, feed: PlayerFeed) -> None:
        """Adjust the clock to the player's progress, drop heard samples, and report started words."""
        now = time.monotonic()
        sent_all = self._complete and self._sent == self._sendable_end(feed)
        feed.record_progress(now, all_written=sent_all and not self._runner.hold_number)
        player = feed.player
        if not player.proven:
            return
        self._players.record_output(player)
        if feed.consumed:
            began_at = now - self._clock.elapsed(now)
            self._players.handovers.sentence_started(player.name, began_at, neural=self._in_background)
        self._samples.drop_until(self._find_unheard_offset() if player.real_time else self._sent)
        self._report_words(self._clock.pop_started(now) if player.real_time else self._clock.pop_all())

    def _report_words(self, words: list[TimedWord]) -> None:
        """Report words with positions relative to the first sample played."""
        for word in words:
            self._on_word(replace(word, position=word.position - self._seconds(self._skipped)))

    def _find_unheard_offset(self) -> int:
        """Return the byte offset in the sentence of the first sound that was perhaps not heard."""
        heard = self._clock.heard_seconds(time.monotonic()) - REPEATED_SOUND_S
        return min(self._sent, max(self._begin, self._samples.begin, int(max(0.0, heard) * self._rate) * SAMPLE_BYTES))

    def _seconds(self, byte_count: int) -> float:
        """Return the duration of this many bytes of samples."""
        return byte_count / (self._rate * SAMPLE_BYTES)

    # -- holding

    def _keep_silent(self, feed: PlayerFeed) -> None:
        """Confirm the pause, and play silence until it ends. In a long pause, release the player.

        Raises:
            _PlayerReleased: the player failed, or the pause is longer than `RELEASE_DELAY_S`.
        """
        if not feed.player.real_time:
            self._wait_for_continue()
            return
        self._await_silence(feed)
        self._silent_at = time.monotonic()
        release_at = self._silent_at + RELEASE_DELAY_S
        while self._runner.hold_number:
            self._runner.confirm_hold()
            try:
                taken = self._offer_silence(feed)
                due = min(release_at, feed.progress_at + STALL_LIMIT_S)
            except CannotSpeak:
                due = 0.0  # a player that fails during a pause is replaced
            if time.monotonic() >= due:
                self._release_and_continue_at(self._sent)  # everything sent so far has been heard
                raise _PlayerReleased
            if not taken:
                self._wait_for_player(feed, due)
        self._silent_at = None
        feed.progress_at = time.monotonic()

    def _await_silence(self, feed: PlayerFeed) -> None:
        """Wait until a paused player is silent. Kill a player that takes too long.

        Return early if the sentence continues.

        Raises:
            _PlayerReleased: the player was killed.
        """
        self._update_progress(feed)
        written, now = feed.written, time.monotonic()
        deadline = now + HOLD_SILENCE_LIMIT_S
        too_late = feed.consumed == 0 or feed.time_left(written, now) > HOLD_SILENCE_LIMIT_S
        while self._runner.hold_number and (left := feed.time_left(written, now) + CLOCK_ERROR_S) > 0:
            if too_late or now >= deadline:
                self._release_and_rewind(feed)
                raise _PlayerReleased
            if not self._offer_silence(feed):
                self._wait_for_player(feed, min(deadline, now + left))
            self._update_progress(feed)
            now = time.monotonic()

    def _offer_silence(self, feed: PlayerFeed) -> int:
        """Offer silence to the player unless it has enough. Return the number of bytes accepted.

        Without this limit, some players would accept silence endlessly.
        """
        feed.player.ended()  # raises an error if the player has failed
        taken = 0 if self._has_enough_silence(feed) else feed.offer_silence(self._seconds(self._sent))
        self._update_progress(feed)
        return taken

    def _has_enough_silence(self, feed: PlayerFeed) -> bool:
        """Return whether the sentence is paused and the player has enough silence."""
        return bool(self._runner.hold_number) and feed.buffered(time.monotonic()) >= HOLD_SILENCE_LIMIT_S

    # -- waiting

    def _keep_playing(self, interests: Sequence[Interest] = (), until: float = NEVER) -> None:
        """Keep playing until a descriptor is ready or time is up.

        This method may return early, for example after a pause.
        """
        if self._feed is not None:
            self._with_player(lambda feed: self._offer_and_wait(feed, interests, until))
        elif self._runner.hold_number:
            self._wait_for_continue()
        else:
            self._wait(interests, until)

    def _wait_for_continue(self) -> None:
        """If the sentence is paused, confirm the pause and wait until it ends.

        No player is open during the wait.
        """
        while self._runner.hold_number:
            self._runner.confirm_hold()
            self._wait()

    def _wait_for_player(
        self, feed: PlayerFeed, until: float, other_interests: Sequence[Interest] = (), *, has_samples: bool = True
    ) -> None:
        """Wait until the player needs attention, a word is due, a descriptor is ready or time is up.

        Args:
            feed: the stream of the player.
            until: the monotonic time.
            other_interests: further descriptors to wait for.
            has_samples: whether there are samples to write.
        """
        player, now = feed.player, time.monotonic()
        idle = not has_samples or self._has_enough_silence(feed)
        until = min(until, now + PIECE_S if idle else player.wake_at())
        if player.proven:
            until = min(until, self._clock.next_word_at())
        if feed.consumed < feed.written:  # poll doesn't always report that a player has consumed samples
            until = min(until, now + PROGRESS_CHECK_INTERVAL_S)
        # If there are no samples to write, don't wait for a writable player, because that would end the wait at once.
        interests = [each for each in player.interests() if not (idle and each[1] == select.POLLOUT)]
        self._wait([*interests, *other_interests], until)

    def _wait(self, interests: Sequence[Interest] = (), until: float = NEVER) -> None:
        """Wait for descriptors or a time, and execute commands meanwhile. Raise Stopped or EndedEarly if due."""
        self._runner.wait(interests, until)
        self._raise_if_ended()

    def _raise_if_ended(self) -> None:
        """Raise Stopped if the sentence was stopped, or EndedEarly if it was interrupted and can end now."""
        if self._stopped:
            raise Stopped
        if self._runner.word_end_due is not None and not self._complete:
            self._end_early(self._runner.word_end_due - time.monotonic())

    def _end_early(self, time_left: float) -> None:
        """If the current word's end is known or no time is left, cut off the rest, and raise EndedEarly.

        Do nothing if the next word isn't known yet, or if it begins too late. `time_left` is the time in seconds in
        which the current word must end. After that, the word is cut off.
        """
        if not self.started:
            raise EndedEarly
        sent = self._seconds(self._sent)
        word = self._clock.next_word_from(sent)
        if word is not None and word.position > sent + time_left:
            word = None
        if word is None and time_left > 0:
            return
        position = sent if word is None else word.position
        faded = int(FADE_S * self._rate) * SAMPLE_BYTES
        end = max(self._sent + faded, round(position * self._rate) * SAMPLE_BYTES)
        if end > self._samples.end:
            if time_left > 0:
                return
            end = self._samples.end
        self._samples.end_at(end, max(self._sent, end - faded))
        self._clock.drop_from(position)
        rest = self._runner.text_start + max(self._sent, end - faded) // SAMPLE_BYTES if self._runner.sound else None
        raise EndedEarly(rest if word is None else word.start)
