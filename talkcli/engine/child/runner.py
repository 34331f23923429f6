"""The main loop of the engine process, which speaks goals and executes commands.

The loop runs in one thread. While `talk`'s own driver speaks, it waits in `GoalRunner.wait`, which executes a `Stop` or
`Hold` at once. Third-party drivers can't pause a sentence. They are stopped instead, and later speak the rest of the
text as a new sentence.

Each goal must end with an `Ended`. pyttsx3 makes this harder because it drops exceptions raised by its callbacks,
ignores blank text and reports errors as notifications.
"""

from __future__ import annotations

import os
import select
import sys
import time
import traceback

from talkcli.engine import protocol
from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.words import TimedWord, WordFinder
from talkcli.engine.pronunciation import Pronunciations
from talkcli.engine.voices import list_voices
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.options import MARKDOWN, SOUND
from talkcli.goals.reasons import Reason
from talkcli.polling import NEVER, wait_ready
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from typing import Any

    from talkcli.engine.child.cutting import GrowingText
    from talkcli.engine.child.players.base import EndedEarly, Interest
    from talkcli.engine.child.players.chooser import PlayerChooser
    from talkcli.engine.child.synthesizers.combined import CombinedSynthesizer
    from talkcli.engine.markdown import MarkdownReader
    from talkcli.engine.sounds import SoundLibrary
    from talkcli.goals.goal import Output

#: Time between two steps of a third-party driver while it speaks. The driver is polled because it can't wake this
#: process.
DRIVER_STEP_S = 0.05

#: Time allowed for a third-party driver to finish the text, in addition to the estimated time for the remaining words.
#: The driver doesn't report whether it is still speaking.
DRIVER_LIMIT_S = 10.0
#: Maximum number of words expected for each remaining character. "€" is spoken as one word. An emoji is spoken as up to
#: five words, but a text rarely consists of emojis only.
MAX_WORDS_PER_CHARACTER = 3
#: Time allowed for the current word to end after an `Interrupt`. libespeak-ng speaks a number of 16 digits as one word,
#: which takes 8 s. A longer word is cut off, and repeated when the goal continues.
WORD_END_LIMIT_S = 1.0
#: How many characters must arrive before the server is told again that text is missing.
REPORTED_CHARS = 1_000


class Channel:
    """The engine process's connection to the server."""

    #: standard input, which is the socket to the server
    descriptor = 0

    def __init__(self) -> None:
        #: whether the server has closed the connection
        self.closed = False
        #: monotonic time at which the last event was sent
        self.sent_at = time.monotonic()
        self._lines = LineSplitter()

    def send(self, event: protocol.Event) -> None:
        """Send an event. Block until all of it is written."""
        data = memoryview(protocol.encode(event))
        self.sent_at = time.monotonic()
        try:
            while data:
                data = data[os.write(self.descriptor, data) :]
        except (BrokenPipeError, ConnectionResetError):
            self.closed = True

    def receive(self) -> list[protocol.Command]:
        """Wait for data, and return all complete commands.

        If the server has closed the connection, set `closed`.
        """
        try:
            data = os.read(self.descriptor, 65536)
        except ConnectionResetError:
            data = b""
        if not data:
            self.closed = True
            return []
        return [protocol.decode(line, protocol.COMMAND_CLASSES) for line in self._lines.feed(data)]


class ActiveGoal:
    """The goal that is being spoken, with its text and its progress."""

    def __init__(self, command: protocol.Speak, now: float) -> None:
        self.id = command.id
        self.command = command
        self._markdown = _make_markdown_reader() if command.format == MARKDOWN else None
        #: the text without Markdown marks. All offsets are the same as in the sender's text.
        self.text = self._remove_markdown(command.text, ended=not command.more)
        #: the text, if it may still grow
        self.growing_text = _make_growing_text(self.text, command) if command.more or command.broken else None
        self.text_missing = False
        #: number of characters received, and the last such number that was reported to the server
        self.length, self.reported_length = len(command.text), 0
        self.words = WordFinder(self.text, max(command.start, command.heard_end), command.heard_words)
        #: time at which the driver last received text
        self.resumed_at = now
        #: seconds of speech before `resumed_at`, if a third-party driver was paused
        self.spoken_s = command.heard
        #: time at which the driver last received text or reported a word
        self.progress_at = now
        #: whether the driver is speaking the text; False while a third-party driver is paused
        self.with_driver = False
        #: whether a third-party driver was stopped in order to pause or interrupt the goal
        self.interrupted = False
        #: offset in the text at which the driver started speaking
        self.offset = 0
        #: offset in the text of the last word heard
        self.last_word = command.start
        self.stop_requested = False
        #: the last output and the last voice reported to the server
        self.reported_output: Output | None = None
        self.reported_voice = ""
        #: human-readable reason for a fallback voice; None if the requested voice speaks
        self.fallback_reason: str | None = None
        #: number of the last pause that was confirmed to the server
        self.confirmed_hold = 0
        #: the first error that the driver reported
        self.error: Exception | None = None
        #: whether the log already says that the driver takes too long
        self.overdue_logged = False

    def append(self, command: protocol.Append, now: float) -> None:
        """Add the text of an `Append` command, and record whether the goal's text is now complete."""
        assert self.growing_text
        self.length += len(command.text)
        text = self._remove_markdown(command.text, ended=command.end)
        self.growing_text.append(text, now)
        self.words.text += text
        self.growing_text.ended = command.end
        if command.broken:
            self.growing_text.drop_incomplete()

    def _remove_markdown(self, text: str, *, ended: bool) -> str:
        """Return the newly completed text without Markdown. Plain text is returned unchanged."""
        return self._markdown.read(text, ended=ended) if self._markdown else text

    def speech_seconds(self, now: float) -> float:
        """Return the seconds for which a third-party driver has spoken the goal, without pauses."""
        return self.spoken_s + (now - self.resumed_at if self.with_driver else 0.0)


class GoalRunner:
    """Executes the server's commands, and speaks its goals.

    Call `attach_engine` once, and then `run`.
    """

    def __init__(self, channel: Channel, players: PlayerChooser, sounds: SoundLibrary) -> None:
        """Create a runner without an engine.

        Args:
            channel: the connection to the server.
            players: chooses the players for `talk`'s own driver.
            sounds: the sounds that can be played.
        """
        self._channel = channel
        self.players = players
        self.sounds = sounds
        self._goal: ActiveGoal | None = None
        self._engine: Any = None
        self._set_properties: Any = None
        self._step_run_loop: Callable[[], None] | None = None
        self._synthesizer: CombinedSynthesizer | None = None
        #: number of the current pause, or 0. The playback reads the number here, because pyttsx3 has no method for
        #: pausing.
        self.hold_number = 0
        #: time by which the current word must end after an interruption; None if the goal wasn't interrupted
        self.word_end_due: float | None = None
        # Only `talk`'s own driver sets these attributes. pyttsx3's notifications have no fields for them.

        #: the word being reported; None with a third-party driver
        self.word: TimedWord | None = None
        #: length of the last sentence in seconds; None if it wasn't heard completely
        self.duration: float | None = None
        #: seconds of the last sentence that were heard; None if unknown
        self.heard: float | None = None
        #: how the last sentence was interrupted; None if it wasn't interrupted
        self.ended_early: EndedEarly | None = None
        #: lengths in seconds of the gaps in the last sentence
        self.gaps: list[float] = []

    def attach_engine(
        self,
        engine: Any,
        set_properties: Callable[[protocol.Speak], str | None],
        step_run_loop: Callable[[], None] | None,
        synthesizer: CombinedSynthesizer | None,
    ) -> None:
        """Set the pyttsx3 engine that speaks the goals, and subscribe to its notifications.

        Args:
            engine: pyttsx3's engine.
            set_properties: sets the engine's properties for a goal. It returns the reason for a fallback voice, or None
                if the goal has the requested voice. It raises CannotSpeak if the goal can't be spoken.
            step_run_loop: called about 20 times a second while a third-party driver speaks, or None for `talk`'s own
                driver.
            synthesizer: the synthesizer of `talk`'s own driver, or None with a third-party driver.
        """
        self._engine = engine
        self._set_properties = set_properties
        self._step_run_loop = step_run_loop
        self._synthesizer = synthesizer
        engine.connect("started-word", _with_traceback(self._report_word))
        engine.connect("finished-utterance", _with_traceback(self._handle_driver_finished))
        engine.connect("error", _with_traceback(self._record_error))

    def run(self, *, send_voices: bool) -> None:
        """Speak goals and execute commands until the server disconnects.

        Args:
            send_voices: whether to send the list of voices first.
        """
        if send_voices:
            try:
                voices = list_voices(self._engine)
            except Exception:  # noqa: BLE001 - a third-party driver may fail here and still be able to speak
                traceback.print_exc()
                voices = ()
            self._channel.send(protocol.VoiceList(voices))
        while not self._channel.closed:
            if self._goal is None:
                self.wait()
            else:
                self._speak(self._goal)

    def wait(self, interests: Iterable[Interest] = (), until: float = NEVER) -> None:
        """Wait until a descriptor is ready or time is up, and execute any commands that arrive.

        Also send events that are due. This method may return early. By then, a command may have stopped or paused the
        sentence.

        Args:
            interests: the descriptors, with the poll events to wait for.
            until: the monotonic time.
        """
        self._send_voice_events()
        watched, until = dict(interests), min(until, self._next_heartbeat_at())
        if not self._channel.closed:
            watched[self._channel.descriptor] = select.POLLIN
        loader = self._synthesizer.loader if self._synthesizer else None
        if loader is not None and loader.descriptor is not None:
            watched[loader.descriptor] = select.POLLIN
            until = min(until, loader.deadline)
        if self._channel.descriptor in wait_ready(watched, until - time.monotonic()):
            for command in self._channel.receive():
                self._execute(command)
            if self._channel.closed:
                self._stop_goal()
        self._send_voice_events()
        self._report_output()
        if time.monotonic() >= self._next_heartbeat_at():
            self._channel.send(protocol.Alive(self._goal.id if self._goal else ""))

    def _execute(self, command: protocol.Command) -> None:
        """Execute a command, unless its goal has already ended."""
        goal = self._goal
        if isinstance(command, protocol.LoadVoice | protocol.DropVoice):
            if self._synthesizer is not None:
                self._synthesizer.load_or_unload(command)
        elif isinstance(command, protocol.GoalCommand):
            self._begin_goal(command)
        elif goal is not None and not isinstance(command, protocol.Configure) and goal.id == command.id:
            self._execute_for_goal(goal, command)

    def _execute_for_goal(self, goal: ActiveGoal, command: protocol.ActiveGoalCommand) -> None:
        """Execute a command for the current goal."""
        match command:
            case protocol.Stop():
                self._stop_goal()
            case protocol.Append():
                goal.append(command, time.monotonic())
            case protocol.NextGoal():
                handovers = self.players.handovers
                handovers.next_waits, handovers.next_is_neural = command.next_waits, command.next_is_neural
            case protocol.Interrupt():
                self.word_end_due = time.monotonic() + WORD_END_LIMIT_S
                self._interrupt_driver(goal)
            case protocol.Continue():
                self.hold_number = 0
            case protocol.Hold():
                if not goal.stop_requested:
                    self.hold_number = command.number
                    self._interrupt_driver(goal)

    def _interrupt_driver(self, goal: ActiveGoal) -> None:
        """Stop the driver if it is a third-party driver, which can't be paused.

        In `talk`'s own driver, the playback handles pauses and interruptions.
        """
        if self._step_run_loop is not None and goal.with_driver and not goal.interrupted:
            goal.interrupted = True
            self._engine.stop()

    def _stop_goal(self) -> None:
        """Stop the driver if it is speaking the current goal. Otherwise, end the goal at once."""
        if self._goal is not None and not self._goal.stop_requested:
            self._goal.stop_requested = True
            if self._goal.with_driver:
                self._engine.stop()
            else:  # the goal is paused or hasn't started, so the driver would not report its end
                self._end_goal(protocol.OUTCOME_STOPPED)

    def _send_voice_events(self) -> None:
        """Send the server all new events about neural voices."""
        loader = self._synthesizer.loader if self._synthesizer else None
        for event in loader.take_events() if loader else ():
            self._channel.send(event)

    def report_voice(self, voice: str, fallback_reason: str | None) -> None:
        """Tell the server which voice speaks the goal, unless the server already knows."""
        goal = self._goal
        if goal is not None and voice != goal.reported_voice:
            goal.reported_voice = voice
            self._channel.send(protocol.VoiceChosen(goal.id, voice, fallback_reason or goal.fallback_reason))

    def find_word(self, location: int, length: int) -> tuple[int, int, int] | None:
        """Return the start, end and number of the word at a location, or None if the word isn't new."""
        assert self._goal
        return self._goal.words.find(location, length)

    @property
    def text_start(self) -> int:
        """The offset in the text at which the current goal continues after an interruption, or 0."""
        return self._goal.command.start if self._goal else 0

    @property
    def pronunciations(self) -> Pronunciations:
        """The pronunciations of terms in the text of the current goal."""
        return Pronunciations(self._goal.command.pronunciations or {} if self._goal else {})

    @property
    def sound(self) -> protocol.Speak | None:
        """The current goal's command if the goal is a sound, otherwise None."""
        command = self._goal.command if self._goal else None
        return command if command and command.format == SOUND else None

    @property
    def growing_text(self) -> GrowingText | None:
        """The text of the current goal, or None if the text doesn't grow."""
        return self._goal.growing_text if self._goal else None

    def report_text_missing(self, missing: bool) -> None:
        """Tell the server whether the goal is silent because text is missing.

        Do nothing if the server already knows, unless a long text has arrived that can't be spoken yet.
        """
        goal = self._goal
        if goal is None:
            return
        if missing != goal.text_missing or (missing and goal.length > goal.reported_length + REPORTED_CHARS):
            goal.text_missing, goal.reported_length = missing, goal.length
            self._channel.send(protocol.TextMissing(goal.id, missing, goal.length))

    def confirm_hold(self) -> None:
        """Confirm to the server that the paused goal is silent.

        Each pause is confirmed only once.
        """
        goal = self._goal
        if goal is not None and not goal.stop_requested and goal.confirmed_hold != self.hold_number:
            goal.confirmed_hold = self.hold_number
            self._channel.send(protocol.Held(goal.id, self.hold_number))

    def _report_output(self) -> None:
        """Tell the server the device, volume and mute state of the goal's output if they have changed."""
        goal, output = self._goal, self.players.output
        if goal is not None and output != goal.reported_output:
            goal.reported_output = output
            self._channel.send(protocol.OutputChanged(goal.id, output.to_json() if output else None))

    # -- one goal

    def _begin_goal(self, command: protocol.Speak) -> None:
        """Make a new goal the current one, and tell the server that it has started."""
        self._goal = ActiveGoal(command, time.monotonic())
        self.hold_number, self.duration, self.heard, self.gaps = 0, None, None, []
        self.word_end_due = self.ended_early = None
        self.players.begin_goal(command)
        self._channel.send(protocol.Started(command.id))

    def _speak(self, goal: ActiveGoal) -> None:
        """Speak a goal until it has ended."""
        if self.sound is None:
            try:
                goal.fallback_reason = self._set_properties(goal.command)
            except CannotSpeak as error:
                self._fail_goal(error.reason, str(error))
        elif self._step_run_loop is not None:
            self._fail_goal(Reason.BAD_OPTION, "this driver can only speak, so it can't play sounds")
        if self._goal is goal and self._step_run_loop is not None and goal.command.lead_in:
            self._fail_goal(Reason.BAD_OPTION, "this driver plays the sound itself, so lead_in can't be used")
        if self._goal is goal and self._step_run_loop is not None and goal.growing_text:
            words = "this driver can't speak growing texts; send the text when it is complete"
            self._fail_goal(Reason.BAD_OPTION, words)
        goal.error = None
        while self._goal is goal:
            if goal.with_driver:
                self._step_driver(goal)
            elif self._step_run_loop is not None and self.word_end_due is not None:
                self._end_goal(protocol.OUTCOME_INTERRUPTED)
            elif self._step_run_loop is not None and self.hold_number:
                self.confirm_hold()
                self.wait()
            else:
                self._send_to_driver(goal)

    def _send_to_driver(self, goal: ActiveGoal) -> None:
        """Pass the goal's text to the driver. A third-party driver starts again at the last word heard."""
        goal.progress_at = goal.resumed_at = time.monotonic()
        goal.offset = goal.last_word
        goal.with_driver, goal.interrupted = True, False
        # pyttsx3 refuses a blank text, so a growing text is passed with its marks. The driver ignores the passed text
        # anyway.
        text = goal.command.text if goal.growing_text else goal.text
        if self._step_run_loop is not None:
            text = goal.text[goal.offset :]
        if self._engine.say(text, goal.id) is not None:
            self._fail_goal(Reason.NOTHING_TO_SAY, "nothing in the text can be spoken")

    def _step_driver(self, goal: ActiveGoal) -> None:
        """Run one step of the driver. If the driver has dropped the goal's text, fail the goal.

        `talk`'s own driver speaks the whole text in one step. A third-party driver needs many steps.
        """
        self._engine.iterate()
        if self._goal is not goal:
            return
        if self._step_run_loop is None:
            self._fail_goal(Reason.ENGINE_FAILED, "the driver dropped the sentence")
        elif goal.error is not None:  # a driver never reports the end of a text if its `say` has failed
            self._engine.stop()
            self._engine.proxy.setBusy(False)  # otherwise, pyttsx3 would hold back the next text
            self._handle_driver_finished(goal.id, completed=False)
        else:
            self.wait(until=time.monotonic() + DRIVER_STEP_S)
            self._step_run_loop()

    def _report_word(self, location: int, length: int, **_: object) -> None:
        """Tell the server about the word at a location in the text. Report each word only once.

        The notification's `name` is not compared with the goal's ID, because some drivers set it to the word.
        """
        goal = self._goal
        if goal is None or goal.stop_requested or goal.interrupted:
            return
        goal.progress_at, word = time.monotonic(), self.word
        if word is not None:
            word = replace(word, position=word.position + goal.command.heard)
        else:
            if found := self.find_word(goal.offset + location if location >= 0 else location, length):
                word = TimedWord(*found, goal.speech_seconds(goal.progress_at))
        if word is not None:
            goal.last_word = word.start
            self._channel.send(protocol.Word(goal.id, word.start, word.end, word.number, round(word.position, 3)))

    def _record_error(self, exception: Exception, **_: object) -> None:
        """Store the first error that the driver reports for the current goal."""
        if self._goal is not None and self._goal.error is None:
            self._goal.error = exception

    def _handle_driver_finished(self, name: str | None, completed: bool, **_: object) -> None:
        """End the goal when the driver has finished, unless a pause or an interruption stopped the driver."""
        goal = self._goal
        if goal is None or name != goal.id:  # the notification is for an earlier goal
            return
        error = goal.error
        if goal.interrupted and not (completed or goal.stop_requested or error):
            goal.spoken_s = goal.speech_seconds(time.monotonic())
            goal.with_driver = False
        elif completed:
            self._end_goal(protocol.OUTCOME_COMPLETED)
        elif isinstance(error, CannotSpeak):
            self._fail_goal(error.reason, str(error))
        elif goal.stop_requested:
            self._end_goal(protocol.OUTCOME_STOPPED)
        elif self.ended_early:
            self._end_goal(protocol.OUTCOME_INTERRUPTED)
        elif error is None:
            self._fail_goal(Reason.ENGINE_FAILED, "the driver stopped before the end of the sentence")
        else:
            traceback.print_exception(error)  # the traceback goes to the server's log
            self._fail_goal(Reason.ENGINE_FAILED, f"{type(error).__name__}: {error}")

    def _fail_goal(self, reason: Reason, message: str) -> None:
        """End the current goal as failed, and tell the server why."""
        self._end_goal(protocol.OUTCOME_FAILED, reason, message)

    def _end_goal(self, outcome: str, reason: Reason | None = None, message: str | None = None) -> None:
        """End the current goal, and tell the server how it ended."""
        assert self._goal is not None
        self._report_output()
        goal, self._goal = self._goal, None
        before, duration, heard = goal.command.heard, self.duration, self.heard
        duration = None if duration is None else round(before + duration, 6)
        heard = None if heard is None else round(before + heard, 6)
        if self._step_run_loop is not None:
            heard = round(goal.speech_seconds(time.monotonic()), 3)
        gaps = len(self.gaps), round(sum(self.gaps), 3)
        rest = None
        if outcome == protocol.OUTCOME_INTERRUPTED:
            rest = self.ended_early.rest if self.ended_early else None
            rest = goal.last_word if rest is None else rest
        player = self.players.last_player
        ended = protocol.Ended(goal.id, outcome, reason, message, duration, *gaps, player, heard, rest)
        self._channel.send(ended)

    def _next_heartbeat_at(self) -> float:
        """Return the time of the next heartbeat, or NEVER if none is needed.

        None is sent while the process is idle or a driver hangs.
        """
        loader = self._synthesizer.loader if self._synthesizer else None
        loading = loader is not None and loader.descriptor is not None
        if not loading and (self._goal is None or self._notice_overdue(self._goal)):
            return NEVER
        return self._channel.sent_at + protocol.ALIVE_INTERVAL_S

    def _notice_overdue(self, goal: ActiveGoal) -> bool:
        """Return whether a third-party driver takes too long. Log this once for each goal.

        The process then sends no `Alive`, so that the server kills it. There may be no other way to stop the driver.
        """
        if self._step_run_loop is None or not goal.with_driver:
            return False
        words_left = (len(goal.command.text) - goal.last_word) * MAX_WORDS_PER_CHARACTER
        limit = DRIVER_LIMIT_S + words_left * 60 / goal.command.rate
        overdue = time.monotonic() > goal.progress_at + limit
        if overdue and not goal.overdue_logged:
            goal.overdue_logged = True
            sys.stderr.write(f"the driver did not finish a text that takes less than {limit:.0f} s\n")
        return overdue


def _make_markdown_reader() -> MarkdownReader:
    """Create a reader for a goal's text in Markdown."""
    from talkcli.engine.markdown import MarkdownReader  # this import is slow and rarely needed

    return MarkdownReader()


def _make_growing_text(text_so_far: str, command: protocol.Speak) -> GrowingText:
    """Return a goal's text so far as a `GrowingText`, to which more text can be added.

    If the text broke off, an incomplete last sentence is left out.
    """
    from talkcli.engine.child.cutting import GrowingText  # this import is slow and rarely needed

    text = GrowingText(text_so_far, ended=False, start=command.start)
    if command.broken:
        text.drop_incomplete()
    return text


def _with_traceback(callback: Callable[..., None]) -> Callable[..., None]:
    """Return a version of a callback that prints its exceptions instead of raising them."""

    def call(**values: Any) -> None:
        try:
            callback(**values)
        except Exception:  # noqa: BLE001 - pyttsx3 would drop any exception
            traceback.print_exc()

    return call
