"""A client's connection to a server: requests go out, replies and events come in. Any number of threads may use it.

There is no thread behind it: whoever waits for something reads for all, and hands on what is for others. It holds no
lock while it waits for the server. What was read is handed out under one lock, `changed`, and under it alone: a wait
whose `done` looks at several things sees them together.
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

from talkcli.client.connect import ANSWER_LIMIT, dial, ready
from talkcli.errors import BadRequest, Lost, RequestRefused, ServerUnavailable, TalkError, refusal
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import Say
from talkcli.protocol.lines import decode
from talkcli.protocol.requests import request_line

if TYPE_CHECKING:
    from collections.abc import Mapping

    from talkcli.client.opening import Opened
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Hello, Request

#: Seconds of silence from a server that somebody waits for; it says that it is alive every 5.
SILENCE_LIMIT = 15.0


OnReply = Callable[["JsonObject", "list[JsonObject]"], None]


def _refusal(reply: JsonObject, items: list[JsonObject]) -> RequestRefused:
    error = reply.get("error")
    code, message = (error.get("code"), error.get("message")) if isinstance(error, dict) else (None, None)
    from talkcli.terminal.text import printable  # no start pays for it

    refused = refusal(str(code), printable(str(message)))
    refused.items = items
    return refused


class _Exchange:
    """One request on its way: the lines of its list, and at last its reply."""

    __slots__ = ("items", "on_reply", "reply", "touched")

    def __init__(self, on_reply: OnReply | None) -> None:
        self.items: list[JsonObject] = []
        self.reply: JsonObject | None = None
        self.on_reply = on_reply
        self.touched = time.monotonic()


class Connection:
    """`on_event` gets every event, in the server's order, in the thread that happens to read, under `changed`."""

    def __init__(
        self,
        socket: str | None,
        hello: Hello,
        version: str,
        on_event: Callable[[JsonObject], None],
        interrupt: Mapping[int, int] | None = None,
        patience: float = ANSWER_LIMIT,
        opened: Opened | None = None,
    ) -> None:
        self.line = dial(socket, hello, version, patience, interrupt, opened)
        self._process = os.getpid()
        # The beginning of the first line to be sent, if that was sent before there was this connection.
        self._sent_early = opened.sent if opened else b""
        self._patience = patience
        self._on_event = on_event
        self._interrupt = interrupt
        self._lines: deque[bytes] = deque(self.line.lines)
        self._exchanges: dict[int, _Exchange] = {}
        self._numbers = itertools.count(1)
        self.changed = threading.Condition()
        self._sending = threading.Lock()
        self._reading = False
        self._closing = False
        self._heard = time.monotonic()
        #: what the server said last that was no answer to anything
        self._told: str | None = None
        #: why nothing more can be sent, once that is so; what was sent before may still be answered
        self._mute: str | None = None
        #: why there is nothing more to come, once that is so
        self.ended: str | None = None

    def close(self) -> None:
        """Close the connection; goals that were sent are spoken all the same. A forked child closes its copy alone."""
        if os.getpid() != self._process:
            # To shut it down would cut the parent's; and a thread of the parent's may have held the lock at the fork.
            self.ended = self.ended or "the connection was closed"
            self.line.socket.close()
            return
        with self.changed:
            self.ended = self.ended or "the connection was closed"
            self._closing = True
            self._shut(SHUT_RDWR)  # wakes a thread that reads; closing alone would not
            if not self._reading:  # else it would poll a descriptor that may be another file's by now
                self.line.socket.close()
            self.changed.notify_all()

    def request(
        self, request: Request, on_reply: OnReply | None = None, *, slow: bool = False
    ) -> tuple[JsonObject, list[JsonObject]]:
        """Send a request and return its reply and the lines of its list.

        RequestRefused or a class of it if the server says no; ServerUnavailable or Lost if it says nothing in time.
        `on_reply` is called with both, once the server said yes, before any event that comes after the reply;
        `slow`: the answer may take any time, in which the server says that it is alive.
        """
        number = next(self._numbers)
        exchange = _Exchange(on_reply)
        self._exchanges[number] = exchange
        # A goal whose sender was interrupted before it knew the goal's id could not be cancelled any more. One that
        # waits for room isn't accepted yet: who hangs up takes it back.
        interruptible = slow or not isinstance(request, Say)
        try:
            self._send(request_line(request, number))
            self.wait_until(
                lambda: exchange.reply is not None,
                lambda: None if slow else exchange.touched + self._patience,
                SILENCE_LIMIT if slow else None,
                interruptible=interruptible,
            )
        finally:
            del self._exchanges[number]
        if exchange.reply is None:
            raise self._no_reply(request)
        if exchange.reply.get("ok") is not True:
            raise _refusal(exchange.reply, exchange.items)
        return exchange.reply, exchange.items

    def post(self, request: Request) -> None:
        """Send a request whose reply nobody waits for."""
        self._send(request_line(request, next(self._numbers)))

    def _no_reply(self, request: Request) -> TalkError:
        why = self.ended or f"it did not reply within {self._patience:g} s"
        words = f"{request.kind} was sent to the server at {self.line.path}, but {why}"
        # Only a goal can still have an effect that the sender does not know of.
        return Lost(f"{words}; it may still be spoken") if isinstance(request, Say) else ServerUnavailable(words)

    def wait_until(
        self,
        done: Callable[[], bool],
        deadline: Callable[[], float | None],
        silence: float | None = None,
        *,
        since: float | None = None,
        interruptible: bool = True,
    ) -> bool:
        """Read until `done()`, and return True; False at the deadline (monotonic), or once the connection ended.

        `done` is called under `changed`, and no more once it was true; `silence`: seconds without a line from the
        server after which the connection counts as ended, counted from this call on, or from `since` (monotonic).
        """
        began = time.monotonic() if since is None else since
        last = False
        while True:
            with self.changed:
                if done():
                    return True
                if self.ended is not None:
                    return False
                now = time.monotonic()
                limit = deadline()
                quiet = None if silence is None else max(began, self._heard) + silence
                if last and quiet is not None and now >= quiet and (limit is None or quiet < limit):
                    self.ended = f"it has said nothing for {silence:g} s"
                    return False
                if last and limit is not None and now >= limit:
                    return False
                rest = min((each - now for each in (limit, quiet) if each is not None), default=None)
                # What has arrived by the deadline counts: one more look, that doesn't wait.
                last = rest is not None and rest <= 0
                if self._reading:
                    self.changed.wait(None if rest is None else min(max(0.0, rest), threading.TIMEOUT_MAX))
                    continue
                self._reading = True
            try:
                self._read(rest, interruptible)
            finally:
                with self.changed:
                    self._reading = False
                    if self._closing:
                        self.line.socket.close()
                    self.changed.notify_all()

    def _read(self, timeout: float | None, interruptible: bool) -> None:
        """Read what there is, or wait for it, and hand it out."""
        if not self._lines and not self._fill(timeout, interruptible):
            return
        while self._lines:
            try:
                message = decode(self._lines.popleft())
                with self.changed:
                    self._dispatch(message)
            except (BadRequest, ValueError) as error:  # ValueError: a goal or an event that is none
                self.ended = self.ended or f"it sent what is no message: {error}"
                return

    def _fill(self, timeout: float | None, interruptible: bool) -> bool:
        try:
            watched = {self.line.socket.fileno(): select.POLLIN}
            if not ready(watched, timeout, self._interrupt if interruptible else None):
                return False
            data = self.line.socket.recv(262144)
        except BlockingIOError:
            return False
        except ConnectionResetError:  # it left without having read all that was sent
            data = b""
        except (OSError, ValueError) as error:  # ValueError: another thread closed it meanwhile
            data = b""
            self.ended = self.ended or f"the connection broke: {error}"
        if not data:
            self.ended = self.ended or self._told or "the server went away"
            return False
        self._heard = time.monotonic()
        self._lines.extend(self.line.splitter.feed(data))
        return bool(self._lines)

    def _dispatch(self, message: JsonObject) -> None:
        if "event" in message:
            self._on_event(message)
            return
        number = message.get("seq")
        if number is None and message.get("ok") is False:
            self._told = f"the server closed it: {_refusal(message, [])}"
        exchange = self._exchanges.get(number) if isinstance(number, int) else None
        if exchange is None:
            return
        exchange.touched = time.monotonic()
        if "ok" not in message:
            exchange.items.append(message)
            return
        if exchange.on_reply and message.get("ok") is True:
            exchange.on_reply(message, exchange.items)
        exchange.reply = message  # now: what can't be understood is no reply

    def _shut(self, direction: int) -> None:
        try:
            self.line.socket.shutdown(direction)
        except OSError:
            pass  # the server has hung up

    def _send(self, data: bytes) -> None:
        """Send a line. What fails here ends nothing that is waited for: the reader still hears what was said before."""
        end = time.monotonic() + ANSWER_LIMIT
        with self._sending:
            why = self.ended or self._mute
            if why:
                raise ServerUnavailable(f"nothing was sent to the server at {self.line.path}: {why}")
            if not data.startswith(self._sent_early):
                raise AssertionError(f"{self._sent_early!r} was sent early instead of {data!r}")
            rest = memoryview(data)[len(self._sent_early) :]
            self._sent_early = b""
            while rest:
                try:
                    rest = rest[self.line.socket.send(rest) :]
                except BlockingIOError:
                    if not ready({self.line.socket.fileno(): select.POLLOUT}, end - time.monotonic()):
                        # Half a line may be out: nothing that follows could be understood.
                        self._mute = f"it took nothing for {ANSWER_LIMIT:g} s"
                        self._shut(SHUT_WR)
                        raise ServerUnavailable(f"the server at {self.line.path} does not answer") from None
                except OSError as error:
                    self._mute = "the server went away"
                    words = f"the server at {self.line.path} went away: {error.strerror}"
                    raise ServerUnavailable(words) from None
