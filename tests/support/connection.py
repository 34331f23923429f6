"""A raw connection to a server, which sends and receives one JSON object per line.

It shares no code with talk, so that mistakes in talk's own code can't hide.
"""

from __future__ import annotations

import contextlib
import json
import socket
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

#: Time limit for a server's messages, in seconds.
PATIENCE = 5.0

Message = dict[str, Any]


class Wire(contextlib.AbstractContextManager["Wire"]):
    """A connection that has received the server's greeting. Close it, or use `with`."""

    def __init__(self, path: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._buffer = bytearray()
        self._seq = 0
        #: messages that came before the reply to a `request`: events, and items of lists
        self.events: list[Message] = []
        self.items: list[Message] = []
        try:
            self._socket.settimeout(PATIENCE)
            self._socket.connect(path)
            self.greeting = self.receive()
        except BaseException:
            self._socket.close()
            raise

    def __exit__(self, *_error: object) -> None:
        self.close()

    def send(self, message: Mapping[str, object]) -> None:
        self.send_raw(json.dumps(message, ensure_ascii=False).encode() + b"\n")

    def send_raw(self, data: bytes) -> None:
        self._socket.settimeout(PATIENCE)
        self._socket.sendall(data)

    def receive(self, timeout: float | None = PATIENCE) -> Message:
        """Return the next message. Raise TimeoutError if none comes, or EOFError if the server has closed."""
        end = None if timeout is None else time.monotonic() + timeout
        while b"\n" not in self._buffer:
            self._socket.settimeout(None if end is None else max(0.001, end - time.monotonic()))
            try:
                data = self._socket.recv(65536)
            except TimeoutError:
                raise TimeoutError(f"nothing from the server within {timeout} s") from None
            except ConnectionResetError:
                data = b""
            if not data:
                raise EOFError(f"the server closed the connection; unfinished line: {bytes(self._buffer)!r}")
            self._buffer += data
        line, _, rest = self._buffer.partition(b"\n")
        self._buffer = rest
        message = json.loads(line)
        assert isinstance(message, dict), f"not an object: {bytes(line)!r}"
        return message

    def request(self, request: str, /, timeout: float = PATIENCE, **fields: object) -> Message:
        """Send a request and return its reply. Earlier messages are kept in `events` and `items`."""
        self._seq += 1
        self.send({"seq": self._seq, "request": request, **fields})
        end = time.monotonic() + timeout
        while True:
            message = self.receive(max(0.001, end - time.monotonic()))
            if message.get("seq") == self._seq and "ok" in message:
                return message
            (self.events if "event" in message else self.items).append(message)

    def receive_event(self, event: str, timeout: float = PATIENCE, **fields: object) -> Message:
        """Return the next event of this kind with these fields, including those that have come already.

        All events before it are dropped.
        """
        end = time.monotonic() + timeout
        while True:
            message = self.events.pop(0) if self.events else self.receive(max(0.001, end - time.monotonic()))
            if message.get("event") == event and all(message.get(name) == value for name, value in fields.items()):
                return message

    def shut_down(self) -> None:
        """Shut down both directions. A `receive` in another thread raises EOFError at once."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def half_close(self) -> None:
        """Close the writing half of the connection."""
        self._socket.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        self._socket.close()
