"""What `--feedback` shows of goals while they are spoken: JSON objects, lines of words, or a sentence that lights up.

It must not wait, and not know who owns a goal: it is told of events, one after the other, and shows them.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
from typing import Protocol

from talkcli.cli.show import colourful, note, show, show_json
from talkcli.client.connect import ready
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.states import State
from talkcli.protocol.events import PausedChanged, Result, StateChanged, WordHeard
from talkcli.terminal.highlight import Sentence
from talkcli.terminal.text import Screen, printable

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

    from talkcli.cli.show import Common
    from talkcli.goals.goal import Goal
    from talkcli.protocol.events import Event

#: Columns of a terminal that doesn't say how many it has.
_USUAL_WIDTH = 80
#: With fewer columns than this for the text beside id and state, these are left out.
_LEAST_TEXT = 20
_LIT, _AHEAD, _PLAIN = "\x1b[1;7m", "\x1b[2m", "\x1b[0m"
#: Back to the line's beginning, and clear it.
_AGAIN = "\r\x1b[2K"


class Feedback(Protocol):
    """Shows what happens to goals."""

    def begin(self, goals: Sequence[Goal]) -> None:
        """Show how these goals stand, before their first event."""

    def show(self, goal: Goal, event: Event) -> None:
        """Show an event of this goal's."""

    def aside(self, words: str) -> None:
        """Write a note to standard error."""

    def close(self) -> None:
        """Leave standard output so that something else can be written."""


def feedback(options: Common) -> Feedback:
    """Return what fits standard output and the options."""
    if options.json:
        return _Objects()
    # Where the terminal is not in UTF-8, what it makes of a character has another width than the character.
    utf_8 = sys.stdout is not None and sys.stdout.encoding.lower().replace("-", "") == "utf8"
    return _Light() if utf_8 and colourful() else _Lines()


class _Objects:
    """The events as they came, an object a line."""

    def begin(self, goals: Sequence[Goal]) -> None:
        """An event is what the server said, so there is none yet."""

    def show(self, goal: Goal, event: Event) -> None:  # noqa: ARG002
        show_json(event.to_json())

    def aside(self, words: str) -> None:
        note(words)

    def close(self) -> None:
        """There is nothing to leave."""


class _Lines:
    """A line an event, its fields separated by blanks; what may have blanks in it comes last."""

    def __init__(self) -> None:
        #: the state that was shown last, by id, of goals that have not ended
        self._shown: dict[str, State] = {}

    def begin(self, goals: Sequence[Goal]) -> None:
        """A line is an event, so there is none yet."""

    def show(self, goal: Goal, event: Event) -> None:  # noqa: ARG002
        if isinstance(event, StateChanged):
            self._state(event.id, event.state)
        elif isinstance(event, WordHeard):
            place = f"{event.number} {event.start}-{event.end} {event.time:.3f}"
            show(f"{printable(event.id)} word {place} {printable(event.word)}")
        elif isinstance(event, PausedChanged):
            show(f"{printable(event.id or '-')} {'PAUSED' if event.paused else 'RESUMED'}")
        elif isinstance(event, Result):
            self._state(event.goal.id, event.goal.state)
            self._shown.pop(event.goal.id, None)

    def _state(self, goal_id: str, state: State) -> None:
        # A goal's end comes as a state and as its result; where it had ended before, or was lost, as the latter alone.
        if self._shown.get(goal_id) is not state:
            self._shown[goal_id] = state
            show(f"{printable(goal_id)} {state.name}")

    def aside(self, words: str) -> None:
        note(words)

    def close(self) -> None:
        """There is nothing to leave."""


class _Light:
    """The sentence on a line of the terminal, each word lit as it is heard; the whole of it at its end.

    The line is written over in place, so it is never wider than the terminal: of a long text a part is shown.
    """

    def __init__(self) -> None:
        self._goal: Goal | None = None
        self._sentence = Sentence("")
        self._state = State.PENDING
        self._paused = False
        self._word = (0, 0)
        #: held while the terminal is written to
        self._painting = threading.Lock()
        self._stale = False
        self._before = signal.signal(signal.SIGWINCH, self._on_resize)

    def begin(self, goals: Sequence[Goal]) -> None:
        going = [each for each in goals if not each.state.terminal]
        if going and self._goal is None:
            self._begin(next((each for each in going if each.state is not State.PENDING), going[0]))
            self._paint()

    def show(self, goal: Goal, event: Event) -> None:
        if isinstance(event, Result):
            self._end(event.goal)
        elif isinstance(event, PausedChanged):  # of all speech, whichever goal was told of it
            self._paused = event.paused
            self._paint()
        elif self._takes(goal, event):
            if isinstance(event, StateChanged):
                # A line begins with the goal as it is now, which may be further than its first event.
                self._state = self._state if event.state is State.PENDING else event.state
            elif isinstance(event, WordHeard):
                self._word = (event.start, event.end)
            self._paint()

    def aside(self, words: str) -> None:
        with self._painting:
            if self._goal is not None:
                _write(_AGAIN)
            note(words)
        self._paint()

    def close(self) -> None:
        """Leave the line whole, as it stands, if there is one."""
        signal.signal(signal.SIGWINCH, self._before)
        if self._goal is not None:
            self._leave(self._goal, self._state, self._word[1])
            self._goal = None

    def _takes(self, goal: Goal, event: Event) -> bool:
        """Whether the line is this goal's, which it gets when it is spoken, or while no other has it."""
        if self._goal is not None and self._goal.id == goal.id:
            return True
        spoken = isinstance(event, WordHeard) or (isinstance(event, StateChanged) and event.state is State.ACTIVE)
        if self._goal is not None and not spoken:
            return False
        self._begin(goal)
        return True

    def _begin(self, goal: Goal) -> None:
        self._goal, self._paused = goal, goal.paused
        self._state = State.PENDING if goal.state.terminal else goal.state
        self._sentence = Sentence(_text(goal))
        heard = len(goal.spoken or "")
        self._word = (heard, heard)

    def _end(self, goal: Goal) -> None:
        heard = self._word[1] if self._goal is not None and self._goal.id == goal.id else 0
        other = self._goal if self._goal is not None and self._goal.id != goal.id else None
        kept = (self._sentence, self._state, self._paused, self._word)
        self._begin(goal)
        self._leave(goal, goal.state, max(heard, self._word[1]))
        self._goal = other
        if other is not None:
            self._sentence, self._state, self._paused, self._word = kept
            self._paint()

    def _leave(self, goal: Goal, state: State, heard: int) -> None:
        """Write the whole sentence, on as many lines as it takes, with what became of it."""
        before, after = (self._sentence.whole, "") if state is State.SUCCEEDED else self._sentence.split(heard)
        with self._painting:
            name = Screen(colour=True).painted(f"{state.name:<9}", state)
            _write(f"{_AGAIN}{printable(goal.id)}  {name}  {before}{_AHEAD}{after}{_PLAIN}\n")

    def _paint(self) -> None:
        # Whoever paints sees to what came meanwhile, from another thread or from a resize that interrupted this one.
        self._stale = True
        while self._stale and self._painting.acquire(blocking=False):
            try:
                self._stale = False
                _write(self._line())
            finally:
                self._painting.release()

    def _line(self) -> str:
        goal = self._goal
        if goal is None:
            return ""
        # The last column stays free: some terminals go on to the next line as soon as it is written.
        columns = _columns() - 1
        name = "PAUSED" if self._paused and self._state is State.ACTIVE else self._state.name
        head = f"{printable(goal.id)}  {name:<9}  "
        if columns - len(head) < _LEAST_TEXT:
            head = ""
        view = self._sentence.view(*self._word, columns - len(head))
        head = head.replace(name, Screen(colour=True).painted(name, self._state), 1) if head else ""
        lit = f"{_LIT}{view.word}{_PLAIN}" if view.word else ""
        return f"{_AGAIN}{head}{view.heard}{lit}{_AHEAD}{view.ahead}{_PLAIN}"

    def _on_resize(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        self._paint()


def _text(goal: Goal) -> str:
    return "(text no longer kept)" if goal.text is None else goal.text


def _columns() -> int:
    with contextlib.suppress(OSError):
        return os.get_terminal_size(sys.stdout.fileno()).columns or _USUAL_WIDTH
    return _USUAL_WIDTH


def _write(text: str) -> None:
    """Write to the terminal past Python's buffer, in which a resize that interrupts a write could not write itself."""
    data = text.encode(errors="backslashreplace")
    fd = sys.stdout.fileno()
    while data:
        try:
            data = data[os.write(fd, data) :]
        except BlockingIOError:  # another program has made the terminal so
            ready({fd: select.POLLOUT}, None)
