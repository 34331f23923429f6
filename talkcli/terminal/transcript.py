"""Code that formats the output of `talk watch` and `talk log`.

Times are in the local time zone. The columns are always in the same order: time, robot (if there are several), state,
id, text, sender, reason.
"""

from __future__ import annotations

import time

from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.states import State
from talkcli.protocol.events import PausedChanged, Snapshot, StateChanged, WordHeard, unfinished
from talkcli.terminal.goals import clock_time, quoted_text, reason_forms, sender_forms
from talkcli.terminal.text import COLUMN_GAP, Screen, cut, fit_columns, longest_fitting, pad, printable, shorten, width

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import Goal
    from talkcli.protocol.events import Event

#: The minimum width of the text column if lines can have any length. Most texts fit, so the next columns line up.
_TEXT_COLUMNS = 40
#: The minimum width of the text if a long reason is shown beside it.
_MIN_TEXT_COLUMNS = 16
#: The initial width of the robot and id columns, which is enough for the ids of a server's first 999 goals.
_FIRST_NAME_COLUMNS = 8
#: The width up to which the robot and id columns grow.
_MAX_NAME_COLUMNS = 20
#: The indentation of continuation lines, which is the width of the time column.
_INDENT_COLUMNS = 10
#: The maximum number of unfinished goals to remember. The oldest goal is dropped first.
_MAX_REMEMBERED_GOALS = 1000


class ColumnWidths:
    """Column widths that grow with the content of the columns.

    Transcripts can share them to align their lines.
    """

    def __init__(self) -> None:
        self._ids = self._robots = _FIRST_NAME_COLUMNS

    def robot(self, name: str, screen: Screen) -> str:
        """Pad a robot's name to the width of its column, which is widened if necessary.

        The name takes up at most a sixth of the terminal.
        """
        shown = screen.fit_name(name, _FIRST_NAME_COLUMNS, 6)
        self._robots = max(self._robots, min(width(shown), _MAX_NAME_COLUMNS))
        return pad(shown, self._robots)

    def goal_id(self, goal_id: str, screen: Screen) -> str:
        """Pad a goal id to the width of its column, which is widened if necessary."""
        shown = screen.fit_name(goal_id)
        self._ids = max(self._ids, min(width(shown), _MAX_NAME_COLUMNS))
        return pad(shown, self._ids)


class Transcript:
    """Formats the events of one server as lines of text."""

    def __init__(
        self, *, full: bool, words: bool, robot: str | None = None, widths: ColumnWidths | None = None
    ) -> None:
        """Create an empty transcript.

        Args:
            full: whether to show every event. Otherwise, PREEMPTING is left out, and PENDING if the goal can start at
                once.
            words: whether to show each word as it is spoken.
            robot: the robot's name, if the events of several robots are shown.
            widths: column widths shared with other transcripts.
        """
        self._full = full
        self._with_words = words
        self._goals: dict[str, Goal] = {}
        self._paused = False
        self._robot = robot
        self._widths = widths or ColumnWidths()

    def lines(self, event: Event, screen: Screen, now: float) -> list[str]:
        """Return the lines for an event. `now` is the time to show if the event has none."""
        if isinstance(event, Snapshot):
            return self._snapshot_lines(event, screen, now)
        if isinstance(event, StateChanged):
            return self._state_lines(event, screen, now)
        if isinstance(event, PausedChanged):
            return [self._pause_line(event, screen, now)]
        if isinstance(event, WordHeard) and self._with_words:
            word = f"{printable(event.word)}{COLUMN_GAP}{event.time:.2f} s"
            return [self._head_columns(event.at or now, "word", None, event.id, screen) + word]
        return []  # results aren't shown, and words only on request

    def _snapshot_lines(self, event: Snapshot, screen: Screen, now: float) -> list[str]:
        status = event.status
        goals = unfinished(status)
        for goal in goals:
            self._goals[goal.id] = goal
            self._widths.goal_id(goal.id, screen)  # widen the column now to align all lines
        self._paused = status.server.get("paused") is True
        place = f"server {printable(str(status.server.get('pid')))} on {printable(str(status.server.get('socket')))}"
        waiting = f", {len(status.pending)} waiting" if status.pending else ""
        activity = "paused" if self._paused else "speaking" if status.active else "silent"
        head = f"{clock_time(now)}{COLUMN_GAP}{pad('watching', 10)}{COLUMN_GAP}{activity}{waiting}; {place}"
        lines = [cut(head, screen.columns_left(0))]
        for goal in goals:
            since = goal.queued_at if goal.started_at is None else goal.started_at
            lines += self._goal_lines(goal, goal.state, since or now, screen)
        return lines

    def _state_lines(self, event: StateChanged, screen: Screen, now: float) -> list[str]:
        if event.goal is not None:
            self._goals[event.id] = event.goal
            if len(self._goals) > _MAX_REMEMBERED_GOALS:  # the event for the end of the oldest goal was probably missed
                del self._goals[next(iter(self._goals))]
        starts_at_once = not self._paused and len(self._goals) == 1
        goal = self._goals.get(event.id)
        if event.state.terminal:
            self._goals.pop(event.id, None)
        brief = event.state is State.PREEMPTING or (event.state is State.PENDING and starts_at_once)
        if brief and not self._full:
            return []
        at = event.at or now
        if goal is None:
            return [self._head_columns(at, event.state.name, event.state, event.id, screen).rstrip()]
        return self._goal_lines(goal, event.state, at, screen)

    def _pause_line(self, event: PausedChanged, screen: Screen, now: float) -> str:
        self._paused = event.paused
        name = "paused" if event.paused else "resumed"
        head = self._head_columns(event.at or now, name, State.PREEMPTING, event.id or "", screen)
        by = event.by.client if event.by else None
        forms = [f"by {each}" for each in sender_forms(by)] if by else [""]
        return (head + longest_fitting(forms, screen.columns_left(width(head)))).rstrip()

    def _goal_lines(self, goal: Goal, state: State, at: float, screen: Screen) -> list[str]:
        head = self._head_columns(at, state.name, state, goal.id, screen)
        ended = state.terminal
        forms = reason_forms(goal) if ended else sender_forms(goal.client)
        if state is State.REJECTED:  # no earlier line has shown the goal's sender
            forms = [f"{forms[0]}, from {each}" for each in sender_forms(goal.client)] + forms
        columns = screen.columns_left(width(head))
        if columns is None:
            return [(head + pad(quoted_text(goal), _TEXT_COLUMNS) + COLUMN_GAP + forms[0]).rstrip()]
        tail_columns = columns // 3
        # The last description lacks the reason. If none of the others fit, `_long_end_lines` gives them more room.
        complete = forms[:-1] if ended and goal.by is not None and len(forms) > 1 else forms
        if ended and all(width(each) > tail_columns for each in complete):
            return self._long_end_lines(head, goal, complete, screen)
        tail = longest_fitting(complete, tail_columns)
        text_columns = columns - tail_columns - len(COLUMN_GAP)
        return [(head + pad(shorten(quoted_text(goal), text_columns), text_columns) + COLUMN_GAP + tail).rstrip()]

    def _long_end_lines(self, head: str, goal: Goal, forms: list[str], screen: Screen) -> list[str]:
        """Format the end of a goal whose reason is too long for its column.

        The reason is shown beside a shortened text if it fits there, otherwise below the text.
        """
        text = quoted_text(goal)
        columns = screen.columns_left(width(head)) or 0
        beside = columns - len(COLUMN_GAP) - min(width(text), _MIN_TEXT_COLUMNS)
        tail = next((each for each in forms if width(each) <= beside), None)
        if tail is not None:
            return [head + shorten(text, columns - len(COLUMN_GAP) - width(tail)) + COLUMN_GAP + tail]
        tail = longest_fitting(forms, screen.columns_left(_INDENT_COLUMNS))
        return [head + shorten(text, columns), " " * _INDENT_COLUMNS + tail]

    def _head_columns(self, at: float, word: str, state: State | None, goal_id: str, screen: Screen) -> str:
        robot = [] if self._robot is None else [self._widths.robot(self._robot, screen)]
        cells = (screen.coloured(pad(word, 10), state), self._widths.goal_id(goal_id, screen))
        return COLUMN_GAP.join((clock_time(at), *robot, *cells, ""))


def log_lines(goals: Sequence[Goal], screen: Screen, now: float) -> list[str]:
    """Return one line for each ended goal. `now` is a Unix timestamp."""
    if not goals:
        return []
    today = time.localtime(now)[:3]
    heads = [(_log_time(goal.ended_at, today), goal.state.name, screen.fit_name(goal.id)) for goal in goals]
    widths = [max(map(width, column)) for column in zip(*heads, strict=True)]
    texts = [quoted_text(goal) for goal in goals]
    senders = [sender_forms(goal.client) for goal in goals]
    reasons = [reason_forms(goal) for goal in goals]
    columns = screen.columns_left(sum(widths) + 3 * len(COLUMN_GAP))
    details = fit_columns(texts, senders, reasons, weights=(4, 2, 3), columns=columns, min_columns=_TEXT_COLUMNS)
    return [
        COLUMN_GAP.join(
            (f"{when:>{widths[0]}}", screen.coloured(pad(state, widths[1]), goal.state), pad(goal_id, widths[2]), words)
        )
        for goal, (when, state, goal_id), words in zip(goals, heads, details, strict=True)
    ]


def _log_time(seconds: float | None, today: tuple[int, ...]) -> str:
    if seconds is None or time.localtime(seconds)[:3] == today:
        return clock_time(seconds)
    return time.strftime("%b %d %H:%M:%S", time.localtime(seconds))
