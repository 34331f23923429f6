"""One client's connection: lines in, objects out, and its limits. It neither decides nor waits.

What is asked goes to a `Handler` and comes back through `send`, `send_list` and `publish`. A client that doesn't read
is not read from either; feedback for it is dropped, and at last the client itself.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from typing import TYPE_CHECKING, Protocol

from talkcli.errors import BadRequest
from talkcli.frozen import replace
from talkcli.goals.options import Cancel
from talkcli.protocol.events import busy_greeting, failure, ok, take_seq
from talkcli.protocol.lines import MAX_LINE_BYTES, LineSplitter, TruncatedLine, decode, encode
from talkcli.protocol.requests import Hello, Request, Status, read_request
from talkcli.server.stream import Stream

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterator

    from talkcli.goals.goal import JsonObject, Sender
    from talkcli.server.stream import Streams

#: Bytes that may wait for a client before feedback for it is dropped, and before its requests are left unread.
SOFT_OUTPUT = 256 * 1024
#: Bytes that may wait for a client that doesn't read its results, before it is let go.
HARD_OUTPUT = 4 * 1024 * 1024
#: Messages held back while a list is sent to a client that reads it slowly, before it is let go.
MAX_HELD = 10_000
#: Seconds from connecting to the first complete request: clients send `hello` at once.
FIRST_REQUEST = 5.0
#: Seconds in which a line that was begun must end.
LINE_LIMIT = 10.0
#: Lines in a row that aren't JSON, after which the other end is taken for something that is no client.
MAX_BAD_LINES = 10
#: Lines taken from one client before the others have their turn: a hundred that send as fast as they can, each line a
#: tenth of a millisecond or two, keep nobody waiting for longer than a tenth of a second.
TURN = 8
#: Lines taken from the socket and not yet answered, past which a client is not read from.
READ_AHEAD = 64


class Handler(Protocol):
    """What a connection needs of the server."""

    #: the first line for a client that is let in
    greeting: bytes

    def joined(self, connection: Connection) -> None:
        """Look who it is: admit a client, let it wait at the door, or close."""

    def left(self, connection: Connection) -> None:
        """Forget a client that is gone."""

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request, and answer it now or later."""

    def owes(self, connection: Connection) -> bool:
        """Whether a client waits for something: then its connection stays open though it sends nothing more."""


class Connection(asyncio.Protocol):
    """A client. One that is not `admitted` waits at the door of a full server until it says that it is urgent."""

    def __init__(self, handler: Handler, streams: Streams, connected: socket.socket) -> None:
        """`connected`: the client's socket, which doesn't block; it is closed with the connection."""
        #: set by the handler when the client joins
        self.sender: Sender
        self.admitted = False
        self.stream = Stream(streams, connected, self, SOFT_OUTPUT)
        self._handler = handler
        self._loop = streams.loop
        self._splitter = LineSplitter(MAX_LINE_BYTES - 1)
        self._lines: deque[bytes] = deque()
        #: what has to be sent in its order while a list is on its way: lists, and what came after them
        self._outbox: deque[Iterator[JsonObject] | bytes] = deque()
        #: the newest feedback that is held back, if there is one
        self._newest = b""
        self._half_closed = self._turn_is_due = False
        self._bad_lines = 0
        self._first_limit = self._limit(FIRST_REQUEST, f"no request came within {FIRST_REQUEST:g} s")
        self._line_limit: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Take the client's requests from now on, if it is let in."""
        self._handler.joined(self)
        if self.admitted:
            self.stream.begin()
        else:
            # Not at once: the end of another client may have come before, and be seen only later in this turn.
            self._loop.call_soon(self.stream.resume_reading)

    def admit(self) -> None:
        """Let the client in: greet it."""
        self.admitted = True
        self._write(self._handler.greeting)

    # -- what the stream calls

    def connection_lost(self, error: Exception | None) -> None:
        self._first_limit.cancel()
        self._stop_line_limit()
        if error is not None and self.admitted:
            self._hear_last_requests()
        self._lines.clear()
        self._outbox.clear()
        self._handler.left(self)

    def data_received(self, data: bytes) -> None:
        self._lines.extend(self._splitter.feed(data))
        if self._splitter.size >= MAX_LINE_BYTES:
            self._lines.append(self._splitter.take_rest())  # its end need not be awaited
        if b"\n" in data:
            self._stop_line_limit()  # what follows the newline is another line
        self._work()

    def eof_received(self) -> bool:
        self._half_closed = True
        self._work()
        return not self.stream.closing

    def pause_writing(self) -> None:
        self._set_reading()

    def resume_writing(self) -> None:
        self._work()

    # -- what the handler calls

    def send(self, message: JsonObject | bytes) -> None:
        """Send a reply, or what is encoded, after the lists that are on their way."""
        if self._half_closed:  # it may be the last that is owed. Not at once: another request must wait meanwhile
            self._ask_for_a_turn()
        line = message if isinstance(message, bytes) else encode(message)
        if not self._outbox:
            self._write(line)
        elif len(self._outbox) < MAX_HELD:
            self._outbox.append(line)
            self.stream.hold(len(line))
        else:
            self.stream.abort()

    def send_list(self, messages: Iterator[JsonObject]) -> None:
        """Send a list, as fast as the client reads, its reply, and what belongs to it; what comes after waits."""
        self._outbox.append(messages)
        self._ask_for_a_turn()

    def publish(self, event: bytes, *, feedback: bool = False) -> None:
        """Send an encoded event. Feedback is dropped, all but the newest, while the client doesn't read."""
        if feedback and self.stream.congested:
            self._newest = event
        else:
            newest, self._newest = self._newest, b""
            self.send(newest + event)

    def has_hung_up(self) -> bool:
        """Return whether the client can't be told anything more, as far as can be known by telling it what there is."""
        self.stream.flush()
        return self.stream.closing

    def part(self, last: JsonObject) -> None:
        """Say this, and close."""
        self._write(encode(last))
        self.stream.close()

    # -- inside

    def _limit(self, seconds: float, words: str) -> asyncio.TimerHandle:
        return self._loop.call_later(seconds, self.part, failure(None, "too_slow", words))

    def _may_go_on(self) -> bool:
        """Whether the client can be told more, and takes it."""
        return not (self.stream.closing or self.stream.congested)

    def _set_reading(self) -> None:
        """Read from the client only while it takes its answers and its requests are kept up with."""
        if self.stream.closing:
            return
        reading = not self.stream.congested and len(self._lines) <= READ_AHEAD
        if reading:
            self.stream.resume_reading()
        else:
            self.stream.pause_reading()
        if not reading or not self._splitter.size:
            self._stop_line_limit()
        elif self._line_limit is None:
            self._line_limit = self._limit(LINE_LIMIT, f"a line took more than {LINE_LIMIT:g} s")

    def _stop_line_limit(self) -> None:
        if self._line_limit:
            self._line_limit.cancel()
            self._line_limit = None

    def _write(self, line: bytes) -> None:
        self.stream.write(line)
        if self.stream.size > HARD_OUTPUT:
            self.stream.abort()

    def _hear_last_requests(self) -> None:
        """Take what a client sent that closed without reading: the error hid it, but it is still in the socket."""
        with contextlib.suppress(OSError):
            while data := self.stream.socket.recv(SOFT_OUTPUT):
                self._lines.extend(self._splitter.feed(data))
        while self._lines and self._bad_lines < MAX_BAD_LINES:
            self._take(self._lines.popleft())

    def _work(self) -> None:
        """Do what can be done now: send the lists and what was held back for them, then take requests."""
        for _ in range(TURN):
            if not (self._may_go_on() and self._step()):
                break
        else:
            self._ask_for_a_turn()
        idle = not (self._outbox or self._lines or self.stream.congested)
        if self._half_closed and idle and not self._handler.owes(self):
            self.stream.close()
        self._set_reading()

    def _ask_for_a_turn(self) -> None:
        if not self._turn_is_due:
            self._turn_is_due = True
            self._loop.call_soon(self._next_turn)

    def _next_turn(self) -> None:
        self._turn_is_due = False
        self._work()

    def _step(self) -> bool:
        if self._outbox:
            first = self._outbox[0]
            if isinstance(first, bytes):
                self._outbox.popleft()
                self.stream.hold(-len(first))
                self._write(first)
            elif (message := next(first, None)) is None:
                self._outbox.popleft()
            else:
                self._write(encode(message))
        elif self._newest:
            newest, self._newest = self._newest, b""
            self._write(newest)
        elif self._lines:
            self._take(self._lines.popleft())
        else:
            return False
        return True

    def _take(self, line: bytes) -> None:
        seq = None
        try:
            message = decode(line)
            self._bad_lines = 0
            seq = take_seq(message)
            request = read_request(message)
        except BadRequest as error:
            self._bad_lines += MAX_BAD_LINES if isinstance(line, TruncatedLine) else 1  # nobody knows what follows it
            self.send(failure(seq, error.code, str(error)))
            if self._bad_lines >= MAX_BAD_LINES or not self.admitted:
                self.stream.close()
            return
        self._first_limit.cancel()
        if not self.admitted:
            # Whose business is urgent comes in; a full server sends the others away.
            if not (isinstance(request, Status | Cancel) or (isinstance(request, Hello) and request.urgent)):
                self.part(busy_greeting())
                return
            self.admit()
        if isinstance(request, Hello):
            self.sender = replace(self.sender, name=request.name)
            self.send(ok(seq))
        else:
            self._handler.handle(self, seq, request)
