"""One client's connection: lines in, objects out, and its limits. It neither decides nor waits.

What is asked goes to a `Handler` and comes back through `reply`, `stream` and `publish`. A client that doesn't read is
not read from either; feedback for it is dropped, and at last the client itself.
"""

from __future__ import annotations

import contextlib
from collections import deque
from itertools import chain
from typing import TYPE_CHECKING, Protocol

from talkcli.errors import BadRequest, LineTooLong
from talkcli.frozen import replace
from talkcli.goals.options import Cancel
from talkcli.protocol import replies
from talkcli.protocol.lines import RequestSplitter, decode, encode
from talkcli.protocol.requests import Hello, Request, Status, read_request
from talkcli.server.stream import Stream

if TYPE_CHECKING:
    import asyncio
    import socket
    from collections.abc import Iterable, Iterator

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

    #: shared by all its connections
    streams: Streams

    def greeting(self) -> JsonObject:
        """Return the first line for a client that is let in."""

    def joined(self, connection: Connection, stream: Stream) -> None:
        """Look who it is: admit a client, let it wait at the door, or close."""

    def left(self, connection: Connection) -> None:
        """Forget a client that is gone."""

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request, and answer it now or later."""

    def owes(self, connection: Connection) -> bool:
        """Whether a client waits for something: then its connection stays open though it sends nothing more."""


class Connection:
    """A client. One that is not `admitted` waits at the door of a full server until it says that it is urgent."""

    def __init__(self, handler: Handler, loop: asyncio.AbstractEventLoop, connected: socket.socket) -> None:
        """`connected`: the client's socket, which doesn't block; it is closed with the connection."""
        #: set by the handler when the client joins
        self.sender: Sender
        self.admitted = False
        self._handler = handler
        self._loop = loop
        self._stream = Stream(loop, handler.streams, connected, self, SOFT_OUTPUT)
        self._splitter = RequestSplitter()
        self._lines: deque[bytes] = deque()
        #: what has to be sent in its order while a list is on its way: lists, and what came after them
        self._outbox: deque[Iterator[JsonObject] | bytes] = deque()
        self._newest: bytes | None = None
        self._congested = self._half_closed = self._turn_is_due = False
        self._bad_lines = 0
        self._first_limit: asyncio.TimerHandle | None = None
        self._line_limit: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Greet the client, if it is let in, and take its requests from now on."""
        self._handler.joined(self, self._stream)
        if not self._open:
            return
        self._first_limit = self._loop.call_later(
            FIRST_REQUEST, self.refuse, "too_slow", f"no request came within {FIRST_REQUEST:g} s"
        )
        if self.admitted:
            self._write(self._handler.greeting())
            self._stream.begin()
        else:
            # Not at once: the end of another client may have come before, and be seen only later in this turn.
            self._loop.call_soon(self._stream.resume_reading)

    def admit(self) -> None:
        """Let a client in that has waited at the door."""
        self.admitted = True
        self._write(self._handler.greeting())

    # -- what the stream calls

    def connection_lost(self, error: OSError | None) -> None:
        for limit in (self._first_limit, self._line_limit):
            if limit:
                limit.cancel()
        if error is not None and self.admitted:
            self._hear_last_requests()
        self._lines.clear()
        self._outbox.clear()
        self._handler.left(self)

    def data_received(self, data: bytes) -> None:
        try:
            self._lines.extend(self._splitter.feed(data))
        except LineTooLong as error:
            self._lines.extend(error.before)
            while self._open and not self._congested and self._step():
                pass  # they were asked for, and are answered
            self.refuse(error.code, str(error))
            return
        if b"\n" in data:
            self._stop_line_limit()  # what follows the newline is another line
        self._work()
        self._set_reading()

    def eof_received(self) -> bool:
        self._half_closed = True
        self._work()
        return self._open

    def pause_writing(self) -> None:
        self._congested = True
        self._set_reading()

    def resume_writing(self) -> None:
        self._congested = False
        self._work()
        self._set_reading()

    # -- what the handler calls

    def reply(self, message: JsonObject) -> None:
        """Answer a request."""
        self._send(message)

    def stream(self, items: Iterable[JsonObject], reply: JsonObject, events: Iterable[JsonObject] = ()) -> None:
        """Send a list, as fast as the client reads, its reply, and events that belong to it; what comes after waits."""
        self._outbox.append(chain(items, [reply], events))
        self._ask_for_a_turn()

    def publish(self, event: bytes, *, feedback: bool = False) -> None:
        """Send an encoded event. Feedback is dropped, all but the newest, while the client doesn't read."""
        if feedback and self._congested:
            self._newest = event
            return
        if self._newest:  # what was the newest is older than this
            newest, self._newest = self._newest, None
            self._send(newest)
        self._send(event)

    def has_hung_up(self) -> bool:
        """Return whether the client can't be told anything more, as far as can be known by telling it what there is."""
        self._stream.flush()
        return not self._open

    def refuse(self, code: str, words: str) -> None:
        """Say why, and close."""
        self._write(replies.failure(None, code, words))
        self.close()

    def close(self) -> None:
        """Close once what was written is sent."""
        self._stream.close()

    def drop(self) -> None:
        """Close at once."""
        self._stream.abort()

    # -- inside

    @property
    def _open(self) -> bool:
        """Whether more can be sent."""
        return not self._stream.closing

    def _send(self, message: JsonObject | bytes) -> None:
        """Send a message after the lists that are on their way."""
        if self._half_closed:  # it may be the last that is owed. Not at once: another request must wait meanwhile
            self._ask_for_a_turn()
        if not self._outbox:
            self._write(message)
        elif len(self._outbox) < MAX_HELD:
            line = message if isinstance(message, bytes) else encode(message)
            self._outbox.append(line)
            self._stream.hold(len(line))
        else:
            self.drop()

    def _set_reading(self) -> None:
        """Read from the client only while it takes its answers and its requests are kept up with."""
        if not self._open:
            return
        reading = not self._congested and len(self._lines) <= READ_AHEAD
        if reading:
            self._stream.resume_reading()
        else:
            self._stream.pause_reading()
        if not reading or not self._splitter.size:
            self._stop_line_limit()
        elif self._line_limit is None:
            self._line_limit = self._loop.call_later(
                LINE_LIMIT, self.refuse, "too_slow", f"a line took more than {LINE_LIMIT:g} s"
            )

    def _stop_line_limit(self) -> None:
        if self._line_limit:
            self._line_limit.cancel()
            self._line_limit = None

    def _write(self, message: JsonObject | bytes) -> None:
        self._stream.write(message if isinstance(message, bytes) else encode(message))
        if self._stream.size > HARD_OUTPUT:
            self.drop()

    def _hear_last_requests(self) -> None:
        """Take what a client sent that closed without reading: the error hid it, but it is still in the socket."""
        try:
            with contextlib.suppress(OSError):
                while data := self._stream.socket.recv(SOFT_OUTPUT):
                    self._lines.extend(self._splitter.feed(data))
        except LineTooLong as error:
            self._lines.extend(error.before)
        while self._lines and self._bad_lines < MAX_BAD_LINES:
            self._take(self._lines.popleft())

    def _work(self) -> None:
        """Do what can be done now: send the lists and what was held back for them, then take requests."""
        for _ in range(TURN):
            if not self._open or self._congested or not self._step():
                break
        else:
            self._ask_for_a_turn()
            return
        idle = not (self._outbox or self._lines or self._congested)
        if self._half_closed and idle and not self._handler.owes(self):
            self.close()

    def _ask_for_a_turn(self) -> None:
        if not self._turn_is_due:
            self._turn_is_due = True
            self._loop.call_soon(self._next_turn)

    def _next_turn(self) -> None:
        self._turn_is_due = False
        self._work()
        self._set_reading()

    def _step(self) -> bool:
        if self._outbox:
            first = self._outbox[0]
            if isinstance(first, bytes):
                self._outbox.popleft()
                self._stream.hold(-len(first))
                self._write(first)
            elif (message := next(first, None)) is None:
                self._outbox.popleft()
            else:
                self._write(message)
        elif self._newest:
            newest, self._newest = self._newest, None
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
            seq = replies.take_seq(message)
            request = read_request(message)
        except BadRequest as error:
            self._bad_lines += 1
            self.reply(replies.failure(seq, error.code, str(error)))
            if self._bad_lines >= MAX_BAD_LINES or not self.admitted:
                self.close()
            return
        if self._first_limit:
            self._first_limit.cancel()
            self._first_limit = None
        if not self.admitted and not self._let_in(request):
            return
        if isinstance(request, Hello):
            self.sender = replace(self.sender, name=request.name)
            self.reply(replies.ok(seq))
        else:
            self._handler.handle(self, seq, request)

    def _let_in(self, request: Request) -> bool:
        """Let a client in whose business is urgent; send the others away from a full server."""
        if isinstance(request, Status | Cancel) or (isinstance(request, Hello) and request.urgent):
            self.admit()
            return True
        self._write(replies.busy_greeting())
        self.close()
        return False
