"""Functions that format the state of a fleet as a table, and its events as lines.

The module is pure. The caller passes the time and the properties of the terminal.
"""

from __future__ import annotations

from talkcli.fleet.payloads import LastGoal, Presence, RobotInfo, RobotStatus
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.states import State
from talkcli.terminal.goals import clock_time
from talkcli.terminal.text import COLUMN_GAP, Screen, cut, cut_quoted, pad, printable, width
from talkcli.terminal.transcript import ColumnWidths, Transcript

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.protocol.events import Event

    #: The text of a cell, and the state that determines its colour. If the state is None, the cell has no colour.
    Cell = tuple[str, State | None]

COLUMN_NAMES = ("ROBOT", "ONLINE", "SERVER", "SPEAKING", "QUEUE", "LAST", "SINCE")
#: Columns that are only shown with `Screen.long`.
_LONG_COLUMNS = ("SERVER", "SINCE")
#: If a terminal is too narrow, these columns are omitted one by one until the column SPEAKING has its minimum width.
_OPTIONAL_COLUMNS = ("SINCE", "LAST", "SERVER", "QUEUE")
_MIN_TEXT_CHARS = 12
#: The width of the column SPEAKING if the output isn't a terminal. Longer texts are not cut off.
_USUAL_TEXT_CHARS = 40
_MAX_VERSION_CHARS = 12
#: The cell to show for an unknown value.
_EMPTY_CELL: Cell = ("-", None)


def format_robots(robots: Sequence[RobotInfo], screen: Screen, now: float) -> list[str]:
    """Format a table of robots as lines. The first line is the heading.

    If a terminal is too narrow, the texts of sentences are shortened, and then columns are omitted.

    Args:
        robots: the robots, one for each row.
        screen: the properties of the terminal.
        now: the current time in seconds since 1970.
    """
    rows = [_row_cells(each, screen, now) for each in robots]
    names = [each for each in COLUMN_NAMES if screen.long or each not in _LONG_COLUMNS]
    widths = {name: max(map(width, (name, *(cells[name][0] for cells in rows)))) for name in names}
    _fit_columns(widths, screen.columns_left(0))
    heading = _format_row({name: (name, None) for name in COLUMN_NAMES}, widths, Screen())
    return [screen.coloured(heading, None), *(_format_row(cells, widths, screen) for cells in rows)]


def _row_cells(robot: RobotInfo, screen: Screen, now: float) -> dict[str, Cell]:
    """Return the cells of a robot's row, by column name."""
    presence, status = robot.presence, robot.status or RobotStatus()
    cells = dict.fromkeys(COLUMN_NAMES, _EMPTY_CELL)
    cells["ROBOT"] = screen.fit_name(presence.name), None
    cells["ONLINE"] = ("yes", None) if presence.online else ("OFFLINE", State.LOST)
    if presence.online:
        version = _server_version(presence)
        if version is None:
            cells["ONLINE"] = "no server", State.LOST
        else:
            cells |= {
                "SERVER": (version, None),
                "SPEAKING": _speaking_cell(status, replace(screen, boot=_boot_id(presence))),
                "QUEUE": (str(status.pending), None),
            }
        if presence.since is not None:
            cells["SINCE"] = _format_age(now - presence.since), None
    if status.last is not None:
        cells["LAST"] = _last_cell(status.last, now)
    return cells


def _server_version(presence: Presence) -> str | None:
    """Return the version of the robot's server. Return None if there is no server."""
    server = presence.server
    return None if server is None else printable(str(server.get("version") or "?"), _MAX_VERSION_CHARS)


def _boot_id(presence: Presence) -> str:
    """Return the boot id of the robot's server, or an empty string if the robot has no server."""
    return str((presence.server or {}).get("boot") or "")


def _speaking_cell(status: RobotStatus, screen: Screen) -> Cell:
    """Return the cell for the active goal. The cell also shows whether speech is paused."""
    if status.active is None:
        return ("PAUSED", State.PREEMPTING) if status.paused else _EMPTY_CELL
    words = screen.goal_id(status.active) if status.text is None else f'"{printable(status.text)}"'
    return (f"PAUSED {words}", State.PREEMPTING) if status.paused else (words, State.ACTIVE)


def _last_cell(goal: LastGoal, now: float) -> Cell:
    """Return the cell that shows how the last goal ended, and how long ago."""
    age = "" if goal.at is None else f" {_format_age(now - goal.at)}"
    return f"{goal.state.name}{age}", goal.state


def _format_age(seconds: float) -> str:
    """Format a duration in its largest unit, such as "3 h".

    A negative duration counts as 0. It occurs if the robot's clock is ahead.
    """
    whole = max(0, int(seconds))
    for size, name in ((86400, "d"), (3600, "h"), (60, "min")):
        if whole >= size:
            return f"{whole // size} {name}"
    return f"{whole} s"


def _fit_columns(widths: dict[str, int], room: int | None) -> None:
    """Shrink or remove columns in `widths` to fit a line into `room` characters."""
    longest = widths["SPEAKING"]
    if room is None:
        widths["SPEAKING"] = min(longest, _USUAL_TEXT_CHARS)
        return
    for omitted in ("", *_OPTIONAL_COLUMNS):
        widths.pop(omitted, None)
        left = room - len(COLUMN_GAP) * (len(widths) - 1) - (sum(widths.values()) - widths["SPEAKING"])
        widths["SPEAKING"] = max(0, min(longest, left))
        if left >= min(longest, _MIN_TEXT_CHARS):
            return


def _format_row(cells: dict[str, Cell], widths: dict[str, int], screen: Screen) -> str:
    """Format cells as a line with aligned columns.

    On a terminal, a long text in SPEAKING is shortened.
    """
    shown = []
    for name, columns in widths.items():
        text, state = cells[name]
        if name == "SPEAKING" and screen.width is not None:
            text = cut_quoted(text, columns)
        text = pad(text, columns)
        shown.append(text if state is None else screen.coloured(text, state))
    return COLUMN_GAP.join(shown).rstrip()


class FleetTranscript:
    """A transcript, line by line, of what the robots say and do.

    Each line begins with the time and the robot's name.
    """

    def __init__(self, *, full: bool) -> None:
        """Create an empty transcript.

        `full` has the same meaning as for `Transcript`.
        """
        self._full = full
        self._columns = ColumnWidths()
        self._transcripts: dict[str, Transcript] = {}
        #: the boot ids of the robots' servers, by robot name
        self._boots: dict[str, str] = {}

    def begin(self, robots: Sequence[Presence], broker: str, screen: Screen, now: float) -> list[str]:
        """Start the transcript. Return a heading that says how many robots there are.

        `broker` is the broker's address.
        """
        for each in robots:
            self._columns.pad_robot(each.name, screen)  # All names must be known first, so that all lines are aligned.
            self._boots[each.name] = _boot_id(each)
        offline = sum(not each.online for each in robots)
        serverless = sum(each.online and each.server is None for each in robots)
        parts = [f"{len(robots)} robot{'' if len(robots) == 1 else 's'}"]
        parts += [f"{offline} OFFLINE"] if offline else []
        parts += [f"{serverless} without a server"] if serverless else []
        return [cut(f"{clock_time(now)}{COLUMN_GAP}{', '.join(parts)}; {printable(broker)}", screen.columns_left(0))]

    def lines(self, name: str, event: Event, screen: Screen, now: float) -> list[str]:
        """Format a robot's event as lines.

        The arguments are those of `Transcript.lines`.
        """
        if name not in self._transcripts:
            self._transcripts[name] = Transcript(
                full=self._full, words=False, robot=name, boot=self._boots.get(name, ""), widths=self._columns
            )
        return self._transcripts[name].lines(event, screen, now)

    def change_lines(self, before: Presence | None, robot: Presence, screen: Screen, now: float) -> list[str]:
        """Return a line that describes how a robot or its server has changed. Also forget the robot's goals.

        Args:
            before: the presence before the change, or None if the robot was unknown.
            robot: the presence after the change.
            screen: the properties of the terminal.
            now: the current time in seconds since 1970.
        """
        self._transcripts.pop(robot.name, None)
        self._boots[robot.name] = _boot_id(robot)
        server = "no server" if robot.server is None else f"talk {_server_version(robot)}"
        if not robot.online:
            word, state, more = "OFFLINE", State.LOST, ""
        elif before is None or not before.online or before.session != robot.session:
            word, state, more = "online", State.SUCCEEDED, server
        elif robot.server is None:
            word, state, more = server, State.LOST, ""
        else:
            word, state, more = "server", State.SUCCEEDED, server
        name, shown = self._columns.pad_robot(robot.name, screen), pad(word, 10) if more else word
        return [COLUMN_GAP.join((clock_time(now), name, screen.coloured(shown, state), *filter(None, [more])))]
