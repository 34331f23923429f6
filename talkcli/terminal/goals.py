"""Functions that format goals, server status, settings and voices as lines of text.

The functions return lines and print nothing. The caller passes the width of the terminal and the time. Events are
formatted in `transcript`.
"""

from __future__ import annotations

import re
import time

from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.goal import By, message_details, read_seconds
from talkcli.goals.options import SOUND, format_number
from talkcli.goals.states import State
from talkcli.protocol.lines import encode
from talkcli.terminal.text import COLUMN_GAP, ELLIPSIS, TEXT_COLUMNS, Screen, fit_row, pad, printable, width, wrap

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from talkcli.goals.goal import Goal, JsonObject, Output, Sender
    from talkcli.protocol.events import ServerStatus

#: The maximum length of a text in a list of goals.
_LISTED_TEXT_CHARS = 200
#: The width of the label at the start of each line.
_LABEL_COLUMNS = 9
#: The maximum length of a sender's command line.
_SENDER_COMMAND_CHARS = 60
#: The maximum length of a voice's name or language. Voice files may contain longer ones.
_VOICE_NAME_CHARS = 80
#: Shown in place of a text that the server no longer keeps.
TEXT_NOT_KEPT = "(text no longer kept)"

#: Formats for fields of the server status. Other fields are shown with their name and value.
_FIELD_FORMATS = {
    "engine": "{}",
    "synthesizer": "{}",
    "lead_in": "lead-in {} ms",
    "rate": "{} words per minute",
    "ttl": "ttl {} s",
    "preempt": "every goal interrupts",
}
#: Fields of the server status that are only shown if they have a value.
_OPTIONAL_FIELDS = frozenset({"synthesizer", "device", "lead_in", "ttl", "preempt"})

_UNKNOWN_SENDER = "unknown"
#: Programs that run a script or another program, by name without the version number. Each value consists of the options
#: that take a value, the options that replace the script, and the number of arguments before the script.
_LAUNCHERS = {
    **dict.fromkeys(("sh", "bash", "dash", "ash", "zsh", "ksh", "fish"), ("o O rcfile init-file", "c s", 0)),
    **dict.fromkeys(("nohup", "setsid"), ("", "", 0)),
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
    "stdbuf": ("i o e input output error", "", 0),
    "sudo": ("u g h p C D R T user group host prompt chdir", "", 0),
    "taskset": ("", "", 1),
    "time": ("f o format output", "", 0),
    "timeout": ("s k signal kill-after", "", 1),
    "xargs": ("n P I L s d a E max-args max-procs arg-file", "", 0),
}
#: Matches an argument such as NAME=VALUE, which sets an environment variable.
_ASSIGNMENT = re.compile(r"\w+=.*")
#: Matches the path of an open file descriptor, which says nothing about the name of the script.
_DESCRIPTOR_PATH = re.compile(r"/dev/(fd/\d+|stdin)|/proc/(self|\d+)/fd/\d+")


def describe_end(goal: Goal, name_client: bool = True) -> str:
    """Return a one-line description of how a goal ended.

    If `name_client` is false, it doesn't name the client that cancelled the goal.
    """
    words = printable(goal.message or goal.state.name)
    by_goal = goal.by and goal.by.goal
    # The message may already name the goal.
    if goal.by and (f"by goal {by_goal}" not in words if by_goal else name_client):
        words += f" ({_describe_cause(goal.by)})"
    return f"{printable(goal.id)}: {words}" if goal.id else words


def goal_lines(goal: Goal, screen: Screen, now: float) -> list[str]:
    """Return all details of a goal, with one field per line."""
    state = screen.coloured(goal.state.name, goal.state)
    rows = [
        ("id", printable(goal.id)),
        ("state", ", ".join([state, *_silence_reasons(goal, screen)])),
        ("reason", goal.reason and printable(goal.reason)),
        ("message", goal.message and printable(goal.message)),
        ("ended", _describe_cause(goal.by) if goal.by else None),
        ("sound" if goal.format == SOUND else "text", _quote(_shown_text(goal))),
        ("said", _quote(goal.said)),
        ("spoken", _quote(goal.spoken)),
        ("heard", goal.heard and goal.heard != goal.duration and f"{goal.heard:.2f} s of audio"),
        ("from", _describe_sender(goal.client)),
        ("priority", str(goal.priority)),
        ("key", _quote(goal.key or None)),
        ("ttl", goal.ttl and ", ".join(filter(None, (f"{format_number(goal.ttl)} s", _describe_time_left(goal, now))))),
        ("data", None if goal.data is None else printable(encode(goal.data).decode().rstrip("\n"))),
        ("queued", _format_date_and_time(goal.queued_at)),
        ("started", _format_date_and_time(goal.started_at)),
        ("ended at", _format_date_and_time(goal.ended_at)),
        ("duration", None if goal.duration is None else f"{goal.duration:.2f} s of audio"),
        ("voice", goal.voice and printable(goal.voice)),
        ("output", goal.output and _describe_output(goal.output)),
    ]
    lines = []
    for name, value in rows:
        if value:
            # Don't wrap JSON, so that it stays valid when it is copied from the terminal.
            lines += wrap(value.split(" "), _pad_label(name), Screen() if name == "data" else screen)
    return lines


def status_lines(status: ServerStatus, screen: Screen, now: float) -> list[str]:
    """Return the lines of `talk status`."""
    server = status.server
    screen = replace(screen, boot=str(server.get("boot")))
    uptime = server.get("uptime")
    identity = [
        f"pid {_format_status_field(server, 'pid')} on {_format_status_field(server, 'socket')}",
        f"up {format_duration(float(uptime) if isinstance(uptime, int | float) else 0.0)}",
        f"{_format_status_field(server, 'clients')} of {_format_status_field(server, 'max_clients')} clients",
    ]
    engine = _format_status_fields(server, "engine", "driver", "synthesizer", "player", "device", "lead_in")
    settings = _format_status_fields(server, "rate", "volume", "pitch", "voice", "ttl", "preempt")
    lines: list[str] = []
    for label, parts in (("server", identity), ("engine", engine), ("settings", settings)):
        lines += wrap([*(f"{each}," for each in parts[:-1]), parts[-1]], _pad_label(label), screen)
    neural = server.get("neural_voices")
    for voice, found in neural.items() if isinstance(neural, dict) else ():
        state, why = (found.get(each) for each in ("state", "why"))
        lines += wrap(printable(f"{voice} {state}{f': {why}' if why else ''}").split(" "), _pad_label("voice"), screen)
    if server.get("paused"):
        words = screen.coloured(describe_pause(server, screen), State.PREEMPTING)
        lines += wrap([f"{words};", "to continue, run: talk resume"], _pad_label("paused"), screen)
    active = [status.active] if status.active else []
    tables: list[tuple[str, Sequence[Goal], str]] = [("now", active, "silent")]
    if status.interrupted:
        tables.append(("next", status.interrupted, ""))
    tables += [("queue", status.pending, "nothing"), ("said", status.recent, "nothing")]
    id_width = max((width(screen.goal_id(goal.id)) for _, goals, _ in tables for goal in goals), default=0)
    for label, goals, without in tables:
        lines += _goal_table(label, goals, id_width, screen, now) if goals else [_pad_label(label) + without]
    return lines


def describe_pause(status: JsonObject, screen: Screen | None = None) -> str:
    """Describe a pause: who paused speech, since when, and until when."""
    by, at, until = By.from_json(status.get("paused_by")), status.get("paused_at"), status.get("paused_until")
    parts = [f" by {sender_forms(by.client, screen or Screen())[0]}"] if by and by.client else []
    parts += [f" since {clock_time(found)}"] if (found := read_seconds(at)) is not None else []
    parts += [f", until {clock_time(found)}"] if (found := read_seconds(until)) is not None else []
    return "".join(["speech is paused", *parts])


def _pad_label(label: str) -> str:
    """Pad a label to the width of the label column."""
    return f"{label:<{_LABEL_COLUMNS}}"


def setting_lines(settings: Mapping[str, object]) -> list[str]:
    """Return one line for each setting, with its name and value.

    The values are written in the form that the options of `talk set` accept.
    """
    shown = {"voice": "default", "ttl": 0}
    rows = [(name, shown.get(name, "-") if value is None else value) for name, value in settings.items()]
    longest = max((len(name) for name, _ in rows), default=0)
    return [f"{printable(name):<{longest}}{COLUMN_GAP}{printable(_format_value(value))}" for name, value in rows]


def voice_lines(voices: list[JsonObject]) -> list[str]:
    """Return one line for each voice, with its id, language and name."""
    limits = {"id": None, "language": _VOICE_NAME_CHARS, "name": _VOICE_NAME_CHARS}
    rows = [[printable(str(each.get(name) or "-"), limit) for name, limit in limits.items()] for each in voices]
    widths = [max((width(row[place]) for row in rows), default=0) for place in (0, 1)]
    return [COLUMN_GAP.join((pad(row[0], widths[0]), pad(row[1], widths[1]), row[2])) for row in rows]


def format_duration(seconds: float) -> str:
    """Format a duration in its two largest units, such as "2 h 5 min"."""
    whole = int(seconds)
    for size, name, smaller, small_name in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            return f"{whole // size} {name} {whole % size // smaller} {small_name}"
    return f"{whole} s"


def _goal_table(label: str, goals: Sequence[Goal], id_width: int, screen: Screen, now: float) -> list[str]:
    """Return one line for each goal, cut to the terminal's width. The first line has the label."""
    labels = [label, *[""] * (len(goals) - 1)]
    heads = [_pad_label(name) + _head_columns(goal, id_width, screen) for name, goal in zip(labels, goals, strict=True)]
    tails = [_tail_forms(goal, screen, now) for goal in goals]
    texts = [quoted_text(goal, _LISTED_TEXT_CHARS) for goal in goals]
    text_columns = min(TEXT_COLUMNS, max(map(width, texts)))
    rows = zip(heads, texts, tails, strict=True)
    return [fit_row(head, text, forms, text_columns, screen) for head, text, forms in rows]


def _head_columns(goal: Goal, id_width: int, screen: Screen) -> str:
    """Return the columns before a goal's text, such as its id and state."""
    goal_id = pad(screen.goal_id(goal.id), id_width)
    head = f"{goal_id}{COLUMN_GAP}{screen.coloured(pad(goal.state.name, 9), goal.state)}{COLUMN_GAP}"
    return f"{clock_time(goal.ended_at)}{COLUMN_GAP}{head}" if goal.state.terminal else head


def _tail_forms(goal: Goal, screen: Screen, now: float) -> list[str]:
    """Return alternative texts for the last column of a goal's line, longest first."""
    if goal.state.terminal:
        return listed_reason_forms(goal, screen)
    # The sender is the most important detail. If there is no room, the other details are left out, starting with the
    # last.
    senders, details = sender_forms(goal.client, screen), _unfinished_details(goal, screen, now)
    kept = range(len(details), -1, -1)
    return [", ".join([f"from {sender}", *details[:count]]) for count in kept for sender in senders]


def quoted_text(goal: Goal, limit: int | None = None) -> str:
    """Return a goal's text or sound in quotes, or a placeholder if it is no longer kept."""
    return "sound " * (goal.format == SOUND) + (_quote(_shown_text(goal), limit) or TEXT_NOT_KEPT)


def _shown_text(goal: Goal) -> str | None:
    """Return a goal's text, with an ellipsis if it may still grow.

    Return None if the text is no longer kept.
    """
    return goal.text + ELLIPSIS if goal.text is not None and goal.more and not goal.state.terminal else goal.text


def _silence_reasons(goal: Goal, screen: Screen) -> list[str]:
    """Return the reasons why an unfinished goal is silent now."""
    if goal.state.terminal:
        return []
    if goal.interrupted_by is not None:
        return [f"interrupted by {screen.goal_id(goal.interrupted_by)}"]
    return ["paused"] * goal.paused + ["waiting for text"] * goal.waits


def _quote(text: str | None, limit: int | None = None) -> str | None:
    """Escape a text, cut it to `limit` characters and put it in quotes.

    Return None if the text is None.
    """
    return None if text is None else f'"{printable(text, limit)}"'


def _unfinished_details(goal: Goal, screen: Screen, now: float) -> list[str]:
    """Return details of an unfinished goal, such as its priority and key."""
    reasons = "".join(f"{each}, " for each in _silence_reasons(goal, screen))
    notes = [
        None if goal.started_at is None else f"{reasons}for {max(0.0, now - goal.started_at):.1f} s",
        f"priority {goal.priority}" if goal.priority else None,
        None if goal.key is None else f'key "{printable(goal.key)}"',
        _describe_time_left(goal, now),
    ]
    return [each for each in notes if each is not None]


def _describe_time_left(goal: Goal, now: float) -> str | None:
    """Describe how much time a pending goal has left before it expires.

    Return None if it has no ttl.
    """
    if goal.state is not State.PENDING or not goal.ttl or goal.queued_at is None:
        return None
    left = max(0.0, goal.queued_at + goal.ttl - now)
    return f"{left:.1f} s left" if left < 60 else f"{format_duration(left)} left"


def _describe_sender(sender: Sender | None) -> str:
    """Describe a sender by its command, process id, user id and name."""
    if sender is None:
        return _UNKNOWN_SENDER
    parts = [
        _sender_command(sender),
        None if sender.pid is None else f"pid {sender.pid}",
        None if sender.uid is None else f"uid {sender.uid}",
        f"named {_quote(sender.name)}" if sender.name else None,
    ]
    return ", ".join(filter(None, parts))


def sender_forms(sender: Sender | None, screen: Screen) -> list[str]:
    """Return alternative descriptions of a sender, longest first.

    The command and the process id are only included with `screen.long`. The name that the sender has
    chosen comes first. It is in quotes because it isn't verified.
    """
    if sender is None:
        return [_UNKNOWN_SENDER]
    name, script = _quote(sender.name or None), _script_name(sender)
    if not screen.long:
        return [name or script]
    number = "" if sender.pid is None else f", pid {sender.pid}"
    forms = dict.fromkeys(f"{each}{number}" for each in (_sender_command(sender), script))
    return [f"{name} ({each})" if name else each for each in forms]


def _describe_cause(by: By) -> str:
    """Describe the goal or the client that caused another goal to end."""
    return f"by {_describe_sender(by.client) if by.goal is None else printable(by.goal)}"


def listed_reason_forms(goal: Goal, screen: Screen) -> list[str]:
    """Return descriptions of why a goal ended, longest first. Show a duration only with `screen.long`.

    The duration of a goal is shown instead of a reason if the goal succeeded.
    """
    if goal.state is State.SUCCEEDED and not screen.long:
        return _muted_note(goal) or [""]
    return reason_forms(goal, screen)


def reason_forms(goal: Goal, screen: Screen) -> list[str]:
    """Return descriptions of why a goal ended, longest first. If it succeeded, return its duration."""
    if goal.state is State.SUCCEEDED:
        return [", ".join([*([] if goal.duration is None else [f"{goal.duration:.1f} s"]), *_muted_note(goal)])]
    reason = "cancelled" if goal.reason == "canceled" else printable(goal.reason or goal.state.name.lower())
    by = []
    if goal.by is not None:
        by = [screen.goal_id(goal.by.goal)] if goal.by.goal is not None else sender_forms(goal.by.client, screen)
    forms = [f"{reason} by {each}" for each in by] or [reason]
    words = _message_details(goal)
    # The shortest description only says who ended the goal, because the state suggests the reason.
    shortest = f"by {by[-1]}" if by else reason
    if not words:
        return [*forms, shortest]
    forms = [f"{each}: {words}" for each in forms]
    # Details from an engine or a player are more useful than the reason alone, even if they are cut off.
    return forms if goal.state in {State.ABORTED, State.REJECTED} else [*forms, shortest]


def _message_details(goal: Goal) -> str:
    """Return the details that a goal's message adds to its reason, if any."""
    if goal.state not in {State.ABORTED, State.REJECTED} and goal.by is not None:
        return ""
    details = message_details(goal.message)
    return "" if details == goal.message else printable(details)


def _describe_output(output: Output) -> str:
    """Describe the device, the player and the volume that a goal was played with."""
    muted = ", muted" if output.muted else ""
    return f"{printable(output.device)}, by {printable(output.player)}, volume {output.volume:g}{muted}"


def _muted_note(goal: Goal) -> list[str]:
    """Return ["muted"] if the goal's output was muted, or an empty list."""
    return ["muted"] if goal.output and goal.output.muted else []


def _sender_command(sender: Sender) -> str:
    """Return the command line of the sender's parent process, or the sender's own if that is unknown."""
    return printable(sender.parent or sender.command or "a program", _SENDER_COMMAND_CHARS)


def _script_name(sender: Sender) -> str:
    """Return the name of the sender's script, without its directory."""
    words = (sender.parent or "").split()
    if not words:
        return _sender_command(sender)
    while launched := _launched_command(words):
        words = launched
    return printable(_file_name(words[0]), _SENDER_COMMAND_CHARS)


def _launched_command(words: list[str]) -> list[str]:
    """Return the command line that a launcher such as `bash` or `sudo` runs.

    The list is empty if the command isn't a launcher, or if the script has no name.
    """
    name = _file_name(words[0]).rstrip("0123456789.")
    if name not in _LAUNCHERS:
        return []
    valued, nameless, arguments_left = _LAUNCHERS[name]
    rest = iter(range(1, len(words)))
    for place in rest:
        word = words[place]
        if word.startswith("-"):
            options = [word[2:]] if word.startswith("--") else list(word[1:])
            for number, each in enumerate(options, start=1):
                if each in nameless.split():
                    return []
                if each in valued.split():
                    if number == len(options):  # otherwise, the value is part of the same word
                        next(rest, None)
                    break
        elif not _ASSIGNMENT.fullmatch(word):
            if arguments_left == 0:
                return [] if _DESCRIPTOR_PATH.fullmatch(word) else words[place:]
            arguments_left -= 1
    return []


def _file_name(path: str) -> str:
    """Return the last component of a path."""
    return path.rstrip("/").rpartition("/")[2] or path


def _format_status_fields(server: JsonObject, *names: str) -> list[str]:
    """Format the named fields of the server's status. Leave out empty optional fields."""
    shown = [each for each in names if server.get(each) or each not in _OPTIONAL_FIELDS]
    return [_FIELD_FORMATS.get(each, f"{each} {{}}").format(_format_status_field(server, each)) for each in shown]


def _format_value(value: object) -> str:
    """Format a value of a setting. A boolean becomes "yes" or "no"."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return format_number(value)


def clock_time(seconds: float | None) -> str:
    """Format a timestamp as the local time of day, or as dashes if it is unknown."""
    return "--:--:--" if seconds is None else time.strftime("%H:%M:%S", time.localtime(seconds))


def _format_date_and_time(seconds: float | None) -> str | None:
    """Format a timestamp as local date and time. Return None for None."""
    return None if seconds is None else time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime(seconds))


def _format_status_field(server: JsonObject, name: str) -> str:
    """Format the value of a field of the server's status."""
    value = server.get(name)
    return "default" if value is None else printable(_format_value(value), _LISTED_TEXT_CHARS)
