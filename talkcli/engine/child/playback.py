"""The playback of one sentence: feeds a player, holds it where it is asked to, and judges whether all of it was heard.

It waits only in the session, which lets a stop and a pause come in, and which it tells when it is silent. It knows
nothing of synthesis and nothing of processes: a player says what it takes, this says what that means.
"""

from __future__ import annotations

import select
import time

from talkcli.engine.child.players.base import CannotEnd, CannotSpeak, Stopped
from talkcli.engine.child.stream import Samples, Stream
from talkcli.engine.child.words import TimedWord, WordClock
from talkcli.engine.players import PIECE_S, SAMPLE_BYTES
from talkcli.frozen import TYPE_CHECKING, replace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.engine.child.players.base import Interest, Player
    from talkcli.engine.child.session import Session

#: Seconds within which a player must take the first sound, be it to read ahead: a Bluetooth or USB device that sleeps
#: needs one or two, a null sink that nobody records up to two. From then on the next limit holds.
FIRST_WITHIN = 5.0

#: Seconds without any sound taken after which a player is stalled; healthy waits are below 0.04 on a busy machine, and
#: up to 2 on a null sink that nobody records.
STALLED_AFTER = 3.0

#: Seconds between two looks at how much a player has taken: the start of a stall is known as exactly as this.
LOOK_EVERY = 0.1

#: Seconds that a player may take longer than the rest of the audio to drain and end, for the same reason.
DRAIN_WITHIN = 3.0

#: Seconds that a sentence may end sooner than its audio is long: clocks of sound cards differ, players cut trailing
#: silence. The pause at a sentence's end is longer than this, so that nothing audible can be missing.
EARLY_END = 0.25

#: Seconds for which a device that somebody else holds is tried again, and those between two tries: a sound of another
#: program's, or `talk doctor --silent`, must not cost a sentence.
BUSY_FOR, BUSY_PAUSE = 1.0, 0.05

#: Seconds of zeros that may stand before a sentence: libespeak-ng makes 0 to 11 ms. More is silence that is wanted, as
#: of a voice whose volume is 0.
ZEROS = 0.1

#: Seconds within which a player that was killed must be gone: it takes 1 ms, unless it hangs in a device's driver.
GONE_WITHIN = 1.0

#: Seconds within which a sentence that is to be held must be silent. A player has 42 to 98 ms of it to play; one that
#: has more, or stands still, is ended instead and the sentence goes on with another.
SILENT_WITHIN = 0.15

#: Seconds by which the word clock may be ahead of what is heard: 4 to 8 ms were measured.
CLOCK_AHEAD = 0.01

#: Seconds of silence in the midst of a sentence, as its sound did not come in time, that are no gap: clocks are no
#: better, and nobody hears them.
GAP = 0.05

#: Seconds that are said again where a player had to be ended before all it held was heard: the clock is no better than
#: this, and nothing may be lost.
SAID_AGAIN = 0.03

#: Seconds of a pause after which the player is let go of: long enough for a question in between, after which the next
#: sample is heard at once; a longer one must leave the device to other programs, and let it sleep.
RELEASE_AFTER = 10.0


class Playback:
    """One sentence on its way to the player: the `SampleSink` of whoever makes it.

    Every method may raise Stopped or CannotSpeak, except the last two, which are for others than the synthesizer.
    """

    def __init__(self, session: Session, on_word: Callable[[TimedWord], None]) -> None:
        self._session = session
        self._players = session.players
        self._wait = session.wait
        self._on_word = on_word
        self._rate = 0
        #: opens the players that were not tried, best first; None where all are to be
        self._untried: Iterator[Callable[[], Player]] | None = None
        self._stream: Stream | None = None
        self._first_error: CannotSpeak | None = None
        self._clock = WordClock()
        #: all of them until the player is proven, then those that were not heard yet
        self._samples = Samples()
        self._complete = False  # whether no more are to come
        self._begin = 0  # bytes before the first that this player got
        self._sent = 0  # bytes that players have taken
        self._began = False  # whether any are known to be heard
        self._stopped = False
        #: whether it is settled where the sound begins, and the bytes of zeros before that, which are left out
        self._settled = False
        self._left_out = 0
        #: until when a device that is busy is tried again; 0 before it was found so
        self._busy_until = 0.0
        #: whether the samples are made beside this, so that they may not be there in time
        self._beside = False
        #: the seconds of each gap that is heard because they were not
        self.gaps: list[float] = []
        #: since when the player has been given nothing but silence, because the sentence is held
        self._silent_at: float | None = None

    def begin(self, rate: int, voice: str, why: str | None = None) -> None:
        """Set the samples per second, and open a player for them: it needs 1 to 15 ms, the synthesis 2.

        What goes wrong with it is told by `write`.
        """
        if self._stream is not None and rate != self._rate:
            self._let_go(0)  # it was started for another
        self._rate = rate
        self._session.tell_voice(voice, why)
        if self._players.takes_time and not self._session.held:
            try:
                self._try(lambda _: True)
            except CannotSpeak:
                self._untried = self._first_error = None

    def word(self, start: int, length: int, position: float) -> None:
        """Report this word when it is heard."""
        self._samples.speaks = True
        self._clock.add(TimedWord(start, length, position))

    def write(self, samples: bytes) -> None:
        """Play the samples; returns when the player has taken them, or at once if nothing audible has come yet."""
        self._samples.add(samples)
        self._wait((), 0.0)  # a file is never waited for, and it must be possible to stop that too
        self._check_stopped()
        if self._samples.speaks and self._settle():
            self._try(self._feed_all)

    def wait(self, descriptor: int) -> None:
        """Play on until the descriptor is readable, or something else has come: more samples are being made.

        The player may be empty meanwhile, which is no fault of its own.
        """
        self._beside = True
        more = (descriptor, select.POLLIN)
        if self._stream is not None:
            self._try(lambda stream: self._go_on_without(stream, more))
            return
        self._await_resume()
        self._wait((more,), None)
        self._check_stopped()

    def finish(self) -> float:
        """Play to the end and return the length in seconds. Returns only if all of it was heard."""
        if not self._samples.speaks:
            raise CannotSpeak("nothing_to_say", "nothing in the text can be spoken")
        self._complete = self._settled = True
        self._try(self._drain)
        self._tell(self._clock.rest())
        if self._stream is not None:
            name, now = self._stream.player.name, time.monotonic()
            self._players.worked = name
            self._players.handovers.sentence_ended(name, now + self._stream.unheard(self._stream.written, now))
        return self._seconds(self._sent - self._left_out)

    def stop(self) -> None:
        """Be silent now; what waits ends with Stopped."""
        self._stopped = True
        if self._stream is not None:
            self._stream.player.kill()

    def silence(self) -> None:
        """Return when nothing can be heard any more, however it ended; CannotEnd where that can't be had."""
        if self._stream is None:
            return
        player = self._stream.player
        if player.proven:
            self._players.update_output(player)
        player.kill()
        limit = time.monotonic() + GONE_WITHIN
        while not player.gone():
            if time.monotonic() >= limit:
                raise CannotEnd(f"{player.name} could not be ended within {GONE_WITHIN:g} s")
            self._wait((), time.monotonic() + PIECE_S)
        if player.real_time and player.proven:
            self._players.device_released(self._silent_at)

    # -- players

    def _try(self, step: Callable[[Stream], bool]) -> None:
        """Do the step; where a player fails before any sound was taken, or is let go of, do it again with the next."""
        while True:
            self._check_stopped()
            try:
                if self._stream is None:
                    self._await_resume()
                    if 0 < self._begin == self._samples.end:  # held at its very end
                        return
                    self._stream = self._open()
                if step(self._stream):
                    return
            except CannotSpeak as error:
                self._next_player(error)

    def _open(self) -> Stream:
        self._untried = self._untried or self._players.candidates(self._rate)
        player = next(self._untried)()
        self._sent = self._begin
        self._silent_at = None
        lead_in = self._players.lead_in_seconds(begins=self._begin == self._left_out)
        return Stream(player, self._rate, self._clock, self._seconds(self._begin), lead_in)

    def _next_player(self, error: CannotSpeak) -> None:
        """Give up on this player; raises the first player's error if there is no other, or if sound was taken."""
        stream = self._stream
        if stream is not None and stream.player.real_time and self._session.held:
            self._go_back(stream)  # what is held is spoken by another later, and fails then if there is none
            return
        first = self._first_error
        if first is None or first.reason == "no_player":  # what is there and fails says more than what isn't there
            first = self._first_error = error
        proven = stream is not None and stream.player.proven
        lost = proven or error.final or (stream is not None and error.reason == "audio_stalled")
        others = list(self._untried or ())
        self._untried = iter(others) if others else None
        if lost or not (others or self._is_busy(first)):
            if stream is not None:
                self._players.update_output(stream.player)
            raise error if lost else first
        self._leave()
        if not others:
            self._wait((), time.monotonic() + BUSY_PAUSE)

    def _is_busy(self, error: CannotSpeak) -> bool:
        """Whether the device is held by somebody else, and not for long yet."""
        if error.reason != "audio_device" or "busy" not in str(error).lower():
            return False
        self._busy_until = self._busy_until or time.monotonic() + BUSY_FOR
        return time.monotonic() < self._busy_until

    def _leave(self) -> None:
        """End the player; the next one begins where `_begin` says."""
        self.silence()
        self._stream = None

    def _let_go(self, begin: int) -> None:
        """End the player of a sentence that is held; any of them may go on with it."""
        stream, self._begin, self._sent = self._stream, begin, begin
        if stream is not None and stream.player.proven:
            self._players.worked = stream.player.name  # tried first again
        self._untried = self._first_error = None
        self._leave()

    def _go_back(self, stream: Stream) -> None:
        """End a player that holds sound that wasn't heard; the next one begins there."""
        stream.tick(time.monotonic(), last=False)  # the clock knows no better than this what was heard
        self._let_go(self._unheard() if stream.player.proven else self._begin)

    # -- samples

    def _feed_all(self, stream: Stream) -> bool:
        """Hand all samples there are to the player; False if it was let go of before."""
        if stream.written == 0:
            stream.progress_at = time.monotonic()  # what it was not given it could not take
        while True:
            if self._session.held and not self._stay_silent(stream):
                return False
            if self._sent == self._audible_end(stream):
                self._tick(stream)  # what comes next may be long in coming
                return True
            taken = self._offer(stream)
            self._tick(stream)
            if taken:
                continue
            limit = FIRST_WITHIN if stream.taken == 0 else STALLED_AFTER
            due = stream.progress_at + limit if stream.player.real_time else None  # as long as a reader takes
            self._wait_for(stream, due)
            if due and time.monotonic() >= due and not self._session.held and not self._offer(stream):
                raise CannotSpeak("audio_stalled", f"{stream.player.name} took no sound for {limit:g} s")

    def _go_on_without(self, stream: Stream, more: Interest) -> bool:
        """Wait once for more samples while the player plays what it has; False if it was let go of before."""
        if self._session.held and not self._stay_silent(stream):
            return False
        self._tick(stream)
        stream.player.ended()  # raises if it is gone; what it says wakes nobody again
        self._wait_for(stream, None, more)
        self._tick(stream)
        stream.progress_at = time.monotonic()  # what it was not given it could not take
        return True

    def _drain(self, stream: Stream) -> bool:
        """Close the player's input and wait for its end; False if it was let go of before."""
        if not self._feed_all(stream):
            return False
        player = stream.player
        player.close()
        now = time.monotonic()
        limit = now + stream.ahead(now) + DRAIN_WITHIN
        while not player.ended():
            self._tick(stream)
            now = time.monotonic()
            if self._session.held and stream.ahead(now) > SILENT_WITHIN:
                self._go_back(stream)
                return False  # with less than that left it has ended as soon as it could be held
            if now >= limit:
                raise CannotSpeak("audio_stalled", f"{player.name} did not end {DRAIN_WITHIN:g} s after the sound")
            self._wait_for(stream, limit)
        missing = stream.missing(time.monotonic())
        if player.real_time and missing > EARLY_END - self._seconds(self._samples.end - self._sent):
            raise CannotSpeak("audio_lost", f"{player.name} ended {missing:.1f} s before the sound did")
        return True

    def _settle(self) -> bool:
        """Whether it is settled where the sound begins; the zeros before that are left out, which nobody can hear.

        Behind another sentence they are a part of the pause between the two, and a file gets what was made.
        """
        if self._settled:
            return True
        zeros = self._samples.zeros()
        silent = zeros == self._samples.end
        if silent and self._seconds(zeros) < ZEROS:
            return False
        self._settled = True
        if not silent and self._players.takes_time and not self._players.handovers.follows and self._sent == 0:
            self._left_out = self._begin = self._sent = zeros
            self._clock.leave_out(self._seconds(zeros))
            if self._stream is not None:
                self._stream.begin(self._seconds(zeros))
        return True

    def _offer(self, stream: Stream) -> int:
        if stream.lead_in:
            taken = stream.offer_silence(self._seconds(self._begin), stream.lead_in)
            stream.lead_in -= taken
            return taken
        with self._samples.part(self._sent, min(self._audible_end(stream), self._sent + stream.piece)) as part:
            silent = stream.silent_for(time.monotonic())
            taken = stream.offer(part)
        if taken and silent > GAP and self._beside and stream.player.real_time:
            self.gaps.append(silent)
        self._sent += taken
        return taken

    def _audible_end(self, stream: Stream) -> int:
        """Return the end of what is to be played: less silence where a goal waits, and for as long as one may come."""
        if not stream.player.real_time or (self._complete and not self._players.handovers.followed):
            return self._samples.end
        most = int(self._players.handovers.silence_to_cut(stream.player.name) * self._rate) * SAMPLE_BYTES
        return max(self._sent, self._samples.end - self._samples.quiet_end(most))

    def _tick(self, stream: Stream) -> None:
        """Bring the clock up to date, report the words that are heard, forget the samples that were heard."""
        now = time.monotonic()
        last = self._complete and self._sent == self._audible_end(stream)
        stream.tick(now, last=last and not self._session.held)
        player = stream.player
        if not player.proven:
            return
        self._players.update_output(player)
        if stream.taken and not self._began:
            self._began = True
            self._players.handovers.sentence_started(player.name, now - self._clock.elapsed(now), neural=self._beside)
        self._samples.forget(self._unheard() if player.real_time else self._sent)
        self._tell(self._clock.due(now) if player.real_time else self._clock.rest())

    def _tell(self, words: list[TimedWord]) -> None:
        """Report words that are heard, at their place in what is played."""
        for word in words:
            self._on_word(replace(word, position=word.position - self._seconds(self._left_out)))

    # -- holding

    def _stay_silent(self, stream: Stream) -> bool:
        """Feed silence while the sentence is held; False if the player was let go of."""
        if not stream.player.real_time:
            self._await_resume()
            return True
        if not self._fall_silent(stream):
            return False
        if self._session.held and not self._stay_open(stream):
            self._let_go(self._sent)  # what it held was heard
            return False
        stream.progress_at = time.monotonic()
        return True

    def _fall_silent(self, stream: Stream) -> bool:
        """Return when all that the player has of the sentence is heard, or it may go on; False if it was let go of."""
        self._tick(stream)
        mark, now = stream.written, time.monotonic()
        limit = now + SILENT_WITHIN
        hopeless = stream.taken == 0 or stream.unheard(mark, now) > SILENT_WITHIN
        while self._session.held and (left := stream.unheard(mark, now) + CLOCK_AHEAD) > 0:
            if hopeless or now >= limit:
                self._go_back(stream)
                return False
            if not self._feed_silence(stream):
                self._wait_for(stream, min(limit, now + left))
            self._tick(stream)
            now = time.monotonic()
        return True

    def _stay_open(self, stream: Stream) -> bool:
        """Keep the player that holds nothing but silence; False if it failed, or must be let go of, before the end."""
        self._silent_at = time.monotonic()
        release_at = self._silent_at + RELEASE_AFTER
        while self._session.held:
            self._session.confirm()
            try:
                fed = self._feed_silence(stream)
            except CannotSpeak:
                return False  # a pause is no reason to end the sentence
            due = min(release_at, stream.progress_at + STALLED_AFTER)
            if time.monotonic() >= due:
                return False
            if not fed:
                self._wait_for(stream, due)
        self._silent_at = None
        return True

    def _feed_silence(self, stream: Stream) -> int:
        """Offer a piece of silence, unless the player has more than enough: one that takes all would keep us busy."""
        stream.player.ended()  # raises if it is gone
        taken = 0 if self._full(stream) else stream.offer_silence(self._seconds(self._sent))
        self._tick(stream)
        return taken

    def _full(self, stream: Stream) -> bool:
        return bool(self._session.held) and stream.ahead(time.monotonic()) >= SILENT_WITHIN

    def _await_resume(self) -> None:
        """Wait, without a player, while the sentence is held."""
        while self._session.held:
            self._session.confirm()
            self._wait((), None)
            self._check_stopped()

    def _wait_for(self, stream: Stream, until: float | None, more: Interest | None = None) -> None:
        """Wait for the player, or until then; or, where nothing is there for it, for `more`."""
        player, now = stream.player, time.monotonic()
        moments = [until, player.wake_at(), self._clock.next_due() if player.proven else None]
        idle = more is not None or self._full(stream)
        if idle:
            moments[1] = now + PIECE_S
        if stream.taken < stream.written:  # a player that takes a part of what waits wakes nobody
            moments.append(now + LOOK_EVERY)
        # Where nothing is to be written, not for room to write.
        interests = [each for each in player.interests() if not (idle and each[1] == select.POLLOUT)]
        interests += [] if more is None else [more]
        self._wait(interests, min((moment for moment in moments if moment is not None), default=None))
        self._check_stopped()

    def _check_stopped(self) -> None:
        if self._stopped:
            raise Stopped

    # -- lengths

    def _unheard(self) -> int:
        """Return the bytes before those that may not have been heard yet, of those that this player got."""
        heard = int(max(0.0, self._clock.heard(time.monotonic()) - SAID_AGAIN) * self._rate) * SAMPLE_BYTES
        return min(self._sent, max(self._begin, self._samples.begin, heard))

    def _seconds(self, length: int) -> float:
        return length / (self._rate * SAMPLE_BYTES)
