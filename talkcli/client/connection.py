"""A client's connection to a server: requests go out, replies and events come in, each to whom it is for.

`Connection` is what the rest of the library knows of one, whatever it leads through; `SocketConnection` is that over a
Unix socket. Nothing here knows what a client asks for, or what a goal's handle makes of its events.
"""

from __future__ import annotations

import itertools
import os
import select
import threading
import time
from _socket import SHUT_RDWR, SHUT_WR  # see `peers`
from collections import deque
from collections.abc import Callable

from talkcli import paths, peers
from talkcli.client.connect import ANSWER_LIMIT, FIRST, connect, hello, sender
from talkcli.client.following import Followed
from talkcli.errors import BadRequest, Lost, ServerUnavailable, Unreadable, UsageError, refusal
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.option import MAX_NAME
from talkcli.goals.options import Say
from talkcli.polling import wait_ready
from talkcli.protocol.lines import LineSplitter, decode, request_line, write_request

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Protocol, TypeVar

    from talkcli.client.connect import Begun
    from talkcli.errors import TalkError
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

    _T = TypeVar("_T")
else:
    Protocol = object

#: Seconds of silence from a server that somebody waits for; it says that it is alive every 5.
SILENCE_LIMIT = 15.0


OnReply = Callable[["JsonObject", "list[JsonObject]"], None]


class Connection(Protocol):
    """A way to one server that has greeted: all that a client and its goals need of it. Any number of threads use it.

    What it sends a server is carried out once or not at all, in the order in which it was sent; nothing that could have
    an effect is sent again by itself, but a goal with its id, which is not spoken twice. Replies and events are taken
    in in the server's order, each before whatever the server said after it: under `changed`, and under it alone, so
    that a wait whose `done` looks at several things sees them together. Nothing is taken in but while somebody waits in
    `request` or `wait_until`; whoever does so does it for all. No lock is held while a server is waited for.

    It ends once and for ever, with `close`, or where nothing more can come: `ended` says why from then on. What came
    before is handed out first. What waits is told so, and what is asked afterwards is ServerUnavailable: nothing was
    sent then.
    """

    #: where the server is, as people are told
    path: str
    #: the server's boot id: the first half of its goals' ids
    boot: str
    #: the server's process, as it says
    pid: int | None
    #: the lock under which all that comes is handed out; notified whenever something was
    changed: threading.Condition
    #: why nothing more comes, once that is so
    ended: str | None
    #: who is told of events; used under `changed`
    followed: Followed

    @property
    def listener(self) -> int | None:
        """The process of this machine that listens there, as its kernel tells it; None where there is none."""

    def request(
        self, request: Request, on_reply: OnReply | None = None, *, slow: bool = False
    ) -> tuple[JsonObject, list[JsonObject]]:
        """Send a request and return its reply and the lines of its list.

        RequestRefused or a class of it if the server says no; ServerUnavailable if it says nothing in time, or Lost
        where what was sent may still have an effect that the sender does not know of. `on_reply` is called with both,
        once the server said yes, before any event that comes after the reply; `slow`: the answer may take any time, in
        which the server says that it is alive. Interrupted as in `wait_until`, but for a goal that may be accepted
        already: its sender could not cancel it.
        """

    def post(self, request: Request) -> None:
        """Send a request whose reply nobody waits for; ServerUnavailable where that is impossible."""

    def wait_until(
        self,
        done: Callable[[], bool],
        deadline: float | None,
        *,
        since: float | None = None,
        interruptible: bool = True,
    ) -> bool:
        """Read until `done()`, and return True; False at the deadline (monotonic), or once the connection ended.

        `done` is called under `changed`, and no more once it was true; what has arrived by the deadline counts.
        A server that says nothing for SILENCE_LIMIT, counted from this call on, or from `since` (monotonic), counts as
        gone. What interrupts the connection's waits does so here, with Interrupted, unless it is not `interruptible`.
        """

    def close(self) -> None:
        """Close the connection, from any thread; goals that were sent are spoken all the same. It may be called again.

        In a forked child it closes the child's copy alone.
        """


def taken(connection: Connection, take: Callable[[], _T], end: float | None) -> Iterator[_T]:
    """Yield what `take` finds, called under `changed`, again and again as it comes.

    What is empty is yielded where nothing has come by `end` (monotonic), or can come any more. What had arrived by then
    counts, nothing after it: a goal may go on for ever.
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


class Exchange:
    """One request on its way: the lines of its list, and at last its reply."""

    __slots__ = ("error", "items", "latest", "number", "on_reply", "reply", "request", "sent", "touched", "tries")

    def __init__(self, number: int, request: Request, on_reply: OnReply | None) -> None:
        #: by which its reply is known
        self.number = number
        self.request = request
        #: whether it has gone out, or may have
        self.sent = True
        #: how often it went out again; until when it means anything, by the clock of the connection that asks again
        self.tries = 0
        self.latest: float | None = None
        self.items: list[JsonObject] = []
        self.reply: JsonObject | None = None
        #: why there will be no reply, where that is known of this one alone
        self.error: TalkError | None = None
        self.on_reply = on_reply
        self.touched = time.monotonic()

    @property
    def over(self) -> bool:
        """Whether nothing more is to be waited for."""
        return self.reply is not None or self.error is not None


class BaseConnection:
    """What connections do alike, whatever they lead through: number requests, read for all, hand out what comes.

    A class of it says how a request is sent and what has come; see `Connection` for what is promised.
    """

    #: requests that can still have an effect, though nobody knows of it, where they were sent and not answered
    lasting: tuple[type[Request], ...] = (Say,)

    def __init__(self, patience: float) -> None:
        """`patience`: seconds in which the server must answer."""
        self.path, self.boot = "", ""
        self.pid: int | None = None
        self.followed = Followed()
        self.changed = threading.Condition()
        self.ended: str | None = None
        self._process = os.getpid()
        self._patience = patience
        self._exchanges: dict[int, Exchange] = {}
        self._numbers: Iterator[int] = itertools.count(FIRST)
        self._lines: deque[bytes] = deque()
        self._reading = False
        self._closing = False
        self._heard = time.monotonic()
        #: what the server said last that was no answer to anything
        self._told: str | None = None
        #: why nothing can be sent at this moment, where that may change
        self._absent = ""

    def close(self) -> None:
        self.ended = self.ended or "the connection was closed"
        if os.getpid() != self._process:
            self._drop()
            return
        with self.changed:
            self._closing = True
            self._hang_up()
            if not self._reading:  # else it would poll a descriptor that may be another file's by now
                self._drop()
            self.changed.notify_all()

    def request(
        self, request: Request, on_reply: OnReply | None = None, *, slow: bool = False
    ) -> tuple[JsonObject, list[JsonObject]]:
        # A goal whose sender was interrupted before it knew the goal's id could not be cancelled any more. One that
        # waits for room isn't accepted yet: who hangs up takes it back.
        interruptible = slow or not isinstance(request, Say)
        exchange = self.begin(request, on_reply)
        try:
            late, deadline = 0.0, -1.0
            while not exchange.over and self.ended is None and late != deadline:
                late, deadline = deadline, self.answer_by(exchange)
                self.wait_until(lambda: exchange.over, None if slow else deadline, interruptible=interruptible)
        finally:
            self.forget(exchange)
        return self.answer(exchange)

    def begin(self, request: Request, on_reply: OnReply | None = None) -> Exchange:
        """Send a request whose answer is taken in as it comes; `forget` it at last."""
        exchange = Exchange(next(self._numbers), request, on_reply)
        self._exchanges[exchange.number] = exchange
        try:
            self._send(exchange.number, request)
        except BaseException:
            self.forget(exchange)
            raise
        return exchange

    def forget(self, exchange: Exchange) -> None:
        """Wait for an answer no more."""
        del self._exchanges[exchange.number]

    def answer(self, exchange: Exchange) -> tuple[JsonObject, list[JsonObject]]:
        """Return the reply, and the lines of its list, to a request that nothing more is waited for; errors as of
        `request`.
        """
        request = exchange.request
        if exchange.error is not None:
            raise exchange.error
        if exchange.reply is None and not exchange.sent:
            raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {self.ended or self._absent}")
        if exchange.reply is None:
            why = self.ended or self._no_reply
            words = f"{request.kind} was sent to the server at {self.path}, but {why}"
            if isinstance(request, Say):
                raise Lost(f"{words}; it may still be spoken")
            raise Lost(words) if isinstance(request, self.lasting) else ServerUnavailable(words)
        if exchange.reply.get("ok") is not True:
            raise self._refusal(exchange.reply, exchange.items)
        return exchange.reply, exchange.items

    def post(self, request: Request) -> None:
        self._send(next(self._numbers), request)

    def wait_until(
        self,
        done: Callable[[], bool],
        deadline: float | None,
        *,
        since: float | None = None,
        interruptible: bool = True,
    ) -> bool:
        began = time.monotonic() if since is None else since
        last = False
        while True:
            with self.changed:
                if done():
                    return True
                if self.ended is not None:
                    return False
                now = time.monotonic()
                quiet, why = self.silent_by(began)
                rest = (quiet if deadline is None else min(deadline, quiet)) - now
                if last and rest <= 0:
                    if deadline is None or quiet < deadline:
                        self.ended = why
                    return False
                # What has arrived by the deadline counts: one more look, that doesn't wait.
                last = rest <= 0
                if self._reading:
                    self.changed.wait(max(0.0, rest))
                    continue
                self._reading = True
            try:
                self._read(rest, interruptible)
            finally:
                with self.changed:
                    self._reading = False
                    if self._closing:
                        self._drop()
                    self.changed.notify_all()

    # -- what each does in its own way

    def _send(self, number: int, request: Request) -> None:
        """Send a request; ServerUnavailable where that is impossible."""
        raise NotImplementedError

    def _fill(self, timeout: float, interruptible: bool) -> None:
        """Put what has come into `_lines`, or wait for it so many seconds; Interrupted."""
        raise NotImplementedError

    def _hang_up(self) -> None:
        """Have nothing more come, and a thread that reads find that out; under `changed`."""
        raise NotImplementedError

    def _drop(self) -> None:
        """Close this process's descriptors, whoever else has them open."""
        raise NotImplementedError

    def answer_by(self, exchange: Exchange) -> float:
        """Return until when an answer is waited for, by the monotonic clock, as far as it is known now."""
        return exchange.touched + self._patience

    @property
    def _no_reply(self) -> str:
        """Why no answer is waited for any more."""
        return f"it did not reply within {self._patience:g} s"

    def silent_by(self, began: float) -> tuple[float, str]:
        """Return when the server counts as gone that says nothing, to one who waits since then, and why."""
        return max(began, self._heard) + SILENCE_LIMIT, f"it has said nothing for {SILENCE_LIMIT:g} s"

    def _refusal(self, reply: JsonObject, items: list[JsonObject]) -> TalkError:
        """Return the error that a reply stands for; `items`: what was listed before."""
        from talkcli.terminal.text import printable  # no start pays for it

        error = reply.get("error")
        code, message = (error.get("code"), error.get("message")) if isinstance(error, dict) else (None, None)
        return refusal(str(code), printable(str(message or "refused: the server gives no reason")), items)

    # -- what has come

    def _read(self, timeout: float, interruptible: bool) -> None:
        """Read what there is, or wait for it, and hand it out."""
        if not self._lines:
            self._fill(timeout, interruptible)
        self.hand_out()

    def hand_out(self) -> None:
        """Hand out what has come, each to whom it is for."""
        while self._lines:
            try:
                message = decode(self._lines.popleft())
                with self.changed:
                    self._dispatch(message)
            except (BadRequest, ValueError) as error:  # ValueError: a goal or an event that is none
                self.ended = self.ended or f"it sent what is no message: {error}"
                return

    def _dispatch(self, message: JsonObject) -> None:
        if "event" in message:
            self.followed.hear(message)
            return
        number = message.get("seq")
        if number is None and message.get("ok") is False:
            self._told = f"the server closed it: {self._refusal(message, [])}"
        exchange = self._exchanges.get(number) if isinstance(number, int) else None
        if exchange is None or exchange.over:
            return
        exchange.touched = time.monotonic()
        if "ok" not in message:
            exchange.items.append(message)
            return
        if exchange.on_reply and message.get("ok") is True:
            try:
                exchange.on_reply(message, exchange.items)
            except Unreadable as error:
                if not isinstance(exchange.request, self.lasting):  # else what was sent may have had an effect
                    exchange.error = error
                raise
        exchange.reply = message  # now: what can't be understood is no reply


class SocketConnection(BaseConnection):
    """A connection by a Unix socket. There is no thread behind it."""

    def __init__(
        self,
        socket: str | None = None,
        *,
        name: str | None = None,
        urgent: bool = False,
        interrupt: Mapping[int, int] | None = None,
        patience: float = ANSWER_LIMIT,
        begun: Begun | None = None,
        keep_trying: float = 0.0,
        end: float | None = None,
    ) -> None:
        """Connect; the errors are those of `Client`.

        Args:
            socket: path of the server's socket; default TALK_SOCKET, then the usual places.
            name: what the sender calls itself; default TALK_NAME.
            urgent: for status and cancel alone, for which a full server keeps some places.
            interrupt: what ends any waiting with Interrupted, as in `connect.ready`.
            patience: seconds in which the server must greet, and answer each request.
            begun: how far the connection has come already; its first request may have been sent.
            keep_trying: seconds for which a server that is not there yet is tried again. What is left of them counts
                as patience if it is more.
            end: the monotonic time by which the server must have greeted, if it is tried again; or None.
        """
        super().__init__(patience)
        self._interrupt = interrupt
        name = sender(name)
        if name and len(name) > MAX_NAME:
            raise UsageError(f"the name of the sender has {len(name)} characters, the longest allowed is {MAX_NAME}")
        said = hello(name, urgent=urgent)
        give_up = time.monotonic() + keep_trying
        begun = connect(paths.named_socket(socket), said, patience, self._interrupt, begun, keep_trying, end)
        assert begun.socket
        self._patience = max(patience, round(give_up - time.monotonic(), 1))
        self._socket, self.path, self.boot, self.pid = begun.socket, begun.path, begun.boot, begun.pid
        self._splitter = LineSplitter()
        self._lines.extend(self._splitter.feed(begun.received))
        # The beginning of the first line to be sent, if that was sent before there was this connection.
        self._sent_early = begun.sent
        self._sending = threading.Lock()
        #: why nothing more can be sent, once that is so; what was sent before may still be answered
        self._mute: str | None = None

    @property
    def listener(self) -> int:
        """The process that listens, as the kernel tells it."""
        return peers.credentials(self._socket)[0]

    def _fill(self, timeout: float, interruptible: bool) -> None:
        try:
            watched = {self._socket.fileno(): select.POLLIN}
            if not wait_ready(watched, timeout, self._interrupt if interruptible else None):
                return
            data = self._socket.recv(262144)
        except BlockingIOError:
            return
        except ConnectionResetError:  # it left without having read all that was sent
            data = b""
        except (OSError, ValueError) as error:  # ValueError: another thread closed it meanwhile
            data = b""
            self.ended = self.ended or f"the connection broke: {error}"
        if not data:
            self.ended = self.ended or self._told or "the server went away"
            return
        self._heard = time.monotonic()
        self._lines.extend(self._splitter.feed(data))

    def _hang_up(self) -> None:
        self._shut(SHUT_RDWR)  # wakes a thread that reads; closing alone would not

    def _drop(self) -> None:
        self._socket.close()

    def _shut(self, direction: int) -> None:
        try:
            self._socket.shutdown(direction)
        except OSError:
            pass  # the server has hung up

    def _send(self, number: int, request: Request) -> None:
        """Send a line. What fails here ends nothing that is waited for: the reader still hears what was said before."""
        data = request_line({"seq": number, **write_request(request)})
        end = time.monotonic() + ANSWER_LIMIT
        with self._sending:
            why = self.ended or self._mute
            if why:
                raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {why}")
            if not data.startswith(self._sent_early):
                raise AssertionError(f"{self._sent_early!r} was sent early instead of {data!r}")
            rest = memoryview(data)[len(self._sent_early) :]
            self._sent_early = b""
            while rest:
                try:
                    rest = rest[self._socket.send(rest) :]
                except BlockingIOError:
                    if not wait_ready({self._socket.fileno(): select.POLLOUT}, end - time.monotonic()):
                        # Half a line may be out: nothing that follows could be understood.
                        self._mute = f"it took nothing for {ANSWER_LIMIT:g} s"
                        self._shut(SHUT_WR)
                        raise ServerUnavailable(f"the server at {self.path} does not answer") from None
                except OSError as error:
                    self._mute = "the server went away"
                    words = f"the server at {self.path} went away: {error.strerror}"
                    raise ServerUnavailable(words) from None
