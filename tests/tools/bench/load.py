"""Rows of a busy server: goals a second, steps while many goals are pending, and a thousand clients that wait."""

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
from tests.tools.bench.stage import serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tests.tools.bench.stage import Stage

_PATIENCE_S = 60.0
_RESULT = b'"event": "result"'
#: Goals of a round of `throughput`; each ends at once, and reports no word.
GOALS = 2_000
_TEXT = "length=0 words=0"
#: The goals a second that are wanted, by the number of connections.
_BOUNDS = {1: 5_000, 50: 3_000}
_MOST_ROUNDS = 6
_BARE = str(Path(__file__).with_name("bare_serve.py"))
#: Pending goals in the scheduler's queue.
FEW, MANY = 1_000, 10_000
#: Pending goals of the server whose memory is measured, and those before them.
PENDING, _FIRST = 9_900, 100
#: Steps that are timed together: one alone is shorter than the clock is exact.
_STEPS = 200
_SENDER, _NOW = Sender(pid=7, uid=1000, command="talk", name="bench"), Now(100.0, 1.7e9)
#: Clients that wait for one goal.
CLIENTS = 1_000


class Wires(contextlib.ExitStack):
    """Connections to a server in one thread, which decodes nothing while the time runs."""

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
            told = b""
            while told.count(b"\n") < 2:
                data = wire.recv(4096)
                assert data, f"a connection was refused: {told!r}"
                told += data
            assert b'"error"' not in told, told
            self._sockets[wire.fileno()] = wire
            self._poll.register(wire, select.EPOLLIN)

    def exchange(self, data: bytes, wanted: bytes, count: int, began: Callable[[], object] = int) -> float:
        """Send data on each connection, and return the seconds until each has received `wanted` so many times.

        `began` is called first, and counts.
        """
        self._received = {each: [] for each in self._sockets}
        missing, tails = dict.fromkeys(self._sockets, count), dict.fromkeys(self._sockets, b"")
        sending = threading.Thread(target=self._send, args=(data,), daemon=True)
        start = time.monotonic()
        began()
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
        for each in self._sockets.values():
            each.sendall(data)

    def received(self) -> list[dict[str, Any]]:
        """Return all that was received in the last exchange, decoded."""
        return [json.loads(line) for each in self._received.values() for line in b"".join(each).splitlines()]


def throughput(stage: Stage) -> list[Row]:
    """Measure goals a second of talk with an engine that takes no time, and of servers that keep no promise."""
    rates: dict[tuple[str, int], list[float]] = {}
    with contextlib.ExitStack() as stack:
        servers = {
            "talk": stack.enter_context(serving("--max-queue", str(2 * GOALS), scripted=True)),
            "bare": stack.enter_context(serving(program=_BARE)),
            "alone": stack.enter_context(serving("--alone", program=_BARE)),
        }
        for number in range(min(_MOST_ROUNDS, stage.options.rounds) + 1):
            for connections in _BOUNDS:
                for name, talk in servers.items():
                    rate = _goals_a_second(talk.socket, connections)
                    if number:  # the first warms up
                        rates.setdefault((name, connections), []).append(rate)
    rows = []
    for connections, bound in _BOUNDS.items():
        ours, floor, alone = (rates[name, connections] for name in servers)
        over = f"{connections} connection{'s' * (connections > 1)}"
        limit = Limit("median", bound, at_least=True)
        name = "… the bare server, without or with an engine process"
        rows += [
            Row(f"goals accepted, queued and ended: {over}", "/s", ours, "bare server", floor, (limit,)),
            Row(f"{name}: {over}", "/s", alone, "bare", floor),
        ]
    return rows


def _goals_a_second(path: str, connections: int) -> float:
    each = GOALS // connections
    with Wires(path, connections) as wires:
        seconds = wires.exchange(_says([_TEXT] * each, wait=True), _RESULT, each)
        ends = [line["goal"]["state"] for line in wires.received() if line.get("event") == "result"]
    assert ends == ["SUCCEEDED"] * (each * connections), f"{ends.count('SUCCEEDED')} of {each * connections} goals"
    return each * connections / seconds


def _says(texts: Iterable[str], **fields: object) -> bytes:
    return b"".join(encode({"seq": n, "request": "say", "text": text, **fields}) for n, text in enumerate(texts, 1))


class BusyScheduler:
    """A scheduler with many pending goals, and the steps whose cost is measured."""

    def __init__(self, size: int) -> None:
        self._scheduler = Scheduler("4k7f", max_queue=size + _STEPS + 1)
        self._numbers = count()
        for _ in range(size + 1):  # the first is being spoken
            self._enqueue()

    def _enqueue(self) -> None:
        number = next(self._numbers)
        say = Say(f"goal {number} is waiting", priority=number % 5, id=f"goal:{number}")
        self._scheduler.submit(say, _SENDER, _NOW)

    def times(self) -> dict[str, float]:
        """Return the microseconds of each step; as many goals are pending afterwards as before."""
        enqueue = _microseconds(repeat(self._enqueue, _STEPS))
        first = (len(self._scheduler.pending) - _STEPS) // 2
        chosen = [each.id for each in islice(self._scheduler.pending, first, first + _STEPS)]
        steps = [partial(self._scheduler.cancel, Cancel((each,)), _SENDER, _NOW) for each in chosen]
        cancel = _microseconds(steps)
        records = iter(self._scheduler.pending)
        line = lambda: encode(events.item(1, pending=next(records).snapshot().to_json()))  # noqa: E731
        status = _microseconds(repeat(line, _STEPS))
        return {"one enqueue": enqueue, "one cancel in the middle": cancel, "one line of a status": status}


def _microseconds(steps: Iterable[Callable[[], object]]) -> float:
    began = time.perf_counter()
    for step in steps:
        step()
    return (time.perf_counter() - began) / _STEPS * 1e6


def queue(stage: Stage) -> list[Row]:
    """Measure each step with few goals pending and with many; then the memory of a pending goal."""
    few, many = BusyScheduler(FEW), BusyScheduler(MANY)
    gc.collect()
    gc.disable()  # a collection would fall into one step or another
    try:
        turns = [(few.times(), many.times()) for _ in range(stage.options.rounds * 3)]
    finally:
        gc.enable()
    rows = []
    for step in turns[0][0]:
        name, limit = f"{step}, {MANY:,} waiting goals", Limit("ratio", 1.5)
        with_few, with_many = ([turn[place][step] for turn in turns] for place in (0, 1))
        rows.append(Row(name, "µs", with_many, f"{FEW:,} waiting", with_few, (limit,)))
    size, limit = _memory_of_a_goal(), Limit("median", 1024)
    return [*rows, Row("memory of a waiting goal, in the server", "B", [size], limits=(limit,))]


def _memory_of_a_goal() -> float:
    with serving("--max-queue", str(PENDING + _FIRST), scripted=True) as talk, Wires(talk.socket, 1) as wires:
        texts = ["never-ends", *(f"goal {each} is waiting" for each in range(PENDING + _FIRST))]
        wires.exchange(_says(texts[: _FIRST + 1]), b'"ok"', _FIRST + 1)
        before = usage.count(talk.pid).memory
        wires.exchange(_says(texts[_FIRST + 1 :]), b'"ok"', PENDING)
        grown = usage.count(talk.pid).memory - before
        talk.request("cancel")
    return grown * 1024 / PENDING


def crowd(stage: Stage) -> list[Row]:
    """Measure how soon the last of many waiting clients knows that their goal has ended."""
    with serving("--max-clients", str(CLIENTS + 100), scripted=True) as talk:
        times = stage.in_turn({"all": partial(_last_to_know, talk.socket)}, min(10, stage.options.rounds))
    name, limit = f"{CLIENTS:,} waiting clients: cancel → result at the last client", Limit("median", 50)
    return [Row(name, "ms", times["all"], limits=(limit,))]


def _last_to_know(path: str) -> float:
    with Client(path) as client, Wires(path, CLIENTS) as wires:
        goal = client.say("never-ends")
        wait = encode({"seq": 1, "request": "wait", "ids": [goal.id]})
        wires.exchange(wait, b'"ok": true', 1)
        seconds = wires.exchange(b"", _RESULT, 1, goal.request_cancel)
        goal.wait(10)
    return seconds
