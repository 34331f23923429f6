"""Begins a plain command before the program that carries it out is imported, and carries it out.

A request is sent early only where nothing can be wrong with it, so that no error is found after it was sent. Its line
must be, byte for byte, the one that the client library sends for the same command: the library takes it for its own,
see `Connection`. A test shows that it is.
"""

from __future__ import annotations

import _signal
import os
import time

from talkcli.client.opening import open_early, stand_back
from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Any

    from talkcli.cli.plain import Plain
    from talkcli.cli.show import Common
    from talkcli.client.opening import Opened

#: Fields of the requests that are sent early, in their order, as `requests` has them.
_FIELDS = {
    "say": (
        *("text", "wait", "feedback", "preempt", "flush", "priority", "ttl", "key", "throttle"),
        *("rate", "volume", "voice", "pitch"),
    ),
    "cancel": ("current", "key"),
    "status": (),
    "pause": (),
    "resume": (),
}
#: Those that are left out of a request where they are this; the others where they are None.
_DEFAULTS = {"wait": False, "feedback": False, "flush": False, "priority": 0, "current": False}
#: Characters of a label and of a text that are surely not too many.
_LABEL, _TEXT = 64, 10_000
_PRIORITIES = range(-1_000_000, 1_000_001)


def lines(plain: Plain) -> tuple[bytes, bytes] | None:
    """Return the lines of `hello` and of the request; None where something about them is not plain."""
    given = plain.given
    if plain.command not in _FIELDS or given.get("id") or given.get("ids") or given.get("before"):
        return None
    if given.get("goal_id") or given.get("priority", 0) not in _PRIORITIES:
        return None
    name = given.get("name") or os.environ.get("TALK_NAME") or None
    if plain.command == "say":
        given = {**given, "text": " ".join(given["text"])}
        hello = _line({"request": "hello", "name": name})
    elif plain.command in ("cancel", "status"):
        hello = _line({"request": "hello", "name": name, "urgent": True})
    else:
        hello = _line({"request": "hello", "name": name})
    fields = {name: given[name] for name in _FIELDS[plain.command]}
    asked = {name: each for name, each in fields.items() if each is not None and each != _DEFAULTS.get(name)}
    request = _line({"seq": 1, "request": plain.command, **asked})
    return (hello, request) if hello and request else None


def _line(fields: dict[str, Any]) -> bytes | None:
    """Return an object as a line of JSON; None where a text in it is long, or has what JSON escapes."""
    shown = []
    for name, each in fields.items():
        if isinstance(each, str):
            fits = 0 < len(each) <= (_TEXT if name == "text" else _LABEL)
            if not (fits and each.isprintable()) or '"' in each or "\\" in each:
                return None
            shown.append(f'"{name}": "{each}"')
        elif each is not None:
            shown.append(f'"{name}": {str(each).lower() if isinstance(each, bool) else repr(each)}')
    return f"{{{', '.join(shown)}}}\n".encode()


def carry_out(plain: Plain, arguments: list[str]) -> int:
    """Carry out a plain command line, and return its exit code."""
    began = time.monotonic()
    said = lines(plain)
    held: set[int] = set()

    def hold() -> None:
        # A goal that is on its way is this command's to cancel: a signal waits until there is somebody to do so.
        asked = {_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP} if plain.command == "say" else set()
        held.update(asked - _signal.pthread_sigmask(_signal.SIG_BLOCK, asked))

    named = plain.common.get("socket") or os.environ.get("TALK_SOCKET") or None
    try:
        opened = open_early(named, *said, hold) if said else None
        if opened and opened.sent and plain.given.get("wait") and not plain.given.get("feedback"):
            opened = stand_back(opened, plain.given["timeout"])
    except KeyboardInterrupt:
        return 128 + int(_signal.SIGINT)  # nothing was sent
    from talkcli.cli.ends import ended
    from talkcli.cli.show import Common

    options = Common(**plain.common)
    return ended(lambda: _command(plain, arguments, options, began, opened, held), options)


def _command(
    plain: Plain, arguments: list[str], options: Common, began: float, opened: Opened | None, held: set[int]
) -> int:
    given = plain.given
    if plain.command == "say":
        from talkcli.cli.interrupts import give_up_unread
        from talkcli.cli.saying import GOAL_OPTIONS, say
        from talkcli.goals.admission import bad_option
        from talkcli.goals.requests import Say

        if bad_option(Say("", **{name: given[name] for name in GOAL_OPTIONS})):
            from talkcli.cli import commands
            from talkcli.cli.show import Common

            return commands.run(arguments, Common())  # which knows how to say it
        end = None if given["timeout"] is None else began + given["timeout"]
        give_up_unread()
        return say(options, " ".join(given["text"]), given, end, opened, held)
    if plain.command == "wait":
        from talkcli.cli.waiting import wait

        return wait(options, given["ids"], given["timeout"], feedback=given["feedback"])
    from talkcli.cli.asking import COMMANDS

    return COMMANDS[plain.command](options, **given, opened=opened)
