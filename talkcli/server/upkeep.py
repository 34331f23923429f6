"""Looks after the socket's file: cleaners of temporary directories and people remove it while it is served.

It decides when to look and what follows; how a socket is bound is the listener's.
"""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

from talkcli.errors import AddressInUse
from talkcli.server import log

if TYPE_CHECKING:
    import asyncio
    import socket
    from collections.abc import Callable

    from talkcli.server.listener import InheritedListener, Listener

#: Seconds between two looks. Nobody reaches the server meanwhile, and 30 s is what is promised; it is two calls of
#: lstat, so it costs a machine at rest nothing.
LOOK_EVERY = 10.0
#: What passes, so that the next look may well succeed: no room, no descriptor, a disk that is read-only for a while.
_PASSING = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS, errno.ENOSPC, errno.EDQUOT, errno.EROFS}


class Upkeep:
    """Looks after the file of a listener, from `begin` to `end`."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        listener: Listener | InheritedListener,
        moved: Callable[[socket.socket | None], None],
        lost: Callable[[AddressInUse], None],
    ) -> None:
        """`moved` is called with the former socket when the listener has bound again, `lost` when it can't."""
        self._loop = loop
        self._listener = listener
        self._moved = moved
        self._lost = lost
        self._said = ""
        self._timer: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Look from now on."""
        self._timer = self._loop.call_later(LOOK_EVERY, self._look)

    def end(self) -> None:
        """Look no more."""
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def _look(self) -> None:
        self.begin()
        if self._listener.in_place():
            self._said = ""
            return
        try:
            former = self._listener.bind_again()
        except AddressInUse as error:
            if not self._listener.passed and not _passes(error):
                self.end()
                self._lost(error)
            elif str(error) != self._said:
                self._said = str(error)
                log.line(log.shown(f"clients can't reach this server: {error}"))
            return
        self._said = ""
        log.line(f"the socket's file or its lock was gone or another: bound again at {self._listener.path}")
        self._moved(former)


def _passes(error: AddressInUse) -> bool:
    return isinstance(error.__cause__, OSError) and error.__cause__.errno in _PASSING
