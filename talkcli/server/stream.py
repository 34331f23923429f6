"""Code that accepts clients' connections, and reads and writes their sockets, in the event loop's thread.

Streams replace asyncio's transports and have a similar interface. There are three reasons for this:

- No request is lost. If a client closes its connection, asyncio's transport fails to write, stops reading, and drops
  the client's last requests.
- It is faster. A client is greeted, and its first request is carried out, in the same iteration of the event loop in
  which it connects.
- All messages of one iteration are sent together, because sending a message takes as long as creating it.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import resource
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.protocol.events import busy_greeting
from talkcli.protocol.lines import encode

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

#: Maximum number of bytes to read at once, equal to the maximum length of a request.
_READ_BYTES = 64 * 1024
#: Output of this size is sent without waiting for the end of the iteration.
_FLUSH_BYTES = 64 * 1024
#: If a client has more unread output than this, the server drops its feedback and stops reading its requests.
CONGESTION_BYTES = 256 * 1024
#: Maximum unread output of all clients together. Without a limit, 250 clients could use a gigabyte.
MAX_TOTAL_OUTPUT_BYTES = 64 * 1024 * 1024

#: Maximum number of connections to accept at once. Each new client may send requests immediately.
ACCEPTS_PER_TURN = 8
#: File descriptors reserved for the server: nine to restart the engine while the old process still exists, two to bind
#: the socket again, one to look up a client's process, and some to spare.
RESERVED_DESCRIPTORS = 16
#: File descriptors used by a server without clients: fourteen of its own, six for the history, and two for libraries.
OWN_DESCRIPTORS = 22
_TOO_FEW_DESCRIPTORS = (
    "the server has too few file descriptors for more clients; raise LimitNOFILE= of its unit, or ulimit -n before "
    "talk serve"
)
#: How long to wait after an error before accepting connections again.
ACCEPT_RETRY_S = 1.0
#: Errors of `accept` when there is no connection to accept.
_NO_CONNECTION = {errno.EAGAIN, errno.ECONNABORTED, errno.EPROTO, errno.EINTR}


class ClientStreams:
    """The streams of all clients, which share a limit for unread output.

    The output is sent at the end of each iteration of the event loop, in one callback for all streams. This saves a
    third of the time if fifty clients watch the words.
    """

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.open: set[ClientStream] = set()
        #: total size of the unread output
        self.unread_bytes = 0
        #: streams with new output in this iteration, in the order of their first output
        self._written: dict[ClientStream, None] = {}

    def shed_load(self) -> None:
        """Disconnect the clients with the most unread output until the total is within the limit."""
        while self.unread_bytes > MAX_TOTAL_OUTPUT_BYTES and self.open:
            max(self.open, key=lambda each: each.unsent_bytes + each.held_bytes).abort()
            total = MAX_TOTAL_OUTPUT_BYTES >> 20
            log.write_limited("output", f"disconnected a client that doesn't read ({total} MiB are unread in total)")

    def flush_later(self, stream: ClientStream) -> None:
        """Schedule a stream's output to be sent at the end of this iteration of the event loop."""
        if not self._written:
            self.loop.call_soon(self._flush_written)
        self._written[stream] = None

    def _flush_written(self) -> None:
        """Send the output that was written in this iteration."""
        written, self._written = self._written, {}
        for stream in written:
            try:
                stream.flush()
            except Exception as error:  # noqa: BLE001 - the output of other clients must still be sent
                stream.abort()
                log.write_bug("the output to a client", error)


class ClientStream:
    """A client's socket, with buffered output.

    The socket is closed after `connection_lost` of its receiver has been called.
    """

    def __init__(self, streams: ClientStreams, connected: socket.socket, receiver: asyncio.Protocol) -> None:
        """Create the stream. Call `begin` or `resume_reading` to start reading.

        Args:
            streams: the streams of all clients.
            connected: the client's non-blocking socket.
            receiver: the protocol that gets the data. Its `connection_lost` is called in a later iteration.
        """
        self.socket = connected
        self._streams = streams
        self._loop = streams.loop
        self._receiver = receiver
        self._unread = bytearray()
        #: size of the output that the receiver holds back until the client catches up
        self.held_bytes = 0
        #: whether the stream was closed and accepts no more output
        self.closing = False
        #: whether the receiver should pause writing
        self.congested = False
        #: whether the socket's send buffer is full
        self._blocked = False
        self._reading = self._eof = False
        streams.open.add(self)

    # -- input

    def begin(self) -> None:
        """Send pending output and start reading.

        Data that has already arrived is read at once.
        """
        self.flush()
        self.resume_reading()
        if self._reading:
            self._read()

    def resume_reading(self) -> None:
        """Start reading again, unless the client has closed its end of the connection."""
        if not (self._reading or self._eof or self.closing):
            self._reading = True
            self._loop.add_reader(self.socket, self._read)

    def pause_reading(self) -> None:
        """Stop reading, so that the client has to wait."""
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self.socket)

    def _read(self) -> None:
        """Read once, and pass the data or the end of the input to the receiver."""
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
            self._receiver.eof_received()
        except Exception:
            self.abort()  # otherwise, the client would wait forever for a reply
            raise

    # -- output

    @property
    def unsent_bytes(self) -> int:
        """The size of the output that has not been sent yet."""
        return len(self._unread)

    def adjust_held_bytes(self, added_bytes: int) -> None:
        """Change the size of the held output. If the total is too large, disconnect slow clients."""
        if self in self._streams.open:
            self.held_bytes += added_bytes
            self._streams.unread_bytes += added_bytes
            self._streams.shed_load()

    def write(self, data: bytes) -> None:
        """Queue data for sending. If too much output is unread in total, disconnect the slowest clients."""
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
        """Send the output now, and set `closing` if the client has closed its socket."""
        if self._unread and not self._blocked:
            self._send()

    def close(self) -> None:
        """Stop reading, and close the stream after all output has been sent."""
        if self.closing:
            return
        self.closing = True
        self.pause_reading()
        if not self._unread:
            self.abort()

    def _send(self) -> None:
        """Send as much output as the socket accepts now.

        If the stream is closing, close it after the last byte.
        """
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
        """Tell the receiver to pause or resume writing, if necessary."""
        if not self.congested and len(self._unread) > CONGESTION_BYTES:
            self.congested = True
            self._receiver.pause_writing()
        elif self.congested and len(self._unread) <= CONGESTION_BYTES // 4:
            self.congested = False
            self._receiver.resume_writing()

    # -- closing

    def abort(self, error: OSError | None = None) -> None:
        """Drop the output, and close the stream without waiting for the client.

        Args:
            error: the error that broke the connection, if any.
        """
        if self not in self._streams.open:
            return
        if self.closing:
            error = None  # the server closed the connection first, so later requests are ignored
        self.closing = True
        self.pause_reading()
        if self._blocked:
            self._loop.remove_writer(self.socket)
        self._streams.open.discard(self)
        self._streams.unread_bytes -= len(self._unread) + self.held_bytes
        self._unread.clear()
        self._loop.call_soon(self._report_end, error)

    def _report_end(self, error: OSError | None) -> None:
        """Tell the receiver that the connection has ended, and close the socket."""
        with self.socket:
            self._receiver.connection_lost(error)


def raise_descriptor_limit(clients: int) -> int:
    """Try to raise the limit of open files for this many clients. Return the limit."""
    wanted = clients + RESERVED_DESCRIPTORS + OWN_DESCRIPTORS
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed, most = (2**31 if each == resource.RLIM_INFINITY else each for each in limits)
    if allowed < wanted:
        with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid this
            resource.setrlimit(resource.RLIMIT_NOFILE, (min(wanted, most), limits[1]))
            allowed = min(wanted, most)
    if allowed < wanted:
        fitting = max(0, allowed - RESERVED_DESCRIPTORS - OWN_DESCRIPTORS)
        log.write(
            f"the limit of {allowed} open files only allows {fitting} clients instead of {clients}; "
            f"raise LimitNOFILE= or ulimit -n to {wanted}"
        )
    return allowed


class Acceptor:
    """Accepts connections on a listening socket.

    Some descriptors stay reserved for the engine.
    """

    def __init__(self, serve: Callable[[socket.socket], None], max_descriptors: int) -> None:
        """Create the acceptor. Call `open` to start.

        Args:
            serve: function that is called with each connected socket and has to close it.
            max_descriptors: this process's limit of file descriptors.
        """
        self._loop = asyncio.get_running_loop()
        self._serve = serve
        self._max_descriptors = max_descriptors
        self._listening: socket.socket | None = None
        self._retry: asyncio.TimerHandle | None = None

    def open(self, listening: socket.socket) -> None:
        """Start accepting connections on this socket instead of an earlier one."""
        self.close()
        self._listening = listening
        self._loop.add_reader(listening, self._accept, listening)

    def close(self) -> None:
        """Stop accepting connections. Call this before the listening socket is closed."""
        if self._retry:
            self._retry.cancel()
            self._retry = None
        if self._listening:
            self._loop.remove_reader(self._listening)
            self._listening = None

    def _accept(self, listening: socket.socket) -> None:
        """Accept some of the waiting connections, and pass them to `serve`.

        Pause for a second after an error.
        """
        for _ in range(ACCEPTS_PER_TURN):
            try:
                connected, _ = listening.accept()
            except OSError as error:
                if error.errno not in _NO_CONNECTION:
                    # The event loop would retry at once, so pause. New connections stay in the backlog.
                    message = f"can't accept connections: {error.strerror}; trying again every second"
                    log.write_limited("accept", message)
                    self.close()
                    self._retry = self._loop.call_later(ACCEPT_RETRY_S, self.open, listening)
                return
            connected.setblocking(False)
            # New descriptors get the lowest free number, so a high number means that few are left.
            if connected.fileno() >= self._max_descriptors - RESERVED_DESCRIPTORS:
                self._turn_away(connected)
                continue
            try:
                self._serve(connected)
            except Exception as error:  # noqa: BLE001 - other connections must not be affected
                log.write_bug("a new connection", error)
                connected.close()

    def _turn_away(self, connected: socket.socket) -> None:
        """Refuse a connection because the server has too few file descriptors."""
        limit = f"the limit of {self._max_descriptors} open files was reached; raise LimitNOFILE= or ulimit -n"
        log.write_limited("descriptors", f"refused a client: {limit}")
        with connected, contextlib.suppress(OSError):  # the client may have closed the connection
            connected.send(encode(busy_greeting(_TOO_FEW_DESCRIPTORS)))
