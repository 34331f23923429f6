"""The bridge's connections to the robot's server.

They are read by the event loop, and return lines without decoding them.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from talkcli.aio.connection import wait_ready
from talkcli.client.connection import SocketConnection
from talkcli.errors import ServerUnavailable
from talkcli.protocol.lines import MAX_LINE_BYTES

if TYPE_CHECKING:
    from typing import Any

    from talkcli.client.connect import ConnectionAttempt
    from talkcli.client.core import Exchange

_CHUNK_BYTES = 64 * 1024


class LocalConnection(SocketConnection):
    """A connection to the robot's server. Only one task at a time may read from it.

    It doesn't use an asyncio transport, because connecting would then take about one and a half times as long. This
    matters when an operator cancels everything on a thousand robots.
    """

    wait = staticmethod(wait_ready)

    def __init__(self, attempt: ConnectionAttempt, *options: Any) -> None:
        """Take over the connection of an attempt that has received the server's greeting."""
        super().__init__(attempt, *options)
        self._loop = asyncio.get_running_loop()
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
        if self._socket is not None and self._socket.fileno() >= 0:
            self._loop.remove_reader(self._socket)
            self._loop.remove_writer(self._socket)
            self._socket.close()

    def abort(self) -> None:
        """Shut down the socket, so that a waiting `read` returns.

        The reader must then call `close`.
        """
        self._hang_up()

    def _flush(self) -> None:
        """Send as much queued data as possible without blocking.

        Send the rest when the socket becomes writable.
        """
        if self._socket is None or self._socket.fileno() < 0:
            return
        super()._flush()
        if self._sending_ended:
            self.abort()  # the server may have received half a line; `read` will report the end
        if self.outgoing():
            self._loop.add_writer(self._socket, self._flush)
        else:
            self._loop.remove_writer(self._socket)
