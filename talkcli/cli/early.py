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
from talkcli.goals.options import MAX_CHARACTERS, MAX_KEY, Cancel, Say

if TYPE_CHECKING:
    from typing import Any

    from talkcli.cli.plain import Plain
    from talkcli.goals.option import Option

#: The requests that are sent early, by their commands: the rows of their fields.
_FIELDS: dict[str, tuple[Option, ...]] = {
    "say": Say.options,
    "cancel": Cancel.options,
    "status": (),
    "pause": (),
    "resume": (),
}
#: What a server may refuse for more than its form: only the library knows the whole id, reads a file, or counts lines.
_LATE = ("id", "ids", "before", "goal_id", "lines")


def lines(plain: Plain) -> tuple[bytes, bytes] | None:
    """Return the lines of `hello` and of the request; None where something about them is not plain."""
    command, given = plain.command.name, dict(plain.given)
    if command not in _FIELDS or any(given.pop(each, None) for each in _LATE):
        return None
    if command == "say":
        given["wait"] = given["wait"] or given["feedback"]
        given["text"] = "" if given["text"] == ("-",) else " ".join(given["text"])
        if not given["text"]:
            return None
    name = given.get("name") or os.environ.get("TALK_NAME") or None
    urgent = {"urgent": True} if command in ("cancel", "status") else {}
    hello = _line({"request": "hello", "name": name, **urgent})
    fields = {each.name: given.get(each.name, each.default) for each in _FIELDS[command]}
    asked = {each.name: fields[each.name] for each in _FIELDS[command] if fields[each.name] != each.default}
    request = _line({"seq": 1, "request": command, **asked})
    return (hello, request) if hello and request else None


def _line(fields: dict[str, Any]) -> bytes | None:
    """Return an object as a line of JSON; None where a text in it is long, or has what JSON escapes."""
    shown = []
    for name, each in fields.items():
        if isinstance(each, str):
            fits = 0 < len(each) <= (MAX_CHARACTERS if name == "text" else MAX_KEY)
            if not (fits and each.isprintable()) or '"' in each or "\\" in each:
                return None
            shown.append(f'"{name}": "{each}"')
        elif each is not None:
            shown.append(f'"{name}": {str(each).lower() if isinstance(each, bool) else repr(each)}')
    return f"{{{', '.join(shown)}}}\n".encode()


def carry_out(plain: Plain) -> int:
    """Carry out a plain command line, and return its exit code."""
    began = time.monotonic()
    said = lines(plain)
    held: set[int] = set()

    def hold() -> None:
        # A goal that is on its way is this command's to cancel: a signal waits until there is somebody to do so.
        asked = {_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP} if plain.command.name == "say" else set()
        held.update(asked - _signal.pthread_sigmask(_signal.SIG_BLOCK, asked))

    named = plain.common.get("socket") or os.environ.get("TALK_SOCKET") or None
    try:
        opened = open_early(named, *said, hold) if said else None
        if opened and opened.sent and plain.given.get("wait") and not plain.given.get("feedback"):
            opened = stand_back(opened, plain.given["timeout"])
    except KeyboardInterrupt:
        return 128 + int(_signal.SIGINT)  # nothing was sent
    from talkcli.cli.show import Common, ended

    options = Common(began=began, opened=opened, held=held, typed=plain.typed, **plain.common)
    return ended(lambda: plain.command.carry_out(options, plain.given), options)
