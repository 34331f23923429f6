"""A proxy between clients and a broker that can stall, break and refuse connections.

No data is lost. Data that is held back is sent after `release()`.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import threading
from typing import TYPE_CHECKING, Literal

from tests.support.connection import PATIENCE
from tests.support.ports import HOST, Port, bound_socket
from tests.support.resources import Resource

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    Direction = Literal["to_client", "to_broker"]

DIRECTIONS: tuple[Direction, Direction] = ("to_client", "to_broker")
_PIECE_BYTES = 65536
#: The value of SO_LINGER that makes closing a socket send a reset.
_RESET = struct.pack("ii", 1, 0)


class Proxy(Resource):
    """Forwards connections from its `port` to another port of this machine, in a thread.

    When a method returns, its effect is complete.
    """

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._passing = {direction: asyncio.Event() for direction in DIRECTIONS}
        self._awaited: tuple[Direction, bytes, threading.Event] | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._server: asyncio.Server | None = None
        self._loop = asyncio.new_event_loop()
        with contextlib.ExitStack() as stack:
            stack.callback(self._loop.close)
            self.port = stack.enter_context(Port()).number
            thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._loop.call_soon_threadsafe, self._loop.stop)
            stack.callback(lambda: self._wait_for(self._end()))
            self.release()
            self.accept()
            self._stack = stack.pop_all()

    def hold(self, *directions: Direction) -> None:
        """Hold back the data in these directions (default: both), and also the ends of connections."""
        for direction in directions or DIRECTIONS:
            self._do(self._passing[direction].clear)

    def hold_from(self, direction: Direction, pattern: bytes) -> threading.Event:
        """Hold back the data in this direction from this pattern on, and return an event that is set then."""
        holding = threading.Event()
        self._awaited = direction, pattern, holding
        return holding

    def release(self) -> None:
        for passing in self._passing.values():
            self._do(passing.set)

    def cut(self) -> None:
        self._do(self._cut)

    def refuse(self) -> None:
        self._do(self._refuse)

    def accept(self) -> None:
        self._wait_for(self._listen())

    def _do(self, action: Callable[[], object]) -> None:
        async def act() -> None:
            action()
            await asyncio.sleep(0)  # the sockets of aborted connections are closed now

        self._wait_for(act())

    def _wait_for(self, action: Coroutine[None, None, None]) -> None:
        asyncio.run_coroutine_threadsafe(action, self._loop).result(PATIENCE)

    async def _listen(self) -> None:
        if self._server is None:
            self._server = await asyncio.start_server(self._serve, sock=bound_socket(self.port))

    def _refuse(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None

    def _cut(self) -> None:
        for writer in self._writers:
            _reset(writer)

    async def _end(self) -> None:
        self._refuse()
        self._cut()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, client: asyncio.StreamWriter) -> None:
        try:
            replies, broker = await asyncio.open_connection(HOST, self._target_port)
        except OSError:
            _reset(client)
            return
        self._writers |= {client, broker}
        pumps = [
            asyncio.create_task(self._pump(reader, broker, "to_broker")),
            asyncio.create_task(self._pump(replies, client, "to_client")),
        ]
        done, pending = await asyncio.wait(pumps, return_when=asyncio.FIRST_EXCEPTION)
        self._writers -= {client, broker}
        for task in pending:
            task.cancel()
        broken = any(task.exception() for task in done)
        for writer in (client, broker):
            if broken:
                _reset(writer)
            else:
                writer.close()

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, direction: Direction) -> None:
        while data := await self._read(reader, direction):
            if self._awaited and self._awaited[0] == direction and self._awaited[1] in data:
                self._passing[direction].clear()
                self._awaited[2].set()
                self._awaited = None
            await self._passing[direction].wait()
            writer.write(data)
            await writer.drain()
        writer.write_eof()

    async def _read(self, reader: asyncio.StreamReader, direction: Direction) -> bytes:
        data = b""
        try:
            data = await reader.read(_PIECE_BYTES)
        finally:
            if not data:  # the end or the reset of a connection is held back, too
                await self._passing[direction].wait()
        return data


def _reset(writer: asyncio.StreamWriter) -> None:
    if not writer.transport.is_closing():
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        writer.transport.abort()
