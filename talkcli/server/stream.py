"""Clients' sockets, in the event loop's thread: taken up, bytes in, bytes out. It knows no lines and no requests.

A stream is used as a transport of asyncio's would be, and replaces that for three reasons. It loses nothing: asyncio's
reads no more as soon as a greeting or an event could not be sent, and what a client sent that closed without reading
would be gone with it. It is there at once: a client is greeted, and its first request carried out, in the turn of the
loop in which it connects, not three turns later: the greeting comes in two thirds of the time. And what is written in
one turn goes out in one piece: the reply to a goal that starts at once and its events are three messages, its end is
two, and to send one costs as much as to make it.

Who takes up connections looks at no client, and leaves the engine the descriptors that it needs.
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

#: Bytes that are read in one go: the longest request line.
_READ = 64 * 1024
#: Bytes after which what was written is sent before the turn ends.
_PIECE = 64 * 1024
#: Bytes that may wait for all clients together: 250 that don't read would hold a gigabyte within the limit of each.
ALL_OUTPUT = 64 * 1024 * 1024
#: Clients after which it is: the first of a thousand can read their result while that of the others is written.
_CROWD = 128

#: Connections taken up before those that are there have their turn: each is greeted, and may have a turn of requests.
AT_ONCE = 8
#: Descriptors that clients can't have: a restart of the engine takes nine besides those of the process that ends, a new
#: socket and its lock two, a look at a client's process one.
RESERVE = 16
#: Descriptors that a server has without clients: fourteen, and two for what a library may open.
OWN = 16
#: What a client is told if the server has no descriptor left for it.
_TOO_FEW_DESCRIPTORS = (
    "the server has too few file descriptors for more clients: raise LimitNOFILE= of its unit, or ulimit -n before "
    "talk serve"
)
#: Seconds until it looks again where no connection could be taken up.
RETRY_AFTER = 1.0
#: What the system says that has nothing left to take up a connection with; the connection waits.
_USED_UP = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
#: What it says of a connection that is gone again, or that there is none after all.
_NONE_THERE = {errno.EAGAIN, errno.ECONNABORTED, errno.EPROTO, errno.EINTR}


class Streams:
    """The streams of one event loop: what was written in a turn of it is sent at its end, and how much may wait in all.

    One callback for all: one for each would make a word that fifty watchers are told of half as dear again.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        #: those that have not ended
        self.open: set[Stream] = set()
        #: bytes that wait in all of them
        self.waiting = 0
        #: those in which something was written in this turn, in their order
        self._due: dict[Stream, None] = {}

    def relieve(self) -> None:
        """Let the clients go for which most waits, until no more waits for all of them than may."""
        while self.waiting > ALL_OUTPUT and self.open:
            most = max(self.open, key=lambda each: each.size + each.held)
            most.abort()
            log.write_limited(
                "output", f"a client that doesn't read is let go: {ALL_OUTPUT >> 20} MiB wait for all together"
            )

    def add(self, stream: Stream) -> None:
        """Have what was written in this stream sent at the end of this turn."""
        if not self._due:
            self.loop.call_soon(self._flush)
        self._due[stream] = None
        if len(self._due) >= _CROWD:
            self._flush()

    def _flush(self) -> None:
        due, self._due = self._due, {}
        for stream in due:
            try:
                stream.flush()
            except Exception as error:  # noqa: BLE001 - one client's must not take the others' answers
                stream.abort()
                log.write_bug("sending to a client", error)


class Stream:
    """The socket of one client; it is closed at the end, and not before the receiver has been told."""

    def __init__(self, streams: Streams, connected: socket.socket, receiver: asyncio.Protocol, high: int) -> None:
        """`streams`: all of this loop; `high`: bytes that may wait before the receiver is told so.

        The receiver learns of the end in a turn of its own, with what the system said, where the connection broke.
        """
        self.socket = connected
        self._streams = streams
        self._loop = streams.loop
        self._receiver = receiver
        self._high = high
        self._waiting = bytearray()
        #: bytes that wait elsewhere, to be written when the client has read what was sent before them
        self.held = 0
        #: whether nothing more can be written
        self.closing = False
        #: whether so much waits that the receiver was told so
        self.congested = False
        #: whether what waits will be sent as soon as the client reads
        self._blocked = False
        self._reading = self._eof = False
        streams.open.add(self)

    # -- in

    def begin(self) -> None:
        """Send what was written by now, and read from now on; what is there already, at once."""
        self.flush()
        self.resume_reading()
        if self._reading:
            self._read()

    def resume_reading(self) -> None:
        """Read what comes. Nothing happens where it is read already, or at its end."""
        if not (self._reading or self._eof or self.closing):
            self._reading = True
            self._loop.add_reader(self.socket, self._read)

    def pause_reading(self) -> None:
        """Leave what comes with the system, which lets the client wait."""
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self.socket)

    def _read(self) -> None:
        try:
            data = self.socket.recv(_READ)
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
            self.abort()  # a client whose bytes met a bug would wait for its answer
            raise

    # -- out

    @property
    def size(self) -> int:
        """Bytes that wait to be sent."""
        return len(self._waiting)

    def hold(self, size: int) -> None:
        """Count bytes that wait elsewhere; with a negative size, that they do no more."""
        if self in self._streams.open:
            self.held += size
            self._streams.waiting += size
            self._streams.relieve()

    def write(self, data: bytes) -> None:
        """Send this at the end of this turn, or as soon as the client has read what was sent before it."""
        if self.closing:
            return
        self._waiting += data
        self._streams.waiting += len(data)
        if self._blocked:
            self._tell_congestion()
        elif len(self._waiting) >= _PIECE:
            self._send()
        else:
            self._streams.add(self)
        self._streams.relieve()

    def flush(self) -> None:
        """Send what was written in this turn now. A client that is gone is seen by that: then it is `closing`."""
        if self._waiting and not self._blocked:
            self._send()

    def close(self) -> None:
        """Close as soon as what was written is sent."""
        if self.closing:
            return
        self.closing = True
        self.pause_reading()
        if not self._waiting:
            self.abort()

    def _send(self) -> None:
        try:
            sent = self.socket.send(self._waiting)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self.abort(error)
            return
        del self._waiting[:sent]
        self._streams.waiting -= sent
        if self._waiting and not self._blocked:
            self._blocked = True
            self._loop.add_writer(self.socket, self._send)
        elif self._blocked and not self._waiting:
            self._blocked = False
            self._loop.remove_writer(self.socket)
        if self.closing and not self._waiting:
            self.abort()
        else:
            self._tell_congestion()

    def _tell_congestion(self) -> None:
        if not self.congested and len(self._waiting) > self._high:
            self.congested = True
            self._receiver.pause_writing()
        elif self.congested and len(self._waiting) <= self._high // 4:
            self.congested = False
            self._receiver.resume_writing()

    # -- the end

    def abort(self, error: OSError | None = None) -> None:
        """Close now; `error`: what the system said, where the connection broke."""
        if self not in self._streams.open:
            return
        if self.closing:
            error = None  # the end was ours: what the client has sent since is nobody's to hear
        self.closing = True
        self.pause_reading()
        if self._blocked:
            self._loop.remove_writer(self.socket)
        self._streams.open.discard(self)
        self._streams.waiting -= len(self._waiting) + self.held
        self.held = 0
        self._waiting.clear()
        self._loop.call_soon(self._tell_end, error)

    def _tell_end(self, error: OSError | None) -> None:
        try:
            self._receiver.connection_lost(error)
        finally:
            self.socket.close()


def make_room(clients: int) -> int:
    """Have this process allowed as many descriptors as it needs for so many clients; return how many it may have."""
    wanted = clients + RESERVE + OWN
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed, most = (2**31 if each == resource.RLIM_INFINITY else each for each in limits)
    if allowed < wanted:
        with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid it
            resource.setrlimit(resource.RLIMIT_NOFILE, (min(wanted, most), limits[1]))
            allowed = min(wanted, most)
    if allowed < wanted:
        log.write(
            f"{allowed} files may be open: {max(0, allowed - RESERVE - OWN)} clients fit, not {clients}; "
            f"raise LimitNOFILE= or ulimit -n to {wanted}"
        )
    return allowed


class Acceptor:
    """Takes up the connections of a listening socket; `serve` is given each, and has to close it."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, serve: Callable[[socket.socket], None], descriptors: int
    ) -> None:
        """`descriptors`: how many this process may have."""
        self._loop = loop
        self._serve = serve
        self._descriptors = descriptors
        self._listening: socket.socket | None = None
        self._retry: asyncio.TimerHandle | None = None

    def open(self, listening: socket.socket) -> None:
        """Take up this socket's connections, and no other's."""
        self.close()
        self._listening = listening
        self._loop.add_reader(listening, self._accept, listening)

    def close(self) -> None:
        """Take up no more connections. The socket stays open; call it before that is closed."""
        if self._retry:
            self._retry.cancel()
            self._retry = None
        if self._listening:
            self._loop.remove_reader(self._listening)
            self._listening = None

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(AT_ONCE):
            try:
                connected, _ = listening.accept()
            except OSError as error:
                if error.errno not in _NONE_THERE:
                    self._pause(listening, error)
                return
            connected.setblocking(False)
            # The lowest free descriptor is taken, so the number says how many are left.
            if connected.fileno() >= self._descriptors - RESERVE:
                self._turn_away(connected)
                continue
            try:
                self._serve(connected)
            except Exception as error:  # noqa: BLE001 - one connection must not take the others'
                log.write_bug("making a connection", error)
                connected.close()

    def _turn_away(self, connected: socket.socket) -> None:
        """Tell a client that the server is full, so that it comes again; the wire's words for it."""
        log.write_limited(
            "descriptors",
            f"clients are turned away: only {self._descriptors} files may be open (raise LimitNOFILE= or ulimit -n)",
        )
        with connected, contextlib.suppress(OSError):  # it is gone again
            connected.send(encode(busy_greeting(_TOO_FEW_DESCRIPTORS)))

    def _pause(self, listening: socket.socket, error: OSError) -> None:
        """Leave the connections waiting for a while: the loop would ask for them without end."""
        if error.errno not in _USED_UP:
            log.write_bug("taking up a connection", error)
        log.write_limited("accept", f"no connection can be taken up: {error.strerror}; they wait until one can")
        self.close()
        self._retry = self._loop.call_later(RETRY_AFTER, self.open, listening)
