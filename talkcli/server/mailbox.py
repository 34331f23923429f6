"""What the engine thread says, on its way into the event loop's thread: in its order, and a few at a time.

It looks at none of them. A sentence of many words must not keep clients waiting who ask for something meanwhile: words
that come faster than they can be told stay here, and the clients have their turn in between.
"""

from __future__ import annotations

import contextlib
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from talkcli.engine.supervisor import Report

#: Reports that are taken before the loop looks at the clients again: to tell fifty watchers of so many words takes it
#: some milliseconds, on a busy machine a hundredth of a second or two.
AT_ONCE = 8


class Mailbox:
    """The reports of one engine thread that have not been taken yet."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        take: Callable[[Report], None],
        failed: Callable[[str, Exception], None],
    ) -> None:
        """`take` is called with each, in the loop's thread; `failed`, where that raised."""
        self._loop = loop
        self._take = take
        self._failed = failed
        self._waiting: deque[Report] = deque()
        #: whether the loop has been told that something waits: to wake it for each costs as much as to take one
        self._due = False

    def post(self, report: Report) -> None:
        """Hand a report over; from any thread."""
        self._waiting.append(report)
        if not self._due:
            self._due = True
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left who would want to know
                self._loop.call_soon_threadsafe(self._take_some)

    def _take_some(self) -> None:
        # Before it looks: what is added after the last look finds it so, and tells the loop again.
        self._due = False
        for _ in range(AT_ONCE):
            if not self._waiting:
                return
            try:
                self._take(self._waiting.popleft())
            except Exception as error:  # noqa: BLE001 - what comes after it must not be lost
                self._failed("a report of the engine", error)
        self._due = True
        self._loop.call_soon(self._take_some)
