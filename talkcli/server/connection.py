"""One client: its connection with its limits, and its requests in progress. It decides nothing.

Requests go to a `Handler`. Answers come back through `send`, `send_list` and `publish`. A client that doesn't read its
answers is not read from either. First its feedback is dropped, then the client itself.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from itertools import chain
from types import coroutine
from typing import TYPE_CHECKING, Protocol

from talkcli.errors import BadRequest
from talkcli.frozen import replace
from talkcli.goals.options import Cancel
from talkcli.protocol.events import busy_greeting, failure, item, ok, take_seq
from talkcli.protocol.lines import MAX_LINE_BYTES, LineSplitter, TruncatedLine, decode, encode
from talkcli.protocol.requests import Hello, Request, Status, read_request
from talkcli.server.stream import ClientStream

if TYPE_CHECKING:
    import socket
    from collections.abc import Coroutine, Generator, Iterable, Iterator

    from talkcli.goals.goal import By, JsonObject, Sender
    from talkcli.goals.reasons import Refusal
    from talkcli.goals.record import Record
    from talkcli.server.stream import ClientStreams

    #: requests that wait for the same thing, in their order
    WaitingList = dict["PendingRequest", None]
    Steps = Coroutine[WaitingList, bool | None, None]

#: Unread output of a client, past which its feedback is dropped and its requests are left unread.
CONGESTION_BYTES = 256 * 1024
#: Unread results of a client, past which it is dropped.
MAX_CLIENT_OUTPUT_BYTES = 4 * 1024 * 1024
#: Messages held back while a list is sent to a slow client, past which the client is dropped.
MAX_HELD_MESSAGES = 10_000
#: From connecting to the first complete request. Clients send `hello` at once.
FIRST_REQUEST_S = 5.0
#: From the beginning of a line to its end.
LINE_LIMIT_S = 10.0
#: Consecutive lines that are not JSON, after which the connection is closed.
MAX_BAD_LINES = 10
#: Lines of one client that are read before other clients have a turn. A line takes 0.1 to 0.2 ms, so a hundred busy
#: clients delay the others by 0.1 s.
LINES_PER_TURN = 8
#: Lines that may be read and not yet answered. Past that, the client is not read from.
READ_AHEAD_LINES = 64


class Handler(Protocol):
    """The server, as a connection sees it."""

    #: the first line for a client that is admitted
    greeting: bytes

    def joined(self, connection: ClientConnection) -> None:
        """Identify a new client, and admit it, keep it waiting, or close its connection."""

    def left(self, connection: ClientConnection) -> None:
        """Forget a client that is gone."""

    def handle(self, connection: ClientConnection, seq: int | None, request: Request) -> None:
        """Carry out a request, and answer it now or later."""

    def is_waiting(self, connection: ClientConnection) -> bool:
        """Return whether a client waits for an answer or an event, so that its connection must stay open."""


class PendingRequest:
    """A request of a client that is not answered yet, and the coroutine that carries it out.

    The coroutine runs until it has to wait, and again as soon as another part of the server resumes it. It never waits
    for a later turn of the event loop. So nothing comes in between, and requests that wait for the same thing continue
    in their order.
    """

    def __init__(self, connection: ClientConnection, seq: int | None, request: Request) -> None:
        self.connection = connection
        self.seq = seq
        self.request = request
        #: where it waits
        self.waiting_list: WaitingList | None = None
        #: the memory that is counted for it while it waits
        self.kept_bytes = 0
        #: why a goal can't wait, if it can't
        self.refusal: Refusal | None = None
        #: who cancelled a goal while it waited, and the goal as it ended then
        self.canceled_by: By | None = None
        self.canceled_goal: Record | None = None
        self._steps: Steps

    def start(self, steps: Steps) -> None:
        """Run a coroutine until it waits or ends. It must answer the request and raise no error."""
        self._steps = steps
        self._step(None)

    async def wait(self, waiting_list: WaitingList, limit_s: float | None = None) -> bool:
        """Wait in a list until something resumes the request. Return False if the time limit ended the wait."""
        timer = None if limit_s is None else asyncio.get_running_loop().call_later(limit_s, self.resume, False)
        try:
            return await _wait_in(waiting_list)
        finally:
            if timer:
                timer.cancel()

    def resume(self, in_time: bool = True) -> None:
        """Continue the request, if it waits."""
        if self._leave():
            self._step(in_time)

    def move_to(self, waiting_list: WaitingList) -> None:
        """Have the request wait in this list instead of another."""
        self._leave()
        self.waiting_list = waiting_list
        waiting_list[self] = None

    def drop(self) -> None:
        """Forget the request, because its client is gone."""
        self._leave()
        self._steps.close()

    def answer(self, items: Iterable[JsonObject] = (), events: Iterable[JsonObject] = (), /, **fields: object) -> None:
        """Answer that the request was carried out.

        Args:
            items: lines of a list, which are sent before the reply.
            events: events that are sent after the reply.
            fields: fields of the reply.
        """
        self._reply(ok(self.seq, **fields), items, events)

    def refuse(self, code: str, message: str, items: Iterable[JsonObject] = ()) -> None:
        """Answer with an error, after the lines of a list."""
        self._reply(failure(self.seq, code, message), items)

    def _reply(self, reply: JsonObject, items: Iterable[JsonObject], events: Iterable[JsonObject] = ()) -> None:
        if items or events:
            lines = (item(self.seq, **each) for each in items)
            self.connection.send_list(chain(lines, [reply], events))
        else:
            self.connection.send(reply)

    def _step(self, value: bool | None) -> None:
        with contextlib.suppress(StopIteration):  # it has been answered
            self.move_to(self._steps.send(value))

    def _leave(self) -> bool:
        """Leave the list where the request waits. Return False if it doesn't wait."""
        if self.waiting_list is None:
            return False
        del self.waiting_list[self]
        self.waiting_list = None
        return True


def resume_all(waiting_list: WaitingList) -> None:
    """Continue the requests that wait in a list now, in their order."""
    for each in list(waiting_list):
        each.resume()


@coroutine
def _wait_in(waiting_list: WaitingList) -> Generator[WaitingList, bool, bool]:
    return (yield waiting_list)


class ClientConnection(asyncio.Protocol):
    """The connection of one client.

    If the server is full, the client is not `admitted`. It waits until another client leaves or until it sends an
    urgent request.
    """

    def __init__(self, handler: Handler, streams: ClientStreams, connected: socket.socket) -> None:
        """Create the connection; call `begin` next.

        Args:
            handler: the server.
            streams: the streams of all clients.
            connected: the client's non-blocking socket, which is closed with the connection.
        """
        #: who the client is; the handler sets it when the client joins
        self.client: Sender
        self.admitted = False
        self.stream = ClientStream(streams, connected, self, CONGESTION_BYTES)
        self._handler = handler
        self._loop = streams.loop
        self._splitter = LineSplitter(MAX_LINE_BYTES - 1)
        self._lines: deque[bytes] = deque()
        #: lists that are being sent, and lines that must come after them
        self._outbox: deque[Iterator[JsonObject] | bytes] = deque()
        #: the newest feedback, if the client was too slow to get it
        self._held_feedback = b""
        self._half_closed = self._turn_is_due = False
        self._bad_lines = 0
        self._first_limit = self._limit(FIRST_REQUEST_S, f"no request came within {FIRST_REQUEST_S:g} s")
        self._line_limit: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Introduce the client to the handler, and read its requests if it is admitted."""
        self._handler.joined(self)
        if self.admitted:
            self.stream.begin()
        else:
            # In the next turn, because another client may have left whose end is seen only later in this turn.
            self._loop.call_soon(self.stream.resume_reading)

    def admit(self) -> None:
        """Admit the client, and greet it."""
        self.admitted = True
        self._write(self._handler.greeting)

    # -- called by the stream

    def connection_lost(self, error: Exception | None) -> None:
        self._first_limit.cancel()
        self._stop_line_limit()
        if error is not None and self.admitted:
            self._take_last_requests()
        self._lines.clear()
        self._outbox.clear()
        self._handler.left(self)

    def data_received(self, data: bytes) -> None:
        self._lines.extend(self._splitter.feed(data))
        if self._splitter.size >= MAX_LINE_BYTES:
            self._lines.append(self._splitter.take_rest())  # too long already
        if b"\n" in data:
            self._stop_line_limit()  # another line begins
        self._work()

    def eof_received(self) -> bool:
        self._half_closed = True
        self._work()
        return not self.stream.closing

    def pause_writing(self) -> None:
        self._set_reading()

    def resume_writing(self) -> None:
        self._work()

    # -- called by the handler

    def send(self, message: JsonObject | bytes) -> None:
        """Send a reply or an encoded line, after the lists that are being sent."""
        if self._half_closed:  # it may be the last answer; close in the next turn, as another request may wait
            self._ask_for_turn()
        line = message if isinstance(message, bytes) else encode(message)
        if not self._outbox:
            self._write(line)
        elif len(self._outbox) < MAX_HELD_MESSAGES:
            self._outbox.append(line)
            self.stream.count_held(len(line))
        else:
            self.stream.abort()

    def send_list(self, messages: Iterator[JsonObject]) -> None:
        """Send a list and its reply as fast as the client reads. Later messages wait until all of it is sent."""
        self._outbox.append(messages)
        self._ask_for_turn()

    def publish(self, event: bytes, *, feedback: bool = False) -> None:
        """Send an encoded event. If the client doesn't read, only the newest feedback is kept."""
        if feedback and self.stream.congested:
            self._held_feedback = event
        else:
            held, self._held_feedback = self._held_feedback, b""
            self.send(held + event)

    def has_hung_up(self) -> bool:
        """Send what is written, and return whether this showed that the client is gone."""
        self.stream.flush()
        return self.stream.closing

    def close_with(self, message: JsonObject) -> None:
        """Send a last message, and close the connection."""
        self._write(encode(message))
        self.stream.close()

    # -- internal

    def _limit(self, seconds: float, words: str) -> asyncio.TimerHandle:
        return self._loop.call_later(seconds, self.close_with, failure(None, "too_slow", words))

    def _set_reading(self) -> None:
        """Read from the client only while it reads its answers and not too many requests wait."""
        if self.stream.closing:
            return
        reading = not self.stream.congested and len(self._lines) <= READ_AHEAD_LINES
        if reading:
            self.stream.resume_reading()
        else:
            self.stream.pause_reading()
        if not reading or not self._splitter.size:
            self._stop_line_limit()
        elif self._line_limit is None:
            self._line_limit = self._limit(LINE_LIMIT_S, f"a line took more than {LINE_LIMIT_S:g} s")

    def _stop_line_limit(self) -> None:
        if self._line_limit:
            self._line_limit.cancel()
            self._line_limit = None

    def _write(self, line: bytes) -> None:
        self.stream.write(line)
        if self.stream.unsent_bytes > MAX_CLIENT_OUTPUT_BYTES:
            self.stream.abort()

    def _take_last_requests(self) -> None:
        """Take the requests of a client that closed without reading. They are still in the socket, after an error."""
        with contextlib.suppress(OSError):
            while data := self.stream.socket.recv(CONGESTION_BYTES):
                self._lines.extend(self._splitter.feed(data))
        while self._lines and self._bad_lines < MAX_BAD_LINES:
            self._take(self._lines.popleft())

    def _work(self) -> None:
        """Send what can be sent and take requests, as much as one turn allows."""
        for _ in range(LINES_PER_TURN):
            if self.stream.closing or self.stream.congested or not self._step():
                break
        else:
            self._ask_for_turn()
        idle = not (self._outbox or self._lines or self.stream.congested)
        if self._half_closed and idle and not self._handler.is_waiting(self):
            self.stream.close()
        self._set_reading()

    def _ask_for_turn(self) -> None:
        if not self._turn_is_due:
            self._turn_is_due = True
            self._loop.call_soon(self._next_turn)

    def _next_turn(self) -> None:
        self._turn_is_due = False
        self._work()

    def _step(self) -> bool:
        """Send one line or take one request. Return False if there is neither."""
        if self._outbox:
            first = self._outbox[0]
            if isinstance(first, bytes):
                self._outbox.popleft()
                self.stream.count_held(-len(first))
                self._write(first)
            elif (message := next(first, None)) is None:
                self._outbox.popleft()
            else:
                self._write(encode(message))
        elif self._held_feedback:
            held, self._held_feedback = self._held_feedback, b""
            self._write(held)
        elif self._lines:
            self._take(self._lines.popleft())
        else:
            return False
        return True

    def _take(self, line: bytes) -> None:
        """Take the request in a line."""
        seq = None
        try:
            message = decode(line)
            self._bad_lines = 0
            seq = take_seq(message)
            request = read_request(message)
        except BadRequest as error:
            # After a line that is too long, nobody knows where the next one begins.
            self._bad_lines += MAX_BAD_LINES if isinstance(line, TruncatedLine) else 1
            self.send(failure(seq, error.code, str(error)))
            if self._bad_lines >= MAX_BAD_LINES or not self.admitted:
                self.stream.close()
            return
        self._first_limit.cancel()
        if not self.admitted:
            if not (isinstance(request, Status | Cancel) or (isinstance(request, Hello) and request.urgent)):
                self.close_with(busy_greeting())
                return
            self.admit()
        if isinstance(request, Hello):
            self.client = replace(self.client, name=request.name)
            self.send(ok(seq))
        else:
            self._handler.handle(self, seq, request)
