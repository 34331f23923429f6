"""The log of a long-running process: lines on standard error, for people and for journald.

Writing a line never blocks and never fails. Text from other programs must go through `sanitize`, so that it can't forge
a line or send control characters to a terminal.
"""

from __future__ import annotations

import os
import select
import sys
import time
import traceback
from typing import TYPE_CHECKING

from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

#: The longest line. If poll reports a pipe as writable, this many bytes never block (PIPE_BUF on Linux).
_MAX_LOG_LINE_BYTES = 4096
_MAX_LOGGED_TEXT_CHARS = 200
#: Time between two lines of the same kind, for events that can happen many times a second.
_REPEAT_AFTER_S = 60.0


class RateLimit:
    """A limit for events that can happen many times a second. The time is an argument."""

    def __init__(self, max_events: int, period_s: float) -> None:
        self._max_events = max_events
        self._period_s = period_s
        self._period_start = float("-inf")
        self._allowed = 0
        self._suppressed = 0

    def allow(self, now: float) -> int | None:
        """Count an event. Return None to suppress it, or else the number of events suppressed before it."""
        if now >= self._period_start + self._period_s:
            suppressed, self._suppressed = self._suppressed, 0
            self._period_start, self._allowed = now, 1
            return suppressed
        if self._allowed < self._max_events:
            self._allowed += 1
            return 0
        self._suppressed += 1
        return None


_lost_lines = 0
_rate_limits: dict[str, RateLimit] = {}


def write(message: str) -> None:
    """Write one line, or drop it if standard error is closed or nobody reads it."""
    global _lost_lines  # noqa: PLW0603
    if _lost_lines:
        message = f"{message} ({_lost_lines} lines before this one could not be written)"
    data = f"talk: {message}\n".encode(errors="backslashreplace")
    if len(data) > _MAX_LOG_LINE_BYTES:
        data = data[: _MAX_LOG_LINE_BYTES - 1] + b"\n"
    try:
        fd = sys.stderr.fileno() if sys.stderr else 2
        poll = select.poll()
        poll.register(fd, select.POLLOUT)
        if not poll.poll(0):
            _lost_lines += 1
            return
        os.write(fd, data)
        _lost_lines = 0
    except (OSError, ValueError):
        _lost_lines += 1


def write_limited(kind: str, message: str) -> None:
    """Write at most one line of each kind per minute. The next line gives the number of lines left out."""
    suppressed = _rate_limits.setdefault(kind, RateLimit(1, _REPEAT_AFTER_S)).allow(time.monotonic())
    if suppressed is not None:
        write(f"{message} ({suppressed} more of these were not logged)" if suppressed else message)


def write_bug(what: str, error: Exception) -> None:
    """Write a line about an unexpected exception, with the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {os.path.basename(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
    write(f"a bug in {what}{place}: {sanitize(f'{type(error).__name__}: {error}')}")


def handle_loop_error(_loop: object, context: Mapping[str, Any]) -> None:
    """Log an error that the event loop caught. This is the loop's exception handler."""
    error, message = context.get("exception"), str(context.get("message"))
    if isinstance(error, Exception):
        write_bug(message, error)
    else:
        write(sanitize(message))


def sanitize(text: str) -> str:
    """Return text from elsewhere in a form that is safe for the log: escaped, shortened and on one line."""
    return printable(text, _MAX_LOGGED_TEXT_CHARS)
