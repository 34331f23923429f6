"""A supervisor for tests: the other end of sd_notify(3), which receives the messages of a server."""

from __future__ import annotations

import contextlib
import os
import socket
import time

#: Seconds in which a message must have come.
PATIENCE = 10.0


class Supervisor(contextlib.AbstractContextManager["Supervisor"]):
    """Listens at `address`: a path, or an abstract name that begins with '@'."""

    def __init__(self, address: str) -> None:
        self.address = address
        #: all messages so far: name, value, time
        self.messages: list[tuple[str, str, float]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(f"\0{address[1:]}" if address.startswith("@") else address)

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        if not self.address.startswith("@"):
            os.unlink(self.address)

    def wait_for(self, name: str, containing: str = "", since: float = 0.0) -> float:
        """Return the time of a message of this name that came after a time."""
        end = time.monotonic() + PATIENCE
        while True:
            for sent, value, at in self.messages:
                if sent == name and containing in value and at > since:
                    return at
            assert self.receive(end - time.monotonic()), f"{name} {containing!r} was never told: {self.messages}"

    def receive(self, timeout: float) -> bool:
        """Take one datagram; False if none comes."""
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
        """Fill the socket, so that a sender of one more message would wait."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            other.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while True:
                    other.sendto(b"NOISE=1\n", self._socket.getsockname())

    def drain(self) -> None:
        """Take the messages that have come already."""
        while self.receive(0):
            pass
