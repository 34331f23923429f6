"""The engine process's loop: one goal after the other through pyttsx3's engine, with commands in between and during.

One thread. While a goal is spoken by `talk`'s own driver, the driver waits in `Session.wait`; a `Stop` that comes in
there is carried out at once, by `engine.stop()`, which comes to the driver, its playback and the player; a `Pause` by
the playback; what ties them together is `driver.start`. Other drivers know no pause: there the sentence is stopped, and
what is left of it is spoken as another. Nothing may leave a goal without its `Ended`: pyttsx3 swallows what its
callbacks raise, ignores blank text and turns errors into notifications.
"""

from __future__ import annotations

import os
import select
import sys
import time
import traceback
from collections import deque

from talkcli.engine import protocol
from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.words import Words
from talkcli.engine.voices import list_voices
from talkcli.frozen import TYPE_CHECKING
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

    from talkcli.engine.child.players.base import Interest
    from talkcli.engine.child.players.chooser import PlayerChooser
    from talkcli.engine.child.synthesizers.combined import CombinedSynthesizer
    from talkcli.engine.protocol import Command, Event
    from talkcli.goals.goal import Output

#: Seconds between two steps of a driver that is not ours while it has a goal in hand: it has no way to wake us.
STEP = 0.05

#: What such a driver may take from one word, or the beginning, to the end of the text: so many seconds, and for each
#: character the time of so many words ("€" is one, an emoji is five, but there is never one alone). Nobody can see
#: whether it speaks, only that it should have ended by then.
PATIENCE = 10.0
WORDS_A_CHARACTER = 3

#: Bytes read in one go; the longest command, escaped, takes a few of them.
_AT_ONCE = 65536


#: What concerns the goal in hand.
_OF_THE_GOAL = (protocol.Stop, protocol.Followed, protocol.Pause, protocol.Resume)


class Channel:
    """The engine process's end of the socket to its server: commands come in, events go out, over one descriptor.

    It blocks only where it is asked to. A server that is gone is no error here: `closed` says so, and the process ends.
    """

    #: standard input
    descriptor = 0

    def __init__(self) -> None:
        #: True once the server is gone.
        self.closed = False
        #: monotonic time of the last event.
        self.sent_at = time.monotonic()
        self._lines = LineSplitter()

    def send(self, event: Event) -> None:
        """Send an event, waiting until the server takes it."""
        data = memoryview(protocol.encode(event))
        self.sent_at = time.monotonic()
        try:
            while data:
                data = data[os.write(self.descriptor, data) :]
        except (BrokenPipeError, ConnectionResetError):
            self.closed = True

    def receive(self) -> list[Command]:
        """Read once, waiting if there is nothing, and return the commands that are complete."""
        try:
            data = os.read(self.descriptor, _AT_ONCE)
        except ConnectionResetError:
            data = b""
        if not data:
            self.closed = True
            return []
        return [protocol.decode(line, protocol.COMMANDS) for line in self._lines.feed(data)]


class InHand:
    """The goal that is being spoken."""

    def __init__(self, say: protocol.Say, now: float) -> None:
        self.id = say.id
        self.say = say
        self.words = Words(say.text)
        #: when it began, without the time for which it was held
        self.began = now
        #: when the driver got it, or said a word of it
        self.progress_at = now
        #: whether the driver has it; not while it is held, unless the driver is our own
        self.spoken = False
        #: whether the driver was told to stop because it is to be held
        self.interrupted = False
        #: when it became silent after that
        self.silent_at: float | None = None
        #: where in the text begins what the driver was given
        self.offset = 0
        #: where in the text the last word that was heard begins
        self.last_word = 0
        self.stop_asked = False
        self.error: Exception | None = None
        #: whether it was said that the driver won't come to its end
        self.given_up = False


class Session:
    """The loop. `open` gives it its engine, `run` runs it."""

    def __init__(self, channel: Channel, players: PlayerChooser) -> None:
        self._channel = channel
        #: what our own driver plays with
        self.players = players
        #: where the goal in hand goes, as the server was told
        self._told: Output | None = None
        #: id of the voice by which it is heard, as the server was told, and why its own can't be set, if it can't
        self._voice = ""
        self._why: str | None = None
        self._backlog: deque[Command] = deque()
        self._goal: InHand | None = None
        self._engine: Any = None
        self._apply: Any = None
        self._pump: Callable[[], None] | None = None
        self._synthesizer: CombinedSynthesizer | None = None
        #: the number of the pause for which the sentence in hand is to be held, 0 for none: for the playback to obey,
        #: as pyttsx3 has no word for a pause; with a driver that is not ours the session itself goes by it
        self.held = 0
        self._confirmed = 0
        #: what our own driver tells beside its notifications, which have no word for it, true as long as one is told:
        #: the place in the audio, in seconds, of the word that begins; the seconds of the sentence that has ended, None
        #: if not all of it was heard. None where another speaks, which doesn't know.
        self.position: float | None = None
        self.duration: float | None = None
        #: the seconds of each gap in that sentence
        self.gaps: list[float] = []

    def open(
        self,
        engine: Any,
        apply: Callable[[protocol.Say], str | None],
        pump: Callable[[], None] | None,
        synthesizer: CombinedSynthesizer | None = None,
    ) -> None:
        """Take the engine, and what sets its properties for a goal: CannotSpeak, or why another voice speaks, or None.

        `pump`: for a foreign driver, called about 20 times a second while it has a goal; `synthesizer`: what loads
        voices beside the speech, if anything does.
        """
        self._engine = engine
        self._synthesizer = synthesizer
        self._apply = apply
        self._pump = pump
        engine.connect("started-word", _told(self._word))
        engine.connect("finished-utterance", _told(self._finished))
        engine.connect("error", _told(self._error))

    def run(self, voices: bool) -> None:
        """Carry out commands until the server is gone; before that tell the voices, if they are wanted."""
        try:
            if voices:
                try:
                    found = list_voices(self._engine)
                except Exception:  # noqa: BLE001 - any driver's; a voice can be spoken with without the list
                    traceback.print_exc()
                    found = ()
                self._channel.send(protocol.Voices(found))
            while not self._channel.closed:
                if not self._backlog:
                    self.wait((), None)
                    continue
                command = self._backlog.popleft()
                # What else comes out of a goal came too late; a second Configure has nothing to change.
                if isinstance(command, protocol.Say):
                    self._say(command)
        finally:
            self._engine.endLoop()

    def wait(self, interests: Sequence[Interest], until: float | None) -> None:
        """Wait for one of the interests, a command or a monotonic time, whatever comes first; it may return early.

        What the server wants now is carried out inside: a sentence can be stopped when this returns.
        """
        self._tell_loaded()
        poll = select.poll()
        if not self._channel.closed:
            poll.register(self._channel.descriptor, select.POLLIN)
        for descriptor, events in interests:
            poll.register(descriptor, events)
        loads = self._synthesizer
        loading = loads.load_descriptor if loads else None
        if loads and loading is not None:
            poll.register(loading, select.POLLIN)
        voice_due = loads.load_deadline if loads and loading is not None else None
        moments = [moment for moment in (until, self._alive_due(), voice_due) if moment is not None]
        timeout = max(0.0, min(moments) - time.monotonic()) * 1000 if moments else None
        ready = [descriptor for descriptor, _ in poll.poll(timeout)]
        if self._channel.descriptor in ready:
            for command in self._channel.receive():
                self._carry_out_now(command)
            if self._channel.closed:
                self._silence()
        self._tell_loaded()
        self._tell_output()
        due = self._alive_due()
        if due is not None and time.monotonic() >= due:
            self._channel.send(protocol.Alive(self._goal.id if self._goal else ""))

    def _carry_out_now(self, command: Command) -> None:
        """Carry out what concerns the goal in hand; the rest has to wait."""
        goal = self._goal
        if isinstance(command, (protocol.Load, protocol.Drop)):
            if self._synthesizer is not None:
                self._synthesizer.carry_out(command)
        elif goal is None or not isinstance(command, _OF_THE_GOAL):
            self._backlog.append(command)
        elif goal.id != command.id:
            return  # it ended before this arrived
        elif isinstance(command, protocol.Stop):
            self._silence()
        elif isinstance(command, protocol.Followed):
            self.players.handovers.followed, self.players.handovers.by_neural = command.followed, command.by_neural
        elif isinstance(command, protocol.Resume):
            self.held = 0
        elif not goal.stop_asked:
            self.held = command.number
            if self._pump is not None and goal.spoken and not goal.interrupted:
                goal.interrupted = True
                self._engine.stop()

    def _tell_loaded(self) -> None:
        for event in self._synthesizer.load_events() if self._synthesizer else ():
            self._channel.send(event)

    def tell_voice(self, voice: str, why: str | None) -> None:
        """Tell by which voice the goal in hand is heard, if that is not known; `why`: as in `SampleSink.begin`."""
        if self._goal is not None and voice != self._voice:
            self._voice = voice
            self._channel.send(protocol.Speaks(self._goal.id, voice, why or self._why))

    def _tell_output(self) -> None:
        output = self.players.output
        if self._goal is not None and output != self._told:
            self._told = output
            self._channel.send(protocol.Output(self._goal.id, output.to_json() if output else None))

    def confirm(self) -> None:
        """Take note that the sentence that is to be held is silent; may be called again and again."""
        if self._goal is not None and not self._goal.stop_asked and self._confirmed != self.held:
            self._confirmed = self.held
            self._channel.send(protocol.Paused(self._goal.id, self.held))

    def _silence(self) -> None:
        if self._goal is not None and not self._goal.stop_asked:
            self._goal.stop_asked = True
            if self._goal.spoken:
                self._engine.stop()
            else:  # held, or not begun: the driver has nothing that it could end
                self._end(protocol.STOPPED)

    def _say(self, say: protocol.Say) -> None:
        """Speak a goal to its end."""
        self._goal = goal = InHand(say, time.monotonic())
        self.held = self._confirmed = 0
        self.gaps = []
        self.players.begin(say)
        self._told, self._voice, self._why = None, "", None
        self._channel.send(protocol.Started(say.id))
        # What came with it in one piece is no later than what comes in a moment.
        waiting, self._backlog = self._backlog, deque()
        for command in waiting:
            self._carry_out_now(command)
        try:
            self._why = self._apply(say)
        except CannotSpeak as error:
            if self._goal is not None:
                self._end(protocol.FAILED, error.reason, str(error))
        if self._goal is not None and self._pump is not None and say.lead_in:
            self._end(protocol.FAILED, "bad_option", "this driver plays by itself: it can't be given a lead-in")
        goal.error = None
        while self._goal is not None:
            self._go_on(goal)

    def _go_on(self, goal: InHand) -> None:
        """Do the next thing for the goal in hand: begin it, let the driver speak, wait while it is held."""
        if goal.spoken:
            self._step()
            return
        if self._pump is not None and self.held:
            self.confirm()
            self.wait((), None)
            return
        if goal.silent_at is not None:
            goal.began += time.monotonic() - goal.silent_at
        goal.offset = goal.last_word
        goal.spoken, goal.interrupted, goal.silent_at = True, False, None
        goal.progress_at = time.monotonic()
        if self._engine.say(goal.say.text[goal.offset :], goal.id) is not None:
            self._end(protocol.FAILED, "nothing_to_say", "nothing in the text can be spoken")

    def _step(self) -> None:
        """Let the driver go on. Ours speaks to the end in one step, others are asked again and again."""
        self._engine.iterate()
        goal = self._goal
        if goal is None:
            return
        if self._pump is None:
            self._end(protocol.FAILED, "engine_failed", "the driver lost the sentence")
        elif goal.error is not None:  # one that raises in `say` never tells that it is finished
            self._engine.stop()
            self._engine.proxy.setBusy(False)  # else pyttsx3 would keep the next sentence to itself
            self._finished(goal.id, completed=False)
        else:
            self.wait((), time.monotonic() + STEP)
            self._pump()

    def _word(self, location: int, length: int, **_: object) -> None:
        """Report a word. Other drivers give the word as the notification's name, so that says nothing."""
        goal = self._goal
        if goal is None or goal.stop_asked or goal.interrupted:
            return
        found = goal.words.next(goal.offset + location if location >= 0 else location, length)
        if found is not None:
            start, end, number = found
            goal.last_word, goal.progress_at = start, time.monotonic()
            seconds = goal.progress_at - goal.began if self.position is None else self.position
            self._channel.send(protocol.Word(goal.id, start, end, number, round(seconds, 3)))

    def _error(self, exception: Exception, **_: object) -> None:
        if self._goal is not None and self._goal.error is None:
            self._goal.error = exception

    def _finished(self, name: str | None, completed: bool, **_: object) -> None:
        goal = self._goal
        if goal is None or name != goal.id:  # of a goal that ended before
            return
        if goal.interrupted and not (completed or goal.stop_asked or goal.error):
            goal.spoken, goal.silent_at = False, time.monotonic()
        elif completed:
            self._end(protocol.COMPLETED, duration=None if self.duration is None else round(self.duration, 6))
        elif goal.stop_asked and not isinstance(goal.error, CannotSpeak):
            self._end(protocol.STOPPED)
        elif isinstance(goal.error, CannotSpeak):
            self._end(protocol.FAILED, goal.error.reason, str(goal.error))
        else:
            text = "the driver did not complete the sentence"
            if goal.error is not None:
                traceback.print_exception(goal.error)  # for the server's log
                text = f"{type(goal.error).__name__}: {goal.error}"
            self._end(protocol.FAILED, "engine_failed", text)

    def _end(
        self, outcome: str, reason: str | None = None, message: str | None = None, duration: float | None = None
    ) -> None:
        assert self._goal is not None
        self._tell_output()
        goal, self._goal = self._goal, None
        gaps = len(self.gaps), round(sum(self.gaps), 3)
        self._channel.send(protocol.Ended(goal.id, outcome, reason, message, duration, *gaps, self.players.chosen))

    def _alive_due(self) -> float | None:
        loading = self._synthesizer is not None and self._synthesizer.load_descriptor is not None
        if not loading and (self._goal is None or self._lost(self._goal)):
            return None
        return self._channel.sent_at + protocol.ALIVE_EVERY

    def _lost(self, goal: InHand) -> bool:
        """Whether a driver that is not ours has had all the time it could need: no sign of life comes from here then.

        The server ends the process for that, as there may be no other way to silence it.
        """
        if self._pump is None or not goal.spoken:
            return False
        rest = (len(goal.say.text) - goal.last_word) * WORDS_A_CHARACTER * 60 / goal.say.rate
        lost = time.monotonic() > goal.progress_at + PATIENCE + rest
        if lost and not goal.given_up:
            goal.given_up = True
            sys.stderr.write(f"the driver did not end what takes less than {PATIENCE + rest:.0f} s\n")
        return lost


def _told(callback: Callable[..., None]) -> Callable[..., None]:
    """Return the callback with its errors printed: pyttsx3 drops them."""

    def call(**values: Any) -> None:
        try:
            callback(**values)
        except Exception:
            traceback.print_exc()
            raise

    return call
