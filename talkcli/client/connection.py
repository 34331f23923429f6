"""Blocking connections to a server: shells around the client core, for any number of threads.

`Connection` is what the rest of the library uses, whatever the transport is. `SocketConnection` is a connection over a
Unix socket. `ReconnectingConnection` is one that connects again after a break.
"""

from __future__ import annotations

import os
import select
import threading
import time
from _socket import SHUT_RDWR, SHUT_WR  # see `peers`

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

#: Bytes that are received at once.
_RECEIVE_BYTES = 256 * 1024
#: Seconds between two attempts to reach a server that went away: the first pause, which doubles up to the second.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.02, 0.5
#: Portions that are taken in before a request is sent without waiting.
_MAX_LOOKS = 4
#: Seconds after which a thread without a connection looks whether another thread has made one.
_LOOK_S = 0.1


def taken(connection: Connection, take: Callable[[], _T], end: float | None) -> Iterator[_T]:
    """Call `take` under `changed` whenever something has come, and yield what it returns, unless that is empty.

    At `end` (monotonic), or when nothing more can come, yield once what is there, even if it is empty. What arrives
    after `end` doesn't count: a goal may go on for ever.
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
    """A connection to one server. Any number of threads use it: one of them reads, and the others wait for it.

    The server carries out each request once or not at all, in the order in which they were sent. Nothing that could
    have an effect is sent twice, except a goal with its id, which is not spoken twice. Replies and events are taken in
    in the server's order, under `changed` and under it alone, so that a wait whose `done` looks at several things sees
    them together. That happens while a thread waits in `request` or `wait_until`: it reads for all threads. No lock is
    held while a thread waits for the server. The core's methods are called under `changed`, too.

    After `close`, or if nothing more can come, `ended` says why. What came before can still be read. Threads that wait
    are told, and later requests raise ServerUnavailable because nothing is sent.
    """

    #: the process of this machine that listens there, as its kernel says; None if the server is elsewhere
    listener: int | None = None
    #: the class of exchanges; a transport's own class can have more attributes
    exchange_type = Exchange

    def __init__(self, patience: float) -> None:
        """`patience`: seconds in which the server must answer."""
        super().__init__(patience, time.monotonic())
        #: the lock under which everything is taken in; notified after that
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
            if not self._reading:  # else it would poll a descriptor that may be another file's by now
                self._drop()
            self.changed.notify_all()

    def request(
        self, request: Request, on_reply: OnReply | None = None, *, slow: bool = False
    ) -> tuple[JsonObject, list[JsonObject]]:
        """Send a request, and return its reply and the lines of its list.

        Args:
            request: the request.
            on_reply: called with both under `changed`, if the server accepts the request, before any later event.
            slow: the answer may take any time, during which the server sends signs of life.

        Raises:
            RequestRefused: the server refuses the request.
            ServerUnavailable: the request was not sent, or not answered in time.
            Lost: the request was sent and not answered, and may have an effect.
            Interrupted: as in `wait_until`.
        """
        # The wait for the reply to a goal can't be interrupted: the goal may be accepted already, and its sender could
        # not cancel it without its id. A goal that waits for room is different: closing the connection takes it back.
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
        """Send a request and don't wait for the answer; `forget` the exchange when it is over.

        Raises:
            ServerUnavailable: nothing can be sent.
        """
        self._prepare(request, attended=on_failure is None)
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
        """Send a request without waiting, and call one of the functions later, under `changed`.

        What the server doesn't take now is sent by later calls. `on_failure` is called for a refusal, too, and if there
        is no answer in time. It may be called at once.

        Raises:
            ServerUnavailable: the connection has ended.
        """
        self._look()
        slow = isinstance(request, Say) and request.patient
        with self.changed:
            if self.ended is not None:
                raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {self.ended}")
            self.begin(request, on_reply, on_failure, slow=slow)

    def post(self, request: Request) -> None:
        """Send a request without waiting, and ignore its answer; ServerUnavailable if it can't be sent."""
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
        """Take in what comes until `done()` is true, and return True.

        Return False at the deadline, or if the connection has ended. What has arrived by the deadline counts. A server
        that is silent for SILENCE_LIMIT_S counts as gone.

        Args:
            done: called under `changed`, and not again after it was true.
            deadline: monotonic time, or None for no limit.
            since: the time from which silence counts; the default is now.
            interruptible: raise Interrupted if the descriptors that interrupt this connection's waits do so.
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
                # What has arrived by the deadline counts: one more look, that doesn't wait.
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

    def _look(self) -> None:
        """Take in what has come, without waiting. The end of the connection may be behind it."""
        for _ in range(_MAX_LOOKS):
            heard = self._heard
            self.wait_until(lambda: False, time.monotonic(), interruptible=False)
            if heard == self._heard:
                break

    # -- what each transport does in its own way

    def _prepare(self, request: Request, *, attended: bool) -> None:
        """Get ready to send a request; raise an error of `attended` ones, which somebody waits for, if that fails."""

    def _send(self, exchange: Exchange) -> None:
        """Send a registered request, or its beginning; ServerUnavailable if nothing can be sent. Under `changed`."""
        raise NotImplementedError

    def _step(self, timeout: float, interruptible: bool) -> None:
        """Wait until something comes, for the timeout at most, and take it in; Interrupted. By one thread at a time."""
        raise NotImplementedError

    def _hang_up(self) -> None:
        """End the connection so that a thread that reads finds that out. Under `changed`."""
        raise NotImplementedError

    def _drop(self) -> None:
        """Close this process's descriptors, whoever else has them open."""
        raise NotImplementedError

    def _cut_off(self) -> None:
        """Make the server see the end of a connection on which a line was sent in part. Under `changed`."""


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
            urgent: the connection is for status and cancel alone, for which a full server keeps some places.
            interrupt: descriptors with the poll events that interrupt any wait, as in `polling.wait_ready`.
            patience: seconds in which the server must greet, and answer each request.
            attempt: how far the connection has come already. Its first request may have been sent.
            keep_trying: seconds for which a server that is not there yet is tried again. What is left of them counts
                as patience if it is more.
            end: the monotonic time by which the server must have greeted, if it is tried again; or None.
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
        #: received with the greeting: it may answer the request that was sent early, which is still to be registered
        self._received_early = attempt.received

    @property
    def listener(self) -> int | None:  # type: ignore[override]
        """The process that listens, as the kernel says; None while there is no connection."""
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

    def _flush(self) -> None:
        """Send as much of what waits as the server takes now. Under `changed`."""
        try:
            while self._socket is not None and (data := self.outgoing()):
                self.mark_sent(self._socket.send(data))
        except BlockingIOError:
            pass
        except OSError as error:  # the reader finds what the server has sent before that, and the end
            if self.greeted:
                self.stop_sending("the server went away", f"the server at {self.path} went away: {error.strerror}")

    def _step(self, timeout: float, interruptible: bool) -> None:
        with self.changed:
            early, self._received_early = self._received_early, b""
            if early:
                self._take_in(early, time.monotonic())
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
            return  # it takes more of what waits
        except ConnectionResetError:  # it left without having read all that was sent
            pass
        except (OSError, ValueError) as error:  # ValueError: another thread closed it meanwhile
            why = f"the connection broke: {error}"
        with self.changed:
            if connected is not self._socket:
                return  # another thread has given it up
            now = time.monotonic()
            if data:
                self._take_in(data, now)
                self._flush()
            else:
                self.break_off(why, now)

    def _take_in(self, data: bytes, now: float) -> None:
        self.receive(data, now)

    def _hang_up(self) -> None:
        self._shut(SHUT_RDWR)  # wakes a thread that reads; closing alone would not

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
            pass  # the server has hung up


class ReconnectingConnection(SocketConnection):
    """A connection that is made again after it broke, by whatever call comes next. It never ends by itself."""

    def __init__(self, socket: str | None = None, *, name: str | None = None, patience: float = ANSWER_LIMIT_S) -> None:
        """Connect; the arguments are those of `SocketConnection`."""
        super().__init__(socket, name=name, patience=patience)
        #: given up while another thread was polling it, which closes it
        self._given_up: list[_socket.socket] = []
        #: when the next attempt may be made, and the pause after it (monotonic, seconds)
        self._retry_at, self._pause_s = 0.0, _FIRST_PAUSE_S
        #: when the server must have greeted on a new connection (monotonic)
        self._greet_by = 0.0
        #: why the last attempt failed
        self._failure: TalkError = ServerUnavailable("")

    def _prepare(self, request: Request, *, attended: bool) -> None:
        if attended:
            self._look()  # the connection may have broken since the last call
        with self.changed:
            if self.ended is None:
                self._connect_again(time.monotonic(), at_once=isinstance(request, Cancel))
            if self._socket is None and self.ended is None and attended:
                raise self._failure

    def post(self, request: Request) -> None:
        failures: list[TalkError] = []
        self.submit(request, lambda *_: None, failures.append)
        if failures and self.unsent_bytes:  # there is no room for it; after a break nothing waits
            raise failures[0]

    def break_off(self, why: str, now: float) -> None:
        if self.ended is not None:
            return
        was_greeted = self.greeted
        self._give_up_socket()
        if was_greeted:
            self.disconnected(why, now)
            self._retry_at, self._pause_s = now, _FIRST_PAUSE_S
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
                timeout = max(0.0, min(timeout, self._retry_at - now, _LOOK_S))
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

    def _take_in(self, data: bytes, now: float) -> None:
        try:
            super()._take_in(data, now)
        except TalkError as error:  # of the greeting
            self._give_up_socket()
            self._not_connected(error, now)

    def _connect_again(self, now: float, *, at_once: bool = False) -> None:
        """Try to connect, unless there is a connection or, not `at_once`, the last attempt is too recent."""
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
        self._retry_at, self._pause_s = now + self._pause_s, min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self.not_connected(error, " ".join(error.message.split()))

    def _give_up_socket(self) -> None:
        """Close the socket, or have the thread that polls it close it. Under `changed`."""
        self._hang_up()
        if self._socket is not None and self._reading:
            self._given_up.append(self._socket)
        elif self._socket is not None:
            self._socket.close()
        self._socket = None

    def _cut_off(self) -> None:
        self.break_off(f"it took nothing for {self._patience:g} s", time.monotonic())
