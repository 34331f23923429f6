"""One connection to the robot's own server, from nothing to its end: it has greeted, and lines go both ways.

What waits has a thread of its own meanwhile. Nothing here knows what the lines say.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket as sockets
import threading
from typing import TYPE_CHECKING, TypeVar

from talkcli import paths
from talkcli.client.connect import connect, hello
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.client.connect import Begun

_T = TypeVar("_T")

#: Bytes that are read in one go.
_READ = 64 * 1024


class Local:
    """A connection to the server of this machine."""

    def __init__(self, begun: Begun, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        #: where the server is, its boot id, and its process, as it says
        self.path, self.boot, self.pid = begun.path, begun.boot, begun.pid
        self._reader, self._writer = reader, writer
        self._splitter = LineSplitter()
        self._lines = self._splitter.feed(begun.received)

    async def read(self) -> list[bytes]:
        """Return the lines that have come since, at least one, without their newlines; none once it has ended."""
        while not self._lines:
            try:
                data = await self._reader.read(_READ)
            except OSError:
                return []
            if not data:
                return []
            self._lines = self._splitter.feed(data)
        lines, self._lines = self._lines, []
        return lines

    def write(self, line: bytes) -> None:
        """Send a line, as soon as the server takes it."""
        self._writer.write(line)

    def close(self) -> None:
        """End it now: what the server was asked and has not answered is taken back, where that is possible."""
        self._writer.transport.abort()


async def dial(socket: str | None, name: str, *, urgent: bool = False, slots: asyncio.Semaphore | None = None) -> Local:
    """Return a connection to the server, to which one has said hello.

    `socket`: its place, None for the usual ones; `urgent`: for status and cancel alone; `slots`: how many may try at
    once, those included for which nobody waits any more. ServerUnavailable, AccessDenied, ProtocolMismatch or Busy
    where there is none.
    """
    if slots:
        await slots.acquire()
    done = slots.release if slots else None
    begun = await apart(lambda: connect(paths.named_socket(socket), hello(name, urgent=urgent)), _hang_up, done)
    assert begun.socket
    connected = sockets.socket(fileno=begun.socket.detach())
    return Local(begun, *await asyncio.open_unix_connection(sock=connected))


def _hang_up(begun: Begun) -> None:
    if begun.socket:
        begun.socket.close()


async def apart(
    work: Callable[[], _T], undo: Callable[[_T], object] | None = None, finished: Callable[[], object] | None = None
) -> _T:
    """Return what `work` does, in a thread of its own, for which nobody waits at the end of the process.

    `undo`: done with what comes of it, where nobody waits for that any more; `finished`: called once the work is over,
    whether anybody waits or not.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[_T] = loop.create_future()

    def tell(result: _T | None, error: BaseException | None) -> None:
        if finished:
            finished()
        if done.cancelled():
            if undo and error is None:
                undo(result)  # type: ignore[arg-type]
        elif error is None:
            done.set_result(result)  # type: ignore[arg-type]
        else:
            done.set_exception(error)

    def run() -> None:
        result: _T | None = None
        error: BaseException | None = None
        try:
            result = work()
        except BaseException as raised:  # noqa: BLE001 - it is raised where it is waited for
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(tell, result, error)

    try:
        threading.Thread(target=run, daemon=True).start()
    except RuntimeError as error:  # the system gives this process no more of them
        tell(None, error)
    return await done
