"""The command `talk log`, which shows the goals that have ended.

If no server is running, the command reads the history of the last one.
"""

from __future__ import annotations

import os
import time

from talkcli.cli.show import note, screen, show_result
from talkcli.errors import AccessDenied, RequestRefused, ServerUnavailable, TalkError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.options import MAX_LOG_GOALS, Log
from talkcli.goals.states import State
from talkcli.paths import closed_directory, history_files, named_robot, named_socket

if TYPE_CHECKING:
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import Client

#: The error code of a server that can't read its history. A test compares it with the server's constant.
HISTORY_FAILED = "history_failed"
#: Time limit for searching the history file if no server is running.
_SEARCH_LIMIT_S = 60.0


def log(options: CommonOptions, count: int | None, long: bool, **filters: Any) -> None:
    """Show the most recently ended goals that pass the filters."""
    from talkcli.terminal.transcript import log_lines

    given = {name: value for name, value in filters.items() if value is not None}
    if count is None:
        count = MAX_LOG_GOALS if given else Log().count
    try:
        client = options.connect()
    except ServerUnavailable as error:
        if named_robot(options.robot, options.socket):
            raise
        goals, boot = _read_history(options, Log(count, **given), error), ""
    else:
        with client:
            goals, boot = _request_goals(client, count, given), client._connection.boot
    output = screen(long=long, boot=boot)
    show_result(options, (each.to_json() for each in goals), lambda: log_lines(goals, output, time.time()))


def _request_goals(client: Client, count: int, filters: dict[str, Any]) -> list[Goal]:
    """Return the server's goals. If the server can't read its history, return only the goals in its memory."""
    if "state" in filters:
        filters = {**filters, "state": State[filters["state"]]}
    try:
        return client.log(count, **filters)
    except RequestRefused as error:
        if filters or error.code != HISTORY_FAILED:
            raise
        note(f"{error.message}; only goals since the server's start are shown")
        return client.log(count, history=False)


def _read_history(options: CommonOptions, request: Log, error: ServerUnavailable) -> list[Goal]:
    """Return goals from the history of a server that isn't running. Print a note about this.

    Args:
        options: the common options, which may name the server's socket.
        request: the number of goals, and the filters.
        error: why no server could be reached.

    Raises:
        ServerUnavailable: there is no history, or it can't be read.
    """
    found = [each for each in history_files(named_socket(options.socket)) if _find_owner(each) is not None]
    if not found:
        raise error
    path = max(found, key=lambda each: os.access(each, os.R_OK))
    try:
        if not os.access(path, os.R_OK):
            raise AccessDenied(f"the file belongs to uid {_find_owner(path)}")
        from talkcli.history.file import search
        from talkcli.history.rows import given_filters, row_to_json, sql_condition

        rows = search(path, *sql_condition(given_filters(request)), request.count, time.monotonic() + _SEARCH_LIMIT_S)
    except (ImportError, TalkError) as failure:  # ImportError means that this Python has no sqlite3
        raise ServerUnavailable(f"{error.message}\nthe history {path} can't be read: {failure}") from failure
    if not options.quiet:
        note(f"no server is running, so these goals come from the history {path}")
    return [Goal.from_json(row_to_json(row)) for row in rows]


def _find_owner(path: str) -> int | None:
    """Return the user id of a file's owner, or None if there is no file.

    If a directory hides the file, return the directory's owner.
    """
    try:
        return os.stat(path).st_uid
    except PermissionError:
        return os.lstat(closed_directory(path) or "/").st_uid
    except OSError:
        return None
