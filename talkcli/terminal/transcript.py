"""Code that formats the output of `talk watch` and `talk log`.

Times are in the local time zone. The columns are always in the same order: time, robot (if there are several), state,
id, text, sender, reason.
"""

from __future__ import annotations

import re
import time

from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.states import State
from talkcli.protocol.events import (
    GoalInterrupted,
    PausedChanged,
    Snapshot,
    StateChanged,
    TextAdded,
    TextMissing,
    WordHeard,
    unfinished,
)
from talkcli.terminal.goals import clock_time, listed_reason_forms, quoted_text, reason_forms, sender_forms
from talkcli.terminal.text import (
    COLUMN_GAP,
    TEXT_COLUMNS,
    Screen,
    cut,
    cut_quoted,
    fit_row,
    longest_fitting,
    pad,
    printable,
    room_beside,
    width,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import Goal
    from talkcli.protocol.events import Event

#: The initial width of the robot column, and of the id column if it shows whole ids.
_FIRST_NAME_COLUMNS = 8
#: The initial width of the id column, which is enough for a server's first 999 goals.
_FIRST_ID_COLUMNS = 3
#: The maximum width of the robot and id columns.
_MAX_NAME_COLUMNS = 20
#: The indentation of continuation lines, which is the width of the time column.
_INDENT_COLUMNS = 10
#: Matches complete sentences and lines. Text that is added to a goal is shown once a sentence or line is complete.
_COMPLETE_SENTENCES = re.compile(r".*(?:[.!?…][\"'”’»)]*\s|[。！？\n])", re.DOTALL)
#: The maximum number of unfinished goals to remember. The oldest goal is dropped first.
_MAX_REMEMBERED_GOALS = 1000


class ColumnWidths:
    """The widths of columns that grow with their content.

    Transcripts can share them to align their lines.
    """

    def __init__(self) -> None:
        self._ids, self._robots = _FIRST_ID_COLUMNS, _FIRST_NAME_COLUMNS

    def pad_robot(self, name: str, screen: Screen) -> str:
        """Shorten and pad a robot's name. Widen its column if necessary.

        The name takes up at most a sixth of the terminal.
        """
        shown = screen.fit_name(name, _FIRST_NAME_COLUMNS, 6)
        self._robots = max(self._robots, min(width(shown), _MAX_NAME_COLUMNS))
        return pad(shown, self._robots)

    def pad_goal_id(self, goal_id: str, screen: Screen) -> str:
        """Shorten and pad a goal id. Widen its column if necessary."""
        shown = screen.goal_id(goal_id)
        self._ids = max(self._ids, _FIRST_NAME_COLUMNS * screen.long, min(width(shown), _MAX_NAME_COLUMNS))
        return pad(shown, self._ids)


class Transcript:
    """Formats the events of one server as lines of text."""

    def __init__(
        self,
        *,
        full: bool,
        words: bool,
        robot: str | None = None,
        boot: str = "",
        widths: ColumnWidths | None = None,
    ) -> None:
        """Create an empty transcript.

        Args:
            full: whether to show every event. Otherwise, PREEMPTING is left out, and PENDING if the goal can start at
                once.
            words: whether to show each word as it is spoken.
            robot: the robot's name, if the events of several robots are shown.
            boot: the server's boot id, if it is known before the first snapshot.
            widths: column widths shared with other transcripts.
        """
        self._full = full
        self._with_words = words
        self._goals: dict[str, Goal] = {}
        #: how many characters of each growing text have been shown, by goal id
        self._shown_chars: dict[str, int] = {}
        #: the goals that have spoken a word since they last waited for text
        self._heard: set[str] = set()
        #: the interrupted goals
        self._interrupted: set[str] = set()
        self._paused = False
        self._robot, self._boot = robot, boot
        self._widths = widths or ColumnWidths()

    def lines(self, event: Event, screen: Screen, now: float) -> list[str]:
        """Update the stored goals after an event. Return the lines that show the event.

        `now` is shown if the event has no time.
        """
        if isinstance(event, Snapshot):
            self._boot = str(event.status.server.get("boot"))
        screen = replace(screen, boot=self._boot)
        if isinstance(event, Snapshot):
            return self._format_snapshot(event, screen, now)
        if isinstance(event, StateChanged):
            return self._format_state_change(event, screen, now)
        if isinstance(event, GoalInterrupted):
            return [self._format_interruption(event.id, event.by.goal or "", event.at or now, screen)]
        if isinstance(event, PausedChanged):
            return [self._format_pause(event, screen, now)]
        if isinstance(event, TextAdded | TextMissing):
            return self._format_growth(event, screen, now)
        if isinstance(event, WordHeard):
            return self._format_word(event, screen, now)
        return []  # results aren't shown

    def _format_word(self, event: WordHeard, screen: Screen, now: float) -> list[str]:
        """Record that a word was heard. Return a line for the word if words are shown."""
        self._heard.add(event.id)
        word = f"{printable(event.word)}{COLUMN_GAP}{event.time:.2f} s"
        return [self._head_columns(event.at or now, "word", None, event.id, screen) + word] * self._with_words

    def _format_snapshot(self, event: Snapshot, screen: Screen, now: float) -> list[str]:
        """Store the server's state. Return the lines that show it."""
        status = event.status
        goals = unfinished(status)
        for goal in goals:
            self._goals[goal.id] = goal
            self._widths.pad_goal_id(goal.id, screen)  # widen the column now to align all lines
        self._paused = status.server.get("paused") is True
        place = f"server {printable(str(status.server.get('pid')))} on {printable(str(status.server.get('socket')))}"
        waiting = f", {len(status.pending)} waiting" if status.pending else ""
        activity = "paused" if self._paused else "speaking" if status.active else "silent"
        head = f"{clock_time(now)}{COLUMN_GAP}{pad('watching', 10)}{COLUMN_GAP}{activity}{waiting}; {place}"
        lines = [cut(head, screen.columns_left(0))]
        for goal in goals:
            since = goal.queued_at if goal.started_at is None else goal.started_at
            lines += self._format_goal(goal, goal.state, since or now, screen)
            if goal.interrupted_by is not None:
                lines.append(self._format_interruption(goal.id, goal.interrupted_by, now, screen))
        return lines

    def _format_state_change(self, event: StateChanged, screen: Screen, now: float) -> list[str]:
        """Update a stored goal after a state change. Return the lines that show the change."""
        if event.goal is not None:
            self._goals[event.id] = event.goal
            if len(self._goals) > _MAX_REMEMBERED_GOALS:  # the event for the end of the oldest goal was probably missed
                del self._goals[next(iter(self._goals))]
        starts_at_once = not self._paused and len(self._goals) == 1
        goal = self._goals.get(event.id)
        if event.state.terminal:
            self._goals.pop(event.id, None)
            self._shown_chars.pop(event.id, None)
            self._heard.discard(event.id)
        continues = event.id in self._interrupted
        self._interrupted.discard(event.id)
        brief = event.state is State.PREEMPTING or (event.state is State.PENDING and starts_at_once)
        if brief and not self._full:
            return []
        at = event.at or now
        if continues and event.state is State.ACTIVE:
            return [self._head_columns(at, "continues", State.ACTIVE, event.id, screen).rstrip()]
        if goal is None:
            return [self._head_columns(at, event.state.name, event.state, event.id, screen).rstrip()]
        return self._format_goal(goal, event.state, at, screen)

    def _format_growth(self, event: TextAdded | TextMissing, screen: Screen, now: float) -> list[str]:
        """Record added text, or a wait for text. Return lines for new sentences and for the wait.

        A goal also waits before its first word, until there is enough text. This isn't shown.
        """
        waits = isinstance(event, TextMissing) and event.waits and event.id in self._heard
        goal, at, lines = self._goals.get(event.id), event.at or now, []
        if goal is not None and goal.text is not None:
            text = goal.text[: event.start] + event.text if isinstance(event, TextAdded) else goal.text
            # The sentences that were complete at the beginning have been shown with the goal.
            shown = self._shown_chars.get(event.id, _last_sentence_end(goal.text, 0))
            end = len(text) if waits else _last_sentence_end(text, shown)
            if added := text[shown:end].strip():
                head = self._head_columns(at, "text", None, event.id, screen)
                lines.append(fit_row(head, f'"{printable(added)}"', [""], 0, screen))
            self._goals[event.id], self._shown_chars[event.id] = replace(goal, text=text), end
        if waits:
            self._heard.discard(event.id)
            lines.append(self._head_columns(at, "waiting", State.PREEMPTING, event.id, screen) + "for more text")
        return lines

    def _format_interruption(self, goal_id: str, interrupted_by: str, timestamp: float, screen: Screen) -> str:
        """Record that a goal is interrupted. Return a line that says so."""
        self._interrupted.add(goal_id)
        head = self._head_columns(timestamp, "paused", State.PREEMPTING, goal_id, screen)
        return f"{head}interrupted by {screen.goal_id(interrupted_by)}"

    def _format_pause(self, event: PausedChanged, screen: Screen, now: float) -> str:
        """Store whether speech is paused. Return a line that says so."""
        self._paused = event.paused
        name = "paused" if event.paused else "resumed"
        head = self._head_columns(event.at or now, name, State.PREEMPTING, event.id or "", screen)
        by = event.by.client if event.by else None
        forms = [f"by {each}" for each in sender_forms(by, screen)] if by else [""]
        return (head + longest_fitting(forms, screen.columns_left(width(head)))).rstrip()

    def _format_goal(self, goal: Goal, state: State, timestamp: float, screen: Screen) -> list[str]:
        """Return the lines that show a goal with this state and timestamp."""
        head = self._head_columns(timestamp, state.name, state, goal.id, screen)
        ended = state.terminal
        forms = reason_forms(goal, screen) if ended else sender_forms(goal.client, screen)
        if state is State.REJECTED:  # no earlier line has shown the goal's sender
            forms = [f"{forms[0]}, from {each}" for each in sender_forms(goal.client, screen)] + forms
        if ended and goal.by is not None and len(forms) > 1:
            forms = forms[:-1]  # the last description lacks the reason
        text, columns = quoted_text(goal), screen.columns_left(width(head))
        if columns is None:
            return [fit_row(head, text, forms, TEXT_COLUMNS, screen)]
        if ended and all(width(each) > room_beside(text, columns, screen) for each in forms):
            # The reason doesn't fit beside the text, so it gets a line of its own.
            below = longest_fitting(forms, screen.columns_left(_INDENT_COLUMNS))
            return [head + cut_quoted(text, columns), " " * _INDENT_COLUMNS + below]
        return [fit_row(head, text, forms, columns * 3 // 4, screen)]

    def _head_columns(self, timestamp: float, label: str, state: State | None, goal_id: str, screen: Screen) -> str:
        """Return the columns of a line from the time to the goal's id."""
        robot = [] if self._robot is None else [self._widths.pad_robot(self._robot, screen)]
        cells = (screen.coloured(pad(label, 10), state), self._widths.pad_goal_id(goal_id, screen))
        return COLUMN_GAP.join((clock_time(timestamp), *robot, *cells, ""))


def _last_sentence_end(text: str, start: int) -> int:
    """Return the end of the last complete sentence, or `start` if there is none.

    The search begins at the offset `start`.
    """
    found = _COMPLETE_SENTENCES.match(text, start)
    return found.end() if found else start


def log_lines(goals: Sequence[Goal], screen: Screen, now: float) -> list[str]:
    """Return one line for each ended goal, for `talk log`."""
    if not goals:
        return []
    today = time.localtime(now)[:3]
    cells = [(_format_log_time(goal.ended_at, today), goal.state.name, screen.goal_id(goal.id)) for goal in goals]
    widths = [max(map(width, column)) for column in zip(*cells, strict=True)]
    heads = []
    for goal, (when, state, goal_id) in zip(goals, cells, strict=True):
        coloured = screen.coloured(pad(state, widths[1]), goal.state)
        heads.append(COLUMN_GAP.join((f"{when:>{widths[0]}}", coloured, pad(goal_id, widths[2]), "")))
    columns = screen.columns_left(width(heads[0]))
    # A sender that has chosen a long name must not leave too little room for the texts.
    max_columns = None if columns is None or screen.long else columns // 4
    senders = [[cut_quoted(each, max_columns) for each in sender_forms(goal.client, screen)] for goal in goals]
    sender_columns = min(TEXT_COLUMNS, max(width(forms[-1]) for forms in senders))
    texts = [quoted_text(goal) for goal in goals]
    left = TEXT_COLUMNS if columns is None else columns - len(COLUMN_GAP) - sender_columns
    text_columns = min(left, max(map(width, texts)))
    lines = []
    for goal, head, text, forms in zip(goals, heads, texts, senders, strict=True):
        reasons = listed_reason_forms(goal, screen)
        # On a terminal, only goals without a reason are aligned, so that there is more room for the texts.
        padding = 0 if columns is not None and reasons[0] else sender_columns
        details = [pad(sender, padding) + COLUMN_GAP * bool(each) + each for sender in forms for each in reasons]
        details.sort(key=width, reverse=True)
        lines.append(fit_row(head, text, details, text_columns, screen))
    return lines


def _format_log_time(seconds: float | None, today: tuple[int, ...]) -> str:
    """Format a timestamp as local time, with the date if it isn't today."""
    if seconds is None or time.localtime(seconds)[:3] == today:
        return clock_time(seconds)
    return time.strftime("%b %d %H:%M:%S", time.localtime(seconds))
