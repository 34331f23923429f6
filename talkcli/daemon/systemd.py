"""Notifications that tell the service manager when the process is ready, alive or stopping.

The notifications are datagrams as in sd_notify(3), for systemd and others. Without NOTIFY_SOCKET nothing is sent.
Sending never waits. If the service manager can't accept a notification, its fields are sent again later. The status
contains no text of goals, because every user of the machine can read it.
"""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING

from talkcli.daemon import log

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

#: Delay before a status change is reported, so that several changes in a row cause only one notification.
STATUS_DELAY_S = 0.5
#: Delay before a failed notification is sent again.
NOTIFY_RETRY_DELAY_S = 0.5
#: Number of notifications per watchdog timeout. One of them may be late.
_NOTIFICATIONS_PER_TIMEOUT_COUNT = 2.5


class ServiceManager:
    """Sends notifications to the service manager, if one started this process.

    Call every method in the event loop's thread.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, describe_status: Callable[[], str]) -> None:
        """Open a socket to the service manager.

        Args:
            loop: the loop that sends delayed notifications.
            describe_status: returns a one-line description of the process's status.
        """
        self._loop = loop
        self._describe_status = describe_status
        self._address = _parse_notify_address(os.environ.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        self._watchdog_interval = _watchdog_interval()
        #: unsent fields, with their newest values
        self._unsent: dict[str, str] = {}
        #: the last status that was sent
        self._status = ""
        #: timers of scheduled notifications, by name
        self._timers: dict[str, asyncio.TimerHandle] = {}
        if self._address:
            # Open the socket now, in case the process runs out of descriptors later.
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def notify_ready(self) -> None:
        """Report that the process is ready, and start the watchdog notifications."""
        self._send(READY="1", STATUS=self._describe_status())
        self._notify_watchdog()

    def schedule_status(self) -> None:
        """Report the process's status to the service manager after a short delay."""
        self._schedule("status", STATUS_DELAY_S, self._notify_status)

    def notify_stopping(self) -> None:
        """Report that the process is stopping. Watchdog notifications continue until `close`."""
        if self._status != "stopping":
            self._send(STOPPING="1", STATUS="stopping")

    def close(self) -> None:
        """Stop all notifications, and close the socket."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        if self._socket:
            self._socket.close()
            self._socket = None

    def _notify_status(self) -> None:
        """Report the process's status if it has changed."""
        status = self._describe_status()
        if self._status not in {status, "stopping"}:
            self._send(STATUS=status)

    def _notify_watchdog(self) -> None:
        """Notify the watchdog, and schedule the next notification."""
        if self._watchdog_interval:
            self._send(WATCHDOG="1")
            self._schedule("watchdog", self._watchdog_interval, self._notify_watchdog)

    def _schedule(self, name: str, seconds: float, action: Callable[[], None]) -> None:
        """Call `action` after a delay, unless a timer with this name is already running."""
        if self._socket is None or name in self._timers:
            return

        def act() -> None:
            del self._timers[name]
            action()

        self._timers[name] = self._loop.call_later(seconds, act)

    def _send(self, **fields: str) -> None:
        """Send fields such as READY=1 to the service manager. If this fails, try again later.

        Fields from failed attempts are sent again.
        """
        if self._socket is None:
            return
        self._status = fields.get("STATUS", self._status)
        self._unsent |= fields
        data = "".join(f"{name}={value}\n" for name, value in self._unsent.items()).encode(errors="replace")
        try:
            self._socket.sendto(data, self._address)
        except OSError as error:
            if not isinstance(error, BlockingIOError):  # BlockingIOError means that the queue is full
                log.write_limited("supervisor", f"can't notify the service manager (NOTIFY_SOCKET): {error.strerror}")
            self._schedule("retry", NOTIFY_RETRY_DELAY_S, self._send)
        else:
            self._unsent.clear()


def _parse_notify_address(value: str) -> str:
    """Convert the value of NOTIFY_SOCKET to a socket address.

    Return "" if it is unset or invalid.
    """
    if value.startswith("@"):
        return "\0" + value[1:]  # on Linux, @ marks an abstract socket
    return value if os.path.isabs(value) else ""


def _watchdog_interval() -> float | None:
    """Return the interval between watchdog notifications in seconds, or None without a watchdog."""
    timeout, own_pid = os.environ.get("WATCHDOG_USEC", ""), str(os.getpid())
    is_for_us = os.environ.get("WATCHDOG_PID", own_pid) == own_pid  # the watchdog may watch another process
    timeout_us = int(timeout) if timeout.isdecimal() and is_for_us else 0
    return timeout_us / 1e6 / _NOTIFICATIONS_PER_TIMEOUT_COUNT or None
