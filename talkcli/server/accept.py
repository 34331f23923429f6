"""Takes up connections, and leaves the engine the descriptors that it needs.

It looks at no client: it hands the connections on, and who is served is their handler's business.
"""

from __future__ import annotations

import contextlib
import errno
import resource
from typing import TYPE_CHECKING

from talkcli.protocol import replies
from talkcli.protocol.lines import encode
from talkcli.server import log

if TYPE_CHECKING:
    import asyncio
    import socket
    from collections.abc import Callable

#: Connections taken up before those that are there have their turn: each is greeted, and may have a turn of requests.
AT_ONCE = 8
#: Descriptors that clients can't have: a restart of the engine takes nine besides those of the process that ends, a new
#: socket and its lock two, a look at a client's process one.
RESERVE = 16
#: Descriptors that a server has without clients: fourteen, and two for what a library may open.
OWN = 16
#: Seconds until it looks again where no connection could be taken up.
RETRY_AFTER = 1.0
#: What the system says that has nothing left to take up a connection with; the connection waits.
_USED_UP = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
#: What it says of a connection that is gone again, or that there is none after all.
_NONE_THERE = {errno.EAGAIN, errno.ECONNABORTED, errno.EPROTO, errno.EINTR}


def make_room(clients: int) -> None:
    """Have this process allowed as many descriptors as it needs for so many clients, as far as the system lets it."""
    wanted = clients + RESERVE + OWN
    allowed, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if allowed == resource.RLIM_INFINITY or allowed >= wanted:
        return
    if most == resource.RLIM_INFINITY or most > allowed:
        with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid it
            limit = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))
            allowed = limit
    if allowed < wanted:
        log.line(
            f"{allowed} files may be open: {max(0, allowed - RESERVE - OWN)} clients fit, not {clients}; "
            f"raise LimitNOFILE= or ulimit -n to {wanted}"
        )


class Acceptor:
    """Takes up the connections of a listening socket; `serve` is given each, and has to close it."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        serve: Callable[[socket.socket], None],
        failed: Callable[[str, Exception], None],
    ) -> None:
        """`failed` is told of a connection that was not made for a reason of the server's own."""
        self._loop = loop
        self._serve = serve
        self._failed = failed
        self._listening: socket.socket | None = None
        self._retry: asyncio.TimerHandle | None = None
        self._limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        if self._limit == resource.RLIM_INFINITY:
            self._limit = 2**31

    def open(self, listening: socket.socket) -> None:
        """Take up this socket's connections, and no other's."""
        self.close()
        self._listening = listening
        self._loop.add_reader(listening, self._accept)

    def close(self) -> None:
        """Take up no more connections. The socket stays open; call it before that is closed."""
        if self._retry:
            self._retry.cancel()
            self._retry = None
        if self._listening:
            self._loop.remove_reader(self._listening)
            self._listening = None

    def _accept(self) -> None:
        for _ in range(AT_ONCE):
            if self._listening is None:
                return
            try:
                connected, _ = self._listening.accept()
            except OSError as error:
                if error.errno in _USED_UP:
                    self._pause(error)
                elif error.errno not in _NONE_THERE:
                    self._failed("taking up a connection", error)
                    self._pause(error)
                return
            connected.setblocking(False)
            # The lowest free descriptor is taken, so the number says how many are left.
            if connected.fileno() >= self._limit - RESERVE:
                self._turn_away(connected)
            else:
                self._connect(connected)

    def _connect(self, connected: socket.socket) -> None:
        try:
            self._serve(connected)
        except Exception as error:  # noqa: BLE001 - one connection must not take the others'
            self._failed("making a connection", error)
            connected.close()

    def _turn_away(self, connected: socket.socket) -> None:
        """Tell a client that the server is full, so that it comes again; the wire's words for it."""
        log.seldom(
            "descriptors",
            f"clients are turned away: only {self._limit} files may be open (raise LimitNOFILE= or ulimit -n)",
        )
        with connected, contextlib.suppress(OSError):  # it is gone again
            connected.send(encode(replies.busy_greeting()))

    def _pause(self, error: OSError) -> None:
        """Leave the connections waiting for a while: the loop would ask for them without end."""
        log.seldom("accept", f"no connection can be taken up: {error.strerror}; they wait until one can")
        assert self._listening
        listening = self._listening
        self._loop.remove_reader(listening)

        def again() -> None:
            self._retry = None
            self._loop.add_reader(listening, self._accept)

        self._retry = self._loop.call_later(RETRY_AFTER, again)
