"""Rows about a busy server: goals per second, and a thousand waiting clients."""

from __future__ import annotations

import contextlib
import json
import resource
import select
import socket
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from talkcli import Client
from talkcli.protocol.lines import encode
from tests.tools.bench.harness import serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.tools.bench.harness import Harness

_PATIENCE_S = 60.0
_RESULT = b'"event": "result"'
#: Goals per round of `throughput`. Each ends at once, without words.
GOALS = 2_000
_TEXT = "length=0 words=0"
#: Required goals per second, by the number of connections.
_REQUIRED_RATES = {1: 5_000, 50: 3_000}
_MOST_ROUNDS = 6
#: Number of clients that wait for one goal.
CLIENTS = 1_000


class Wires(contextlib.ExitStack):
    """Connections to a server in one thread. Nothing is decoded during the measurement."""

    def __init__(self, path: str, count: int) -> None:
        super().__init__()
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, count + 200)), hard))
        self._poll = self.enter_context(contextlib.closing(select.epoll()))
        self._received: dict[int, list[bytes]] = {}
        self._sockets: dict[int, socket.socket] = {}
        for _ in range(count):
            wire = self.enter_context(socket.socket(socket.AF_UNIX))
            wire.settimeout(_PATIENCE_S)
            wire.connect(path)
            wire.sendall(b'{"seq": 0, "request": "hello", "name": "bench"}\n')
            reply = b""
            while reply.count(b"\n") < 2:
                data = wire.recv(4096)
                assert data, f"a connection was refused: {reply!r}"
                reply += data
            assert b'"error"' not in reply, reply
            self._sockets[wire.fileno()] = wire
            self._poll.register(wire, select.EPOLLIN)

    def exchange(self, data: bytes, wanted: bytes, count: int, first: Callable[[], object] = int) -> float:
        """Send data on each connection, and return the seconds until each has received `wanted` `count` times.

        `first` is called before, and its time is included.
        """
        self._received = {number: [] for number in self._sockets}
        missing, tails = dict.fromkeys(self._sockets, count), dict.fromkeys(self._sockets, b"")
        sending = threading.Thread(target=self._send, args=(data,), daemon=True)
        start = time.monotonic()
        first()
        sending.start()
        while missing:
            ready = self._poll.poll(_PATIENCE_S)
            assert ready, f"{len(missing)} connections have not received {count} times {wanted!r}"
            for number, _ in ready:
                piece = self._sockets[number].recv(1 << 18)
                assert piece, "the server closed a connection"
                self._received[number].append(piece)
                if number in missing:
                    new = tails[number] + piece
                    missing[number] -= new.count(wanted)
                    tails[number] = new[1 - len(wanted) :]
                    if missing[number] <= 0:
                        del missing[number]
        seconds = time.monotonic() - start
        sending.join()
        return seconds

    def _send(self, data: bytes) -> None:
        for wire in self._sockets.values():
            wire.sendall(data)

    def received(self) -> list[dict[str, Any]]:
        """Return all messages of the last exchange."""
        return [json.loads(line) for pieces in self._received.values() for line in b"".join(pieces).splitlines()]


def throughput(harness: Harness) -> list[Row]:
    """Measure the goals per second of a server with an engine that takes no time."""
    rates: dict[int, list[float]] = {connections: [] for connections in _REQUIRED_RATES}
    with serving("--max-queue", str(2 * GOALS), scripted=True) as talk:
        for number in range(min(_MOST_ROUNDS, harness.options.rounds) + 1):
            for connections in _REQUIRED_RATES:
                rate = _goals_per_second(talk.socket, connections)
                rates[connections] += [rate] if number else []  # the first round only warms up
    return [
        Row(
            f"goals accepted, queued and ended: {connections} connection{'s' * (connections > 1)}",
            "/s",
            rates[connections],
            limits=(Limit("median", bound, at_least=True),),
        )
        for connections, bound in _REQUIRED_RATES.items()
    ]


def _goals_per_second(path: str, connections: int) -> float:
    count = GOALS // connections
    with Wires(path, connections) as wires:
        lines = [encode({"seq": n + 1, "request": "say", "text": _TEXT, "wait": True}) for n in range(count)]
        seconds = wires.exchange(b"".join(lines), _RESULT, count)
        ends = [line["goal"]["state"] for line in wires.received() if line.get("event") == "result"]
    assert ends == ["SUCCEEDED"] * (count * connections), f"{ends.count('SUCCEEDED')} of {count * connections} goals"
    return count * connections / seconds


def crowd(harness: Harness) -> list[Row]:
    """Measure the time until the last of many waiting clients has the result."""
    with serving("--max-clients", str(CLIENTS + 100), scripted=True) as talk:
        times = harness.in_turn({"all": partial(_last_result, talk.socket)}, min(10, harness.options.rounds))
    name, limit = f"{CLIENTS:,} waiting clients: cancel → result at the last client", Limit("median", 50)
    return [Row(name, "ms", times["all"], limits=(limit,))]


def _last_result(path: str) -> float:
    with Client(path) as client, Wires(path, CLIENTS) as wires:
        goal = client.say("never-ends")
        wait = encode({"seq": 1, "request": "wait", "ids": [goal.id]})
        wires.exchange(wait, b'"ok": true', 1)
        seconds = wires.exchange(b"", _RESULT, 1, goal.request_cancel)
        goal.wait(10)
    return seconds
