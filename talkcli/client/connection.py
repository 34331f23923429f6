"""Blocking, thread-safe connections to a server, built on `ClientCore`.

`Connection` is the interface that the rest of the library uses, and the base class of all blocking transports.
`SocketConnection` uses a Unix socket. `ReconnectingConnection` also uses a Unix socket, and reconnects after a break.
"""

from __future__ import annotations

import os
import select
import threading
import time
from _socket import SHUT_RDWR  # importing `socket` would take longer (see `peers`)

from talkcli import paths, peers
from talkcli.client.connect import ANSWER_LIMIT_S, connect, hello, reach, sender_name, unreachable_error
from talkcli.client.core import MAX_UNSENT_BYTES, ClientCore, Exchange
from talkcli.errors import ProtocolMismatch, ServerUnavailable, TalkError, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import MAX_SENDER_NAME_CHARS, Cancel, Say
from talkcli.polling import NEVER, block_until_ready, wait_ready
from talkcli.protocol.lines import request_line

if TYPE_CHECKING:
    import _socket
    from collections.abc import Callable, Collection, Coroutine, Mapping
    from typing import Any, TypeVar

    from typing_extensions import Self

    from talkcli.client.connect import ConnectionAttempt
    from talkcli.client.core import OnFailure, OnReply
    from talkcli.goals.goal import JsonObject
    from talkcli.polling import WaitReady
    from talkcli.protocol.requests import Request

    _T = TypeVar("_T")

#: Maximum number of bytes to receive at once.
_RECEIVE_BYTES = 256 * 1024
#: The pause between two attempts to reconnect. A thread without a socket also checks at this interval whether
#: another thread has reconnected.
_RECONNECT_PAUSE_S = 0.1


def checked_sender_name(name: str | None) -> str | None:
    """Return the given name, or the value of TALK_NAME by default. Raise UsageError if it is too long."""
    name = sender_name(name)
    if name and len(name) > MAX_SENDER_NAME_CHARS:
        raise UsageError(f"the sender's name is too long: {len(name)} characters (at most {MAX_SENDER_NAME_CHARS})")
    return name


def event_reader(
    connection: Connection, take: Callable[[], _T], deadline: float | None
) -> Callable[[], Coroutine[Any, Any, _T]]:
    """Return a coroutine function that waits until `take` returns received events, and returns them.

    Its result is false if `deadline` has passed or the connection has ended. Nothing more is received after `deadline`,
    so that a loop over the results ends even if the server keeps sending events.

    Args:
        connection: the connection to wait for.
        take: removes and returns received events, or returns a false value if there are none. It is called while
            `connection.changed` is held.
        deadline: monotonic time; None for no limit.
    """
    found: _T
    late = False

    def arrived() -> bool:
        nonlocal found
        found = take()
        return bool(found)

    async def read() -> _T:
        nonlocal late
        if late:
            with connection.changed:
                arrived()
        else:
            await connection.until(arrived, deadline)
            late = deadline is not None and time.monotonic() >= deadline
        return found

    return read


class Connection(ClientCore):
    """Base class for thread-safe connections to a server.

    The server carries out each request at most once, in the order of sending. A request that could have an effect is
    never sent twice. The exception is a `say` with an id, because the server speaks it only once.

    Messages are read only while a thread is in `request`, `submit` or `wait_until`. One of these threads reads for all
    of them. Messages are processed in the server's order while the lock `changed` is held, so that a waiting thread
    sees a consistent state. No lock is held during a wait. Callers of the core's methods must hold this lock.

    When the connection has ended, `ended` is the reason. Waiting threads return then, and later requests raise
    ServerUnavailable. Events that were received before can still be read.
    """

    #: the function that waits for descriptors while the connection is being opened
    wait: WaitReady = staticmethod(block_until_ready)
    #: whether the client reconnects if the connection breaks
    reconnects = False
    #: descriptors that interrupt any wait, with their poll events
    _interrupt: Mapping[int, int] | None = None
    #: id of the process that listens at the socket, or None if the server is on another machine
    listener_pid: int | None = None
    #: the class that `begin` uses for exchanges
    exchange_type = Exchange

    def __init__(self, patience_s: float) -> None:
        """Initialize a connection.

        The server must answer each request within `patience_s` seconds.
        """
        super().__init__(patience_s, time.monotonic())
        #: a condition that protects all state. It is notified after messages have been processed.
        self.changed = threading.Condition()
        self._process = os.getpid()
        self._reading = False
        self._closing = False

    @classmethod
    async def open(cls, *arguments: Any, **options: Any) -> Self:
        """Connect to a server. Return the connection. Each transport has its own arguments."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the connection. Goals that were sent are still spoken.

        Any thread may call this method, and it may be called twice. In a forked child process, it closes only the
        child's copies of the descriptors.
        """
        if os.getpid() != self._process:
            self.ended = self.ended or "the connection was closed"
            self._drop()
            return
        with self.changed:
            self.end("the connection was closed")
            self._closing = True
            self._hang_up()
            # If a thread is reading, let that thread close the descriptor. If it were closed here, its number could be
            # reused while the thread is still polling it.
            if not self._reading:
                self._drop()
            self.changed.notify_all()

    async def open_another(self) -> Connection:
        """Return another open connection to the same server. Raise UsageError if a broker is in between.

        The server ends such a connection, and its pause, if the program dies.
        """
        raise UsageError("paused() doesn't work over a broker; use pause(seconds=...) instead")

    async def request(self, request: Request, on_reply: OnReply | None = None) -> tuple[JsonObject, list[JsonObject]]:
        """Send a request, and wait for the answer. Return the reply and the list items that came with it.

        Args:
            request: the request.
            on_reply: called if the server accepts the request, before any later event is processed. The lock `changed`
                is held during the call.

        Raises:
            RequestRefused: the server refused the request.
            ServerUnavailable: the request was not sent, or a request without lasting effect was not answered in time.
            Lost: the request was sent, but not answered. It may have taken effect.
            Interrupted: as in `wait_until`.
        """
        exchange = self.begin(request, on_reply)
        # A normal `say` can't be interrupted, because the caller needs the goal's id to cancel the goal. A patient
        # `say` can be interrupted, because closing the connection cancels a goal that is waiting for room in the queue.
        interruptible = exchange.unlimited or not isinstance(request, Say)
        try:
            await self.until(lambda: exchange.over, None, interruptible=interruptible)
        finally:
            with self.changed:
                self._stop_waiting(exchange)
        return self.answer(exchange)

    def _stop_waiting(self, exchange: Exchange) -> None:
        """Drop an exchange. If only part of its request was sent, break off the connection."""
        if not self.forget(exchange):
            self._cut_off()

    def new_goal_id(self) -> str:
        """Return a new random id for a goal that this client sends."""
        return f"talk:{os.urandom(8).hex()}"

    def begin(self, request: Request, on_reply: OnReply | None = None, on_failure: OnFailure | None = None) -> Exchange:
        """Send a request without waiting for the answer. Return the exchange.

        The arguments are those of `Exchange`. A caller without `on_failure` must call `forget` if it stops waiting for
        the answer.
        """
        exchange = self.exchange_type(request, on_reply, on_failure)
        with self.changed:
            self.register(exchange, time.monotonic())
            try:
                if self.greeted and (error := self.unsupported(request)):
                    raise error
                self._send(exchange)
            except (ServerUnavailable, ProtocolMismatch) as error:
                self.fail(exchange, error)
        return exchange

    def submit(self, request: Request, on_reply: OnReply, on_failure: OnFailure) -> None:
        """Send a request without blocking. Pass the reply to `on_reply`, or the error to `on_failure`.

        Later calls send the bytes that the server doesn't accept now. One of the two functions is called during this
        call or a later one, while the lock `changed` is held.

        Args:
            request: the request.
            on_reply: called if the server accepts the request.
            on_failure: called if the request is refused, can't be sent, or isn't answered in time.

        Raises:
            ServerUnavailable: the connection has ended.
        """
        self._read_available()
        with self.changed:
            if self.ended is not None:
                raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {self.ended}")
            self.begin(request, on_reply, on_failure)

    async def until(self, done: Callable[[], bool], deadline: float | None, *, interruptible: bool = True) -> bool:
        """Wait until `done()` is true. Return False at the deadline or the connection's end.

        The arguments are those of `wait_until`. A connection that runs in an event loop suspends the coroutine. Other
        connections block.
        """
        return self.wait_until(done, deadline, interruptible=interruptible)

    def wait_until(
        self,
        done: Callable[[], bool],
        deadline: float | None,
        *,
        since: float | None = None,
        interruptible: bool = True,
    ) -> bool:
        """Process messages until `done()` is true. Return False at the deadline or the connection's end.

        If the server is silent for too long, the connection ends.

        Args:
            done: called while the lock `changed` is held, and never again after it has returned True.
            deadline: monotonic time; None for no limit. All messages that have arrived by then are processed.
            since: when the caller started to wait for the server (monotonic). Earlier silence doesn't count. The
                default is now.
            interruptible: whether the connection's interrupting descriptors end the wait.

        Returns:
            False if the deadline has passed or the connection has ended.

        Raises:
            Interrupted: one of the interrupting descriptors is ready.
        """
        began = time.monotonic() if since is None else since
        deadline = float("inf") if deadline is None else deadline
        late = False
        while True:
            with self.changed:
                now = time.monotonic()
                if late and not self.expire(now):
                    self._cut_off()
                if done():
                    return True
                if self.ended is not None:
                    return False
                silent_at, why = self.silence_deadline(began)
                if late and now >= min(deadline, silent_at):
                    if deadline <= silent_at:
                        return False
                    self.break_off(why, now)
                    continue
                # When a time limit is reached, first read once more without waiting, because messages that have
                # already arrived must be processed.
                end = min(deadline, silent_at, self.next_expiry())
                late = now >= end
                wait_s = max(0.0, end - now)
                if self._reading:
                    self.changed.wait(min(wait_s, threading.TIMEOUT_MAX))
                    continue
                self._reading = True
            try:
                self._step(wait_s, interruptible)
            finally:
                with self.changed:
                    self._reading = False
                    if self._closing:
                        self._drop()
                    self.changed.notify_all()

    def _read_available(self) -> None:
        """Process all messages that have already arrived."""
        for _ in range(2):  # the end of the connection can only be read after the last messages
            self.wait_until(lambda: False, time.monotonic(), interruptible=False)

    def _cut_off(self) -> None:
        """Break off the connection after only part of a request was sent.

        The caller must hold the lock `changed`.
        """
        self.break_off(f"the server accepted no data for {self._patience:g} s", time.monotonic())

    def _step(self, timeout: float, interruptible: bool) -> None:
        """Send waiting requests, wait up to `timeout` seconds for messages, and process them.

        Only one thread at a time may call this method.

        Raises:
            Interrupted: the wait is `interruptible`, and one of the interrupting descriptors is ready.
        """
        with self.changed:
            now = time.monotonic()
            watched, due = self.prepare(now)
        if not watched:
            timeout = min(timeout, _RECONNECT_PAUSE_S)
        self.process(wait_ready(watched, max(0.0, min(timeout, due - now)), self._interrupt if interruptible else None))

    # -- methods that each transport implements. Callers of `_send`, `prepare` and `_hang_up` hold the lock `changed`.

    def _send(self, exchange: Exchange) -> None:
        """Send an exchange's request, or queue it for later.

        Raises:
            ServerUnavailable: nothing can be sent.
        """
        raise NotImplementedError

    def prepare(self, now: float) -> tuple[dict[int, int], float]:
        """Send requests and reconnect as far as possible without blocking. Return what to wait for next.

        Returns:
            The poll events by descriptor, and the monotonic time at which to call `process` even if nothing is ready.
        """
        raise NotImplementedError

    def process(self, ready: Collection[int]) -> None:
        """Process the messages that have arrived, without blocking.

        `ready` are those of the descriptors from the last call of `prepare` that are ready.
        """
        raise NotImplementedError

    def _hang_up(self) -> None:
        """Disconnect, and wake the reading thread."""
        raise NotImplementedError

    def _drop(self) -> None:
        """Close the connection's descriptors in this process.

        A parent process keeps its own copies.
        """
        raise NotImplementedError


class SocketConnection(Connection):
    """A connection over a Unix socket."""

    def __init__(
        self, attempt: ConnectionAttempt, patience_s: float, reopen: tuple[str | None, str | None, JsonObject]
    ) -> None:
        """Use the connection of an attempt that has read the server's greeting.

        Args:
            attempt: the attempt.
            patience_s: seconds in which the server must answer.
            reopen: the named socket, the sender's name and the hello message, which are needed to connect again.
        """
        super().__init__(patience_s)
        self._named, self._name, self._hello_message = reopen
        #: the socket, or None while disconnected
        self._socket: _socket.socket | None = attempt.socket
        #: the socket that a thread may be polling. Only that thread closes it.
        self._polled: _socket.socket | None = None
        assert attempt.server
        self.path, self.server = attempt.path, attempt.server
        self._sent_early = attempt.request_sent
        #: bytes received after the greeting. They are processed after the early request is registered.
        self._received_early = attempt.received

    @classmethod
    async def open(
        cls,
        socket: str | None = None,
        *,
        name: str | None = None,
        urgent: bool = False,
        interrupt: Mapping[int, int] | None = None,
        patience_s: float = ANSWER_LIMIT_S,
        attempt: ConnectionAttempt | None = None,
        keep_trying_s: float = 0.0,
        end: float | None = None,
    ) -> Self:
        """Connect to a server. Return the connection.

        The errors are those of `Client`.

        Args:
            socket: path of the server's socket. The default is TALK_SOCKET, or else the usual places.
            name: the sender's name. The default is TALK_NAME.
            urgent: whether the client sends only `status` and `cancel`. A full server keeps some places for such
                clients.
            interrupt: descriptors that interrupt any wait, with their poll events, as in `polling.wait_ready`.
            patience_s: seconds in which the server must send its greeting, and must answer each request.
            attempt: an open connection, on which the first request may have been sent.
            keep_trying_s: seconds for which to try again if there is no server yet. After connecting, the rest of this
                time is the limit for each answer, unless `patience_s` is longer.
            end: with `keep_trying_s`, the monotonic time by which the server must have sent its greeting. None for no
                limit.
        """
        name, named = checked_sender_name(name), paths.named_socket(socket)
        message = hello(name, urgent=urgent)
        give_up = time.monotonic() + keep_trying_s
        found = await connect(named, message, patience_s, interrupt, attempt, keep_trying_s, end, cls.wait)
        patience_s = max(patience_s, round(give_up - time.monotonic(), 1))
        connection = cls(found, patience_s, (named, name, message))
        connection._interrupt = interrupt
        return connection

    async def open_another(self) -> Connection:
        """Open and return another connection to the same server, with the same name.

        The errors are those of `Client`.
        """
        return await self.open(self._named, name=self._name, patience_s=self._patience)

    @property
    def listener_pid(self) -> int | None:  # type: ignore[override]
        """The id of the process that listens at the socket, or None while disconnected."""
        return None if self._socket is None else peers.credentials(self._socket)[0]

    def _send(self, exchange: Exchange) -> None:
        """Queue an exchange's request, and send as many bytes as the server accepts."""
        line = self.line(exchange)
        if exchange.on_failure and self.unsent_bytes + len(line) > MAX_UNSENT_BYTES:
            words = f"{MAX_UNSENT_BYTES >> 10} KiB are already waiting for the server at {self.path}"
            raise ServerUnavailable(f"nothing was sent: {words}")
        self.queue(line, exchange)
        self._flush()

    def _flush(self) -> None:
        """Send queued bytes until the socket is full.

        The caller must hold the lock `changed`.
        """
        try:
            while self._socket is not None and (data := self.outgoing()):
                self.mark_sent(self._socket.send(data))
        except BlockingIOError:
            pass
        except OSError as error:  # keep the connection, because the server's last messages can still be read
            if self.greeted:
                self.stop_sending(f"the connection to the server was lost: {error.strerror}")

    def prepare(self, now: float) -> tuple[dict[int, int], float]:
        """Send waiting requests. Return the socket with its poll events, and when to call `process` next."""
        self._polled = self._socket
        if self._received_early:
            return {}, now
        self._flush()
        if self._socket is None:
            return {}, NEVER
        return {self._socket.fileno(): select.POLLIN | (select.POLLOUT if self.outgoing() else 0)}, NEVER

    def process(self, ready: Collection[int]) -> None:
        """Read once from the socket, and process the data. Break off the connection if it has ended."""
        polled, early = self._polled, self._received_early
        if early:
            with self.changed:
                self._received_early = b""
                self.receive(early, time.monotonic())
        if polled is None or not ready:
            return
        data, why = b"", "the connection to the server was lost"
        try:
            data = polled.recv(_RECEIVE_BYTES)
        except BlockingIOError:
            return  # the socket is writable, but not readable
        except ConnectionResetError:  # the server closed the connection without reading all requests
            pass
        except OSError as error:
            why = f"the connection to the server was lost: {error}"
        with self.changed:
            if polled is not self._socket:
                return  # another thread has disconnected
            now = time.monotonic()
            if data:
                self.receive(data, now)
                self._flush()
            else:
                self.break_off(why, now)

    def _hang_up(self) -> None:
        """Shut down the socket, which also wakes the thread that reads from it."""
        try:
            if self._socket is not None:
                self._socket.shutdown(SHUT_RDWR)  # closing the socket would not wake the reading thread
        except OSError:
            pass  # the server has closed the connection

    def _drop(self) -> None:
        """Close the socket's descriptor in this process."""
        if self._socket is not None:
            self._socket.close()


class ReconnectingConnection(SocketConnection):
    """A connection over a Unix socket that reconnects after a break.

    It has no thread of its own, so it reconnects during later calls. Only `close` ends it for good.
    """

    reconnects = True
    #: monotonic time of the next attempt to connect. During an attempt, the greeting must arrive by this time.
    _due = 0.0

    def begin(self, request: Request, on_reply: OnReply | None = None, on_failure: OnFailure | None = None) -> Exchange:
        """Reconnect if necessary, and send a request. Return the exchange."""
        if on_failure is None:
            self._read_available()  # this detects a broken connection
        with self.changed:
            if self.ended is None:
                self._connect_again(time.monotonic(), at_once=isinstance(request, Cancel))
            if self._socket is None and self.ended is None and on_failure is None:
                assert self.connect_error
                raise self.connect_error
        return super().begin(request, on_reply, on_failure)

    def break_off(self, why: str, now: float) -> None:
        """Disconnect, fail unanswered requests, and schedule an attempt to reconnect.

        Do nothing if the connection has ended for good.
        """
        if self.ended is not None:
            return
        was_greeted = self.greeted
        self._give_up_socket()
        if was_greeted:
            self.disconnected(why, now)
            self._due = now
        else:
            self._schedule_retry(ServerUnavailable(f"nothing was sent to the server at {self.path}: {why}"), now)

    def prepare(self, now: float) -> tuple[dict[int, int], float]:
        """Reconnect if necessary. Return the socket with its poll events, and when to call `process` next."""
        is_needed = bool(self.exchanges or self.listeners.goals or self.listeners.watches)
        if self._socket is not None and not self.greeted and now >= self._due:
            self._drop()
            self._give_up_socket()
            self._schedule_retry(ServerUnavailable(f"the server at {self.path} doesn't respond"), now)
        if self.ended is None and is_needed:
            self._connect_again(now)
        watched, due = super().prepare(now)
        return watched, self._due if not self.greeted and (is_needed or self._socket) else due

    def process(self, ready: Collection[int]) -> None:
        """Read from the socket, and process the data. Close the socket if it is no longer used."""
        super().process(ready)
        with self.changed:
            if self._polled is not None and self._polled is not self._socket:
                self._polled.close()

    def receive(self, data: bytes, now: float) -> None:
        """Process received bytes. If the greeting refuses this client, disconnect and retry."""
        try:
            super().receive(data, now)
        except TalkError as error:  # the greeting shows that the server can't be used
            self._give_up_socket()
            self._schedule_retry(error, now)

    def _connect_again(self, now: float, *, at_once: bool = False) -> None:
        """Open a new connection if there is none and the pause between attempts is over.

        `at_once` ignores the pause.
        """
        if self._socket is not None or (now < self._due and not at_once):
            return
        found = reach(self._named, only_path=self.path)
        if found.socket is None:
            self._schedule_retry(unreachable_error(found, self._named), now)
            return
        self._socket, self._due = found.socket, now + self._patience
        self.connecting(request_line(self._hello_message))
        self._flush()

    def _schedule_retry(self, error: TalkError, now: float) -> None:
        """Record a failed attempt to connect, fail the requests that callers await, and schedule a retry."""
        self._due = now + _RECONNECT_PAUSE_S
        self.not_connected(error)

    def _give_up_socket(self) -> None:
        """Disconnect, and close the socket unless a thread is reading from it.

        If a thread is reading, that thread closes the socket, because it may still be polling it. The caller must hold
        the lock `changed`.
        """
        self._hang_up()
        if not self._reading:
            self._drop()
        self._socket = None
