"""The engine process's loop: it speaks one goal after the other through pyttsx3, and obeys commands in between.

It runs in one thread. While `talk`'s own driver speaks, the driver waits in `GoalRunner.wait`, which obeys a `Stop` or
`Hold` at once. Foreign drivers can't hold a sentence. There, a hold stops the sentence, and the rest of its text is
spoken as another.

Each goal must end with an `Ended`, although pyttsx3 drops the exceptions of its callbacks, ignores blank text and
reports errors as notifications.
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
from talkcli.engine.child.words import WordFinder
from talkcli.engine.voices import list_voices
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.reasons import Reason
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

    from talkcli.engine.child.players.base import Interest
    from talkcli.engine.child.players.chooser import PlayerChooser
    from talkcli.engine.child.synthesizers.combined import CombinedSynthesizer
    from talkcli.engine.protocol import Command, Event
    from talkcli.goals.goal import Output

#: Interval for letting a foreign driver go on while it speaks. It can't wake this process.
DRIVER_STEP_S = 0.05

# Limit for a foreign driver from one word, or the beginning, to the end of the text. It only shows that the driver
# should have ended by then, because nobody can see whether it still speaks.
#: The fixed part of the limit.
DRIVER_LIMIT_S = 10.0
#: Words to allow for each character left, at the goal's rate. "€" is spoken as one word and an emoji as five, but
#: other characters stand between emojis.
MAX_WORDS_PER_CHARACTER = 3


class Channel:
    """The engine process's end of the socket to its server. If the server is gone, `closed` is set."""

    #: standard input, which is the socket
    descriptor = 0

    def __init__(self) -> None:
        self.closed = False
        #: monotonic time of the last event
        self.sent_at = time.monotonic()
        self._lines = LineSplitter()

    def send(self, event: Event) -> None:
        """Send an event and wait until the server takes it."""
        data = memoryview(protocol.encode(event))
        self.sent_at = time.monotonic()
        try:
            while data:
                data = data[os.write(self.descriptor, data) :]
        except (BrokenPipeError, ConnectionResetError):
            self.closed = True

    def receive(self) -> list[Command]:
        """Read once, waiting for data, and return the commands that are complete."""
        try:
            data = os.read(self.descriptor, 65536)
        except ConnectionResetError:
            data = b""
        if not data:
            self.closed = True
            return []
        return [protocol.decode(line, protocol.COMMAND_CLASSES) for line in self._lines.feed(data)]


class ActiveGoal:
    """The goal being spoken."""

    def __init__(self, command: protocol.Speak, now: float) -> None:
        self.id = command.id
        self.command = command
        self.words = WordFinder(command.text)
        #: when it began; moved later by the time for which it was held
        self.began_at = now
        #: when the driver got the text or reported a word
        self.progress_at = now
        #: whether the driver has the text; a foreign driver doesn't have that of a held goal
        self.with_driver = False
        #: whether the driver was stopped in order to hold the goal
        self.interrupted = False
        #: when a foreign driver was silent after that
        self.silent_at: float | None = None
        #: where the driver's part of the text begins
        self.offset = 0
        #: where the last word that was heard begins
        self.last_word = 0
        self.stop_requested = False
        self.error: Exception | None = None
        #: whether it was logged that the driver doesn't end
        self.overdue_logged = False


class GoalRunner:
    """The loop over the commands of the server. `attach_engine` gives it an engine, and `run` runs it."""

    def __init__(self, channel: Channel, players: PlayerChooser) -> None:
        """Prepare the loop. `players` is what `talk`'s own driver plays with."""
        self._channel = channel
        self.players = players
        #: what the server was told about the goal: its output, its voice, and why that is another than it asked for
        self._reported_output: Output | None = None
        self._reported_voice = ""
        self._fallback_reason: str | None = None
        self._backlog: deque[Command] = deque()
        self._goal: ActiveGoal | None = None
        self._engine: Any = None
        self._set_properties: Any = None
        self._pump: Callable[[], None] | None = None
        self._synthesizer: CombinedSynthesizer | None = None
        #: number of the hold in force, or 0; the playback reads it here because pyttsx3 can't pass on a pause
        self.hold_number = 0
        self._confirmed_hold = 0
        # Set by `talk`'s own driver beside its notifications, which have no room for them. None with a foreign driver.
        #: position in the audio of the word that begins, in seconds
        self.position: float | None = None
        #: length of the sentence that has ended, in seconds; None if not all of it was heard
        self.duration: float | None = None
        #: seconds of each gap in that sentence
        self.gaps: list[float] = []

    def attach_engine(
        self,
        engine: Any,
        set_properties: Callable[[protocol.Speak], str | None],
        pump: Callable[[], None] | None,
        synthesizer: CombinedSynthesizer | None = None,
    ) -> None:
        """Take the engine to speak with.

        Args:
            engine: pyttsx3's engine.
            set_properties: sets the engine's properties for a goal. It returns why another voice speaks, or None, and
                raises CannotSpeak if the goal can't be spoken.
            pump: called about 20 times a second while a foreign driver speaks; None for `talk`'s own driver.
            synthesizer: loads neural voices, or None if the driver has none.
        """
        self._engine = engine
        self._set_properties = set_properties
        self._pump = pump
        self._synthesizer = synthesizer
        engine.connect("started-word", _with_traceback(self._report_word))
        engine.connect("finished-utterance", _with_traceback(self._driver_finished))
        engine.connect("error", _with_traceback(self._note_error))

    def run(self, *, send_voices: bool) -> None:
        """Obey commands until the server is gone. First send the list of voices if that is wanted."""
        try:
            if send_voices:
                try:
                    voices = list_voices(self._engine)
                except Exception:  # noqa: BLE001 - a foreign driver may raise anything, and can speak without the list
                    traceback.print_exc()
                    voices = ()
                self._channel.send(protocol.VoiceList(voices))
            while not self._channel.closed:
                if not self._backlog:
                    self.wait((), None)
                    continue
                command = self._backlog.popleft()
                if isinstance(command, protocol.GoalCommand):  # anything else came after its goal had ended
                    self._speak(command)
        finally:
            self._engine.endLoop()

    def wait(self, interests: Sequence[Interest], until: float | None) -> None:
        """Wait for one of the descriptors, a command or a monotonic time. It may return early.

        Commands are obeyed inside, so the sentence may have been stopped when this returns.
        """
        self._send_voice_events()
        poll = select.poll()
        if not self._channel.closed:
            poll.register(self._channel.descriptor, select.POLLIN)
        for descriptor, events in interests:
            poll.register(descriptor, events)
        deadlines = [until, self._alive_due()]
        loader = self._synthesizer.loader if self._synthesizer else None
        if loader is not None and loader.descriptor is not None:
            poll.register(loader.descriptor, select.POLLIN)
            deadlines.append(loader.deadline)
        first = min((each for each in deadlines if each is not None), default=None)
        timeout = None if first is None else max(0.0, first - time.monotonic()) * 1000
        ready = [descriptor for descriptor, _ in poll.poll(timeout)]
        if self._channel.descriptor in ready:
            for command in self._channel.receive():
                self._obey(command)
            if self._channel.closed:
                self._stop_goal()
        self._send_voice_events()
        self._report_output()
        alive_due = self._alive_due()
        if alive_due is not None and time.monotonic() >= alive_due:
            self._channel.send(protocol.Alive(self._goal.id if self._goal else ""))

    def _obey(self, command: Command) -> None:
        """Obey a command for the goal being spoken or about voices. Keep any other for later."""
        goal = self._goal
        if isinstance(command, protocol.LoadVoice | protocol.DropVoice):
            if self._synthesizer is not None:
                self._synthesizer.carry_out(command)
        elif goal is None or isinstance(command, protocol.Configure | protocol.GoalCommand):
            self._backlog.append(command)
        elif goal.id != command.id:
            return  # that goal ended before the command arrived
        elif isinstance(command, protocol.Stop):
            self._stop_goal()
        elif isinstance(command, protocol.NextGoal):
            handovers = self.players.handovers
            handovers.next_waits, handovers.next_is_neural = command.next_waits, command.next_is_neural
        elif isinstance(command, protocol.Continue):
            self.hold_number = 0
        elif not goal.stop_requested:
            self.hold_number = command.number
            if self._pump is not None and goal.with_driver and not goal.interrupted:
                goal.interrupted = True
                self._engine.stop()

    def _stop_goal(self) -> None:
        if self._goal is not None and not self._goal.stop_requested:
            self._goal.stop_requested = True
            if self._goal.with_driver:
                self._engine.stop()
            else:  # it is held or hasn't begun, so the driver would not report its end
                self._end(protocol.OUTCOME_STOPPED)

    def _send_voice_events(self) -> None:
        loader = self._synthesizer.loader if self._synthesizer else None
        for event in loader.events() if loader else ():
            self._channel.send(event)

    def report_voice(self, voice: str, fallback_reason: str | None) -> None:
        """Report the voice that speaks the goal, unless the server knows it. The playback calls this."""
        if self._goal is not None and voice != self._reported_voice:
            self._reported_voice = voice
            self._channel.send(protocol.VoiceChosen(self._goal.id, voice, fallback_reason or self._fallback_reason))

    def confirm_hold(self) -> None:
        """Report, once, that the held goal is silent. The playback calls this as long as it is."""
        if self._goal is not None and not self._goal.stop_requested and self._confirmed_hold != self.hold_number:
            self._confirmed_hold = self.hold_number
            self._channel.send(protocol.Held(self._goal.id, self.hold_number))

    def _report_output(self) -> None:
        output = self.players.output
        if self._goal is not None and output != self._reported_output:
            self._reported_output = output
            self._channel.send(protocol.OutputChanged(self._goal.id, output.to_json() if output else None))

    # -- one goal

    def _speak(self, command: protocol.Speak) -> None:
        """Speak a goal to its end."""
        self._goal = goal = ActiveGoal(command, time.monotonic())
        self.hold_number = self._confirmed_hold = 0
        self.gaps = []
        self.players.begin(command)
        self._reported_output, self._reported_voice, self._fallback_reason = None, "", None
        self._channel.send(protocol.Started(command.id))
        # Commands for this goal may have arrived together with it.
        backlog, self._backlog = self._backlog, deque()
        for each in backlog:
            self._obey(each)
        try:
            self._fallback_reason = self._set_properties(command)
        except CannotSpeak as error:
            if self._goal is not None:
                self._fail(error.reason, str(error))
        if self._goal is not None and self._pump is not None and command.lead_in:
            self._fail(Reason.BAD_OPTION, "this driver plays by itself: it can't be given a lead-in")
        goal.error = None
        while self._goal is not None:
            if goal.with_driver:
                self._step_driver(goal)
            elif self._pump is not None and self.hold_number:
                self.confirm_hold()
                self.wait((), None)
            else:
                self._give_to_driver(goal)

    def _give_to_driver(self, goal: ActiveGoal) -> None:
        """Have the driver speak the text from the last word that was heard."""
        goal.progress_at = time.monotonic()
        if goal.silent_at is not None:
            goal.began_at += goal.progress_at - goal.silent_at
        goal.offset = goal.last_word
        goal.with_driver, goal.interrupted, goal.silent_at = True, False, None
        if self._engine.say(goal.command.text[goal.offset :], goal.id) is not None:
            self._fail(Reason.NOTHING_TO_SAY, "nothing in the text can be spoken")

    def _step_driver(self, goal: ActiveGoal) -> None:
        """Let the driver go on. `talk`'s own speaks to the end in one step; a foreign one needs many steps."""
        self._engine.iterate()
        if self._goal is None:
            return
        if self._pump is None:
            self._fail(Reason.ENGINE_FAILED, "the driver lost the sentence")
        elif goal.error is not None:  # a driver whose `say` raises never reports that it is finished
            self._engine.stop()
            self._engine.proxy.setBusy(False)  # otherwise pyttsx3 would not pass on the next sentence
            self._driver_finished(goal.id, completed=False)
        else:
            self.wait((), time.monotonic() + DRIVER_STEP_S)
            self._pump()

    def _report_word(self, location: int, length: int, **_: object) -> None:
        """Report a word. The notification's name is ignored, because some drivers put the word there."""
        goal = self._goal
        if goal is None or goal.stop_requested or goal.interrupted:
            return
        found = goal.words.find(goal.offset + location if location >= 0 else location, length)
        if found is not None:
            start, end, number = found
            goal.last_word, goal.progress_at = start, time.monotonic()
            seconds = goal.progress_at - goal.began_at if self.position is None else self.position
            self._channel.send(protocol.Word(goal.id, start, end, number, round(seconds, 3)))

    def _note_error(self, exception: Exception, **_: object) -> None:
        if self._goal is not None and self._goal.error is None:
            self._goal.error = exception

    def _driver_finished(self, name: str | None, completed: bool, **_: object) -> None:
        goal = self._goal
        if goal is None or name != goal.id:  # it is about an earlier goal
            return
        error = goal.error
        if goal.interrupted and not (completed or goal.stop_requested or error):
            goal.with_driver, goal.silent_at = False, time.monotonic()
        elif completed:
            self._end(protocol.OUTCOME_COMPLETED)
        elif isinstance(error, CannotSpeak):
            self._fail(error.reason, str(error))
        elif goal.stop_requested:
            self._end(protocol.OUTCOME_STOPPED)
        elif error is None:
            self._fail(Reason.ENGINE_FAILED, "the driver did not complete the sentence")
        else:
            traceback.print_exception(error)  # for the server's log
            self._fail(Reason.ENGINE_FAILED, f"{type(error).__name__}: {error}")

    def _fail(self, reason: Reason, message: str) -> None:
        self._end(protocol.OUTCOME_FAILED, reason, message)

    def _end(self, outcome: str, reason: Reason | None = None, message: str | None = None) -> None:
        assert self._goal is not None
        self._report_output()
        goal, self._goal = self._goal, None
        duration = self.duration if outcome == protocol.OUTCOME_COMPLETED else None
        gaps = len(self.gaps), round(sum(self.gaps), 3)
        self._channel.send(protocol.Ended(goal.id, outcome, reason, message, duration, *gaps, self.players.chosen))

    def _alive_due(self) -> float | None:
        """Return when the next sign of life is due; None if none is to be sent."""
        loader = self._synthesizer.loader if self._synthesizer else None
        loading = loader is not None and loader.descriptor is not None
        if not loading and (self._goal is None or self._is_overdue(self._goal)):
            return None
        return self._channel.sent_at + protocol.ALIVE_INTERVAL_S

    def _is_overdue(self, goal: ActiveGoal) -> bool:
        """Return whether a foreign driver is taking longer than the text could need.

        This process then sends no signs of life, so the server kills it. There may be no other way to silence the
        driver.
        """
        if self._pump is None or not goal.with_driver:
            return False
        words_left = (len(goal.command.text) - goal.last_word) * MAX_WORDS_PER_CHARACTER
        limit = DRIVER_LIMIT_S + words_left * 60 / goal.command.rate
        overdue = time.monotonic() > goal.progress_at + limit
        if overdue and not goal.overdue_logged:
            goal.overdue_logged = True
            sys.stderr.write(f"the driver did not end what takes less than {limit:.0f} s\n")
        return overdue


def _with_traceback(callback: Callable[..., None]) -> Callable[..., None]:
    """Return a callback that prints the traceback of its exceptions, which pyttsx3 drops."""

    def call(**values: Any) -> None:
        try:
            callback(**values)
        except Exception:
            traceback.print_exc()
            raise

    return call
