"""The sockets of clients, in the event loop's thread: accepted, read and written. It knows no lines and no requests.

A stream is used like a transport of asyncio, and replaces it for three reasons. No request is lost: asyncio's transport
stops reading when it can't write, and drops the last requests of a client that closes. It is faster: a client is
greeted in the turn of the loop in which it connects, a third sooner, and its first request is carried out in the same
turn. And all messages of one turn are sent together, because sending a message costs as much as making it.
"""

from __future__ import annotations

import contextlib
import errno
import resource
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.protocol.events import busy_greeting
from talkcli.protocol.lines import encode

if TYPE_CHECKING:
    import asyncio
    import socket
    from collections.abc import Callable

#: Bytes that are read at once: the longest request.
_READ_BYTES = 64 * 1024
#: Written bytes of a stream, past which they are sent before the turn ends.
_FLUSH_BYTES = 64 * 1024
#: Unread output of all clients together. 250 clients could hold a gigabyte within their own limits.
MAX_TOTAL_OUTPUT_BYTES = 64 * 1024 * 1024
#: Streams with new output, past which they are flushed before the turn ends. With a thousand clients, the first ones
#: can read their result while those of the others are being written.
_FLUSH_STREAMS = 128

#: Connections that are accepted before other clients have a turn. Each is greeted, and may send requests at once.
ACCEPTS_PER_TURN = 8
#: Descriptors that clients can't use: nine for a restart of the engine, beside those of the old process; two for a new
#: socket and its lock; one to look up a client's process.
RESERVED_DESCRIPTORS = 16
#: Descriptors of a server without clients: fourteen, and two for libraries.
OWN_DESCRIPTORS = 16
_TOO_FEW_DESCRIPTORS = (
    "the server has too few file descriptors for more clients: raise LimitNOFILE= of its unit, or ulimit -n before "
    "talk serve"
)
#: How long to wait if no connection can be accepted.
ACCEPT_RETRY_S = 1.0
#: Errors of `accept` that mean that the system has run out of something. The connection waits.
_EXHAUSTED = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
#: Errors of `accept` that mean that there is no connection, or not any more.
_NO_CONNECTION = {errno.EAGAIN, errno.ECONNABORTED, errno.EPROTO, errno.EINTR}


class ClientStreams:
    """The streams of all clients of one event loop.

    It flushes them at the end of each turn and limits their unread output. One callback for all streams is cheaper than
    one for each: it saves a third of the time for a word that fifty clients watch.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        #: the streams that have not ended
        self.open: set[ClientStream] = set()
        #: unread output of all streams
        self.unread_bytes = 0
        #: the streams with new output in this turn, in their order
        self._written: dict[ClientStream, None] = {}

    def shed_load(self) -> None:
        """Drop the clients with the most unread output until the rest is within the limit."""
        while self.unread_bytes > MAX_TOTAL_OUTPUT_BYTES and self.open:
            max(self.open, key=lambda each: each.unsent_bytes + each.held_bytes).abort()
            total = MAX_TOTAL_OUTPUT_BYTES >> 20
            log.write_limited("output", f"a client that doesn't read is let go: {total} MiB wait for all together")

    def flush_later(self, stream: ClientStream) -> None:
        """Send the output of a stream at the end of this turn."""
        if not self._written:
            self.loop.call_soon(self._flush)
        self._written[stream] = None
        if len(self._written) >= _FLUSH_STREAMS:
            self._flush()

    def _flush(self) -> None:
        written, self._written = self._written, {}
        for stream in written:
            try:
                stream.flush()
            except Exception as error:  # noqa: BLE001 - the other clients still get their answers
                stream.abort()
                log.write_bug("sending to a client", error)


class ClientStream:
    """The socket of one client. It is closed after the receiver has been told of the end."""

    def __init__(
        self, streams: ClientStreams, connected: socket.socket, receiver: asyncio.Protocol, congestion_bytes: int
    ) -> None:
        """Create the stream; call `begin` or `resume_reading` to read.

        Args:
            streams: the streams of all clients.
            connected: the client's non-blocking socket.
            receiver: is called with the data. It learns of the end in a turn of its own, with the error, if any.
            congestion_bytes: unread output past which the receiver is told to pause.
        """
        self.socket = connected
        self._streams = streams
        self._loop = streams.loop
        self._receiver = receiver
        self._congestion_bytes = congestion_bytes
        self._unread = bytearray()
        #: bytes that the receiver keeps until the client has read what was sent before
        self.held_bytes = 0
        #: whether nothing more can be written
        self.closing = False
        #: whether the receiver was told to pause
        self.congested = False
        #: whether the output waits until the client reads
        self._blocked = False
        self._reading = self._eof = False
        streams.open.add(self)

    # -- input

    def begin(self) -> None:
        """Send what is written, and read from now on, at once if there is data already."""
        self.flush()
        self.resume_reading()
        if self._reading:
            self._read()

    def resume_reading(self) -> None:
        """Read from the client, unless all was read."""
        if not (self._reading or self._eof or self.closing):
            self._reading = True
            self._loop.add_reader(self.socket, self._read)

    def pause_reading(self) -> None:
        """Stop reading, so that the client has to wait."""
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self.socket)

    def _read(self) -> None:
        try:
            data = self.socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self.abort(error)
            return
        try:
            if data:
                self._receiver.data_received(data)
                return
            self.pause_reading()
            self._eof = True
            if not self._receiver.eof_received():
                self.close()
        except Exception:
            self.abort()  # otherwise the client would wait for an answer
            raise

    # -- output

    @property
    def unsent_bytes(self) -> int:
        """The number of bytes that are written and not sent."""
        return len(self._unread)

    def count_held(self, size_bytes: int) -> None:
        """Count bytes that the receiver keeps for the client, or with a negative size, no longer keeps."""
        if self in self._streams.open:
            self.held_bytes += size_bytes
            self._streams.unread_bytes += size_bytes
            self._streams.shed_load()

    def write(self, data: bytes) -> None:
        """Send data at the end of this turn, or when the client has read what was sent before."""
        if self.closing:
            return
        self._unread += data
        self._streams.unread_bytes += len(data)
        if self._blocked:
            self._report_congestion()
        elif len(self._unread) >= _FLUSH_BYTES:
            self._send()
        else:
            self._streams.flush_later(self)
        self._streams.shed_load()

    def flush(self) -> None:
        """Send what is written now. If this shows that the client is gone, the stream is `closing`."""
        if self._unread and not self._blocked:
            self._send()

    def close(self) -> None:
        """Close the stream when what is written has been sent."""
        if self.closing:
            return
        self.closing = True
        self.pause_reading()
        if not self._unread:
            self.abort()

    def _send(self) -> None:
        try:
            sent = self.socket.send(self._unread)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self.abort(error)
            return
        del self._unread[:sent]
        self._streams.unread_bytes -= sent
        if self._unread and not self._blocked:
            self._blocked = True
            self._loop.add_writer(self.socket, self._send)
        elif self._blocked and not self._unread:
            self._blocked = False
            self._loop.remove_writer(self.socket)
        if self.closing and not self._unread:
            self.abort()
        else:
            self._report_congestion()

    def _report_congestion(self) -> None:
        if not self.congested and len(self._unread) > self._congestion_bytes:
            self.congested = True
            self._receiver.pause_writing()
        elif self.congested and len(self._unread) <= self._congestion_bytes // 4:
            self.congested = False
            self._receiver.resume_writing()

    # -- the end

    def abort(self, error: OSError | None = None) -> None:
        """Close the stream now. `error`: why the connection broke."""
        if self not in self._streams.open:
            return
        if self.closing:
            error = None  # the server closed first, so later requests don't count
        self.closing = True
        self.pause_reading()
        if self._blocked:
            self._loop.remove_writer(self.socket)
        self._streams.open.discard(self)
        self._streams.unread_bytes -= len(self._unread) + self.held_bytes
        self.held_bytes = 0
        self._unread.clear()
        self._loop.call_soon(self._report_end, error)

    def _report_end(self, error: OSError | None) -> None:
        try:
            self._receiver.connection_lost(error)
        finally:
            self.socket.close()


def raise_descriptor_limit(clients: int) -> int:
    """Raise this process's limit of descriptors to what this number of clients needs. Return the limit."""
    wanted = clients + RESERVED_DESCRIPTORS + OWN_DESCRIPTORS
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed, most = (2**31 if each == resource.RLIM_INFINITY else each for each in limits)
    if allowed < wanted:
        with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid it
            resource.setrlimit(resource.RLIMIT_NOFILE, (min(wanted, most), limits[1]))
            allowed = min(wanted, most)
    if allowed < wanted:
        fitting = max(0, allowed - RESERVED_DESCRIPTORS - OWN_DESCRIPTORS)
        log.write(
            f"{allowed} files may be open: {fitting} clients fit, not {clients}; "
            f"raise LimitNOFILE= or ulimit -n to {wanted}"
        )
    return allowed


class Acceptor:
    """Accepts the connections of a listening socket, but leaves the descriptors that the engine needs."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, serve: Callable[[socket.socket], None], max_descriptors: int
    ) -> None:
        """Create the acceptor; call `open` next.

        Args:
            loop: the event loop.
            serve: is called with each connection, and has to close it.
            max_descriptors: the number of descriptors that this process may have.
        """
        self._loop = loop
        self._serve = serve
        self._max_descriptors = max_descriptors
        self._listening: socket.socket | None = None
        self._retry: asyncio.TimerHandle | None = None

    def open(self, listening: socket.socket) -> None:
        """Accept the connections of this socket and of no other."""
        self.close()
        self._listening = listening
        self._loop.add_reader(listening, self._accept, listening)

    def close(self) -> None:
        """Accept no more connections. Call this before the socket is closed."""
        if self._retry:
            self._retry.cancel()
            self._retry = None
        if self._listening:
            self._loop.remove_reader(self._listening)
            self._listening = None

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(ACCEPTS_PER_TURN):
            try:
                connected, _ = listening.accept()
            except OSError as error:
                if error.errno not in _NO_CONNECTION:
                    self._pause(listening, error)
                return
            connected.setblocking(False)
            # The system gives the lowest free number, which tells how many descriptors are left.
            if connected.fileno() >= self._max_descriptors - RESERVED_DESCRIPTORS:
                self._turn_away(connected)
                continue
            try:
                self._serve(connected)
            except Exception as error:  # noqa: BLE001 - the other connections go on
                log.write_bug("making a connection", error)
                connected.close()

    def _turn_away(self, connected: socket.socket) -> None:
        """Tell a client that the server is full."""
        log.write_limited(
            "descriptors",
            f"clients are turned away: only {self._max_descriptors} files may be open (raise LimitNOFILE= or ulimit "
            "-n)",
        )
        with connected, contextlib.suppress(OSError):  # the client is gone
            connected.send(encode(busy_greeting(_TOO_FEW_DESCRIPTORS)))

    def _pause(self, listening: socket.socket, error: OSError) -> None:
        """Accept no connections for a while, because the loop would try again without a pause."""
        if error.errno not in _EXHAUSTED:
            log.write_bug("taking up a connection", error)
        log.write_limited("accept", f"no connection can be taken up: {error.strerror}; they wait until one can")
        self.close()
        self._retry = self._loop.call_later(ACCEPT_RETRY_S, self.open, listening)
