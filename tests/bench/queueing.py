"""What a step costs while 10,000 goals are pending, against 1,000, and what a pending goal takes of memory.

The steps are the scheduler's own and the status line's, in this process; the memory is that of a server.
"""

from __future__ import annotations

import gc
import time
from itertools import count, islice
from typing import TYPE_CHECKING

from talkcli.goals.goal import Sender
from talkcli.goals.options import Cancel, Say
from talkcli.goals.scheduler import Now, Scheduler
from talkcli.protocol import events
from talkcli.protocol.lines import encode
from tests.bench.installed import serve
from tests.bench.table import Limit, Row
from tests.bench.wires import Wires
from tests.support import census

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.bench.stage import Stage

FEW, MANY = 1_000, 10_000
#: Pending goals of the server whose memory is measured, above those that bring what is there only once.
PENDING, FIRST = 9_900, 100
_SENDER = Sender(pid=7, uid=1000, command="talk", name="bench")
_NOW = Now(100.0, 1.7e9)
_WAITING = "goal {} is waiting"
#: Steps that are timed together: one alone is shorter than a clock is exact.
TIMES = 200


class Crowd:
    """A scheduler that is saying something while so many goals wait, and the steps whose cost is measured."""

    def __init__(self, size: int) -> None:
        self.scheduler = Scheduler("4k7f", max_queue=size + TIMES + 1)
        self._names = count()
        self._chosen: list[str] = []
        self.enqueue()  # it is being spoken
        for _ in range(size):
            self.enqueue()

    def enqueue(self) -> None:
        """Accept a goal."""
        number = next(self._names)
        say = Say(_WAITING.format(number), priority=number % 5, id=f"goal:{number}")
        self.scheduler.submit(say, _SENDER, _NOW)

    def choose(self, count: int) -> None:
        """Choose so many in the middle of those that wait, to be cancelled."""
        first = (self.scheduler.pending_count - count) // 2
        self._chosen = [each.id for each in islice(self.scheduler.pending(), first, first + count)]

    def cancel(self) -> None:
        """Cancel one of those that were chosen, by its id."""
        self.scheduler.cancel(Cancel((self._chosen.pop(),)), _SENDER, _NOW)

    def status(self, lines: int) -> None:
        """Make so many lines of a status."""
        for record in islice(self.scheduler.pending(), lines):
            encode(events.item(1, pending=record.snapshot().to_json()))


def queueing(stage: Stage) -> list[Row]:
    """Measure each step with few goals pending and with many, in turn; then the memory."""
    few, many = Crowd(FEW), Crowd(MANY)
    gc.collect()
    gc.disable()  # a collection that looks at all of them would fall into one step or another
    try:
        times: dict[str, tuple[list[float], list[float]]] = {each: ([], []) for each in ("enqueue", "cancel", "status")}
        for _ in range(stage.options.rounds * 3):
            for crowd, place in ((few, 0), (many, 1)):
                for name, seconds in timed(crowd).items():
                    times[name][place].append(seconds)
    finally:
        gc.enable()
    names = {"enqueue": "one enqueue", "cancel": "one cancel in the middle", "status": "one line of a status"}
    rows = [
        Row(
            "queue",
            f"{names[name]}, {MANY:,} goals pending",
            "µs",
            _microseconds(with_many),
            f"{FEW:,} pending",
            _microseconds(with_few),
            (Limit("ratio", 1.5),),
        )
        for name, (with_few, with_many) in times.items()
    ]
    return [*rows, memory(stage)]


def timed(crowd: Crowd) -> dict[str, float]:
    """Return the seconds of one of each step; there are as many goals afterwards as before."""

    def seconds(step: Callable[[], None]) -> float:
        began = time.perf_counter()
        for _ in range(TIMES):
            step()
        return (time.perf_counter() - began) / TIMES

    enqueue = seconds(crowd.enqueue)
    crowd.choose(TIMES)
    cancel = seconds(crowd.cancel)
    began = time.perf_counter()
    crowd.status(TIMES)
    return {"enqueue": enqueue, "cancel": cancel, "status": (time.perf_counter() - began) / TIMES}


def memory(stage: Stage) -> Row:
    """Measure by how much a server grows with each goal that waits."""
    with serve(stage.scripted("--max-queue", str(PENDING + FIRST)), {}) as server:
        pid = server.pids[0]
        with Wires(server.socket, 1) as wires:
            first = ["never-ends", *(_WAITING.format(each) for each in range(FIRST))]
            wires.exchange([_goals(first)], b'"ok"', len(first))
            before = census.count(pid).memory
            wires.exchange([_goals([_WAITING.format(each) for each in range(PENDING)])], b'"ok"', PENDING)
            grown = census.count(pid).memory - before
            with server.client() as client:
                client.cancel()
    size = grown * 1024 / PENDING
    return Row("queue", "memory of a pending goal, in the server", "B", (size,), limits=(Limit("median", 1024),))


def _goals(texts: list[str]) -> bytes:
    return b"".join(encode({"seq": number, "request": "say", "text": text}) for number, text in enumerate(texts, 1))


def _microseconds(seconds: list[float]) -> tuple[float, ...]:
    return tuple(each * 1e6 for each in seconds)
