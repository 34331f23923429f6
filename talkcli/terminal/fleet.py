"""The robots of a fleet: as a table, `talk fleet status`, and what happens to all of them in lines, `talk fleet watch`.

Pure, as all that shows something: how wide the terminal is, and what time it is, its caller says.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State
from talkcli.terminal.goals import clock_time
from talkcli.terminal.text import COLUMN_GAP, Screen, cut, max_id_columns, pad, printable, shorten, width
from talkcli.terminal.transcript import ColumnWidths, Transcript

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.protocol.events import Event

    #: What stands in a column, and the state in whose colour; None for none.
    Cell = tuple[str, State | None]

#: The columns; and those that are left out, the first of them first, where a terminal has no room beside them for so
#: many characters of the texts, or for the whole of shorter ones.
HEADS = ("ROBOT", "ONLINE", "SERVER", "SPEAKING", "QUEUE", "LAST", "SINCE")
_ROBOT, _ONLINE, _SERVER, _SPEAKING, _QUEUE, _LAST, _SINCE = HEADS
_LEAST_TEXT = 12
_LEFT_OUT = (_SINCE, _LAST, _SERVER, _QUEUE)
#: Columns of a text, at most, by which what follows lines up where nothing has to fit.
_USUAL_TEXT = 40
#: Characters of a server's version.
_MAX_VERSION = 12
#: Stands for nothing, and for what is not known.
_NOTHING: Cell = ("-", None)


@frozen
class Robot:
    """A robot as the table shows it."""

    name: str
    online: bool
    #: the version of its server; None where there is none
    server: str | None = None
    #: the goal that is spoken, None where none is; and its text, None where that is not told
    active: str | None = None
    text: str | None = None
    pending: int = 0
    paused: bool = False
    #: how the last goal ended, and when; since when the robot is there: both times in seconds since 1970
    last: State | None = None
    last_at: float | None = None
    since: float | None = None


def robot_lines(robots: Sequence[Robot], screen: Screen, now: float) -> list[str]:
    """Return a head, and a line for each robot; `now`: seconds since 1970, for how long ago something was.

    On a terminal none is wider than that: first the texts are cut, then columns are left out.
    """
    rows = [_cells(each, screen, now) for each in robots]
    widths = {head: max(map(width, (head, *(cells[place][0] for cells in rows)))) for place, head in enumerate(HEADS)}
    _fit(widths, screen.columns_left(0))
    lines = [screen.coloured(_line({head: (head, None) for head in HEADS}, widths, Screen()), None)]
    return lines + [_line(dict(zip(HEADS, cells, strict=True)), widths, screen) for cells in rows]


def _cells(robot: Robot, screen: Screen, now: float) -> list[Cell]:
    """Return what stands in the columns of a robot's line."""
    serving = robot.online and robot.server is not None
    return [
        (cut(printable(robot.name), max_id_columns(screen)), None),
        ("yes", None) if robot.online else ("OFFLINE", State.LOST),
        _server(robot),
        _speaking(robot) if serving else _NOTHING,
        (str(robot.pending), None) if serving else _NOTHING,
        _last(robot, now),
        _NOTHING if robot.since is None or not robot.online else (_age(now - robot.since), None),
    ]


def _server(robot: Robot) -> Cell:
    if not robot.online:
        return _NOTHING
    return ("none", State.LOST) if robot.server is None else (printable(robot.server, _MAX_VERSION), None)


def _speaking(robot: Robot) -> Cell:
    said = _NOTHING[0]
    if robot.active is not None:
        said = printable(robot.active) if robot.text is None else f'"{printable(robot.text)}"'
    if robot.paused:
        return ("PAUSED" if robot.active is None else f"PAUSED {said}"), State.PREEMPTING
    return said, None if robot.active is None else State.ACTIVE


def _last(robot: Robot, now: float) -> Cell:
    if robot.last is None:
        return _NOTHING
    age = "" if robot.last_at is None else f" {_age(now - robot.last_at)}"
    return f"{robot.last.name}{age}", robot.last


def _age(seconds: float) -> str:
    """Return a length of time in its largest unit. The robot's clock may be ahead of this one."""
    whole = max(0, int(seconds))
    for size, name in ((86400, "d"), (3600, "h"), (60, "min")):
        if whole >= size:
            return f"{whole // size} {name}"
    return f"{whole} s"


def _fit(widths: dict[str, int], room: int | None) -> None:
    """Make the column of the texts narrower, and leave others out, so that a line has no more than `room`."""
    longest = widths[_SPEAKING]
    if room is None:
        widths[_SPEAKING] = min(longest, _USUAL_TEXT)
        return
    for head in (None, *_LEFT_OUT):
        if head is not None:
            del widths[head]
        left = room - len(COLUMN_GAP) * (len(widths) - 1) - (sum(widths.values()) - widths[_SPEAKING])
        widths[_SPEAKING] = max(0, min(longest, left))
        if left >= min(longest, _LEAST_TEXT):
            return


def _line(cells: dict[str, Cell], widths: dict[str, int], screen: Screen) -> str:
    shown = []
    for head, columns in widths.items():
        text, state = cells[head]
        if head == _SPEAKING and screen.width is not None:
            text = shorten(text, columns)
        text = pad(text, columns)
        shown.append(text if state is None else screen.coloured(text, state))
    return COLUMN_GAP.join(shown).rstrip()


class FleetTranscript:
    """Turns what robots tell into lines, as a transcript does for each, with the robot's name behind the time."""

    def __init__(self, *, full: bool) -> None:
        """`full`: as of `Transcript`."""
        self._full = full
        self._columns = ColumnWidths()
        self._transcripts: dict[str, Transcript] = {}

    def begin(self, robots: Sequence[Robot], where: str, screen: Screen, now: float) -> list[str]:
        """Return what is said of all robots in the beginning; `where`: of which broker they are."""
        for each in robots:
            self._columns.robot(each.name, screen)  # so that all lines line up
        gone = sum(not each.online for each in robots)
        alone = sum(each.online and each.server is None for each in robots)
        parts = [f"{len(robots)} robot{'' if len(robots) == 1 else 's'}"]
        parts += [f"{gone} OFFLINE"] if gone else []
        parts += [f"{alone} without a server"] if alone else []
        return [cut(f"{clock_time(now)}{COLUMN_GAP}{', '.join(parts)}; {printable(where)}", screen.columns_left(0))]

    def lines(self, name: str, event: Event, screen: Screen, now: float) -> list[str]:
        """Return what is to be shown of an event of a robot's; `now`: as of `Transcript.lines`."""
        if name not in self._transcripts:
            self._transcripts[name] = Transcript(full=self._full, words=False, robot=name, widths=self._columns)
        return self._transcripts[name].lines(event, screen, now)

    def change(self, before: Robot | None, robot: Robot, screen: Screen, now: float) -> list[str]:
        """Return what is to be shown of a robot that has come or gone, or its server has; of its goals none is left.

        `before`: how the same bridge of it stood, None where it is another one's, or there was none.
        """
        self._transcripts.pop(robot.name, None)
        server = "no server" if robot.server is None else f"talk {printable(robot.server, _MAX_VERSION)}"
        if not robot.online:
            word, state, more = "OFFLINE", State.LOST, ""
        elif before is None or not before.online:
            word, state, more = "online", State.SUCCEEDED, server
        elif robot.server is None:
            word, state, more = server, State.LOST, ""
        else:
            word, state, more = "server", State.SUCCEEDED, server
        name, shown = self._columns.robot(robot.name, screen), pad(word, 10) if more else word
        return [COLUMN_GAP.join((clock_time(now), name, screen.coloured(shown, state), *filter(None, [more])))]
