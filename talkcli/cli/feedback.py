"""The displays for `--feedback`: JSON, plain lines or a highlighted sentence.

These classes only display events. They never wait, and they don't know which client owns a goal.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading

from talkcli.cli.show import Feedback, has_colour, note, show, show_json, terminal_columns
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.states import State
from talkcli.polling import wait_ready
from talkcli.protocol.events import GoalInterrupted, PausedChanged, Result, StateChanged, TextMissing, WordHeard
from talkcli.terminal.goals import TEXT_NOT_KEPT
from talkcli.terminal.text import MeasuredText, Screen, printable, width

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from talkcli.cli.show import CommonOptions
    from talkcli.goals.goal import Goal
    from talkcli.protocol.events import Event

#: The minimum width of the text. If there is less room, the goal's id and state are left out.
_MIN_SENTENCE_COLUMNS = 20
#: Terminal codes that style the current word, the text after it, and normal text.
_WORD_STYLE, _UNHEARD_STYLE, _NORMAL_STYLE = "\x1b[1;7m", "\x1b[2m", "\x1b[0m"
#: Terminal code that clears the current line and moves the cursor to its start.
_CLEAR_LINE = "\r\x1b[2K"


def make_feedback(options: CommonOptions) -> Feedback:
    """Choose and create the display for --feedback."""
    if options.json:
        return _JsonFeedback()
    # With other encodings, the displayed width of characters is unknown.
    utf_8 = sys.stdout is not None and sys.stdout.encoding.lower().replace("-", "") == "utf8"
    return _TerminalFeedback() if utf_8 and has_colour() else _LineFeedback()


class _JsonFeedback(Feedback):
    """A display that prints each event as a JSON object."""

    shows_events = True

    def show(self, goal: Goal, event: Event) -> None:  # noqa: ARG002
        """Print an event as a JSON object."""
        show_json(event.to_json())


class _LineFeedback(Feedback):
    """A display that prints each event as a line.

    Fields are separated by spaces, so only the last field can contain spaces.
    """

    shows_events = True

    def __init__(self) -> None:
        #: the last state shown for each unfinished goal, by goal id
        self._shown: dict[str, State] = {}

    def show(self, goal: Goal, event: Event) -> None:  # noqa: ARG002
        """Print an event as a line."""
        if isinstance(event, StateChanged):
            self._show_state(event.id, event.state)
        elif isinstance(event, WordHeard):
            place = f"{event.number} {event.start}-{event.end} {event.time:.3f}"
            show(f"{printable(event.id)} word {place} {printable(event.word)}")
        elif isinstance(event, TextMissing):
            show(f"{printable(event.id)} {'WAITING' if event.waits else 'CONTINUES'}")
        elif isinstance(event, GoalInterrupted):
            self._shown.pop(event.id, None)  # ACTIVE will be shown again when the goal continues
            show(f"{printable(event.id)} INTERRUPTED {printable(event.by.goal or '')}")
        elif isinstance(event, PausedChanged):
            show(f"{printable(event.id or '-')} {'PAUSED' if event.paused else 'RESUMED'}")
        elif isinstance(event, Result):
            self._show_state(event.goal.id, event.goal.state)
            self._shown.pop(event.goal.id, None)

    def _show_state(self, goal_id: str, state: State) -> None:
        """Print the state of a goal if it has changed."""
        # The end of a goal is usually reported twice, as a new state and as a result. Print it only once.
        if self._shown.get(goal_id) is not state:
            self._shown[goal_id] = state
            show(f"{printable(goal_id)} {state.name}")


class _TerminalFeedback(Feedback):
    """A display that highlights each word on a terminal as it is heard.

    The line is rewritten in place and is never wider than the terminal, so only part of a long text is visible. When
    the goal ends, the whole text is written.
    """

    shows_events = True

    def __init__(self) -> None:
        self._line: _GoalLine | None = None
        #: held during output, because another thread repaints the line when the terminal is resized
        self._writing = threading.Lock()
        self._resizes = _ResizeWatcher(self._paint)

    def begin(self, goals: Sequence[Goal]) -> None:
        """Show the goal that is being spoken. If there is none, show the first unfinished goal."""
        unfinished = [each for each in goals if not each.state.terminal]
        if unfinished and self._line is None:
            spoken = (each for each in unfinished if each.state is not State.PENDING)
            self._line = _GoalLine(next(spoken, unfinished[0]))
            self._paint()

    def show(self, goal: Goal, event: Event) -> None:
        """Update the line after an event. When a goal ends, write its whole text."""
        line = self._line
        if isinstance(event, Result):
            self._show_end(event.goal)
        elif isinstance(event, PausedChanged):  # pausing affects all goals
            if line:
                line.paused = event.paused
        else:
            # Until the goal of this event is spoken, the line may show another goal.
            if line is None or (line.goal.id != goal.id and _is_spoken(event)):
                line = self._line = _GoalLine(goal)
            if line.goal.id == goal.id:
                line.update(goal, event)
        self._paint()

    def note(self, message: str) -> None:
        """Write a message to standard error, and repaint the line below it."""
        with self._writing:
            if self._line:
                _write(_CLEAR_LINE)
            note(message)
        self._paint()

    def close(self) -> None:
        """Write the current goal's whole text, and stop watching the terminal's size."""
        self._resizes.close()
        if self._line:
            self._write_whole_text(self._line)
            self._line = None

    def _show_end(self, goal: Goal) -> None:
        """Write the final state and the whole text of a goal that has ended."""
        line, ended = self._line, _GoalLine(goal)
        ended.state = goal.state
        if line and line.goal.id == goal.id:
            ended.word = max(line.word, ended.word, key=lambda word: word[1])
            self._line = None
        self._write_whole_text(ended)

    def _write_whole_text(self, line: _GoalLine) -> None:
        """Write a goal's id, its state and its whole text, followed by a line break."""
        ended = line.state is State.SUCCEEDED
        heard, unheard = line.text.split(len(line.text) if ended else line.word[1])
        with self._writing:
            state = Screen(colour=True).coloured(f"{line.state.name:<9}", line.state)
            _write(
                f"{_CLEAR_LINE}{printable(line.goal.id)}  {state}  {heard}{_UNHEARD_STYLE}{unheard}{_NORMAL_STYLE}\n"
            )

    def _paint(self) -> None:
        """Repaint the current goal's line on the terminal."""
        with self._writing:
            line = self._line  # another thread may set `_line` to None
            if line:
                _write(line.render())


class _ResizeWatcher(threading.Thread):
    """A thread that calls a function when the terminal is resized.

    It uses `sigwait`, because a signal handler would interrupt the wait for goals (see `interrupts`). macOS discards
    signals without a handler, so on macOS the line only adapts to the new width at the next event.
    """

    def __init__(self, on_resize: Callable[[], None]) -> None:
        super().__init__(name="resizes", daemon=True)
        self._on_resize = on_resize
        self._closed = False
        self._blocked = {signal.SIGWINCH} - signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGWINCH})
        try:
            self.start()
        except RuntimeError:  # the thread could not be started, so the line keeps its width until the next event
            self._closed = True

    def run(self) -> None:
        """Call the function after each resize until the watcher is closed."""
        while signal.sigwait({signal.SIGWINCH}) and not self._closed:
            self._on_resize()

    def close(self) -> None:
        """Stop the thread, and unblock the signal SIGWINCH."""
        if not self._closed:
            self._closed = True
            assert self.ident
            signal.pthread_kill(self.ident, signal.SIGWINCH)
            self.join()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, self._blocked)


class _GoalLine:
    """The line that shows a goal's state and text, with the current word highlighted."""

    def __init__(self, goal: Goal) -> None:
        self.goal = goal
        self.paused = goal.paused
        self.state = State.PENDING if goal.state.terminal else goal.state
        self.waits = goal.waits
        self.interrupted = goal.interrupted_by is not None
        self.text = MeasuredText(TEXT_NOT_KEPT if goal.text is None else goal.text)
        heard = len(goal.spoken or "")
        #: the start and end of the current word, as indices into the text
        self.word = (heard, heard)

    def update(self, goal: Goal, event: Event) -> None:
        """Update the current word, the text or the state after an event."""
        text = goal.text or ""
        if isinstance(event, WordHeard):
            if goal.text is not None and event.end > len(text):  # only the sender knows the new text before it is heard
                text = text.ljust(event.start) + event.word
            self.word = (event.start, event.end)
        elif isinstance(event, TextMissing):
            self.waits = event.waits
        elif isinstance(event, GoalInterrupted):
            self.interrupted = True
        elif isinstance(event, StateChanged) and event.state is not State.PENDING:
            # A PENDING event may arrive late, when the goal is already in a later state.
            self.state, self.interrupted = event.state, False
        self.text.extend(text[len(self.text) :])

    def render(self) -> str:
        """Return the line with terminal codes, cut to the terminal's width."""
        # Leave the last column free, because some terminals start a new line as soon as it is filled.
        columns = terminal_columns(sys.stdout) - 1
        state = self.state.name
        if self.state is State.ACTIVE and self.interrupted:
            state = "INTERRUPTED"
        elif self.state is State.ACTIVE and (self.paused or self.waits):
            state = "PAUSED" if self.paused else "WAITING"
        head = f"{printable(self.goal.id)}  {Screen(colour=True).coloured(f'{state:<9}', self.state)}  "
        if columns - width(head) < _MIN_SENTENCE_COLUMNS:
            head = ""
        heard, word, unheard = self.text.view(*self.word, columns - width(head))
        lit = f"{_WORD_STYLE}{word}{_NORMAL_STYLE}" if word else ""
        return f"{_CLEAR_LINE}{head}{heard}{lit}{_UNHEARD_STYLE}{unheard}{_NORMAL_STYLE}"


def _is_spoken(event: Event) -> bool:
    """Return whether an event shows that its goal is being spoken."""
    return isinstance(event, WordHeard) or (isinstance(event, StateChanged) and event.state is State.ACTIVE)


def _write(text: str) -> None:
    """Write to the terminal without buffering."""
    data = text.encode(errors="backslashreplace")
    fd = sys.stdout.fileno()
    while data:
        try:
            data = data[os.write(fd, data) :]
        except BlockingIOError:  # another program has made the terminal non-blocking
            wait_ready({fd: select.POLLOUT}, None)
