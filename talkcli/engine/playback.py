"""The playback of one sentence: feeds a sink, keeps the word clock, and judges whether all of it was heard.

It waits only through the function it is given, which lets a stop come in. It knows nothing of synthesis and nothing of
processes: a sink says what it takes, this says what that means.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from talkcli.engine.sink import PIECE, SAMPLE, AudioFailed, Stopped
from talkcli.engine.wordclock import WordClock

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.engine.outlet import Outlet
    from talkcli.engine.sink import Sink, Wait
    from talkcli.engine.wordclock import TimedWord

#: Seconds within which a player must take the first sound: a Bluetooth or USB device that sleeps needs one or two, a
#: null sink that nobody records up to two.
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

#: Seconds of sound that a player holds at least between taking and playing it: of the 60 ms it is asked for, aplay was
#: seen to hold 42 to 78, pacat 25 to 60.
PLAYER_HOLDS = 0.02


class Playback:
    """One sentence on its way to the player. Every method may raise Stopped or AudioFailed, except the last three."""

    def __init__(
        self,
        outlet: Outlet,
        wait: Wait,
        on_word: Callable[[TimedWord], None],
    ) -> None:
        self._outlet = outlet
        self._wait = wait
        self._on_word = on_word
        self._rate = 0
        self._candidates: list[Callable[[], Sink]] = []
        self._sink: Sink | None = None
        self._first_error: AudioFailed | None = None
        self._clock = WordClock()
        self._any_word = False
        #: samples that may still be needed: all of them until the player is proven, then those it has not taken yet
        self._samples = bytearray()
        self._dropped = 0  # bytes before those
        self._sent = 0  # bytes the sink has taken
        self._first_write = 0.0
        self._taken = 0  # the sink's own count, when it last grew
        self._progress_at = 0.0
        self._stopped = False

    def begin(self, rate: int) -> None:
        """Set the samples per second; before the first samples."""
        self._rate = rate

    def add_word(self, word: TimedWord) -> None:
        """Report this word when it is heard. It comes before its samples do."""
        self._any_word = True
        self._clock.add(word)

    def write(self, samples: bytes) -> None:
        """Play the samples; returns when the player has taken them, or at once if nothing audible has come yet."""
        self._samples += samples
        self._wait((), 0.0)  # a file is never waited for, and it must be possible to stop that too
        self._check_stopped()
        if self._sink is None and not self._audible(samples):
            return
        self._try(self._feed)

    def finish(self) -> float:
        """Play to the end and return the length in seconds. Returns only if all of it was heard."""
        if self._sink is None and not self._any_word:
            raise AudioFailed("nothing_to_say", "nothing in the text can be spoken")
        self._try(self._drain)
        for word in self._clock.rest():
            self._on_word(word)
        if self._sink is not None:
            self._outlet.worked(self._sink.name)
        return self._length()

    def stop(self) -> None:
        """Be silent now; what waits ends with Stopped."""
        self._stopped = True
        if self._sink is not None:
            self._sink.kill()

    def silence(self) -> None:
        """Return when nothing can be heard any more, however it ended."""
        if self._sink is None:
            return
        self._sink.kill()
        while not self._sink.gone():  # hangs in the kernel: the server has a limit of its own
            self._wait((), time.monotonic() + PIECE)

    def _audible(self, samples: bytes) -> bool:
        return self._any_word or samples.count(0) != len(samples)

    def _try(self, step: Callable[[], None]) -> None:
        """Do the step; where a player fails before any sound was taken, do it again with the next one."""
        while True:
            self._check_stopped()
            try:
                if self._sink is None:
                    self._open()
                step()
            except AudioFailed as error:
                self._next_player(error)
            else:
                return

    def _open(self) -> None:
        if not self._candidates:
            self._candidates = self._outlet.candidates(self._rate)
        self._sink = self._candidates.pop(0)()
        self._sent = self._taken = 0
        self._progress_at = time.monotonic()

    def _next_player(self, error: AudioFailed) -> None:
        """Give up on this player; raises the first player's error if there is no other, or if sound was taken."""
        first = self._first_error or error
        self._first_error = first
        lost = self._sink is not None and (self._sink.proven or error.reason == "audio_stalled")
        if lost or not self._candidates:
            raise error if lost else first
        self.silence()
        self._sink = None

    def _feed(self) -> None:
        """Hand all samples there are to the sink."""
        sink = self._running()
        while self._sent < self._end():
            taken = self._offer(sink)
            self._tick(sink)
            if taken:
                continue
            limit = FIRST_WITHIN if self._taken == 0 else STALLED_AFTER
            self._wait_for(sink, self._progress_at + limit)
            if self._sent < self._end() and time.monotonic() >= self._progress_at + limit and not self._offer(sink):
                raise AudioFailed("audio_stalled", f"{sink.name} took no sound for {limit:g} s")

    def _drain(self) -> None:
        """Close the sink and wait for its end."""
        self._feed()
        sink = self._running()
        sink.close()
        now = time.monotonic()
        limit = now + max(0.0, self._length() - self._clock.position(now)) + DRAIN_WITHIN
        while not sink.ended():
            self._tick(sink)
            if time.monotonic() >= limit:
                raise AudioFailed("audio_stalled", f"{sink.name} did not end {DRAIN_WITHIN:g} s after the sound")
            self._wait_for(sink, limit)
        missing = self._first_write + self._length() - time.monotonic()
        if sink.real_time and missing > EARLY_END:
            raise AudioFailed("audio_lost", f"{sink.name} ended {missing:.1f} s before the sound did")

    def _offer(self, sink: Sink) -> int:
        begin = self._sent - self._dropped
        piece = int(PIECE * self._rate) * SAMPLE
        with memoryview(self._samples) as view, view[begin : begin + piece] as part:
            taken = sink.offer(part)
        if not taken:
            return 0
        now = time.monotonic()
        if self._sent == 0:
            self._first_write = now
            self._clock.start(now)
        self._sent += taken
        self._progress_at = now
        return taken

    def _tick(self, sink: Sink) -> None:
        """Bring the clock up to date, report the words that are heard, forget the samples that were taken."""
        now = time.monotonic()
        consumed = sink.consumed()
        if consumed > self._taken:
            if self._taken == 0:  # it has opened its device: the clock starts here, not with what waited in the pipe
                self._clock.start(now)
            self._taken = consumed
            self._progress_at = now
        if sink.real_time and consumed < self._end():
            self._clock.hold(now, max(0.0, self._seconds(consumed) - PLAYER_HOLDS))
        if not sink.proven:
            return
        del self._samples[: self._sent - self._dropped]
        self._dropped = self._sent
        for word in self._clock.due(now) if sink.real_time else self._clock.rest():
            self._on_word(word)

    def _wait_for(self, sink: Sink, until: float) -> None:
        moments = [until, sink.wake_at(), self._clock.next_due() if sink.proven else None]
        if self._taken < self._sent:  # a player that takes a part of what waits wakes nobody
            moments.append(time.monotonic() + LOOK_EVERY)
        self._wait(sink.interests(), min(moment for moment in moments if moment is not None))
        self._check_stopped()

    def _check_stopped(self) -> None:
        if self._stopped:
            raise Stopped

    def _running(self) -> Sink:
        assert self._sink is not None
        return self._sink

    def _end(self) -> int:
        return self._dropped + len(self._samples)

    def _seconds(self, length: int) -> float:
        return length / (self._rate * SAMPLE)

    def _length(self) -> float:
        return self._seconds(self._end())
