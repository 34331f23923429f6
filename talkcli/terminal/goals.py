"""Goals in words: one with all that is known, those of a status, who sent them, and what ended them; voices, settings.

It prints nothing itself, so that any client can use it; how wide the terminal is, whether it has colour and what time
it is, its caller says. Text from others always goes through `printable`. What happens as it happens is in `transcript`.
"""

from __future__ import annotations

import re
import time

from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.option import figure
from talkcli.goals.states import State
from talkcli.protocol.lines import encode
from talkcli.terminal.text import GAP, LONGEST_ID, Screen, cut, fitted, folded, id_room, pad, printable, width

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from talkcli.goals.goal import By, Goal, JsonObject, Output, Sender
    from talkcli.protocol.events import ServerStatus

#: Characters of a text that a list shows.
MAX_TEXT = 200
#: Columns of what stands before each line of `status`.
_LABEL = 9
#: Characters of a command line that are shown.
MAX_COMMAND = 60
#: Characters of a voice's name and of its language: of neural ones they stand in a stranger's file.
_MAX_VOICE = 80
#: Stands for the text of a goal that ended long ago.
NOT_KEPT = "(text no longer kept)"

#: How a server's part is told that does not begin with its name, and which are left out where there is none.
_ABOUT = {
    "engine": "{}",
    "synthesizer": "{}",
    "lead_in": "lead-in {} ms",
    "rate": "{} words a minute",
    "ttl": "ttl {} s",
    "preempt": "preempts",
}
_IF_ANY = frozenset({"synthesizer", "device", "lead_in", "ttl", "preempt"})

_NOBODY = "nobody known"
#: Programs that start another one, without their version: their options that take a value, their options after which no
#: script follows, and the number of arguments before the program.
_SHELL = ("o O rcfile init-file", "c s", 0)
_STARTERS = {
    **dict.fromkeys(("sh", "bash", "dash", "ash", "zsh", "ksh", "fish"), _SHELL),
    "python": ("W X", "c", 0),
    "perl": ("I", "e E", 0),
    "ruby": ("I r", "e", 0),
    "node": ("r require import", "e p eval print", 0),
    "lua": ("l", "e", 0),
    "chrt": ("T P D", "", 1),
    "env": ("u C unset chdir", "", 0),
    "flock": ("w E timeout", "c", 1),
    "ionice": ("c n class classdata", "", 0),
    "nice": ("n adjustment", "", 0),
    "nohup": ("", "", 0),
    "setsid": ("", "", 0),
    "stdbuf": ("i o e input output error", "", 0),
    "sudo": ("u g h p C D R T user group host prompt chdir", "", 0),
    "taskset": ("", "", 1),
    "time": ("f o format output", "", 0),
    "timeout": ("s k signal kill-after", "", 1),
    "xargs": ("n P I L s d a E max-args max-procs arg-file", "", 0),
}
#: Arguments that are neither the program nor one of those before it: variables that are set.
_ASSIGNMENT = re.compile(r"\w+=.*")
#: Paths of open files, which say nothing about the script.
_DESCRIPTOR = re.compile(r"/dev/(fd/\d+|stdin)|/proc/(self|\d+)/fd/\d+")


def ending(goal: Goal) -> str:
    """Return how a goal ended, in one line for people."""
    words = printable(goal.message or goal.state.name)
    if goal.by:
        words += f" ({by_whom(goal.by)})"
    return f"{printable(goal.id)}: {words}" if goal.id else words


def goal_lines(goal: Goal, screen: Screen, now: float) -> list[str]:
    """Return all that is known of one goal, a line each; on a terminal what is longer goes on under its beginning.

    `now`: seconds since 1970, for how long something takes.
    """
    state = screen.painted(goal.state.name, goal.state)
    rows = [
        ("id", printable(goal.id)),
        ("state", f"{state}, paused" if goal.paused and not goal.state.terminal else state),
        ("reason", goal.reason and printable(goal.reason)),
        ("message", goal.message and printable(goal.message)),
        ("ended", by_whom(goal.by) if goal.by else None),
        ("text", None if goal.text is None else f'"{printable(goal.text)}"'),
        ("spoken", None if goal.spoken is None else f'"{printable(goal.spoken)}"'),
        ("from", who(goal.client)),
        ("priority", str(goal.priority)),
        ("key", goal.key and f'"{printable(goal.key)}"'),
        ("ttl", goal.ttl and ", ".join(filter(None, (f"{figure(goal.ttl)} s", _left(goal, now))))),
        ("data", None if goal.data is None else printable(encode(goal.data).decode().rstrip("\n"))),
        ("queued", _moment(goal.queued_at)),
        ("started", _moment(goal.started_at)),
        ("ended at", _moment(goal.ended_at)),
        ("duration", None if goal.duration is None else f"{goal.duration:.2f} s of audio"),
        ("voice", goal.voice and printable(goal.voice)),
        ("output", goal.output and _output(goal.output)),
    ]
    lines = []
    for name, value in rows:
        if value:
            # What is JSON is left to the terminal to break: copied from there it is the same still.
            lines += folded(value.split(" "), f"{name:<{_LABEL}}", Screen() if name == "data" else screen)
    return lines


def status_lines(status: ServerStatus, screen: Screen, now: float) -> list[str]:
    """Return what a server says, will say and said; `now`: as of `goal_lines`."""
    server = status.server
    uptime = server.get("uptime")
    about = [
        f"pid {_field(server, 'pid')} on {_field(server, 'socket')}",
        f"up {span(float(uptime) if isinstance(uptime, int | float) else 0.0)}",
        f"{_field(server, 'clients')} of {_field(server, 'max_clients')} clients",
    ]
    engine = _about(server, "engine", "driver", "synthesizer", "player", "device", "lead_in")
    settings = _about(server, "rate", "volume", "pitch", "voice", "ttl", "preempt")
    lines = []
    for label, parts in (("server", about), ("engine", engine), ("settings", settings)):
        lines += folded([*(f"{each}," for each in parts[:-1]), parts[-1]], f"{label:<{_LABEL}}", screen)
    neural = server.get("neural_voices")
    for voice, found in neural.items() if isinstance(neural, dict) else ():
        state, why = (found.get(each) for each in ("state", "why"))
        lines += folded(
            printable(f"{voice} {state}{f': {why}' if why else ''}").split(" "), f"{'voice':<{_LABEL}}", screen
        )
    if server.get("paused"):
        lines.append(f"{'paused':<{_LABEL}}{screen.painted('speech is held', State.PREEMPTING)}: talk resume")
    active = [status.active] if status.active else []
    tables = (("now", active, "silent"), ("queue", status.pending, "nothing"), ("said", status.recent, "nothing"))
    widest = max((width(printable(goal.id)) for _, goals, _ in tables for goal in goals), default=0)
    id_columns = min(widest, id_room(screen) or LONGEST_ID)
    for label, goals, without in tables:
        lines += _table(label, goals, id_columns, screen, now) if goals else [f"{label:<{_LABEL}}{without}"]
    return lines


def setting_lines(settings: Mapping[str, object]) -> list[str]:
    """Return a server's settings, a line each: the name of its option, and a value that this option takes."""
    shown = {"voice": "default", "ttl": 0}
    rows = [(name, shown.get(name, "-") if value is None else value) for name, value in settings.items()]
    longest = max((len(name) for name, _ in rows), default=0)
    return [f"{printable(name):<{longest}}{GAP}{printable(_value(value))}" for name, value in rows]


def voice_lines(voices: list[JsonObject]) -> list[str]:
    """Return the voices in columns: id, language, name, of which what is very long is cut."""
    limits = {"id": None, "language": _MAX_VOICE, "name": _MAX_VOICE}
    rows = [[printable(str(each.get(name) or "-"), limit) for name, limit in limits.items()] for each in voices]
    widths = [max((width(row[place]) for row in rows), default=0) for place in (0, 1)]
    return [GAP.join((pad(row[0], widths[0]), pad(row[1], widths[1]), row[2])) for row in rows]


def span(seconds: float) -> str:
    """Return a length of time in its two largest units."""
    whole = int(seconds)
    for size, name, smaller, small_name in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            return f"{whole // size} {name} {whole % size // smaller} {small_name}"
    return f"{whole} s"


def _table(label: str, goals: Sequence[Goal], id_columns: int, screen: Screen, now: float) -> list[str]:
    """Return a line for each goal in a status, that fits the terminal."""
    heads = [
        f"{'' if number else label:<{_LABEL}}{_head(goal, id_columns, screen)}" for number, goal in enumerate(goals)
    ]
    tails = [_tails(goal, now) for goal in goals]
    texts = [quoted(goal, MAX_TEXT) for goal in goals]
    room = screen.room(max(map(width, heads)))
    if room is None:
        return [GAP.join([head + text, *tail[:1]]) for head, text, tail in zip(heads, texts, tails, strict=True)]
    said = fitted(texts, [tail or [""] for tail in tails], weights=(1, 1), room=room)
    return [head + words for head, words in zip(heads, said, strict=True)]


def _head(goal: Goal, id_columns: int, screen: Screen) -> str:
    """Return what stands before a goal's text."""
    goal_id = pad(cut(printable(goal.id), id_room(screen)), id_columns)
    head = f"{goal_id}{GAP}{screen.painted(pad(goal.state.name, 9), goal.state)}{GAP}"
    return f"{clock(goal.ended_at)}{GAP}{head}" if goal.state.terminal else head


def _tails(goal: Goal, now: float) -> list[str]:
    """Return what stands after a goal's text, the longest form first."""
    if goal.state.terminal:
        return _muted(goal) if goal.state is State.SUCCEEDED else why_forms(goal)
    # The sender first: what does not fit is cut at its end.
    return [", ".join([f"from {each}", *_notes(goal, now)]) for each in who_forms(goal.client)]


def quoted(goal: Goal, limit: int | None = None) -> str:
    """Return the text of a goal, cut after `limit` characters."""
    return NOT_KEPT if goal.text is None else f'"{printable(goal.text, limit)}"'


def _notes(goal: Goal, now: float) -> list[str]:
    """Return what is worth knowing of a goal that has not ended, beside its text and its sender."""
    held = "held, " if goal.paused else ""
    notes = [
        None if goal.started_at is None else f"{held}for {max(0.0, now - goal.started_at):.1f} s",
        f"priority {goal.priority}" if goal.priority else None,
        None if goal.key is None else f'key "{printable(goal.key)}"',
        _left(goal, now),
    ]
    return [each for each in notes if each is not None]


def _left(goal: Goal, now: float) -> str | None:
    """Return how long a goal may still wait for its turn."""
    if goal.state is not State.PENDING or not goal.ttl or goal.queued_at is None:
        return None
    left = max(0.0, goal.queued_at + goal.ttl - now)
    return f"{left:.1f} s left" if left < 60 else f"{span(left)} left"


def who(sender: Sender | None) -> str:
    """Return who sent something: the script that one looks for, and what it calls itself."""
    if sender is None:
        return _NOBODY
    numbers = {"pid": sender.pid, "uid": sender.uid}
    parts = [_program(sender), *(f"{name} {number}" for name, number in numbers.items() if number is not None)]
    if sender.name:
        parts.append(f'calls itself "{printable(sender.name)}"')
    return ", ".join(parts)


def who_forms(sender: Sender | None) -> list[str]:
    """Return who sent something, for a column: the longest form first.

    What it calls itself, in quotes, as it is a claim, comes before what it is, and stays where there is room for one.
    """
    if sender is None:
        return [_NOBODY]
    script = _script(sender)
    number = "" if sender.pid is None else f", pid {sender.pid}"
    forms = [f"{_program(sender)}{number}", f"{script}{number}", script]
    if sender.name:
        claim = f'"{printable(sender.name)}"'
        forms = [*(f"{claim} ({each})" for each in forms), claim]
    return list(dict.fromkeys(forms))


def by_whom(by: By) -> str:
    """Return what ended a goal."""
    return f"by {who(by.client) if by.goal is None else printable(by.goal)}"


def why_forms(goal: Goal) -> list[str]:
    """Return why a goal ended and who ended it, for a column: the longest form first."""
    if goal.state is State.SUCCEEDED:
        return [", ".join([*([] if goal.duration is None else [f"{goal.duration:.1f} s"]), *_muted(goal)])]
    reason = printable(goal.reason or goal.state.name.lower())
    by = []
    if goal.by is not None:
        by = [printable(goal.by.goal)] if goal.by.goal is not None else who_forms(goal.by.client)
    forms = [f"{reason} by {each}" for each in by] or [reason]
    words = _words(goal)
    # Who ended it is worth more than the reason, of which the state says something already.
    shortest = f"by {by[-1]}" if by else reason
    if not words:
        return [*forms, shortest]
    forms = [f"{each}: {words}" for each in forms]
    # What an engine or a player said is worth more than the reason alone, even if it is cut.
    return forms if goal.state in {State.ABORTED, State.REJECTED} else [*forms, shortest]


def _words(goal: Goal) -> str:
    """Return what the goal's message says beyond its state, where that is more than reason and `by` say."""
    if goal.state not in {State.ABORTED, State.REJECTED} and goal.by is not None:
        return ""
    head, colon, words = (goal.message or "").partition(": ")
    return printable(words) if colon and head.startswith("Talk ") else ""


def _output(output: Output) -> str:
    muted = ", muted" if output.muted else ""
    return f"{printable(output.device)}, by {printable(output.player)}, volume {output.volume:g}{muted}"


def _muted(goal: Goal) -> list[str]:
    """Return what is said of a goal that nobody could hear, though it was played."""
    return ["muted"] if goal.output and goal.output.muted else []


def _program(sender: Sender) -> str:
    return printable(sender.parent or sender.command or "a program", MAX_COMMAND)


def _script(sender: Sender) -> str:
    """Return the name of the script, without its directory, its arguments and the programs that started it."""
    words = (sender.parent or "").split()
    if not words:
        return _program(sender)
    while started := _started(words):
        words = started
    return printable(_base(words[0]), MAX_COMMAND)


def _started(words: list[str]) -> list[str]:
    """Return the command that this command starts, empty if it starts none or a script without a name."""
    name = _base(words[0]).rstrip("0123456789.")
    if name not in _STARTERS:
        return []
    valued, nameless, arguments = _STARTERS[name]
    rest = iter(range(1, len(words)))
    for place in rest:
        word = words[place]
        if word.startswith("-"):
            options = [word[2:]] if word.startswith("--") else list(word[1:])
            for number, each in enumerate(options, start=1):
                if each in nameless.split():
                    return []
                if each in valued.split():
                    if number == len(options):  # else its value is the rest of this word
                        next(rest, None)
                    break
        elif not _ASSIGNMENT.fullmatch(word):
            if arguments == 0:
                return [] if _DESCRIPTOR.fullmatch(word) else words[place:]
            arguments -= 1
    return []


def _base(path: str) -> str:
    return path.rstrip("/").rpartition("/")[2] or path


def _about(server: JsonObject, *names: str) -> list[str]:
    """Return what these are of a server, in a few words each."""
    shown = [each for each in names if server.get(each) or each not in _IF_ANY]
    return [_ABOUT.get(each, f"{each} {{}}").format(_field(server, each)) for each in shown]


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return figure(value)


def clock(seconds: float | None) -> str:
    """Return a moment of today, in the local time zone."""
    return "--:--:--" if seconds is None else time.strftime("%H:%M:%S", time.localtime(seconds))


def _moment(seconds: float | None) -> str | None:
    return None if seconds is None else time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime(seconds))


def _field(server: JsonObject, name: str) -> str:
    value = server.get(name)
    return "default" if value is None else printable(_value(value), MAX_TEXT)
