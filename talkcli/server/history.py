"""The server's history: stores the goals that have ended, and searches them for clients.

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
from queue import SimpleQueue
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.errors import RequestRefused, TalkError, memory_hint
from talkcli.history.file import HistoryError, HistoryWriter, search
from talkcli.history.rows import columns_of, matches, sql_condition, to_row, without_text
from talkcli.server.connection import resume_all

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.history.file import FileIdentity
    from talkcli.history.rows import Row
    from talkcli.server.connection import PendingRequest, WaitingList

#: How long an ended goal waits to be written together with others. If the server is killed, at most 2 s may be lost.
WRITE_AFTER_S = 1.0
#: How long to wait after a failed attempt to write.
RETRY_AFTER_S = 10.0
#: Number of goals that are written without waiting for others, and the maximum number to write at once.
BATCH_GOALS = 500
#: Maximum number of characters to write at once, except for a single text.
MAX_BATCH_CHARS = 256 * 1024
#: Maximum number of goals, and of characters in their texts, that wait to be written.
MAX_UNWRITTEN_GOALS, MAX_UNWRITTEN_CHARS = 10_000, 8 * 1024 * 1024
#: How long a search may take. Clients give up after five seconds.
SEARCH_LIMIT_S = 4.0
#: How long a server that shuts down waits until its last goals are written.
_CLOSE_LIMIT_S = 1.0


class _Worker:
    """A thread that runs functions one after the other.

    If the disk doesn't respond, the thread doesn't prevent the process from exiting.
    """

    def __init__(self, name: str) -> None:
        self._functions: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        try:
            self._thread.start()
        except RuntimeError as error:  # there is no more specific exception
            raise TalkError(f"can't start the history's threads: {memory_hint()}") from error

    def run_later(self, function: Callable[[], None]) -> None:
        """Let the thread run a function, which must not raise."""
        self._functions.put(function)

    def close(self, limit_s: float) -> bool:
        """Wait until the thread has run all functions. Return False at the time limit."""
        self._functions.put(None)
        self._thread.join(limit_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        """Run functions until `close` is called."""
        while function := self._functions.get():
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
        #: goals that wait to be written, oldest first, and the length of their texts
        self._unwritten: deque[Goal] = deque()
        self._unwritten_chars = 0
        #: the goals that are being written
        self._batch: list[Goal] = []
        self._is_writing = False
        self._timer: asyncio.TimerHandle | None = None
        #: a file that a search has found to be damaged, or None
        self._damaged_file: FileIdentity | None = None
        #: why goals can't be written now, or None
        self._error: str | None = None
        #: message about the last file that was removed or damaged, or None
        self._replaced: str | None = None
        self._dropped = 0
        self._write()  # find errors before the first goal ends

    def add(self, goal: Goal) -> None:
        """Add an ended goal, to be written soon. If too many goals wait, drop the oldest."""
        goal = goal if self.with_text else without_text(goal)
        self._unwritten.append(goal)
        self._unwritten_chars += len(goal.text or "")
        self._limit_unwritten()
        self._schedule_write()

    async def search(self, pending: PendingRequest, filters: Mapping[str, object], count: int) -> list[Row]:
        """Return the rows of the newest goals that pass all filters, oldest first. Wait for the disk.

        Raises:
            RequestRefused: the file can't be read, or the disk doesn't respond in time.
        """
        unwritten = [goal for goal in (*self._batch, *self._unwritten) if matches(filters, columns_of(goal))]
        waiting: WaitingList = {}
        answer: list[list[Row] | Exception] = []
        end = time.monotonic() + SEARCH_LIMIT_S
        self._search_thread.run_later(partial(self._search_file, filters, count, end, answer, waiting))
        if not await pending.wait(waiting, SEARCH_LIMIT_S):
            raise self._refusal(f"did not respond within {SEARCH_LIMIT_S:g} s")
        rows = answer[0]
        if isinstance(rows, Exception):
            if isinstance(rows, HistoryError):
                self._damaged_file = rows.damaged_file or self._damaged_file
                self._schedule_write()
            else:
                log.write_bug("the history", rows)
            raise self._refusal(f"can't be read: {rows}")
        # Some goals may have been written in the meantime.
        written = {row[:2] for row in rows}
        rest = [to_row(goal) for goal in unwritten[-count:] if (goal.id, goal.ended_at) not in written]
        return [*rows, *rest][-count:]

    def describe(self) -> JsonObject:
        """Return the state of the history for the reply to `status`."""
        return {
            "path": self._path,
            "with_text": self.with_text,
            "error": self._error,
            "replaced": self._replaced,
            "unwritten": len(self._batch) + len(self._unwritten),
            "dropped": self._dropped,
        }

    def close(self) -> None:
        """Write the last goals. If the disk doesn't respond in time, give up."""
        rest = list(self._unwritten)

        def finish() -> None:
            try:
                self._writer.write(rest)
            except Exception as error:  # noqa: BLE001 - the server must exit
                log.write(log.sanitize(f"the last goals ({len(rest)}) are missing in the history: {error}"))
            self._writer.close()

        self._write_thread.run_later(finish)
        if not self._write_thread.close(_CLOSE_LIMIT_S):
            log.write(log.sanitize(f"the history {self._path} did not respond; the last goals may be missing"))
        self._search_thread.close(0)

    # -- writing

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
        if self._is_writing:
            return
        chars = 0
        while self._unwritten and len(self._batch) < BATCH_GOALS and chars < MAX_BATCH_CHARS:
            self._batch.append(self._unwritten.popleft())
            chars += len(self._batch[-1].text or "")
        self._unwritten_chars -= chars
        self._is_writing, damaged_file, self._damaged_file = True, self._damaged_file, None
        self._write_thread.run_later(partial(self._write_batch, self._batch, damaged_file))

    def _write_batch(self, goals: Sequence[Goal], damaged_file: FileIdentity | None) -> None:
        """Write goals in the writing thread, and pass the outcome to `_handle_written`."""
        replaced: str | None = None
        error: Exception | None = None
        try:
            replaced = self._writer.write(goals, damaged_file)
        except Exception as failure:  # noqa: BLE001 - it is reported by the event loop
            error = failure
        self._call_in_loop(partial(self._handle_written, replaced, error))

    def _handle_written(self, replaced: str | None, error: Exception | None) -> None:
        """Keep the goals if writing has failed. Log new errors, and schedule the next write."""
        batch, self._batch, self._is_writing = self._batch, [], False
        if isinstance(error, HistoryError):
            self._unwritten.extendleft(reversed(batch))
            self._unwritten_chars += sum(len(goal.text or "") for goal in batch)
            self._limit_unwritten()
        elif error:
            log.write_bug("the history", error)
            self._dropped += len(batch)
        if replaced:
            self._replaced = replaced
            log.write(log.sanitize(replaced))
        former, self._error = self._error, str(error) if error else None
        if self._error and self._error != former:
            words = f"the history {self._path} can't be written: {self._error}; talk tries again"
            log.write(log.sanitize(words))
        elif former and not self._error:
            lost = f"; {self._dropped:,} goals are missing" if self._dropped else ""
            log.write(log.sanitize(f"the history {self._path} is written again{lost}"))
        self._schedule_write()

    def _limit_unwritten(self) -> None:
        """Drop the oldest unwritten goals if there are too many."""
        while len(self._unwritten) > MAX_UNWRITTEN_GOALS or self._unwritten_chars > MAX_UNWRITTEN_CHARS:
            self._unwritten_chars -= len(self._unwritten.popleft().text or "")
            self._dropped += 1

    # -- searching

    def _search_file(
        self,
        filters: Mapping[str, object],
        count: int,
        end: float,
        answer: list[list[Row] | Exception],
        waiting: WaitingList,
    ) -> None:
        """Search the file in the searching thread. Store the rows or the error, and resume the request."""
        if time.monotonic() > end:
            return  # the request was refused long ago
        try:
            answer.append(search(self._path, *sql_condition(filters), count, end))
        except Exception as error:  # noqa: BLE001 - it is reported by the event loop
            answer.append(error)
        self._call_in_loop(partial(resume_all, waiting))

    def _refusal(self, problem: str) -> RequestRefused:
        """Return the error for a request that the history can't answer because of a problem."""
        return RequestRefused(f"the history {self._path} {problem}; see: talk doctor", HistoryError.code)

    def _call_in_loop(self, callback: Callable[[], None]) -> None:
        """Call a function in the event loop's thread, unless the loop is closed."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(callback)
