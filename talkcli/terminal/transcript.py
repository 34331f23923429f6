"""What happens to goals and what happened to them, in lines for people: `talk watch` and `talk log`.

Pure: events and goals go in, lines come out; times are shown in the local time zone. Every line has its columns in the
same order: time, state, id, text, who sent it, why it ended; behind the time the robot, where there are several.
"""

from __future__ import annotations

import time

from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.states import State
from talkcli.protocol.events import PausedChanged, Snapshot, StateChanged, WordHeard, unfinished
from talkcli.terminal.goals import clock, quoted, who_forms, why_forms
from talkcli.terminal.text import (
    GAP,
    LONGEST_ID,
    Screen,
    cut,
    fitted,
    id_room,
    longest_that_fits,
    pad,
    printable,
    shortened,
    width,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import Goal
    from talkcli.protocol.events import Event

#: Columns of the text where nothing has to fit: most sentences of a robot are shorter, so that what follows lines up.
_TEXT_COLUMNS = 40
#: A text of at least so much is shown beside why a goal ended; a longer why has a line of its own.
_LEAST_TEXT = 16
#: Columns of a server's ids, until it has given more than 999.
_USUAL_ID = 8
#: Where a line begins that goes on from the one before it: under what is behind the time.
_INDENT = 10
#: Goals that are remembered, until their end is told.
_MOST = 1000
#: Columns of a robot's name, at first.
_USUAL_ROBOT = 8


class Columns:
    """How wide the columns are so far: the lines of all transcripts that share them line up."""

    def __init__(self) -> None:
        self.ids = _USUAL_ID
        self.robots = _USUAL_ROBOT

    def robot(self, name: str, screen: Screen) -> str:
        """Return a robot's name as it is shown: on a terminal, in a sixth of the line."""
        room = screen.room(0)
        shown = cut(printable(name), None if room is None else max(_USUAL_ROBOT, room // 6))
        self.robots = max(self.robots, min(width(shown), LONGEST_ID))
        return pad(shown, self.robots)


class Transcript:
    """Turns a server's events into lines, one after the other. It knows what it has been told, and no more.

    `full`: a line for each event; else what is over at once is left out: that a goal waits where nothing is before it,
    and that one is being stopped. `words`: a line for each word that is heard, too. `robot`: the name of the robot that
    these are the events of, where there are several; `columns`: those that all of them share.
    """

    def __init__(self, *, full: bool, words: bool, robot: str | None = None, columns: Columns | None = None) -> None:
        self._full = full
        self._with_words = words
        self._goals: dict[str, Goal] = {}
        self._paused = False
        self._robot = robot
        self._columns = columns or Columns()

    def lines(self, event: Event, screen: Screen, now: float) -> list[str]:
        """Return what is to be shown of an event; `now`: when it happened, where the event doesn't tell."""
        if isinstance(event, Snapshot):
            return self._begin(event, screen, now)
        if isinstance(event, StateChanged):
            return self._changed(event, screen, now)
        if isinstance(event, PausedChanged):
            return self._held(event, screen, now)
        if isinstance(event, WordHeard) and self._with_words:
            word = f"{printable(event.word)}{GAP}{event.time:.2f} s"
            return [self._head(event.at or now, "word", None, event.id, screen) + word]
        return []  # a watcher waits for no goal, and has no result

    def _begin(self, event: Snapshot, screen: Screen, now: float) -> list[str]:
        status = event.status
        for goal in unfinished(status):
            self._goals[goal.id] = goal
            self._make_room(goal.id, screen)  # before the first line, so that all of them line up
        self._paused = status.server.get("paused") is True
        place = f"server {printable(str(status.server.get('pid')))} on {printable(str(status.server.get('socket')))}"
        waiting = f", {len(status.pending)} waiting" if status.pending else ""
        at_work = "paused" if self._paused else "speaking" if status.active else "silent"
        head = f"{clock(now)}{GAP}{pad('watching', 10)}{GAP}{at_work}{waiting}; {place}"
        lines = [cut(head, screen.room(0))]
        for goal in unfinished(status):
            since = goal.queued_at if goal.started_at is None else goal.started_at
            lines += self._goal(goal, goal.state, since or now, screen)
        return lines

    def _changed(self, event: StateChanged, screen: Screen, now: float) -> list[str]:
        if event.goal is not None:
            self._goals[event.id] = event.goal
            if len(self._goals) > _MOST:  # of the oldest the end was missed, or its beginning tells all of it again
                del self._goals[next(iter(self._goals))]
        at_once = not self._paused and len(self._goals) == 1
        goal = self._goals.get(event.id)
        if event.state.terminal:
            self._goals.pop(event.id, None)
        brief = event.state is State.PREEMPTING or (event.state is State.PENDING and at_once)
        if brief and not self._full:
            return []
        at = event.at or now
        if goal is None:
            return [self._head(at, event.state.name, event.state, event.id, screen).rstrip()]
        return self._goal(goal, event.state, at, screen)

    def _held(self, event: PausedChanged, screen: Screen, now: float) -> list[str]:
        self._paused = event.paused
        name = "paused" if event.paused else "resumed"
        head = self._head(event.at or now, name, State.PREEMPTING, event.id or "", screen)
        by = event.by.client if event.by else None
        who = [f"by {each}" for each in who_forms(by)] if by else [""]
        room = screen.room(width(head))
        return [(head + longest_that_fits(who, room)).rstrip()]

    def _goal(self, goal: Goal, state: State, at: float, screen: Screen) -> list[str]:
        head = self._head(at, state.name, state, goal.id, screen)
        ended = state.terminal
        forms = why_forms(goal) if ended else who_forms(goal.client)
        if state is State.REJECTED:  # it had no line before that told who sent it
            forms = [f"{forms[0]}, from {each}" for each in who_forms(goal.client)] + forms
        room = screen.room(width(head))
        if room is None:
            return [(head + pad(quoted(goal), _TEXT_COLUMNS) + GAP + forms[0]).rstrip()]
        tail_room = room // 3
        # Who ended it must not give way to its column; who sent it was told when it began.
        whole = forms[:-1] if ended and goal.by is not None and len(forms) > 1 else forms
        if ended and all(width(each) > tail_room for each in whole):
            return self._ending(head, goal, whole, screen)
        tail = longest_that_fits(whole, tail_room)
        text_room = room - tail_room - len(GAP)
        return [(head + pad(shortened(quoted(goal), text_room), text_room) + GAP + tail).rstrip()]

    def _ending(self, head: str, goal: Goal, forms: list[str], screen: Screen) -> list[str]:
        """Return the end of a goal whose reason is too long for its column: beside the text, or else under it."""
        text = quoted(goal)
        room = screen.room(width(head)) or 0
        beside = room - len(GAP) - min(width(text), _LEAST_TEXT)
        tail = next((each for each in forms if width(each) <= beside), None)
        if tail is not None:
            return [head + shortened(text, room - len(GAP) - width(tail)) + GAP + tail]
        tail = longest_that_fits(forms, screen.room(_INDENT))
        return [head + shortened(text, room), " " * _INDENT + tail]

    def _head(self, at: float, word: str, state: State | None, goal_id: str, screen: Screen) -> str:
        shown = self._make_room(goal_id, screen)
        robot = [] if self._robot is None else [self._columns.robot(self._robot, screen)]
        return GAP.join((clock(at), *robot, screen.painted(pad(word, 10), state), pad(shown, self._columns.ids), ""))

    def _make_room(self, goal_id: str, screen: Screen) -> str:
        """Widen the column of the ids for this one, and return it as it is shown."""
        shown = cut(printable(goal_id), id_room(screen))
        self._columns.ids = max(self._columns.ids, min(width(shown), LONGEST_ID))
        return shown


def log_lines(goals: Sequence[Goal], screen: Screen, now: float) -> list[str]:
    """Return goals that have ended, a line each: when, how, who said what, and why it ended."""
    today = time.localtime(now)[:3]
    heads = [(_when(goal.ended_at, today), goal.state.name, cut(printable(goal.id), id_room(screen))) for goal in goals]
    widths = [max((width(head[place]) for head in heads), default=0) for place in range(3)]
    texts = [quoted(goal) for goal in goals]
    who = [who_forms(goal.client) for goal in goals]
    why = [why_forms(goal) for goal in goals]
    room = screen.room(sum(widths) + 3 * len(GAP))
    if room is None:
        # Most lines line up; one that is longer is whole, and pushes what follows.
        said = [
            GAP.join((pad(text, _TEXT_COLUMNS), pad(sender[0], _TEXT_COLUMNS), reason[0])).rstrip()
            for text, sender, reason in zip(texts, who, why, strict=True)
        ]
    else:
        said = fitted(texts, who, why, weights=(4, 2, 3), room=room) if goals else []
    return [
        GAP.join(
            (f"{when:>{widths[0]}}", screen.painted(pad(state, widths[1]), goal.state), pad(goal_id, widths[2]), words)
        )
        for goal, (when, state, goal_id), words in zip(goals, heads, said, strict=True)
    ]


def _when(seconds: float | None, today: tuple[int, ...]) -> str:
    if seconds is None or time.localtime(seconds)[:3] == today:
        return clock(seconds)
    return time.strftime("%b %d %H:%M:%S", time.localtime(seconds))
