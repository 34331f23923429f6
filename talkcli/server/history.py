"""The server's history, which stores ended goals and lets clients search them.

The methods run in the event loop's thread and never wait for the disk. One thread writes the goals, and another one
searches, so that a slow search doesn't delay writing. Goals that have not been written yet are kept in memory, for
example while the disk is full. Searches find these goals, too.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from functools import partial
from itertools import islice
from queue import SimpleQueue
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.errors import RequestRefused, TalkError, memory_hint
from talkcli.history.file import HistoryError, HistoryWriter, search
from talkcli.history.rows import filter_values, matches, sql_condition, to_row, without_text
from talkcli.server.connection import resume_all

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.history.file import FileIdentity
    from talkcli.history.rows import Row
    from talkcli.server.connection import PendingRequest, WaitingList

#: How long an ended goal waits to be written together with others. If the server is killed, at most 2 s may be lost.
WRITE_AFTER_S = 1.0
#: How long to wait after a failed attempt to write.
RETRY_AFTER_S = 10.0
#: Maximum number of goals to write at once, which have at most 7 MB. If this many goals are waiting, they are written
#: soon.
BATCH_GOALS = 32
#: Maximum number of goals that wait to be written. The scheduler keeps the texts of the same number of goals.
MAX_UNWRITTEN_GOALS = 2_200
#: How long a search may take. Clients give up after five seconds.
SEARCH_LIMIT_S = 4.0
#: How long a server that is shutting down waits for its last goals to be written.
_CLOSE_LIMIT_S = 1.0


class _Worker:
    """A thread that runs functions one after the other.

    If the disk doesn't respond, the thread doesn't prevent the process from exiting.
    """

    def __init__(self, name: str) -> None:
        #: the functions to run, which must not raise. None ends the thread.
        self.functions: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.thread = threading.Thread(target=self._run, name=name, daemon=True)
        try:
            self.thread.start()
        except RuntimeError as error:  # there is no more specific exception
            raise TalkError(f"can't start the history's threads: {memory_hint()}") from error

    def _run(self) -> None:
        """Run the queued functions. End the thread when None is in the queue."""
        while function := self.functions.get():
            function()


class History:
    """Stores ended goals in a file, and searches them."""

    def __init__(self, path: str, *, with_text: bool) -> None:
        """Start the threads. Create the file if necessary.

        Args:
            path: absolute path of the file.
            with_text: whether to store the texts of goals.
        """
        self.with_text = with_text
        self._path = path
        self._loop = asyncio.get_running_loop()
        self._writer = HistoryWriter(path)
        self._write_thread, self._search_thread = _Worker("history-write"), _Worker("history-search")
        #: goals that may not have been written yet, oldest first
        self._unwritten: deque[Goal] = deque()
        #: how many of the oldest unwritten goals are being written, or None if the thread is idle
        self._writing: int | None = None
        self._timer: asyncio.TimerHandle | None = None
        #: a file that a search has found to be damaged, or None
        self._damaged_file: FileIdentity | None = None
        #: why goals can't be written now, or None
        self._error: str | None = None
        #: message about the last file that was removed or damaged, or None
        self._replaced: str | None = None
        #: number of goals that were not written, because too many waited
        self._dropped = 0
        self._write()  # find errors before the first goal ends

    def add(self, goal: Goal) -> None:
        """Queue an ended goal for writing. If too many goals wait, drop the oldest."""
        self._unwritten.append(goal if self.with_text else without_text(goal))
        if len(self._unwritten) > MAX_UNWRITTEN_GOALS:
            self._unwritten.popleft()
            self._writing = self._writing and self._writing - 1
            self._dropped += 1
        self._schedule_write()

    async def search(self, request: PendingRequest, filters: Mapping[str, object], count: int) -> list[Row]:
        """Search the history while the request waits. Return the newest matching rows, oldest first.

        Raises:
            RequestRefused: the file can't be read, or the disk doesn't respond in time.
        """
        unwritten = [goal for goal in self._unwritten if matches(filters, filter_values(goal))][-count:]
        waiting: WaitingList = {}
        answer: list[list[Row] | Exception] = []
        end = time.monotonic() + SEARCH_LIMIT_S

        def search_file() -> None:  # in the searching thread
            try:
                answer.append(search(self._path, *sql_condition(filters), count, end))
            except Exception as error:  # noqa: BLE001 - the client gets the error
                answer.append(error)
            self._call_in_loop(partial(resume_all, waiting))

        self._search_thread.functions.put(search_file)
        await request.wait(waiting, SEARCH_LIMIT_S)
        rows = answer[0] if answer else TimeoutError(f"its disk did not respond within {SEARCH_LIMIT_S:g} s")
        if isinstance(rows, Exception):
            self._damaged_file = getattr(rows, "damaged_file", None) or self._damaged_file
            self._schedule_write()
            raise RequestRefused(
                f"can't read the history {self._path}: {rows}; next, run: talk doctor", HistoryError.code
            )
        # Some goals may have been written in the meantime.
        written = {row[:2] for row in rows}
        return [*rows, *(to_row(goal) for goal in unwritten if (goal.id, goal.ended_at) not in written)][-count:]

    def describe(self) -> JsonObject:
        """Return the state of the history for the reply to `status`."""
        state = {"path": self._path, "with_text": self.with_text, "error": self._error, "replaced": self._replaced}
        return {**state, "unwritten": len(self._unwritten), "dropped": self._dropped}

    def close(self) -> None:
        """Write the last goals. If the disk doesn't respond in time, give up."""
        rest = list(islice(self._unwritten, self._writing or 0, None))
        for each in (partial(self._write_goals, rest, None), self._writer.close, None):
            self._write_thread.functions.put(each)
        self._search_thread.functions.put(None)
        self._write_thread.thread.join(_CLOSE_LIMIT_S)
        if self._write_thread.thread.is_alive():
            log.write(log.sanitize(f"the disk did not respond, so the last goals may be missing in {self._path}"))

    def _schedule_write(self) -> None:
        """Schedule a write if there is anything to write. If many goals wait, start at once."""
        if len(self._unwritten) >= BATCH_GOALS and not self._error:
            self._write()
        elif self._timer is None and (self._unwritten or self._damaged_file):
            self._timer = self._loop.call_later(RETRY_AFTER_S if self._error else WRITE_AFTER_S, self._write)

    def _write(self) -> None:
        """Let the thread write the oldest goals, unless it is still writing others."""
        if self._timer:
            self._timer.cancel()
            self._timer = None
        if self._writing is None:
            goals, damaged_file = list(islice(self._unwritten, BATCH_GOALS)), self._damaged_file
            self._writing, self._damaged_file = len(goals), None
            self._write_thread.functions.put(partial(self._write_goals, goals, damaged_file))

    def _write_goals(self, goals: list[Goal], damaged_file: FileIdentity | None) -> None:
        """Write goals in the writing thread, and pass the outcome to `_handle_written`."""
        try:
            replaced, error = self._writer.write(goals, damaged_file), None
        except Exception as failure:  # noqa: BLE001 - it is logged by the event loop
            replaced, error = None, str(failure)
        self._call_in_loop(partial(self._handle_written, replaced, error))

    def _handle_written(self, replaced: str | None, error: str | None) -> None:
        """Remove the written goals, or keep them after an error. Log a new error, and schedule the next write."""
        for _ in range(0 if error else self._writing or 0):
            self._unwritten.popleft()
        self._writing, former, self._error = None, self._error, error
        if replaced:
            self._replaced = replaced
            log.write(log.sanitize(replaced))
        if error and error != former:
            log.write(log.sanitize(f"can't write to the history {self._path}: {error}; talk keeps trying"))
        elif former and not error:
            log.write(log.sanitize(f"the history {self._path} is written again; {self._dropped:,} goals were dropped"))
        self._schedule_write()

    def _call_in_loop(self, callback: Callable[[], None]) -> None:
        """Let the event loop call a function, unless the loop is closed."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(callback)
