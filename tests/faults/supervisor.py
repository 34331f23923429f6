"""A supervisor that receives the sd_notify(3) messages of a server."""

from __future__ import annotations

import contextlib
import os
import socket
import time

#: Limit in seconds for the arrival of a message.
PATIENCE = 10.0


class Supervisor(contextlib.AbstractContextManager["Supervisor"]):
    """A socket at `address`: a path, or an abstract name that starts with '@'."""

    def __init__(self, address: str) -> None:
        self.address = address
        #: name, value and time of all received messages
        self.messages: list[tuple[str, str, float]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(f"\0{address[1:]}" if address.startswith("@") else address)

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        if not self.address.startswith("@"):
            os.unlink(self.address)

    def wait_for(self, name: str, containing: str = "", since: float = 0.0) -> float:
        """Return the time of the first such message after `since`."""
        end = time.monotonic() + PATIENCE
        while True:
            for sent, value, at in self.messages:
                if sent == name and containing in value and at > since:
                    return at
            assert self.receive(end - time.monotonic()), f"{name} {containing!r} was never received: {self.messages}"

    def receive(self, timeout: float) -> bool:
        """Receive one datagram; return False if none arrives in time."""
        self._socket.settimeout(max(0.001, timeout))
        try:
            data = self._socket.recv(65536)
        except TimeoutError:
            return False
        now = time.monotonic()
        for line in data.decode().splitlines():
            name, _, value = line.partition("=")
            self.messages.append((name, value, now))
        return True

    def fill(self) -> None:
        """Fill the socket so that the next sender would block."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            other.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while True:
                    other.sendto(b"NOISE=1\n", self._socket.getsockname())

    def drain(self) -> None:
        """Receive the messages that have already arrived."""
        while self.receive(0):
            pass
