"""Bytes on a Unix socket: what a broken or foreign client sends, and what a foreign server answers.

`tests.support.connection.Wire` sends objects and is greeted; this is for what isn't an object, or stops halfway.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from typing import TYPE_CHECKING, Any

from tests.support.connection import PATIENCE

if TYPE_CHECKING:
    from collections.abc import Iterable

#: What a server sends that is one, for a fake.
GREETING = b'{"talk": 1, "version": "0", "pid": 1, "boot": "fake", "features": []}\n'


class Raw(contextlib.AbstractContextManager["Raw"]):
    """A connection that sends bytes and collects bytes; it waits for no greeting."""

    def __init__(self, path: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(PATIENCE)
        self.socket.connect(path)
        self.received = bytearray()

    def __exit__(self, *_error: object) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        """Send bytes; a server that has closed meanwhile is none of the sender's business."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.socket.sendall(data)

    def half_close(self) -> None:
        """Say that nothing more will be sent."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)

    def receive(self, timeout: float = PATIENCE) -> bytes:
        """Return what comes next; b"" once the server has closed."""
        self.socket.settimeout(timeout)
        try:
            data = self.socket.recv(1 << 20)
        except (ConnectionResetError, BrokenPipeError):
            data = b""
        self.received += data
        return data

    def receive_lines(self, count: int) -> list[dict[str, Any]]:
        """Wait for so many lines since the connection began, and return all that came whole."""
        end = time.monotonic() + PATIENCE
        while self.received.count(b"\n") < count:
            if not self.receive(max(0.001, end - time.monotonic())):
                raise EOFError(f"closed after {bytes(self.received)!r}")
        return self.lines

    def receive_all(self, timeout: float = PATIENCE) -> list[dict[str, Any]]:
        """Wait until the server closes, and return every line since the connection began."""
        end = time.monotonic() + timeout
        while self.receive(max(0.001, end - time.monotonic())):
            pass
        assert not self.received or self.received.endswith(b"\n"), f"half a line: {bytes(self.received)!r}"
        return self.lines

    @property
    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in bytes(self.received).split(b"\n")[:-1]]


class FakeServer(contextlib.AbstractContextManager["FakeServer"]):
    """Says the same bytes to every client, and nothing else.

    `closes`: hangs up after that and the client's first words; `listens`: waits for these.
    """

    def __init__(self, path: str, says: Iterable[bytes], *, closes: bool = False, listens: bool = True) -> None:
        self._says = b"".join(says)
        self._closes = closes
        self._listens = listens
        self._clients: list[socket.socket] = []
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(path)
        self._socket.listen()
        self._served = threading.Semaphore(0)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __exit__(self, *_error: object) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)  # which ends `accept`
        self._thread.join()
        for connection in (self._socket, *self._clients):
            connection.close()

    def wait_for_client(self) -> None:
        """Wait until one more client has sent something."""
        assert self._served.acquire(timeout=PATIENCE), "no client came"

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            with contextlib.suppress(OSError):
                client.sendall(self._says)
                client.settimeout(PATIENCE)
                if self._listens:
                    client.recv(65536)
            self._served.release()
            if self._closes:
                client.close()
            else:
                self._clients.append(client)
