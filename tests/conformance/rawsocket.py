"""Clients and servers that send any bytes, for malformed or incomplete messages.

`tests.support.connection.Wire` is a client that sends whole messages and waits for the greeting.
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

#: A valid greeting of a server.
GREETING = b'{"talk": 1, "version": "0", "pid": 1, "boot": "fake", "features": []}\n'


class Raw(contextlib.AbstractContextManager["Raw"]):
    """A connection that sends and collects bytes, and does not wait for the greeting."""

    def __init__(self, path: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(PATIENCE)
        self.socket.connect(path)
        self.received = bytearray()

    def __exit__(self, *_error: object) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        """Send bytes, and ignore it if the server has closed the connection."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.socket.sendall(data)

    def half_close(self) -> None:
        """Close the sending half of the connection."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)

    def receive(self, timeout: float = PATIENCE) -> bytes:
        """Return the next bytes; b"" if the server has closed the connection."""
        self.socket.settimeout(timeout)
        try:
            data = self.socket.recv(1 << 20)
        except (ConnectionResetError, BrokenPipeError):
            data = b""
        self.received += data
        return data

    def receive_lines(self, count: int) -> list[dict[str, Any]]:
        """Wait until `count` lines have arrived in total, and return all complete lines."""
        end = time.monotonic() + PATIENCE
        while self.received.count(b"\n") < count:
            if not self.receive(max(0.001, end - time.monotonic())):
                raise EOFError(f"closed after {bytes(self.received)!r}")
        return self.lines

    def receive_all(self, timeout: float = PATIENCE) -> list[dict[str, Any]]:
        """Wait until the server closes the connection, and return all lines."""
        end = time.monotonic() + timeout
        while self.receive(max(0.001, end - time.monotonic())):
            pass
        assert not self.received or self.received.endswith(b"\n"), f"half a line: {bytes(self.received)!r}"
        return self.lines

    @property
    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in bytes(self.received).split(b"\n")[:-1]]


class FakeServer(contextlib.AbstractContextManager["FakeServer"]):
    """A server that sends the same bytes to every client, and nothing else.

    Args:
        closes: Close the connection after the client's first request.
        listens: Wait for the client's first request.
    """

    def __init__(self, path: str, messages: Iterable[bytes], *, closes: bool = False, listens: bool = True) -> None:
        self._data = b"".join(messages)
        self._closes = closes
        self._listens = listens
        self._clients: list[socket.socket] = []
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(path)
        self._socket.listen()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __exit__(self, *_error: object) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)  # so that `accept` returns
        self._thread.join()
        for connection in (self._socket, *self._clients):
            connection.close()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            with contextlib.suppress(OSError):
                client.sendall(self._data)
                client.settimeout(PATIENCE)
                if self._listens:
                    client.recv(65536)
            if self._closes:
                client.close()
            else:
                self._clients.append(client)
