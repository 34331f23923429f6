"""One connection to the robot's own server, from nothing to its end: it has greeted, and lines go both ways.

What waits for longer than a moment has a thread of its own. But for the greeting nothing here knows what lines say.
"""

from __future__ import annotations

import _socket  # see `peers`
import asyncio
import contextlib
import threading
from typing import TYPE_CHECKING, TypeVar

from talkcli import paths
from talkcli.client.connect import AT_ONCE, GREETING, connect, hello, reach
from talkcli.frozen import replace
from talkcli.protocol.lines import LineSplitter, encode

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.client.connect import Begun
    from talkcli.goals.goal import JsonObject

_T = TypeVar("_T")

#: Bytes that are read in one go.
_READ = 64 * 1024


class Local:
    """A connection to the server of this machine.

    It is a socket in the loop and nothing more: with asyncio's streams, and a thread that connects, a cancel took a
    thousand robots on one machine 1.2 times as long, as each asker is new once.
    """

    def __init__(self, begun: Begun) -> None:
        """`begun`: greeted."""
        assert begun.socket
        #: where the server is, its boot id, and its process, as it says
        self.path, self.boot, self.pid = begun.path, begun.boot, begun.pid
        self._loop = asyncio.get_running_loop()
        self._socket = begun.socket
        self._splitter = LineSplitter()
        self._lines = self._splitter.feed(begun.received)
        #: what the server has not taken yet
        self._unsent = bytearray()
        #: done once there may be something to read
        self._readable: asyncio.Future[None] | None = None
        self._closed = False
        #: whether what came last was there already, so that others may have waited
        self._busy = False

    async def read(self) -> list[bytes]:
        """Return the lines that have come since, at least one, without their newlines; none once it has ended."""
        while not self._lines:
            data = await self._receive()
            if not data:
                return []
            self._lines = self._splitter.feed(data)
        lines, self._lines = self._lines, []
        return lines

    def write(self, line: bytes) -> None:
        """Send a line, as soon as the server takes it."""
        waits = bool(self._unsent)
        self._unsent += line
        if not waits:
            self._send()

    def close(self) -> None:
        """End it now: what the server was asked and has not answered is taken back, where that is possible."""
        if not self._closed:
            self._closed = True
            self._loop.remove_reader(self._socket)
            self._loop.remove_writer(self._socket)
            self._socket.close()
            self._wake()

    async def _receive(self) -> bytes:
        """Return what comes next; nothing once it has ended."""
        if self._busy:
            await asyncio.sleep(0)
        self._busy = True
        while not self._closed:
            try:
                return self._socket.recv(_READ)
            except BlockingIOError:
                self._busy = False
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
        """Send what the server takes of what waits; that the connection has broken is told by who reads."""
        if self._closed:
            return
        try:
            del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._unsent.clear()
            with contextlib.suppress(OSError):
                self._socket.shutdown(_socket.SHUT_RDWR)  # half a line may have gone: nothing may follow it
        if self._unsent:
            self._loop.add_writer(self._socket, self._send)
        else:
            self._loop.remove_writer(self._socket)


async def dial(socket: str | None, name: str, *, urgent: bool = False, slots: asyncio.Semaphore | None = None) -> Local:
    """Return a connection to the server, to which one has said hello.

    `socket`: its place, None for the usual ones; `urgent`: for status and cancel alone; `slots`: how many may try at
    once, those included for which nobody waits any more. ServerUnavailable, AccessDenied, ProtocolMismatch or Busy
    where there is none.
    """
    if slots:
        await slots.acquire()
    finished = slots.release if slots else None
    place, words = paths.named_socket(socket), hello(name, urgent=urgent)
    try:
        begun = _say_hello(reach(place), words)
    except BaseException:
        if finished:
            finished()
        raise

    def rest() -> asyncio.Future[Begun]:
        going = apart(lambda: connect(place, words, begun=begun), _hang_up, finished)
        if going.done():  # it could not begin
            _hang_up(begun)
        return going

    try:
        begun = await _hear(begun)
    except BaseException:
        rest().cancel()  # what has connected is in the server's way until it has greeted, whoever waits for that
        raise
    greeting, ended, _ = begun.received.partition(b"\n")
    if not (ended and greeting.startswith(GREETING)) or b'"error"' in greeting:
        return Local(await rest())
    if finished:
        finished()
    return Local(connect(place, words, 0, begun=begun))  # it has all that it would wait for


def _say_hello(begun: Begun, words: JsonObject) -> Begun:
    if not begun.socket:
        return begun
    with contextlib.suppress(OSError):  # it has hung up; it may have said why
        begun.socket.send(encode(words))
    return replace(begun, greeted=True)


async def _hear(begun: Begun) -> Begun:
    """Return a connection with what the server says at once."""
    connected, received = begun.socket, b""
    if not connected:
        return begun
    loop = asyncio.get_running_loop()
    said = loop.create_future()

    def go_on() -> None:
        if not said.done():
            said.set_result(None)

    loop.add_reader(connected, go_on)
    limit = loop.call_later(AT_ONCE, go_on)
    try:
        await said
    finally:
        limit.cancel()
        loop.remove_reader(connected)
    with contextlib.suppress(OSError):
        received = connected.recv(_READ)
    return replace(begun, received=received)


def _hang_up(begun: Begun) -> None:
    if begun.socket:
        begun.socket.close()


def apart(
    work: Callable[[], _T], undo: Callable[[_T], object] | None = None, finished: Callable[[], object] | None = None
) -> asyncio.Future[_T]:
    """Return what `work` does, in a thread of its own, for which nobody waits at the end of the process.

    `undo`: done with what comes of it, where nobody waits for that any more; `finished`: called once the work is over,
    whether anybody waits or not. Both are called in the loop; once that has ended, `undo` is in the work's own thread,
    and `finished` is not called.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[_T] = loop.create_future()

    def tell(result: _T | None, error: BaseException | None) -> None:
        if finished:
            finished()
        if done.cancelled():
            _undo(undo, result, error)
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
        try:
            loop.call_soon_threadsafe(tell, result, error)
        except RuntimeError:  # the loop has ended, and whoever waited with it
            _undo(undo, result, error)

    try:
        threading.Thread(target=run, daemon=True).start()
    except RuntimeError as error:  # the system gives this process no more of them
        tell(None, error)
    return done


def _undo(undo: Callable[[_T], object] | None, result: _T | None, error: BaseException | None) -> None:
    """Undo what has come of work, if anything has: nobody waits for it."""
    if undo and error is None:
        undo(result)  # type: ignore[arg-type]
