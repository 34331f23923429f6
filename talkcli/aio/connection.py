"""Connections that are run by the event loop instead of blocking a thread.

All classes and functions of this module must be used in the thread of a running event loop.
"""

from __future__ import annotations

import asyncio
import time
from select import POLLIN, POLLOUT
from typing import TYPE_CHECKING

from talkcli import polling
from talkcli.client.connection import Connection, ReconnectingConnection
from talkcli.polling import NEVER

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

    from typing_extensions import Self

    from talkcli.client.core import Exchange, OnFailure, OnReply
    from talkcli.protocol.requests import Request


class Watch:
    """Calls a function once, as soon as a descriptor is ready or the time is up."""

    def __init__(self, watched: Mapping[int, int], timeout: float, callback: Callable[[], object]) -> None:
        """Start watching descriptors.

        Args:
            watched: the poll events to wait for, by descriptor. The descriptors must stay open until the end of the
                watch.
            timeout: the longest time to wait in seconds, or NEVER.
            callback: the function to call.
        """
        self._loop = asyncio.get_running_loop()
        self._descriptors, self._callback = tuple(watched), callback
        for descriptor, events in watched.items():
            if events & POLLIN:
                self._loop.add_reader(descriptor, self._on_ready)
            if events & POLLOUT:
                self._loop.add_writer(descriptor, self._on_ready)
        self._timer = None if timeout == NEVER else self._loop.call_later(timeout, self._on_ready)

    def cancel(self) -> None:
        """Stop watching, without calling the function. Do nothing if the watch has ended."""
        for descriptor in self._descriptors:
            self._loop.remove_reader(descriptor)
            self._loop.remove_writer(descriptor)
        self._descriptors = ()
        if self._timer:
            self._timer.cancel()

    def _on_ready(self) -> None:
        """Stop watching, and call the callback. A descriptor is ready, or the time is up."""
        self.cancel()
        self._callback()


async def wait_ready(
    watched: Mapping[int, int], timeout: float | None, _interrupt: Mapping[int, int] | None = None
) -> set[int]:
    """Suspend until a descriptor is ready or the time is up. Return the descriptors that are ready.

    The arguments are those of `polling.wait_ready`. Nothing interrupts the wait, because tasks are cancelled instead.
    """
    ended = asyncio.Event()
    watch = Watch(watched, NEVER if timeout is None else max(0.0, timeout), ended.set)
    try:
        await ended.wait()
    finally:
        watch.cancel()
    return polling.wait_ready(watched, 0.0)


class LoopConnection(Connection):
    """The base class of connections that are run by the event loop.

    It is combined with a transport. The loop reads all messages as they arrive, whether or not a coroutine waits.
    Nothing blocks.
    """

    wait = staticmethod(wait_ready)
    #: the events that the loop waits for, or None while the connection isn't open
    _watch: Watch | None = None
    #: the earliest time limit of the connection and all waiting coroutines (monotonic time)
    _limit = NEVER
    #: the condition, the deadline and the start time of each coroutine that waits in `until`, by its future
    _waits: dict[asyncio.Future[bool], tuple[Callable[[], bool], float, float]]

    @classmethod
    async def open(cls, *arguments: Any, **options: Any) -> Self:
        """Connect to a server, and let the event loop run the connection. Return the connection.

        The arguments and errors are those of the transport.
        """
        connection = await super().open(*arguments, **options)
        connection._waits = {}
        connection._watch = Watch({}, 0.0, connection._run)
        return connection

    def close(self) -> None:
        """Close the connection, and wake all waiting coroutines. Goals that were sent are still spoken."""
        if self._watch:
            self._watch.cancel()
        super().close()
        self._end_waits(NEVER)

    async def until(self, done: Callable[[], bool], deadline: float | None, *, interruptible: bool = True) -> bool:  # noqa: ARG002
        """Suspend the coroutine until `done()` is true. Return False at the deadline or the connection's end.

        The arguments are those of `wait_until`.
        """
        if (is_done := done()) or self.ended is not None:
            return is_done
        future: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        self._waits[future] = done, NEVER if deadline is None else deadline, time.monotonic()
        self._run_soon()
        try:
            return await future
        finally:
            del self._waits[future]

    def begin(self, request: Request, on_reply: OnReply | None = None, on_failure: OnFailure | None = None) -> Exchange:
        """Send a request without waiting for the answer. Return the exchange."""
        self._run_soon()
        return super().begin(request, on_reply, on_failure)

    def wait_until(self, done: Callable[[], bool], deadline: float | None, **options: Any) -> bool:
        """Process the messages that have arrived, without waiting. Return whether `done()` is true.

        The deadline must not be in the future.
        """
        self._run_soon()
        return super().wait_until(done, deadline, **options)

    def _stop_waiting(self, exchange: Exchange) -> None:
        """Withdraw a request if no part of it was sent. Otherwise, ignore its answer.

        A cancelled task must not break off the connection, which other tasks use, too.
        """
        if exchange.over or (not exchange.sent and self.forget(exchange)):
            return
        exchange.on_reply, exchange.on_failure = None, lambda _: None
        self.exchanges[exchange.number] = exchange

    def _run_soon(self) -> None:
        """Run the connection in the next round of the loop. Stop watching descriptors until then.

        Call this before a method that may open or close descriptors.
        """
        if self._watch:
            self._watch.cancel()
            self._watch = Watch({}, 0.0, self._run)

    def _run(self) -> None:
        """Process the messages that have arrived, enforce time limits, and watch the descriptors again."""
        self._watch = None  # it has ended
        try:
            late = time.monotonic() >= self._limit  # messages that have already arrived are processed first
            self._step(0.0, interruptible=False)
            now, since = time.monotonic(), min((since for _, _, since in self._waits.values()), default=NEVER)
            if late and not self.expire(now):
                self._cut_off()
            silent_at, why = self.silence_deadline(since)
            if late and now >= silent_at:
                self.break_off(why, now)
            watched, due = self.prepare(now)
            self._end_waits(now if late else -NEVER)
        except Exception as error:
            self.end(f"a bug in the connection: {type(error).__name__}: {error}")
            self._end_waits(NEVER)
            raise  # the event loop reports it
        if self.ended is None:
            deadlines = [deadline for future, (_, deadline, _) in self._waits.items() if not future.done()]
            self._limit = min(self.next_expiry(), self.silence_deadline(since)[0], *deadlines)
            self._watch = Watch(watched, max(0.0, min(due, self._limit) - now), self._run)

    def _end_waits(self, now: float) -> None:
        """Wake the coroutines that are done or late, or all of them if the connection has ended."""
        for future, (done, deadline, _) in self._waits.items():
            if not future.done() and ((is_done := done()) or self.ended is not None or deadline <= now):
                future.set_result(is_done)


class LoopSocketConnection(LoopConnection, ReconnectingConnection):
    """A connection over a Unix socket that reconnects after a break, and is run by the event loop."""
