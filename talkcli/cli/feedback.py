"""What `--feedback` shows of goals while they are spoken: JSON objects, lines of words, or a sentence that lights up.

It must not wait, and not know who owns a goal: it is told of events, one after the other, and shows them.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading

from talkcli.cli.show import USUAL_WIDTH, Feedback, colourful, columns, note, show, show_json
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.states import State
from talkcli.polling import wait_ready
from talkcli.protocol.events import PausedChanged, Result, StateChanged, WordHeard
from talkcli.terminal.goals import NOT_KEPT
from talkcli.terminal.text import Screen, Sentence, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from talkcli.cli.show import Common
    from talkcli.goals.goal import Goal
    from talkcli.protocol.events import Event

#: With fewer columns than this for the text beside id and state, these are left out.
_LEAST_TEXT = 20
_LIT, _AHEAD, _PLAIN = "\x1b[1;7m", "\x1b[2m", "\x1b[0m"
#: Back to the line's beginning, and clear it.
_AGAIN = "\r\x1b[2K"


def feedback(options: Common) -> Feedback:
    """Return what fits standard output and the options."""
    if options.json:
        return _Objects()
    # Where the terminal is not in UTF-8, what it makes of a character has another width than the character.
    utf_8 = sys.stdout is not None and sys.stdout.encoding.lower().replace("-", "") == "utf8"
    return _Light() if utf_8 and colourful() else _Lines()


class _Objects(Feedback):
    """The events as they came, an object a line."""

    shows = True

    def show(self, goal: Goal, event: Event) -> None:  # noqa: ARG002
        show_json(event.to_json())


class _Lines(Feedback):
    """A line an event, its fields separated by blanks; what may have blanks in it comes last."""

    shows = True

    def __init__(self) -> None:
        #: the state that was shown last, by id, of goals that have not ended
        self._shown: dict[str, State] = {}

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


class _Light(Feedback):
    """The sentence on a line of the terminal, each word lit as it is heard; the whole of it at its end.

    The line is written over in place, so it is never wider than the terminal: of a long text a part is shown.
    """

    shows = True

    def __init__(self) -> None:
        self._line: _Line | None = None
        #: held while the terminal is written to
        self._painting = threading.Lock()
        self._stale = False
        self._resizes = _Resizes(self._paint)

    def begin(self, goals: Sequence[Goal]) -> None:
        going = [each for each in goals if not each.state.terminal]
        if going and self._line is None:
            self._line = _Line(next((each for each in going if each.state is not State.PENDING), going[0]))
            self._paint()

    def show(self, goal: Goal, event: Event) -> None:
        line = self._line
        if isinstance(event, Result):
            self._end(event.goal)
        elif isinstance(event, PausedChanged):  # of all speech, whichever goal was told of it
            if line:
                line.paused = event.paused
        elif line is None or (line.goal.id != goal.id and _is_spoken(event)):
            self._line = _Line(goal)
            self._line.take(event)
        elif line.goal.id == goal.id:
            line.take(event)
        else:  # the line is another's, until this one is spoken
            return
        self._paint()

    def aside(self, words: str) -> None:
        with self._painting:
            if self._line:
                _write(_AGAIN)
            note(words)
        self._paint()

    def close(self) -> None:
        """Leave the line whole, as it stands, if there is one."""
        self._resizes.close()
        if self._line:
            self._leave(self._line)
            self._line = None

    def _end(self, goal: Goal) -> None:
        line, ended = self._line, _Line(goal)
        ended.state = goal.state
        if line and line.goal.id == goal.id:
            ended.word = max(line.word, ended.word, key=lambda word: word[1])
            self._line = None
        self._leave(ended)

    def _leave(self, line: _Line) -> None:
        """Write the whole sentence, on as many lines as it takes, with what became of it."""
        ended = line.state is State.SUCCEEDED
        before, after = (line.sentence.whole, "") if ended else line.sentence.split(line.word[1])
        with self._painting:
            name = Screen(colour=True).painted(f"{line.state.name:<9}", line.state)
            _write(f"{_AGAIN}{printable(line.goal.id)}  {name}  {before}{_AHEAD}{after}{_PLAIN}\n")

    def _paint(self) -> None:
        # Whoever paints sees to what came meanwhile, from another thread.
        self._stale = True
        while self._stale and self._painting.acquire(blocking=False):
            try:
                self._stale = False
                line = self._line  # which another thread may take away
                _write(line.painted() if line else "")
            finally:
                self._painting.release()


class _Resizes(threading.Thread):
    """Paints anew whenever the terminal gets another size. Where the system forgets a signal that nobody handles, as
    macOS does, the next event paints it so.

    Not by a handler: a signal that has one ends the waiting for goals, see `interrupts`.
    """

    def __init__(self, paint: Callable[[], None]) -> None:
        super().__init__(name="resizes", daemon=True)
        self._paint = paint
        self._over = False
        self._held = {signal.SIGWINCH} - signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGWINCH})
        try:
            self.start()
        except RuntimeError:  # no thread can be had: as where it is forgotten
            self._over = True

    def run(self) -> None:
        """Wait for one after the other."""
        while signal.sigwait({signal.SIGWINCH}) and not self._over:
            self._paint()

    def close(self) -> None:
        """Paint no more."""
        if not self._over:
            self._over = True
            assert self.ident
            signal.pthread_kill(self.ident, signal.SIGWINCH)
            self.join()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, self._held)


class _Line:
    """The goal that is on the line: how it stands, and what of it is heard."""

    def __init__(self, goal: Goal) -> None:
        self.goal = goal
        self.paused = goal.paused
        self.state = State.PENDING if goal.state.terminal else goal.state
        self.sentence = Sentence(NOT_KEPT if goal.text is None else goal.text)
        heard = len(goal.spoken or "")
        #: where the word begins and ends that is being heard
        self.word = (heard, heard)

    def take(self, event: Event) -> None:
        if isinstance(event, WordHeard):
            self.word = (event.start, event.end)
        elif isinstance(event, StateChanged) and event.state is not State.PENDING:
            # A line begins with the goal as it is now, which may be further than its first event.
            self.state = event.state

    def painted(self) -> str:
        """Return what it looks like now, in one line of the terminal."""
        # The last column stays free: some terminals go on to the next line as soon as it is written.
        room = (columns(sys.stdout) or USUAL_WIDTH) - 1
        name = "PAUSED" if self.paused and self.state is State.ACTIVE else self.state.name
        head = f"{printable(self.goal.id)}  {name:<9}  "
        if room - len(head) < _LEAST_TEXT:
            head = ""
        heard, word, ahead = self.sentence.view(*self.word, room - len(head))
        head = head.replace(name, Screen(colour=True).painted(name, self.state), 1) if head else ""
        lit = f"{_LIT}{word}{_PLAIN}" if word else ""
        return f"{_AGAIN}{head}{heard}{lit}{_AHEAD}{ahead}{_PLAIN}"


def _is_spoken(event: Event) -> bool:
    return isinstance(event, WordHeard) or (isinstance(event, StateChanged) and event.state is State.ACTIVE)


def _write(text: str) -> None:
    """Write to the terminal past Python's buffer, where it can be waited for if it takes nothing at the moment."""
    data = text.encode(errors="backslashreplace")
    fd = sys.stdout.fileno()
    while data:
        try:
            data = data[os.write(fd, data) :]
        except BlockingIOError:  # another program has made the terminal so
            wait_ready({fd: select.POLLOUT}, None)
