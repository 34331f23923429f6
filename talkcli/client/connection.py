"""Blocking connections to a server: shells around the client core, for any number of threads.

`Connection` is what the rest of the library uses, whatever the transport is. `SocketConnection` is a connection over a
Unix socket. `ReconnectingConnection` is one that connects again after a break.
"""

from __future__ import annotations

import os
import select
import threading
import time
from _socket import MSG_PEEK, SHUT_RDWR, SHUT_WR  # lighter than `socket`, see `peers`

from talkcli import __version__, paths, peers
from talkcli.client.connect import ANSWER_LIMIT_S, connect, hello, reach, sender_name, unreachable
from talkcli.client.core import MAX_UNSENT_BYTES, ClientCore, Exchange
from talkcli.errors import ServerUnavailable, TalkError, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import MAX_SENDER_NAME_CHARS, Cancel, Say
from talkcli.polling import wait_ready
from talkcli.protocol.lines import request_line

if TYPE_CHECKING:
    import _socket
    from collections.abc import Callable, Iterator, Mapping
    from typing import TypeVar

    from talkcli.client.connect import ConnectionAttempt
    from talkcli.client.core import OnFailure, OnReply
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

    _T = TypeVar("_T")

#: The most bytes that are received at once.
_RECEIVE_BYTES = 256 * 1024
#: Seconds between two attempts to reconnect: the first pause, and the limit up to which it is doubled.
_FIRST_RECONNECT_PAUSE_S, _LONGEST_RECONNECT_PAUSE_S = 0.02, 0.5
#: Reads before a request is sent, which are enough to find the end of a connection behind events.
_MAX_READS = 4
#: Seconds after which a waiting thread notices that another thread has reconnected.
_RECONNECT_CHECK_S = 0.1


def taken(connection: Connection, take: Callable[[], _T], end: float | None) -> Iterator[_T]:
    """Iterate over the non-empty results of `take`, which is called under `changed` after each read.

    At `end` (monotonic), or when the connection has ended, yield the result even if it is empty. Events received after
    `end` don't count, because a goal may go on for ever.
    """
    found: _T

    def arrived() -> bool:
        nonlocal found
        found = take()
        return bool(found)

    late = False
    while True:
        if late:
            with connection.changed:
                arrived()
        else:
            connection.wait_until(arrived, end)
            late = end is not None and time.monotonic() >= end
        yield found


class Connection(ClientCore):
    """A connection to one server, for any number of threads. One of them reads, and the others wait for it.

    The server carries out each request at most once, in the order of sending. A request that could have an effect is
    never sent twice, except a goal with its id, which is spoken once. Messages are processed in the server's order and
    under `changed`, so that a waiting thread sees a consistent state. They are only read while a thread is in `request`
    or `wait_until`, which reads for all threads. No lock is held during a wait. The core's methods must be called under
    `changed`.

    When the connection has ended, `ended` gives the reason. Events that were received before can still be read. Waiting
    threads return, and later requests raise ServerUnavailable.
    """

    #: the process on this machine that listens at the socket, according to the kernel; None if the server is elsewhere
    listener: int | None = None
    #: the class of exchanges; a transport's own class can have more attributes
    exchange_type = Exchange

    def __init__(self, patience: float) -> None:
        """`patience` is the time in seconds in which the server must answer."""
        super().__init__(patience, time.monotonic())
        #: the lock under which messages are processed; notified after that
        self.changed = threading.Condition()
        self._process = os.getpid()
        self._reading = False
        self._closing = False

    def close(self) -> None:
        """Close the connection, from any thread. Goals that were sent are still spoken.

        Closing twice is no error. In a forked child, only the child's copies of the descriptors are closed.
        """
        if os.getpid() != self._process:
            self.ended = self.ended or "the connection was closed"
            self._drop()
            return
        with self.changed:
            self.end("the connection was closed")
            self._closing = True
            self._hang_up()
            if not self._reading:  # the reader would poll a descriptor that may belong to another file by now
                self._drop()
            self.changed.notify_all()

    def request(
        self, request: Request, on_reply: OnReply | None = None, *, slow: bool = False
    ) -> tuple[JsonObject, list[JsonObject]]:
        """Send a request, and return its reply and the lines of its list.

        Args:
            request: the request.
            on_reply: called with both under `changed` if the server accepts the request, before any later event.
            slow: the answer may take any time, during which the server sends signs of life.

        Raises:
            RequestRefused: the server refused the request.
            ServerUnavailable: the request was not sent, or not answered in time.
            Lost: the request was sent and not answered, so it may have taken effect.
            Interrupted: as in `wait_until`.
        """
        # A goal may be accepted before its reply is read. Without the reply, the sender has no id to cancel it with, so
        # this wait can't be interrupted. Closing the connection cancels a goal that is still waiting for room.
        interruptible = slow or not isinstance(request, Say)
        exchange = self.begin(request, on_reply, slow=slow)
        try:
            last, deadline = 0.0, -1.0
            while not exchange.over and self.ended is None and last != deadline:
                last, deadline = deadline, self.answer_by(exchange)
                limit = None if deadline == float("inf") else deadline
                self.wait_until(lambda: exchange.over, limit, interruptible=interruptible)
        finally:
            with self.changed:
                if not self.forget(exchange):
                    self._cut_off()
        return self.answer(exchange)

    def begin(
        self,
        request: Request,
        on_reply: OnReply | None = None,
        on_failure: OnFailure | None = None,
        *,
        slow: bool = False,
    ) -> Exchange:
        """Send a request without waiting for the answer. If `on_failure` is None, `forget` the exchange in the end.

        Raises:
            ServerUnavailable: nothing can be sent.
        """
        self._prepare(request, awaited=on_failure is None)
        exchange = self.exchange_type(request, on_reply, on_failure, slow=slow)
        with self.changed:
            self.register(exchange, time.monotonic())
            try:
                self._send(exchange)
            except BaseException:
                self.forget(exchange)
                raise
        return exchange

    def submit(self, request: Request, on_reply: OnReply, on_failure: OnFailure) -> None:
        """Send a request without waiting. One of the two functions is called under `changed`, now or later.

        Bytes that the server doesn't accept now are sent by later calls. A refusal, and an answer that doesn't come in
        time, count as failures.

        Raises:
            ServerUnavailable: the connection has ended.
        """
        self._read_available()
        slow = isinstance(request, Say) and request.patient
        with self.changed:
            if self.ended is not None:
                raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {self.ended}")
            self.begin(request, on_reply, on_failure, slow=slow)

    def post(self, request: Request) -> None:
        """Send a request without waiting and ignore the answer; ServerUnavailable if it can't be sent."""
        failures: list[TalkError] = []
        self.submit(request, lambda *_: None, failures.append)
        if failures:
            raise failures[0]

    def wait_until(
        self,
        done: Callable[[], bool],
        deadline: float | None,
        *,
        since: float | None = None,
        interruptible: bool = True,
    ) -> bool:
        """Read until `done()` is true. A server that is silent for SILENCE_LIMIT_S counts as gone.

        Args:
            done: called under `changed`, and not again after it has returned True.
            deadline: monotonic time, or None for no limit. Messages that have arrived by then count.
            since: the monotonic time from which silence counts; the default is now.
            interruptible: raise Interrupted if one of the connection's interrupting descriptors is ready.

        Returns:
            False if the deadline has passed, or if the connection has ended.
        """
        began = time.monotonic() if since is None else since
        last = False
        while True:
            with self.changed:
                now = time.monotonic()
                if not self.expire(now):
                    self._cut_off()
                if done():
                    return True
                if self.ended is not None:
                    return False
                silent_at, why = self.silent_by(began)
                end = silent_at if deadline is None else min(deadline, silent_at)
                if last and now >= end:
                    if deadline is not None and deadline <= silent_at:
                        return False
                    self.break_off(why, now)
                    continue
                # Read once more at the deadline, without waiting, because messages that have arrived count.
                last = now >= end
                wait_s = max(0.0, min(end, self.next_expiry()) - now)
                if self._reading:
                    self.changed.wait(wait_s)
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
        """Read the messages that have arrived, without waiting. The end of the connection may follow them."""
        for _ in range(_MAX_READS):
            heard = self._heard
            self.wait_until(lambda: False, time.monotonic(), interruptible=False)
            if heard == self._heard:
                break

    # -- to be implemented by each transport

    def _prepare(self, request: Request, *, awaited: bool) -> None:
        """Prepare the connection for a request. Raise a failure only if the answer will be awaited."""

    def _send(self, exchange: Exchange) -> None:
        """Send or queue a registered request, under `changed`; ServerUnavailable if nothing can be sent."""
        raise NotImplementedError

    def _step(self, timeout: float, interruptible: bool) -> None:
        """Wait for messages, up to the timeout, and process them; Interrupted. One thread at a time calls this."""
        raise NotImplementedError

    def _hang_up(self) -> None:
        """Disconnect under `changed`, so that the reading thread notices it."""
        raise NotImplementedError

    def _drop(self) -> None:
        """Close the descriptors of this process. A parent process keeps its own."""
        raise NotImplementedError

    def _cut_off(self) -> None:
        """Disconnect under `changed`, after a line was sent only in part."""


class SocketConnection(Connection):
    """A connection over a Unix socket. It has no thread of its own."""

    def __init__(
        self,
        socket: str | None = None,
        *,
        name: str | None = None,
        urgent: bool = False,
        interrupt: Mapping[int, int] | None = None,
        patience: float = ANSWER_LIMIT_S,
        attempt: ConnectionAttempt | None = None,
        keep_trying: float = 0.0,
        end: float | None = None,
    ) -> None:
        """Connect; the errors are those of `Client`.

        Args:
            socket: path of the server's socket. The default is TALK_SOCKET, then the usual places.
            name: what the sender calls itself. The default is TALK_NAME.
            urgent: only `status` and `cancel` will be sent, for which a full server keeps some places.
            interrupt: descriptors with the poll events that interrupt any wait, as in `polling.wait_ready`.
            patience: seconds in which the server must greet, and must answer each request.
            attempt: a connection that has already been opened. Its first request may have been sent.
            keep_trying: seconds for which to try again if there is no server yet. The rest of this time replaces
                `patience` if it is longer.
            end: with `keep_trying`, the monotonic time by which the server must have greeted; None for no limit.
        """
        super().__init__(patience)
        self._interrupt = interrupt
        name = sender_name(name)
        if name and len(name) > MAX_SENDER_NAME_CHARS:
            raise UsageError(
                f"the name of the sender has {len(name)} characters, the longest allowed is {MAX_SENDER_NAME_CHARS}"
            )
        self._first_words = hello(name, urgent=urgent)
        self._named = paths.named_socket(socket)
        give_up = time.monotonic() + keep_trying
        attempt = connect(self._named, self._first_words, patience, self._interrupt, attempt, keep_trying, end)
        self._patience = max(patience, round(give_up - time.monotonic(), 1))
        #: None while there is no connection
        self._socket: _socket.socket | None = attempt.socket
        self.path, self.boot, self.pid = attempt.path, attempt.boot, attempt.pid
        self._sent_early = attempt.request_sent
        #: received together with the greeting, and processed after the request that was sent early is registered
        self._received_early = attempt.received

    @property
    def listener(self) -> int | None:  # type: ignore[override]
        """The process that listens at the socket, according to the kernel; None while disconnected."""
        return None if self._socket is None else peers.credentials(self._socket)[0]

    def _send(self, exchange: Exchange) -> None:
        line = self.line(exchange)
        try:
            if exchange.on_failure and self.unsent_bytes + len(line) > MAX_UNSENT_BYTES:
                words = f"{MAX_UNSENT_BYTES >> 10} KiB wait to be sent to the server at {self.path} already"
                raise ServerUnavailable(f"nothing was sent: {words}")
            self.queue(line, exchange)
        except ServerUnavailable as error:
            if exchange.on_failure is None:
                raise
            self.fail(exchange, error)
        self._flush()

    def _read_available(self) -> None:
        try:
            if self._socket is None:
                return
            self._socket.recv(1, MSG_PEEK)
        except BlockingIOError:
            return  # there is nothing to read, and the connection is open
        except OSError:
            pass  # the connection broke
        super()._read_available()

    def _flush(self) -> None:
        """Send as many of the outgoing bytes as the server accepts now, under `changed`."""
        try:
            while self._socket is not None and (data := self.outgoing()):
                self.mark_sent(self._socket.send(data))
        except BlockingIOError:
            pass
        except OSError as error:  # the reader will find the end, after the server's last messages
            if self.greeted:
                self.stop_sending("the server went away", f"the server at {self.path} went away: {error.strerror}")

    def _step(self, timeout: float, interruptible: bool) -> None:
        with self.changed:
            early, self._received_early = self._received_early, b""
            if early:
                self._receive(early, time.monotonic())
                timeout = 0.0
            self._flush()
            connected = self._socket
            waits = bool(self.outgoing())
        if connected is None:
            return
        data, why = b"", "the server went away"
        try:
            watched = {connected.fileno(): select.POLLIN | (select.POLLOUT if waits else 0)}
            if not wait_ready(watched, timeout, self._interrupt if interruptible else None):
                return
            data = connected.recv(_RECEIVE_BYTES)
        except BlockingIOError:
            return  # the socket is ready for sending only
        except ConnectionResetError:  # the server closed it without reading everything
            pass
        except (OSError, ValueError) as error:  # ValueError: another thread has closed it
            why = f"the connection broke: {error}"
        with self.changed:
            if connected is not self._socket:
                return  # another thread has disconnected
            now = time.monotonic()
            if data:
                self._receive(data, now)
                self._flush()
            else:
                self.break_off(why, now)

    def _receive(self, data: bytes, now: float) -> None:
        self.receive(data, now)

    def _hang_up(self) -> None:
        self._shut(SHUT_RDWR)  # this wakes the reading thread, unlike closing the socket

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _cut_off(self) -> None:
        self.stop_sending(f"it took nothing for {self._patience:g} s", f"the server at {self.path} does not answer")
        self._shut(SHUT_WR)

    def _shut(self, direction: int) -> None:
        try:
            if self._socket is not None:
                self._socket.shutdown(direction)
        except OSError:
            pass  # the server has closed it


class ReconnectingConnection(SocketConnection):
    """A connection over a Unix socket that reconnects after a break. Only `close` ends it.

    It has no thread of its own, so it reconnects during the next calls.
    """

    def __init__(self, socket: str | None = None, *, name: str | None = None, patience: float = ANSWER_LIMIT_S) -> None:
        """Connect; the arguments are those of `SocketConnection`."""
        super().__init__(socket, name=name, patience=patience)
        #: sockets that the reading thread is to close, because it may be polling them
        self._given_up: list[_socket.socket] = []
        #: the earliest time of the next attempt (monotonic), and the pause after it
        self._retry_at, self._pause_s = 0.0, _FIRST_RECONNECT_PAUSE_S
        #: by when the server must greet on a new connection (monotonic)
        self._greet_by = 0.0
        #: why the last attempt failed
        self._failure: TalkError = ServerUnavailable("")

    def _prepare(self, request: Request, *, awaited: bool) -> None:
        if awaited:
            self._read_available()  # finds a break since the last call
        with self.changed:
            if self.ended is None:
                self._connect_again(time.monotonic(), at_once=isinstance(request, Cancel))
            if self._socket is None and self.ended is None and awaited:
                raise self._failure

    def post(self, request: Request) -> None:
        failures: list[TalkError] = []
        self.submit(request, lambda *_: None, failures.append)
        if failures and self.unsent_bytes:  # the buffer is full; after a break it would be empty
            raise failures[0]

    def break_off(self, why: str, now: float) -> None:
        if self.ended is not None:
            return
        was_greeted = self.greeted
        self._give_up_socket()
        if was_greeted:
            self.disconnected(why, now)
            self._retry_at, self._pause_s = now, _FIRST_RECONNECT_PAUSE_S
        else:
            self._not_connected(ServerUnavailable(f"nothing was sent to the server at {self.path}: {why}"), now)

    def _step(self, timeout: float, interruptible: bool) -> None:
        with self.changed:
            now = time.monotonic()
            if self._socket is not None and not self.greeted and now >= self._greet_by:
                self._give_up_socket()
                self._not_connected(ServerUnavailable(f"the server at {self.path} does not answer"), now)
            if self.ended is None:
                self._connect_again(now)
            if self._socket is None:
                timeout = max(0.0, min(timeout, self._retry_at - now, _RECONNECT_CHECK_S))
            elif not self.greeted:
                timeout = max(0.0, min(timeout, self._greet_by - now))
            absent = self._socket is None
        if absent:
            wait_ready({}, timeout)
        else:
            super()._step(timeout, interruptible)
        with self.changed:
            for each in self._given_up:
                each.close()
            self._given_up.clear()

    def _receive(self, data: bytes, now: float) -> None:
        try:
            super()._receive(data, now)
        except TalkError as error:  # the greeting
            self._give_up_socket()
            self._not_connected(error, now)

    def _connect_again(self, now: float, *, at_once: bool = False) -> None:
        """Try to connect if there is no connection. Wait for the end of the pause, unless `at_once` is set."""
        if self._socket is not None or (now < self._retry_at and not at_once):
            return
        found = reach(self._named, only=self.path)
        if found.socket is None:
            self._not_connected(unreachable(found, self._named), now)
            return
        self._socket, self._greet_by = found.socket, now + self._patience
        self.connecting(request_line(self._first_words), __version__)
        self._flush()

    def _not_connected(self, error: TalkError, now: float) -> None:
        self._failure = error
        self._retry_at, self._pause_s = now + self._pause_s, min(2 * self._pause_s, _LONGEST_RECONNECT_PAUSE_S)
        self.not_connected(error, " ".join(error.message.split()))

    def _give_up_socket(self) -> None:
        """Disconnect under `changed`, and leave closing the socket to the reading thread if there is one."""
        self._hang_up()
        if self._socket is not None and self._reading:
            self._given_up.append(self._socket)
        elif self._socket is not None:
            self._socket.close()
        self._socket = None

    def _cut_off(self) -> None:
        self.break_off(f"it took nothing for {self._patience:g} s", time.monotonic())
