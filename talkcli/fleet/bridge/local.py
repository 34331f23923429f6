"""The bridge's connections to the robot's own server, as sockets in the event loop.

Only the greeting is read here. All other lines pass undecoded.
"""

from __future__ import annotations

import _socket  # see `peers`
import asyncio
import contextlib
import random
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.client import connect
from talkcli.errors import Busy, TalkError
from talkcli.frozen import replace
from talkcli.protocol.lines import LineSplitter, encode

if TYPE_CHECKING:
    from talkcli.client.connect import ConnectionAttempt
    from talkcli.goals.goal import JsonObject

_READ_BYTES = 64 * 1024
#: Pause before another try if the server is busy. Random, so that many clients don't come back together.
_BUSY_PAUSE_S = (0.02, 0.2)


class LocalConnection:
    """A connection to the server of this machine, used by one reader.

    It uses the loop directly. With asyncio's streams and a thread that connects, a cancel of a thousand robots on one
    machine took 1.2 times as long.
    """

    def __init__(self, greeted: ConnectionAttempt) -> None:
        """`greeted` is a connection whose greeting has been read."""
        assert greeted.socket
        self.path, self.boot, self.pid = greeted.path, greeted.boot, greeted.pid
        self._socket = greeted.socket
        self._loop = asyncio.get_running_loop()
        self._splitter = LineSplitter()
        self._lines = self._splitter.feed(greeted.received)
        #: what the server has not accepted yet
        self._unsent = bytearray()
        #: done as soon as there may be something to read
        self._readable: asyncio.Future[None] | None = None
        self._closed = False

    async def read(self) -> list[bytes]:
        """Return the lines that have come, without their newlines. Wait for the first; none if the connection ended."""
        while not self._lines:
            data = await self._receive()
            if not data:
                return []
            self._lines = self._splitter.feed(data)
        lines, self._lines = self._lines, []
        return lines

    def write(self, line: bytes) -> None:
        """Send a line as soon as the server accepts it."""
        waits = bool(self._unsent)
        self._unsent += line
        if not waits:
            self._send()

    def close(self) -> None:
        """Close the connection now. The server cancels unanswered requests if that is still possible."""
        if not self._closed:
            self._closed = True
            self._loop.remove_reader(self._socket)
            self._loop.remove_writer(self._socket)
            self._socket.close()
            self._wake()

    async def _receive(self) -> bytes:
        """Return the next data, nothing if the connection has ended."""
        await asyncio.sleep(0)  # lets other tasks run if the server sends a lot
        while not self._closed:
            try:
                return self._socket.recv(_READ_BYTES)
            except BlockingIOError:
                pass
            except OSError:
                break
            self._readable = self._loop.create_future()
            self._loop.add_reader(self._socket, self._wake)
            try:
                await self._readable
            finally:
                if not self._closed:
                    self._loop.remove_reader(self._socket)
        return b""

    def _wake(self) -> None:
        if self._readable and not self._readable.done():
            self._readable.set_result(None)

    def _send(self) -> None:
        if self._closed:
            return
        try:
            del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            # A part of a line may have been sent, so nothing may follow. The reader finds that the connection ended.
            self._unsent.clear()
            with contextlib.suppress(OSError):
                self._socket.shutdown(_socket.SHUT_RDWR)
        if self._unsent:
            self._loop.add_writer(self._socket, self._send)
        else:
            self._loop.remove_writer(self._socket)


async def dial(
    socket: str | None, name: str, *, urgent: bool = False, slots: asyncio.Semaphore | None = None
) -> LocalConnection:
    """Connect to the server, and wait for its greeting.

    Args:
        socket: path of the server's socket, None for the usual places.
        name: what the client calls itself.
        urgent: whether the client only sends `status` and `cancel`, for which a full server keeps some places.
        slots: limits how many connections wait for a greeting at the same time. A hung server keeps a connection in
            its backlog although the client has closed it, so a cancelled call keeps its slot until the server answers.

    Raises:
        ServerUnavailable, AccessDenied, ProtocolMismatch, Busy: no server can be used.
    """
    if slots:
        await slots.acquire()
    dialing = asyncio.create_task(_dial(paths.named_socket(socket), connect.hello(name, urgent=urgent)))
    if slots:
        dialing.add_done_callback(lambda _: slots.release())
    try:
        return await asyncio.shield(dialing)
    except asyncio.CancelledError:
        dialing.add_done_callback(_discard)
        raise


def _discard(dialing: asyncio.Task[LocalConnection]) -> None:
    if not dialing.cancelled() and not dialing.exception():
        dialing.result().close()


async def _dial(place: str | None, hello: JsonObject) -> LocalConnection:
    loop = asyncio.get_running_loop()
    give_up = loop.time() + connect.BUSY_LIMIT_S
    while True:
        attempt = connect.reach(place)
        try:
            attempt = await _await_greeting(attempt, hello)
            return LocalConnection(connect.connect(place, hello, 0, attempt=attempt))
        except TalkError as error:
            if not (attempt.backlog_full or isinstance(error, Busy)) or loop.time() > give_up:
                raise
        except asyncio.CancelledError:
            if attempt.socket:
                attempt.socket.close()
            raise
        await asyncio.sleep(random.uniform(*_BUSY_PAUSE_S))


async def _await_greeting(attempt: ConnectionAttempt, hello: JsonObject) -> ConnectionAttempt:
    """Say hello, and return the connection with what the server has said within the limit for a greeting."""
    connected, received = attempt.socket, bytearray()
    if not connected:
        return attempt
    loop = asyncio.get_running_loop()
    done = loop.create_future()

    def finish() -> None:
        if not done.done():
            done.set_result(None)

    def read() -> None:
        data = b""
        with contextlib.suppress(OSError):
            data = connected.recv(_READ_BYTES)
        received.extend(data)
        if not data or b"\n" in data:
            finish()

    with contextlib.suppress(OSError):  # the server has hung up, but may have said why
        connected.send(encode(hello))
    loop.add_reader(connected, read)
    limit = loop.call_later(connect.ANSWER_LIMIT_S, finish)
    try:
        await done
    finally:
        limit.cancel()
        loop.remove_reader(connected)
    return replace(attempt, hello_sent=True, received=bytes(received))
