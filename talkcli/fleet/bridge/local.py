"""The bridge's connections to the robot's server.

They wrap the client core, run in the event loop, and return lines without decoding them.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.aio.connection import wait_ready
from talkcli.client import connect
from talkcli.client.core import ClientCore
from talkcli.errors import ServerUnavailable
from talkcli.protocol.lines import MAX_LINE_BYTES

if TYPE_CHECKING:
    from talkcli.client.connect import ConnectionAttempt
    from talkcli.client.core import Exchange

_CHUNK_BYTES = 64 * 1024


class LocalConnection(ClientCore):
    """A connection to the robot's server. Only one task at a time may read from it.

    It doesn't use an asyncio transport, because connecting would then take about one and a half times as long. This
    matters when an operator cancels everything on a thousand robots.
    """

    def __init__(self, attempt: ConnectionAttempt) -> None:
        """Wrap the socket of an attempt that has read the server's greeting."""
        assert attempt.socket
        assert attempt.server
        self._loop = asyncio.get_running_loop()
        super().__init__(connect.ANSWER_LIMIT_S, self._loop.time())
        self.path, self.server, self._socket = attempt.path, attempt.server, attempt.socket
        #: received lines that `read` has not returned yet
        self._lines = self.split(attempt.received, self._loop.time())

    async def read(self) -> list[bytes]:
        """Wait for lines from the server. Return an empty list if the connection has ended.

        The lines are returned without newlines.
        """
        while not self._lines:
            await asyncio.sleep(0)  # let other tasks run even if data is always available
            try:
                data = await self._loop.sock_recv(self._socket, _CHUNK_BYTES)  # type: ignore[arg-type]
            except OSError:
                return []
            if not data:
                return []
            self._lines = self.split(data, self._loop.time())
        lines, self._lines = self._lines, []
        return lines

    def send(self, exchange: Exchange) -> bool:
        """Send a request without waiting for the answer. Return False if the request is too long."""
        self.register(exchange, self._loop.time())
        line = self.line(exchange)
        if len(line) > MAX_LINE_BYTES:
            self.forget(exchange)
            return False
        with contextlib.suppress(ServerUnavailable):  # `read` will report the end of the connection
            self.queue(line, exchange)
        self._flush()
        return True

    def close(self) -> None:
        """Close the connection.

        A waiting `read` must first be cancelled, or ended with `abort`. The server cancels the requests that it has not
        answered, if possible.
        """
        if self._socket.fileno() >= 0:
            self._loop.remove_reader(self._socket)
            self._loop.remove_writer(self._socket)
            self._socket.close()

    def abort(self) -> None:
        """Shut down the socket, so that a waiting `read` returns.

        The reader must then call `close`.
        """
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _flush(self) -> None:
        """Send as much queued data as possible without blocking.

        Send the rest when the socket becomes writable.
        """
        if self._socket.fileno() < 0:
            return
        try:
            self.mark_sent(self._socket.send(self.outgoing()))
        except BlockingIOError:
            pass
        except OSError as error:
            # Send nothing more, because the server may have received half a line. `read` will report the error.
            self.stop_sending(str(error))
            self.abort()
        if self.outgoing():
            self._loop.add_writer(self._socket, self._flush)
        else:
            self._loop.remove_writer(self._socket)


async def dial(path: str | None, name: str, *, urgent: bool = False) -> LocalConnection:
    """Connect to the server, and wait for its greeting. Return the connection.

    Keep trying while the server is busy.

    Args:
        path: path of the server's socket, or None for the default locations.
        name: the client's name.
        urgent: whether the client sends only `status` and `cancel`. The server reserves connections for such clients.

    Raises:
        ServerUnavailable, AccessDenied, ProtocolMismatch, Busy: no usable server was found.
    """
    message = connect.hello(name, urgent=urgent)
    return LocalConnection(
        await connect.connect(paths.named_socket(path), message, connect.ANSWER_LIMIT_S, wait=wait_ready)
    )
