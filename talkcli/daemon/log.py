"""The log of a long-running process: lines on standard error, for people and for journald.

Writing a line never blocks and never fails. Text from other programs must go through `sanitize`, so that it can't forge
a line or send control characters to a terminal.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
import traceback
from typing import TYPE_CHECKING

from talkcli.polling import wait_ready
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

#: Length limit for a line. Writing this many bytes never blocks if poll reports a pipe as writable (PIPE_BUF on Linux).
_MAX_LOG_LINE_BYTES = 4096
#: Length limit for text from other programs.
_MAX_LOGGED_TEXT_CHARS = 200
#: Time between two lines of the same kind that are written by `write_limited`.
_REPEAT_AFTER_S = 60.0


class RateLimit:
    """A limit for events that can happen many times a second: at most `max_events` in each period."""

    def __init__(self, max_events: int, period_s: float) -> None:
        self._max_events = max_events
        self._period_s = period_s
        self._period_end = float("-inf")
        #: events in this period, allowed or not
        self._event_count = 0

    def allow(self, now: float) -> int | None:
        """Count an event at this time. Return None to suppress it.

        If the event is allowed, return how many events were suppressed since the last event that was allowed.
        """
        if now >= self._period_end:
            suppressed = max(0, self._event_count - self._max_events)
            self._period_end, self._event_count = now + self._period_s, 1
            return suppressed
        self._event_count += 1
        return 0 if self._event_count <= self._max_events else None


#: How many lines could not be written since the last line that was.
_lost_lines = 0
#: The limits of `write_limited`, by the kind of line.
_rate_limits: dict[str, RateLimit] = {}


def write(message: str) -> None:
    """Write one line, or drop it if standard error is closed or nobody reads it."""
    global _lost_lines  # noqa: PLW0603
    if _lost_lines:
        message = f"{message} ({_lost_lines} lines before this one could not be written)"
    data = f"talk: {message}\n".encode(errors="backslashreplace")
    if len(data) > _MAX_LOG_LINE_BYTES:
        data = data[: _MAX_LOG_LINE_BYTES - 1] + b"\n"
    with contextlib.suppress(OSError, ValueError):  # ValueError: standard error has been closed
        fd = sys.stderr.fileno() if sys.stderr else 2
        if wait_ready({fd: select.POLLOUT}, 0):
            os.write(fd, data)
            _lost_lines = 0
            return
    _lost_lines += 1


def write_limited(kind: str, message: str) -> None:
    """Write at most one line of each kind per minute. The next line of this kind gives the number of those left out."""
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
