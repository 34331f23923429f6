"""A network that stalls, breaks and refuses: a proxy between clients and a broker, in a thread of the test's.

It loses nothing that it took, and takes nothing where it is to hold: what is sent then waits where it does on a network
that has stalled, at its sender.
"""

from __future__ import annotations

import contextlib
import queue
import selectors
import socket
import struct
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Literal

from tests.support.connection import PATIENCE
from tests.support.ports import HOST, Port, bound

if TYPE_CHECKING:
    from collections.abc import Callable

    Way = Literal["to_client", "to_broker"]

#: Both ways through a proxy.
WAYS: tuple[Way, Way] = ("to_client", "to_broker")
#: Bytes that are taken at once, and after which no more are taken before they are handed on.
_PIECE = 65536
#: With this a socket that is closed sends a reset.
_RESET = struct.pack("ii", 1, 0)


class Proxy(contextlib.AbstractContextManager["Proxy"]):
    """Hands on what comes to its own `port` to another port of this machine, and back.

    What it is told has happened when the call returns: all is done by its one thread.
    """

    def __init__(self, to: int) -> None:
        self._to = to
        self._held: set[Way] = set()
        self._awaited: tuple[Way, bytes, threading.Event] | None = None
        self._pairs: list[_Pair] = []
        self._asked: queue.SimpleQueue[tuple[Callable[[], None], Future[None]]] = queue.SimpleQueue()
        self._listening: socket.socket | None = None
        self._selector = selectors.DefaultSelector()
        with contextlib.ExitStack() as stack:
            stack.callback(self._selector.close)
            self.port = stack.enter_context(Port()).number
            woken, self._wake = (stack.enter_context(each) for each in socket.socketpair())
            self._selector.register(woken, selectors.EVENT_READ, lambda _mask: woken.recv(1))
            self._closing = False
            thread = threading.Thread(target=self._run, name="proxy", daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._do, self._stop)
            self.accept()
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Cut all connections and end the thread; a second time is nothing."""
        self._stack.close()

    @property
    def connections(self) -> int:
        """How many connections it has now."""
        return len(self._pairs)

    def hold(self, *ways: Way) -> None:
        """Let nothing more pass, one way or both (where none is named), of all connections, new ones included.

        That one side has ended does not pass either.
        """
        self._do(lambda: self._held.update(ways or WAYS))

    def hold_from(self, way: Way, words: bytes) -> threading.Event:
        """Hold this way as soon as something has come by it with these bytes, which do not pass either.

        What is returned is set then.
        """
        held = threading.Event()

        def begin() -> None:
            self._awaited = way, words, held

        self._do(begin)
        return held

    def release(self) -> None:
        """Let all pass again, what was held first."""
        self._do(self._held.clear)

    def cut(self) -> None:
        """Reset all connections; new ones may come."""
        self._do(self._cut)

    def refuse(self) -> None:
        """Refuse new connections; those that are there stay."""
        self._do(self._refuse)

    def accept(self) -> None:
        """Take new connections again."""
        self._do(self._accept)

    def _do(self, action: Callable[[], None]) -> None:
        """Have the thread do something between what it hands on."""
        done: Future[None] = Future()
        self._asked.put((action, done))
        self._wake.send(b"x")
        done.result(PATIENCE)

    def _run(self) -> None:
        while not self._closing:
            for key, mask in self._selector.select():
                if key.fd in self._selector.get_map():  # else one before it in this list has closed it
                    key.data(mask)
            while not self._asked.empty():
                action, done = self._asked.get()
                action()
                self._renew()
                done.set_result(None)
            self._renew()

    def _stop(self) -> None:
        self._refuse()
        self._cut()
        self._closing = True

    def _cut(self) -> None:
        for each in list(self._pairs):
            self._drop(each)

    def _refuse(self) -> None:
        if self._listening is not None:
            self._selector.unregister(self._listening)
            self._listening.close()
            self._listening = None

    def _accept(self) -> None:
        if self._listening is None:
            self._listening = bound(self.port)
            self._listening.listen()
            self._listening.setblocking(False)
            self._selector.register(self._listening, selectors.EVENT_READ, lambda _mask: self._connect())

    def _connect(self) -> None:
        assert self._listening is not None
        try:
            client, _ = self._listening.accept()
        except BlockingIOError:  # it has gone again
            return
        try:
            broker = socket.create_connection((HOST, self._to), PATIENCE)
        except OSError:
            _reset(client)
            return
        self._pairs.append(_Pair(client, broker))

    def _renew(self) -> None:
        """Wait for what each connection may do now."""
        for pair in list(self._pairs):
            if pair.over:
                self._drop(pair)
                continue
            for way in WAYS:
                self._wait_for(pair, way)

    def _wait_for(self, pair: _Pair, way: Way) -> None:
        """Wait for what the one end may do from which this way begins."""
        mask = 0
        if way not in self._held and pair.takes(way):
            mask |= selectors.EVENT_READ
        if _back(way) not in self._held and pair.has(_back(way)):
            mask |= selectors.EVENT_WRITE
        end = pair.ends[way]
        known = self._selector.get_map().get(end)
        if mask and known is None:
            self._selector.register(end, mask, lambda mask: self._move(pair, way, mask))
        elif mask and known is not None and known.events != mask:
            self._selector.modify(end, mask, known.data)
        elif not mask and known is not None:
            self._selector.unregister(end)

    def _move(self, pair: _Pair, way: Way, mask: int) -> None:
        try:
            if mask & selectors.EVENT_READ:
                pair.take(way)
                self._hold_if_awaited(pair, way)
                if way not in self._held:
                    pair.hand_on(way)
            if mask & selectors.EVENT_WRITE:
                pair.hand_on(_back(way))
        except OSError:  # one side has reset it
            self._drop(pair)

    def _hold_if_awaited(self, pair: _Pair, way: Way) -> None:
        if self._awaited and self._awaited[0] == way and pair.waits(way, self._awaited[1]):
            self._held.add(way)
            self._awaited[2].set()
            self._awaited = None

    def _drop(self, pair: _Pair) -> None:
        self._pairs.remove(pair)
        for end in pair.ends.values():
            if end in self._selector.get_map():
                self._selector.unregister(end)
            if pair.over:
                end.close()
            else:
                _reset(end)


class _Pair:
    """One connection: for each way the end where it begins, what was taken from that, and whether that has ended."""

    def __init__(self, client: socket.socket, broker: socket.socket) -> None:
        self.ends: dict[Way, socket.socket] = {"to_broker": client, "to_client": broker}
        self._waiting: dict[Way, bytearray] = {way: bytearray() for way in WAYS}
        self._ended: set[Way] = set()
        self._closed: set[Way] = set()
        for each in self.ends.values():
            each.setblocking(False)
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def over(self) -> bool:
        """Whether both sides have ended it, and know that of each other."""
        return len(self._closed) == len(WAYS)

    def takes(self, way: Way) -> bool:
        return way not in self._ended and len(self._waiting[way]) < _PIECE

    def has(self, way: Way) -> bool:
        """Whether there is something to hand on, the end included."""
        return bool(self._waiting[way]) or (way in self._ended and way not in self._closed)

    def waits(self, way: Way, words: bytes) -> bool:
        """Whether these bytes are among what was taken and not handed on."""
        return words in self._waiting[way]

    def take(self, way: Way) -> None:
        with contextlib.suppress(BlockingIOError):
            data = self.ends[way].recv(_PIECE)
            self._waiting[way] += data
            if not data:
                self._ended.add(way)

    def hand_on(self, way: Way) -> None:
        waiting, to = self._waiting[way], self.ends[_back(way)]
        with contextlib.suppress(BlockingIOError):
            if waiting:
                del waiting[: to.send(waiting)]
            if not waiting and way in self._ended and way not in self._closed:
                self._closed.add(way)
                to.shutdown(socket.SHUT_WR)


def _back(way: Way) -> Way:
    return "to_client" if way == "to_broker" else "to_broker"


def _reset(connection: socket.socket) -> None:
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
    connection.close()
