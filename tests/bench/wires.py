"""Connections by the thousand in one thread, which send what is ready-made and count what comes: as light as can be.

Whatever the benchmark itself does takes from the machine that the server runs on; so nothing is decoded while the time
runs.
"""

from __future__ import annotations

import contextlib
import json
import resource
import select
import socket
import time
from typing import TYPE_CHECKING, Any

from tests.bench.failure import FailedError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_PATIENCE = 60.0
_HELLO = b'{"seq": 0, "request": "hello", "name": "bench"}\n'


class _Wire:
    """One connection, greeted."""

    def __init__(self, path: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.received: list[bytes] = []
        self.rest = memoryview(b"")
        self._tail = b""
        try:
            self.socket.settimeout(_PATIENCE)
            self.socket.connect(path)
            self.socket.sendall(_HELLO)
            lines = b""
            while lines.count(b"\n") < 2:
                data = self.socket.recv(4096)
                if not data or b'"error"' in data:
                    raise FailedError(f"a connection was refused: {(lines + data).decode(errors='replace')}")
                lines += data
            self.socket.setblocking(False)
        except BaseException:
            self.socket.close()
            raise

    def read(self, wanted: bytes) -> int:
        """Take what has come; return how many times what is wanted is in it."""
        data = self.socket.recv(1 << 18)
        if not data:
            raise FailedError("the server closed a connection")
        self.received.append(data)
        found = (self._tail + data).count(wanted)
        self._tail = (self._tail + data)[1 - len(wanted) :]
        return found

    def write(self) -> bool:
        """Send what goes; return whether that was the last of it."""
        self.rest = self.rest[self.socket.send(self.rest[: 1 << 16]) :]
        return not self.rest


class Wires(contextlib.AbstractContextManager["Wires"]):
    """So many connections to a server, all greeted."""

    def __init__(self, path: str, count: int) -> None:
        allow(count + 100)
        self._wires: list[_Wire] = []
        self._poll = select.epoll()
        try:
            for _ in range(count):
                self._wires.append(_Wire(path))
                self._poll.register(self._wires[-1].socket, select.EPOLLIN)
        except BaseException:
            self.close()
            raise
        self._by_descriptor = {each.socket.fileno(): each for each in self._wires}

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._poll.close()
        for each in self._wires:
            each.socket.close()

    def exchange(self, data: Sequence[bytes], wanted: bytes, count: int, began: Callable[[], object] = int) -> float:
        """Send each connection its data and read until each has had `count` times what is wanted; return the seconds.

        `began` is called first, and counts.
        """
        missing = dict.fromkeys(self._wires, count)
        for wire, each in zip(self._wires, data, strict=True):
            wire.rest = memoryview(each)
            self._poll.modify(wire.socket, select.EPOLLIN | (select.EPOLLOUT if each else 0))
        start = time.monotonic()
        began()
        while missing:
            ready = self._poll.poll(_PATIENCE)
            if not ready:
                raise FailedError(f"{len(missing)} connections have not had their {count} × {wanted.decode()}")
            for descriptor, event in ready:
                wire = self._by_descriptor[descriptor]
                if event & select.EPOLLOUT and wire.write():
                    self._poll.modify(descriptor, select.EPOLLIN)
                if event & ~select.EPOLLOUT and wire in missing:
                    missing[wire] -= wire.read(wanted)
                    if missing[wire] <= 0:
                        del missing[wire]
        return time.monotonic() - start

    def received(self) -> list[dict[str, Any]]:
        """Return all that has come since the last call, decoded; call it when no time runs."""
        lines = [line for wire in self._wires for line in b"".join(wire.received).splitlines()]
        for wire in self._wires:
            wire.received.clear()
        return [json.loads(line) for line in lines]


def allow(descriptors: int) -> None:
    """Let this process have so many descriptors; FailedError where it may not."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < descriptors:
        if hard != resource.RLIM_INFINITY and hard < descriptors:
            raise FailedError(f"{descriptors} descriptors are needed, {hard} are allowed (ulimit -n)")
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, hard))
