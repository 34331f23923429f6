"""What a supervisor is told: that this process is ready, how it is, that its event loop lives, that it ends.

The datagrams of sd_notify(3), which systemd and others read. Without NOTIFY_SOCKET nothing happens. It never waits:
what the supervisor can't take now is told with what follows. Goals' texts are not told: any user may read what is.
"""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING

from talkcli.daemon import log

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

#: Seconds after a change until it is told, so that a burst of goals is one message.
STATUS_AFTER = 0.5
#: Seconds after which what could not be sent is sent again.
RETRY_AFTER = 0.5
#: Signs of life in the time after which the supervisor gives the process up: one may come late.
BEATS = 2.5


class Systemd:
    """The one that started this process, if it wants to be told. All calls are made in the event loop's thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop, words: Callable[[], str]) -> None:
        """`words` returns how the process is, in one line for people."""
        self._loop = loop
        self._words = words
        self._address = _address(os.environ.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        self._beat = _beat()
        #: what could not be sent yet; the newest of each kind
        self._unsent: dict[str, str] = {}
        self._status = ""
        self._timers: dict[str, asyncio.TimerHandle] = {}
        if self._address:
            # Opened once: a process that has used up its descriptors must still give signs of life.
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def ready(self) -> None:
        """Say that the process does its work, and begin with the signs of life."""
        self._status = self._words()
        self._send(READY="1", STATUS=self._status)
        self._live()

    def changed(self) -> None:
        """Say soon how the process is now."""
        self._later("status", STATUS_AFTER, self._tell_status)

    def stopping(self) -> None:
        """Say that the process ends; the signs of life go on until `close`."""
        if self._status != "ending":
            self._status = "ending"
            self._send(STOPPING="1", STATUS=self._status)

    def close(self) -> None:
        """Say nothing more."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        if self._socket:
            self._socket.close()
            self._socket = None

    def _tell_status(self) -> None:
        words = self._words()
        if self._status not in {words, "ending"}:
            self._status = words
            self._send(STATUS=words)

    def _live(self) -> None:
        if self._beat:
            self._send(WATCHDOG="1")
            self._later("beat", self._beat, self._live)

    def _later(self, name: str, seconds: float, action: Callable[[], None]) -> None:
        if self._socket is None or name in self._timers:
            return

        def act() -> None:
            del self._timers[name]
            action()

        self._timers[name] = self._loop.call_later(seconds, act)

    def _send(self, **fields: str) -> None:
        if self._socket is None:
            return
        self._unsent |= fields
        data = "".join(f"{name}={value}\n" for name, value in self._unsent.items()).encode(errors="replace")
        try:
            self._socket.sendto(data, self._address)
        except OSError as error:
            if not isinstance(error, BlockingIOError):  # else it has too much to read at this moment
                log.seldom("supervisor", f"the supervisor (NOTIFY_SOCKET) can't be told anything: {error.strerror}")
            self._later("retry", RETRY_AFTER, self._send)
        else:
            self._unsent.clear()


def _address(name: str) -> str:
    """Return the address to send to; empty where there is none, or one that no Unix socket has."""
    if name.startswith("@"):
        return "\0" + name[1:]  # Linux's abstract sockets, which have no file
    return name if os.path.isabs(name) else ""


def _beat() -> float | None:
    """Return the seconds between two signs of life; None if nobody counts them."""
    limit, this = os.environ.get("WATCHDOG_USEC", ""), str(os.getpid())
    if not (limit.isascii() and limit.isdecimal() and int(limit)):
        return None
    if os.environ.get("WATCHDOG_PID", this) != this:
        return None  # another process of this unit is watched
    return int(limit) / 1e6 / BEATS
