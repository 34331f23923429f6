"""What the commands print, as text: goals, status, voices. It prints nothing itself and knows neither click nor the
terminal, so that any client can use it; whether there is colour is said by its caller.

Text from others always goes through `printable`.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from talkcli.printable import printable
from talkcli.states import State

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.client import ServerStatus
    from talkcli.messages import By, Goal, JsonObject, Sender

#: Characters of a text that a list shows.
MAX_TEXT = 200

_COLOURS = {
    State.PENDING: "36",
    State.ACTIVE: "1;32",
    State.PREEMPTING: "33",
    State.PREEMPTED: "33",
    State.RECALLED: "33",
    State.SUCCEEDED: "32",
    State.ABORTED: "31",
    State.REJECTED: "31",
    State.LOST: "31",
}


def ending(goal: Goal) -> str:
    """Return how a goal ended, in one line for people."""
    words = printable(goal.message or goal.state.name)
    if goal.by:
        words += f" ({by_whom(goal.by)})"
    return f"{printable(goal.id)}: {words}" if goal.id else words


def by_whom(by: By) -> str:
    """Return what ended a goal, for people."""
    if by.goal is not None:
        return f"by {printable(by.goal)}"
    return f"by {who(by.client)}" if by.client else "by nobody known"


def who(sender: Sender | None) -> str:
    """Return who sent something, for people: the script that one looks for, and what it calls itself."""
    if sender is None:
        return "nobody known"
    parts = [printable(sender.parent or sender.command or "a program", 60)]
    if sender.pid is not None:
        parts.append(f"pid {sender.pid}")
    if sender.uid is not None:
        parts.append(f"uid {sender.uid}")
    if sender.name:
        parts.append(f'calls itself "{printable(sender.name)}"')
    return ", ".join(parts)


def goal_lines(goal: Goal, *, colour: bool) -> list[str]:
    """Return all that is known of one goal, a line each."""
    rows = [
        ("id", printable(goal.id)),
        ("state", _state(goal.state, colour)),
        ("reason", goal.reason),
        ("message", goal.message and printable(goal.message)),
        ("ended", by_whom(goal.by) if goal.by else None),
        ("text", None if goal.text is None else f'"{printable(goal.text)}"'),
        ("spoken", None if goal.spoken is None else f'"{printable(goal.spoken)}"'),
        ("from", who(goal.client)),
        ("queued", _moment(goal.queued_at)),
        ("started", _moment(goal.started_at)),
        ("ended at", _moment(goal.ended_at)),
        ("duration", None if goal.duration is None else f"{goal.duration:.2f} s of audio"),
    ]
    return [f"{name:<9}{value}" for name, value in rows if value is not None]


def status_lines(status: ServerStatus, *, colour: bool, now: float | None = None) -> list[str]:
    """Return what a server says, will say and said; `now`: seconds since 1970, for how long something takes."""
    now = time.time() if now is None else now
    server = status.server
    lines = [
        f"server   pid {_field(server, 'pid')} on {_field(server, 'socket')}, up {span(_number(server, 'uptime'))}, "
        f"{_field(server, 'clients')} of {_field(server, 'max_clients')} clients",
        f"engine   {_engine(server)}",
        f"now      {_now(status.active, now, colour)}",
    ]
    lines += _list("queue", status.pending, _who_and_text)
    lines += _list("said", status.recent, lambda goal: f"{_clock(goal.ended_at)}  {_outcome(goal, colour)}")
    return lines


def voice_lines(voices: list[JsonObject]) -> list[str]:
    """Return the voices in columns: id, language, name."""
    rows = [[printable(str(each.get(name) or "-")) for name in ("id", "language", "name")] for each in voices]
    widths = [max((len(row[column]) for row in rows), default=0) for column in (0, 1)]
    return [f"{row[0]:<{widths[0]}}  {row[1]:<{widths[1]}}  {row[2]}" for row in rows]


def span(seconds: float) -> str:
    """Return a length of time in its two largest units."""
    whole = int(seconds)
    for size, name, smaller, small_name in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            return f"{whole // size} {name} {whole % size // smaller} {small_name}"
    return f"{whole} s"


def _engine(server: JsonObject) -> str:
    parts = [_field(server, "engine"), f"driver {_field(server, 'driver')}"]
    if server.get("synthesizer"):
        parts.append(_field(server, "synthesizer"))
    parts += [f"player {_field(server, 'player')}", f"voice {_field(server, 'voice')}"]
    parts.append(f"{_field(server, 'rate')} words a minute")
    parts.append(f"volume {_field(server, 'volume')}, pitch {_field(server, 'pitch')}")
    if server.get("preempt"):
        parts.append("preempts")
    return ", ".join(parts)


def _now(active: Goal | None, now: float, colour: bool) -> str:
    if active is None:
        return "silent"
    since = "" if active.started_at is None else f" for {max(0.0, now - active.started_at):.1f} s"
    return f"{printable(active.id)}  {_state(active.state, colour)}{since}  {_who_and_text(active, with_id=False)}"


def _list(name: str, goals: tuple[Goal, ...], show: Callable[[Goal], str]) -> list[str]:
    if not goals:
        return [f"{name:<9}nothing"]
    return [f"{'' if number else name:<9}{show(goal)}" for number, goal in enumerate(goals)]


def _who_and_text(goal: Goal, *, with_id: bool = True) -> str:
    text = "(text no longer kept)" if goal.text is None else f'"{printable(goal.text, MAX_TEXT)}"'
    return f"{printable(goal.id) + '  ' if with_id else ''}{text}  from {who(goal.client)}"


def _outcome(goal: Goal, colour: bool) -> str:
    text = "(text no longer kept)" if goal.text is None else f'"{printable(goal.text, MAX_TEXT)}"'
    why = "" if goal.state is State.SUCCEEDED else f"  {printable(goal.message or '')}"
    return f"{printable(goal.id)}  {_state(goal.state, colour)}  {text}{why}"


def _state(state: State, colour: bool) -> str:
    return f"\x1b[{_COLOURS.get(state, '0')}m{state.name}\x1b[0m" if colour else state.name


def _clock(seconds: float | None) -> str:
    return "--:--:--" if seconds is None else time.strftime("%H:%M:%S", time.localtime(seconds))


def _moment(seconds: float | None) -> str | None:
    return None if seconds is None else time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime(seconds))


def _field(server: JsonObject, name: str) -> str:
    value = server.get(name)
    return "default" if value is None else printable(str(value), MAX_TEXT)


def _number(fields: JsonObject, name: str) -> float:
    value = fields.get(name)
    return float(value) if isinstance(value, int | float) else 0.0
