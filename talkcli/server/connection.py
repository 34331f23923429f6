"""The connection of a client, its limits and its unanswered requests.

The connection passes requests to a `Handler`, which answers with `send`, `send_list` and `publish`. If a client doesn't
read its replies, the server first drops its feedback and reads no more requests. If that is not enough, it closes the
connection.
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
from talkcli.server.stream import CONGESTION_BYTES, ClientStream, ClientStreams

if TYPE_CHECKING:
    import socket
    from collections.abc import Coroutine, Generator, Iterable, Iterator

    from talkcli.goals.goal import By, JsonObject, Sender
    from talkcli.goals.reasons import Refusal
    from talkcli.goals.record import Record

    #: requests that wait for the same condition, in order of arrival
    WaitingList = dict["PendingRequest", None]
    Steps = Coroutine[WaitingList, bool | None, None]

#: A client with more unread output than this is disconnected.
MAX_CLIENT_OUTPUT_BYTES = 4 * 1024 * 1024
#: Maximum number of messages that wait while a list is sent to a client. If there are more, the client is
#: disconnected.
MAX_HELD_MESSAGES = 10_000
#: Time limit for a client's first request. Clients send `hello` immediately.
FIRST_REQUEST_S = 5.0
#: Time limit for receiving a whole line.
LINE_LIMIT_S = 10.0
#: Number of consecutive lines without valid JSON after which a connection is closed.
MAX_BAD_LINES = 10
#: Maximum number of lines processed for one client before other clients have their turn. A line takes 0.1 to 0.2 ms, so
#: a hundred busy clients delay all others by 0.1 s.
LINES_PER_TURN = 8
#: Maximum number of unprocessed lines of a client before the server stops reading from it.
READ_AHEAD_LINES = 64


class Handler(Protocol):
    """The interface that connections use to call the server."""

    #: first line sent to every admitted client
    greeting: bytes

    def joined(self, connection: ClientConnection) -> None:
        """Admit a new client, let it wait until another one leaves, or refuse it."""

    def left(self, connection: ClientConnection) -> None:
        """Remove a client that has disconnected."""

    def handle(self, connection: ClientConnection, seq: int | None, request: Request) -> None:
        """Start to carry out a client's request, which may be answered later."""

    def input_ended(self, connection: ClientConnection) -> None:
        """End a client's pause, and all its incomplete texts that no other connection may continue.

        This method is called at the end of the client's input.
        """

    def is_waiting(self, connection: ClientConnection) -> bool:
        """Return whether a client is still waiting for a reply or an event."""


class PendingRequest:
    """A request that has not been answered yet, and the coroutine that handles it.

    The coroutine runs until it has to wait, and continues immediately when another part of the server resumes it.
    Unlike an asyncio task, it never waits for a later iteration of the event loop. Therefore, nothing happens in
    between, and requests that wait for the same condition continue in their order.
    """

    def __init__(self, connection: ClientConnection, seq: int | None, request: Request) -> None:
        self.connection = connection
        self.seq = seq
        self.request = request
        #: the waiting list that contains the request, or None
        self.waiting_list: WaitingList | None = None
        #: memory counted for the request while it waits
        self.kept_bytes = 0
        #: reason why the request was not allowed to wait, or None
        self.refusal: Refusal | None = None
        #: the client that cancelled the goal while it was waiting
        self.canceled_by: By | None = None
        #: the goal that was cancelled while it was waiting
        self.canceled_goal: Record | None = None
        self._steps: Steps

    def start(self, steps: Steps) -> None:
        """Run `steps`, the coroutine that handles the request, until it waits or ends.

        It must answer the request and must not raise.
        """
        self._steps = steps
        self._step(None)

    async def wait(self, waiting_list: WaitingList, limit_s: float | None = None) -> bool:
        """Wait until the request is resumed. Return False if the time limit was reached first."""
        timer = None if limit_s is None else asyncio.get_running_loop().call_later(limit_s, self.resume, False)
        try:
            return await _wait_in(waiting_list)
        finally:
            if timer:
                timer.cancel()

    def resume(self, in_time: bool = True) -> None:
        """Continue the request if it is waiting. Its call of `wait` returns `in_time`."""
        if self._leave():
            self._step(in_time)

    def move_to(self, waiting_list: WaitingList) -> None:
        """Move the request from its current waiting list to this one."""
        self._leave()
        self.waiting_list = waiting_list
        waiting_list[self] = None

    def drop(self) -> None:
        """Abandon the request, because its client has disconnected."""
        self._leave()
        self._steps.close()

    def answer(self, items: Iterable[JsonObject] = (), events: Iterable[JsonObject] = (), /, **fields: object) -> None:
        """Reply that the request succeeded.

        Args:
            items: the lines of a list to send before the reply.
            events: the events to send after the reply.
            fields: the fields of the reply.
        """
        self._reply(ok(self.seq, **fields), items, events)

    def refuse(self, code: str, message: str, items: Iterable[JsonObject] = (), **fields: object) -> None:
        """Reply that the request failed.

        Args:
            code: the machine-readable error.
            message: the human-readable error.
            items: the lines of a list to send before the reply.
            fields: further fields of the reply.
        """
        self._reply(failure(self.seq, code, message, **fields), items)

    def _reply(self, reply: JsonObject, items: Iterable[JsonObject], events: Iterable[JsonObject] = ()) -> None:
        """Send the list items, then the reply, and then the events."""
        if items or events:
            lines = (item(self.seq, **each) for each in items)
            self.connection.send_list(chain(lines, [reply], events))
        else:
            self.connection.send(reply)

    def _step(self, in_time: bool | None) -> None:
        """Run the coroutine until it waits or ends. Its pending call of `wait` returns `in_time`.

        At the start, there is no such call, and `in_time` is None.
        """
        with contextlib.suppress(StopIteration):  # raised when the coroutine has ended
            self.move_to(self._steps.send(in_time))

    def _leave(self) -> bool:
        """Remove the request from its waiting list. Return whether it was waiting."""
        if self.waiting_list is None:
            return False
        del self.waiting_list[self]
        self.waiting_list = None
        return True


def resume_all(waiting_list: WaitingList) -> None:
    """Continue all requests in a waiting list, in order."""
    for each in list(waiting_list):
        each.resume()


@coroutine
def _wait_in(waiting_list: WaitingList) -> Generator[WaitingList, bool, bool]:
    """Suspend a request in a waiting list. Return whether it was resumed in time."""
    return (yield waiting_list)


class ClientConnection(asyncio.Protocol):
    """A client's connection, which reads requests and sends replies and events.

    If the server is full, a new client is admitted only when another client leaves, or when it sends an urgent request.
    """

    def __init__(self, handler: Handler, streams: ClientStreams, connected: socket.socket) -> None:
        """Create the connection. Call `begin` to start reading.

        Args:
            handler: the server.
            streams: the streams of all clients.
            connected: the client's non-blocking socket. The connection closes it.
        """
        #: the connected program, set by `Handler.joined`
        self.client: Sender
        self.admitted = False
        #: requests that have not been answered yet, oldest first
        self.unanswered: WaitingList = {}
        self.stream = ClientStream(streams, connected, self)
        self._handler = handler
        self._loop = streams.loop
        self._splitter = LineSplitter(MAX_LINE_BYTES - 1)
        self._lines: deque[bytes] = deque()
        #: lists that are being sent, and the lines that follow them
        self._outbox: deque[Iterator[JsonObject] | bytes] = deque()
        #: the latest feedback, which is held back because the client reads too slowly
        self._held_feedback = b""
        self._half_closed = self._finishing = self._work_is_scheduled = False
        self._bad_lines = 0
        self._first_timer = self._close_after(FIRST_REQUEST_S, f"no request arrived within {FIRST_REQUEST_S:g} s")
        self._line_timer: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Register the client with the handler, and start reading its requests."""
        self._handler.joined(self)
        if self.admitted:
            self.stream.begin()
        else:
            # Start reading in the next iteration of the event loop. Until then, the server may notice that another
            # client has left.
            self._loop.call_soon(self.stream.resume_reading)

    def admit(self) -> None:
        """Admit the client and send it the greeting."""
        self.admitted = True
        self._write(self._handler.greeting)

    # -- called by the stream

    def connection_lost(self, error: Exception | None) -> None:
        """Process the last requests of a disconnected client, and remove the client from the server."""
        self._first_timer.cancel()
        self._cancel_line_timer()
        if error is not None and self.admitted:
            self._process_last_requests()
        self._lines.clear()
        self._outbox.clear()
        self._handler.left(self)

    def data_received(self, data: bytes) -> None:
        """Split received data into lines, and process them."""
        self._lines.extend(self._splitter.feed(data))
        if self._splitter.size >= MAX_LINE_BYTES:
            self._lines.append(self._splitter.take_rest())  # this line is too long
        if b"\n" in data:
            self._cancel_line_timer()  # the next line has a new time limit
        self._work()

    def eof_received(self) -> None:
        """Record the end of the client's input. Close the connection once all answers are sent."""
        self._half_closed = True
        self._work()

    def pause_writing(self) -> None:
        """Stop reading requests, because the client doesn't read its output."""
        self._update_reading()

    def resume_writing(self) -> None:
        """Continue to send output and to process requests."""
        self._work()

    # -- called by the handler

    def send(self, message: JsonObject | bytes) -> None:
        """Send a reply or an encoded line, after any lists that are still being sent.

        If too many lines wait, disconnect the client.
        """
        if self._half_closed:  # if this is the last reply, close the connection soon
            self._schedule_work()
        line = message if isinstance(message, bytes) else encode(message)
        if not self._outbox:
            self._write(line)
        elif len(self._outbox) < MAX_HELD_MESSAGES:
            self._outbox.append(line)
            self.stream.adjust_held_bytes(len(line))
        else:
            self.stream.abort()

    def send_list(self, messages: Iterator[JsonObject]) -> None:
        """Send a list of messages as fast as the client reads them.

        Later messages follow the list.
        """
        self._outbox.append(messages)
        self._schedule_work()

    def publish(self, event: bytes, *, feedback: bool = False) -> None:
        """Send an encoded event. If the client reads too slowly, keep only the newest feedback for later."""
        if feedback and self.stream.congested:
            self._held_feedback = event
        else:
            held, self._held_feedback = self._held_feedback, b""
            self.send(held + event)

    def detect_hang_up(self) -> bool:
        """Send pending output to find out whether the connection is closing. Return whether it is."""
        self.stream.flush()
        return self.stream.closing

    def close_with(self, message: JsonObject) -> None:
        """Send a last message and close the connection."""
        self._write(encode(message))
        self.stream.close()

    def finish(self) -> None:
        """Read no more requests, finish all answers, and then close the connection."""
        self._finishing = True
        self._schedule_work()

    # -- internals

    def _close_after(self, seconds: float, message: str) -> asyncio.TimerHandle:
        """Start a timer that closes the connection with an error message. Return the timer."""
        return self._loop.call_later(seconds, self.close_with, failure(None, "too_slow", message))

    def _update_reading(self) -> None:
        """Start or stop reading. Start or cancel the time limit for the rest of a line.

        The server reads only while the client reads its replies and has few unprocessed lines.
        """
        if self.stream.closing:
            return
        reading = not (self._finishing or self.stream.congested) and len(self._lines) <= READ_AHEAD_LINES
        if reading:
            self.stream.resume_reading()
        else:
            self.stream.pause_reading()
        if not reading or not self._splitter.size:
            self._cancel_line_timer()
        elif self._line_timer is None:
            self._line_timer = self._close_after(LINE_LIMIT_S, f"a line was not complete within {LINE_LIMIT_S:g} s")

    def _cancel_line_timer(self) -> None:
        """Cancel the time limit for an incomplete line, if there is one."""
        if self._line_timer:
            self._line_timer.cancel()
            self._line_timer = None

    def _write(self, line: bytes) -> None:
        """Write a line to the stream. Disconnect the client if too much output is unsent."""
        self.stream.write(line)
        if self.stream.unsent_bytes > MAX_CLIENT_OUTPUT_BYTES:
            self.stream.abort()

    def _process_last_requests(self) -> None:
        """Process the last requests of a client that has closed its socket.

        The system reports this as a connection error, but the requests can still be read after that.
        """
        with contextlib.suppress(OSError):
            while data := self.stream.socket.recv(CONGESTION_BYTES):
                self._lines.extend(self._splitter.feed(data))
        while self._lines and self._bad_lines < MAX_BAD_LINES:
            self._process_line(self._lines.popleft())

    def _work(self) -> None:
        """Send some output, process some requests, and close the connection if it is done."""
        for _ in range(LINES_PER_TURN):
            if self.stream.closing or self.stream.congested or not self._send_or_process_one():
                break
        else:
            self._schedule_work()
        if self._half_closed and not self._lines:
            self._handler.input_ended(self)
        idle = not (self._outbox or self._lines or self.stream.congested)
        if idle and (self._finishing or (self._half_closed and not self._handler.is_waiting(self))):
            self.stream.close()
        self._update_reading()

    def _schedule_work(self) -> None:
        """Schedule `_work` for the next iteration of the event loop."""
        if not self._work_is_scheduled:
            self._work_is_scheduled = True
            self._loop.call_soon(self._do_scheduled_work)

    def _do_scheduled_work(self) -> None:
        """Call `_work`, and allow it to be scheduled again."""
        self._work_is_scheduled = False
        self._work()

    def _send_or_process_one(self) -> bool:
        """Send one line or process one request. Return False if there was nothing to do."""
        if self._outbox:
            first = self._outbox[0]
            if isinstance(first, bytes):
                self._outbox.popleft()
                self.stream.adjust_held_bytes(-len(first))
                self._write(first)
            elif (message := next(first, None)) is None:
                self._outbox.popleft()
            else:
                self._write(encode(message))
        elif self._held_feedback:
            held, self._held_feedback = self._held_feedback, b""
            self._write(held)
        elif self._lines:
            self._process_line(self._lines.popleft())
        else:
            return False
        return True

    def _process_line(self, line: bytes) -> None:
        """Pass the request in a line to the handler, or reply with an error.

        An urgent request admits the client.
        """
        seq = None
        try:
            message = decode(line)
            self._bad_lines = 0
            seq = take_seq(message)
            request = read_request(message)
        except BadRequest as error:
            # After a truncated line, the start of the next line is unknown.
            self._bad_lines += MAX_BAD_LINES if isinstance(line, TruncatedLine) else 1
            self.send(failure(seq, error.code, str(error)))
            if self._bad_lines >= MAX_BAD_LINES or not self.admitted:
                self.stream.close()
            return
        self._first_timer.cancel()
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
