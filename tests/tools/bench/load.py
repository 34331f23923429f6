"""Rows about a busy server: goals per second, many pending goals, and a thousand waiting clients."""

from __future__ import annotations

import contextlib
import gc
import json
import resource
import select
import socket
import threading
import time
from functools import partial
from itertools import count, islice, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from talkcli import Client
from talkcli.goals.goal import Sender
from talkcli.goals.options import Cancel, Say
from talkcli.goals.scheduler import Now, Scheduler
from talkcli.protocol import events
from talkcli.protocol.lines import encode
from tests.support import usage
from tests.tools.bench.harness import serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tests.tools.bench.harness import Harness

_PATIENCE_S = 60.0
_RESULT = b'"event": "result"'
#: Goals per round of `throughput`. Each ends at once, without words.
GOALS = 2_000
_TEXT = "length=0 words=0"
#: Required goals per second, by the number of connections.
_REQUIRED_RATES = {1: 5_000, 50: 3_000}
_MOST_ROUNDS = 6
_BARE = str(Path(__file__).with_name("bare_serve.py"))
#: Pending goals in the scheduler's queue.
FEW, MANY = 1_000, 10_000
#: Pending goals whose memory is measured, and pending goals before them.
PENDING, _FIRST = 9_900, 100
#: Number of steps that are timed together, because one step is too short for the clock.
_STEPS = 200
_SENDER, _NOW = Sender(pid=7, uid=1000, command="talk", name="bench"), Now(100.0, 1.7e9)
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
    """Measure the goals per second of talk with an engine that takes no time, and of bare servers."""
    rates: dict[tuple[str, int], list[float]] = {}
    with contextlib.ExitStack() as stack:
        servers = {
            "talk": stack.enter_context(serving("--max-queue", str(2 * GOALS), scripted=True)),
            "bare": stack.enter_context(serving(program=_BARE)),
            "no engine": stack.enter_context(serving("--no-engine", program=_BARE)),
        }
        for number in range(min(_MOST_ROUNDS, harness.options.rounds) + 1):
            for connections in _REQUIRED_RATES:
                for name, talk in servers.items():
                    rate = _goals_per_second(talk.socket, connections)
                    if number:  # the first round only warms up
                        rates.setdefault((name, connections), []).append(rate)
    rows = []
    for connections, bound in _REQUIRED_RATES.items():
        talk_rates, bare_rates, no_engine_rates = (rates[name, connections] for name in servers)
        over = f"{connections} connection{'s' * (connections > 1)}"
        limit = Limit("median", bound, at_least=True)
        name = "… the bare server, without or with an engine process"
        rows += [
            Row(f"goals accepted, queued and ended: {over}", "/s", talk_rates, "bare server", bare_rates, (limit,)),
            Row(f"{name}: {over}", "/s", no_engine_rates, "bare", bare_rates),
        ]
    return rows


def _goals_per_second(path: str, connections: int) -> float:
    count = GOALS // connections
    with Wires(path, connections) as wires:
        seconds = wires.exchange(_say_requests([_TEXT] * count, wait=True), _RESULT, count)
        ends = [line["goal"]["state"] for line in wires.received() if line.get("event") == "result"]
    assert ends == ["SUCCEEDED"] * (count * connections), f"{ends.count('SUCCEEDED')} of {count * connections} goals"
    return count * connections / seconds


def _say_requests(texts: Iterable[str], **fields: object) -> bytes:
    return b"".join(encode({"seq": n, "request": "say", "text": text, **fields}) for n, text in enumerate(texts, 1))


class BusyScheduler:
    """A scheduler with many pending goals, and the steps that are measured."""

    def __init__(self, size: int) -> None:
        self._scheduler = Scheduler("4k7f", max_queue=size + _STEPS + 1)
        self._numbers = count()
        for _ in range(size + 1):  # the first goal is active
            self._enqueue()

    def _enqueue(self) -> None:
        number = next(self._numbers)
        say = Say(f"goal {number} is waiting", priority=number % 5, id=f"goal:{number}")
        self._scheduler.submit(say, _SENDER, _NOW)

    def times(self) -> dict[str, float]:
        """Return the microseconds of each step. The number of pending goals doesn't change."""
        enqueue = _microseconds(repeat(self._enqueue, _STEPS))
        first = (len(self._scheduler.pending) - _STEPS) // 2
        chosen = [goal.id for goal in islice(self._scheduler.pending, first, first + _STEPS)]
        steps = [partial(self._scheduler.cancel, Cancel((goal_id,)), _SENDER, _NOW) for goal_id in chosen]
        cancel = _microseconds(steps)
        records = iter(self._scheduler.pending)
        line = lambda: encode(events.item(1, pending=next(records).snapshot().to_json()))  # noqa: E731
        status = _microseconds(repeat(line, _STEPS))
        return {"one enqueue": enqueue, "one cancel in the middle": cancel, "one line of a status": status}


def _microseconds(steps: Iterable[Callable[[], object]]) -> float:
    started_at = time.perf_counter()
    for step in steps:
        step()
    return (time.perf_counter() - started_at) / _STEPS * 1e6


def queue(harness: Harness) -> list[Row]:
    """Measure each step with few and with many pending goals, and the memory of a pending goal."""
    few, many = BusyScheduler(FEW), BusyScheduler(MANY)
    gc.collect()
    gc.disable()  # a collection would delay some steps
    try:
        rounds = [(few.times(), many.times()) for _ in range(harness.options.rounds * 3)]
    finally:
        gc.enable()
    rows = []
    for step in rounds[0][0]:
        name, limit = f"{step}, {MANY:,} waiting goals", Limit("ratio", 1.5)
        with_few, with_many = ([result[index][step] for result in rounds] for index in (0, 1))
        rows.append(Row(name, "µs", with_many, f"{FEW:,} waiting", with_few, (limit,)))
    size, limit = _memory_of_a_goal(), Limit("median", 1024)
    return [*rows, Row("memory of a waiting goal, in the server", "B", [size], limits=(limit,))]


def _memory_of_a_goal() -> float:
    with serving("--max-queue", str(PENDING + _FIRST), scripted=True) as talk, Wires(talk.socket, 1) as wires:
        texts = ["never-ends", *(f"goal {number} is waiting" for number in range(PENDING + _FIRST))]
        wires.exchange(_say_requests(texts[: _FIRST + 1]), b'"ok"', _FIRST + 1)
        before = usage.count(talk.pid).memory
        wires.exchange(_say_requests(texts[_FIRST + 1 :]), b'"ok"', PENDING)
        grown = usage.count(talk.pid).memory - before
        talk.request("cancel")
    return grown * 1024 / PENDING


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
