"""The log of a long-running process, written to standard error.

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

#: Maximum length of a line, which is PIPE_BUF on Linux. If poll() reports a pipe as writable, writing this many bytes
#: never blocks.
_MAX_LOG_LINE_BYTES = 4096
#: Maximum length of text from other programs.
_MAX_LOGGED_TEXT_CHARS = 200
#: Minimum time between two lines of the same kind in `write_limited`.
_REPEAT_AFTER_S = 60.0


class RateLimit:
    """A limit on the number of events in a period."""

    def __init__(self, max_events: int, period_s: float) -> None:
        self._max_events = max_events
        self._period_s = period_s
        self._period_end = float("-inf")
        #: number of events in this period, including suppressed events
        self._event_count = 0

    def count_event(self, now: float) -> int | None:
        """Count an event. Return how many earlier events were suppressed, or None to suppress this one too.

        Only the events that have been suppressed since the last allowed event are counted.
        """
        if now >= self._period_end:
            suppressed = max(0, self._event_count - self._max_events)
            self._period_end, self._event_count = now + self._period_s, 1
            return suppressed
        self._event_count += 1
        return 0 if self._event_count <= self._max_events else None


#: Number of lines lost since the last successful write.
_lost_lines = 0
#: The rate limits of `write_limited`, by kind of line.
_rate_limits: dict[str, RateLimit] = {}


def write(message: str) -> None:
    """Write a line to the log without blocking. Count lines that can't be written.

    The next line that is written gives the number of lost lines.
    """
    global _lost_lines  # noqa: PLW0603
    if _lost_lines:
        message = f"{message} ({_lost_lines} lines before this one could not be written)"
    data = f"talk: {message}\n".encode(errors="backslashreplace")
    if len(data) > _MAX_LOG_LINE_BYTES:
        data = data[: _MAX_LOG_LINE_BYTES - 1] + b"\n"
    with contextlib.suppress(OSError, ValueError):  # ValueError means that standard error is closed
        fd = sys.stderr.fileno() if sys.stderr else 2
        if wait_ready({fd: select.POLLOUT}, 0):
            os.write(fd, data)
            _lost_lines = 0
            return
    _lost_lines += 1


def write_limited(kind: str, message: str) -> None:
    """Write a line to the log, at most once a minute for each kind of line.

    The next line of the same kind gives the number of suppressed lines.
    """
    suppressed = _rate_limits.setdefault(kind, RateLimit(1, _REPEAT_AFTER_S)).count_event(time.monotonic())
    if suppressed is not None:
        write(f"{message} ({suppressed} similar lines were not logged)" if suppressed else message)


def write_bug(context: str, error: Exception) -> None:
    """Log an unexpected exception as a bug, with the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {os.path.basename(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
    write(f"a bug in talk ({context}{place}): {sanitize(f'{type(error).__name__}: {error}')}")


def handle_loop_error(_loop: object, context: Mapping[str, Any]) -> None:
    """Log an error that the event loop caught."""
    error, message = context.get("exception"), str(context.get("message"))
    if isinstance(error, Exception):
        write_bug(message, error)
    else:
        write(sanitize(message))


def sanitize(text: str) -> str:
    """Escape and shorten untrusted text for the log."""
    return printable(text, _MAX_LOGGED_TEXT_CHARS)
