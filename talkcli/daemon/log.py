"""The log of a process that runs for months: lines on standard error, for people and for journald.

It never blocks and never fails. Nothing that others send can forge a line or reach a terminal raw: all of it goes
through `printable`. What is said of goals and engines is in `talkcli.server.log`.
"""

from __future__ import annotations

import os
import select
import sys
import time
import traceback
from typing import TYPE_CHECKING

from talkcli.daemon.quota import Quota
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

#: Bytes of one line at most: a pipe that poll calls writable takes as many without blocking (PIPE_BUF on Linux).
_MAX_LINE = 4096
#: Characters of a text in the log.
_MAX_TEXT = 200
#: Seconds between two lines of the same kind, of what may happen many times a second.
_SELDOM = 60.0

_lost = 0
_seldom: dict[str, Quota] = {}


def line(words: str) -> None:
    """Write one line; where standard error is closed or its reader is stuck, the line is lost and all else goes on."""
    global _lost  # noqa: PLW0603
    if _lost:
        words = f"{words} ({_lost} lines before this one could not be written)"
    data = f"talk: {words}\n".encode(errors="backslashreplace")
    if len(data) > _MAX_LINE:
        data = data[: _MAX_LINE - 1] + b"\n"
    try:
        fd = sys.stderr.fileno() if sys.stderr else 2
        poll = select.poll()
        poll.register(fd, select.POLLOUT)
        if not poll.poll(0):
            _lost += 1
            return
        os.write(fd, data)
        _lost = 0
    except (OSError, ValueError):
        _lost += 1


def seldom(kind: str, words: str) -> None:
    """Write a line at most once a minute for each kind; the next one says how often it was not written."""
    more = _seldom.setdefault(kind, Quota(1, _SELDOM)).take(time.monotonic())
    if more is not None:
        line(f"{words} ({more} more of these were not logged)" if more else words)


def bug(what: str, error: Exception) -> None:
    """Write a line of a bug, with the place where it is."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {os.path.basename(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
    line(f"a bug in {what}{place}: {shown(f'{type(error).__name__}: {error}')}")


def loop_bug(_loop: object, context: Mapping[str, Any]) -> None:
    """Write a line of a bug that an event loop has met; its exception handler."""
    error, words = context.get("exception"), str(context.get("message"))
    if isinstance(error, Exception):
        bug(words, error)
    else:
        line(shown(words))


def shown(words: str) -> str:
    """Return words that may hold text from elsewhere, fit for one line of the log."""
    return printable(words, _MAX_TEXT)
