"""What an idle server takes: context switches, processor time and memory of its process and the engine process."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.bench.table import Limit, Row
from tests.support.census import count

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tests.bench.stage import Stage

#: Seconds without a switch after which a server has done what was left to do.
_STILL, _PATIENCE = 1.0, 15.0


@dataclass(frozen=True, slots=True)
class Taken:
    """What processes have taken so far, all their threads together."""

    switches: int
    #: seconds of processor time
    processor: float

    def since(self, before: Taken) -> Taken:
        """Return what was taken since then."""
        return Taken(self.switches - before.switches, self.processor - before.processor)


def taken(pids: Iterable[int]) -> Taken:
    """Count the context switches, voluntary and not, and the processor time of these processes."""
    switches, processor = 0, 0.0
    for pid in pids:
        for thread in os.listdir(f"/proc/{pid}/task"):
            with open(f"/proc/{pid}/task/{thread}/status", encoding="utf-8") as status:
                switches += sum(int(line.split()[1]) for line in status if "ctxt_switches:" in line)
            processor += _processor(f"/proc/{pid}/task/{thread}")
    return Taken(switches, processor)


def megabytes(pid: int, kind: str) -> float:
    """Return what a process has of the memory: "Rss", all of it, or "Pss", what it shares as its part of that."""
    with open(f"/proc/{pid}/smaps_rollup", encoding="utf-8") as file:
        return next(int(each.split()[1]) for each in file if each.startswith(f"{kind}:")) / 1024


def settle(pids: Iterable[int]) -> None:
    """Wait until a server stands still: what it owes to clients that are gone has its own time."""
    pids = list(pids)
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        before = taken(pids)
        time.sleep(_STILL)
        if taken(pids).since(before).switches == 0:
            return


def idle(stage: Stage) -> list[Row]:
    """Measure a server that has spoken and has nothing to do, for a minute."""
    with stage.server() as server:
        with server.client() as client:
            client.say("ready").wait(10)
        settle(server.pids)
        memory = count(server.pids[0]).memory / 1024
        before, began = taken(server.pids), time.monotonic()
        time.sleep(stage.options.idle)
        seconds = time.monotonic() - began
        found = taken(server.pids).since(before)
    return [
        *rest(f"idle for {seconds:.0f} s", "server and engine", found, seconds),
        Row("idle", "memory of server and engine process (Pss)", "MB", (memory,), limits=(Limit("median", 28),)),
    ]


def rest(where: str, whose: str, found: Taken, seconds: float) -> list[Row]:
    """Return the rows of what processes took in so many seconds, in which nothing was asked of them."""
    share = found.processor / seconds * 100
    switches = (found.switches / seconds,)
    return [
        Row("idle", f"{where}: context switches of {whose} a second", "/s", switches, limits=(Limit("median", 1),)),
        # 0.0 as `top` shows it.
        Row("idle", f"{where}: processor time of {whose}", "%", (share,), limits=(Limit("median", 0.05),)),
    ]


def _processor(task: str) -> float:
    with contextlib.suppress(OSError), open(f"{task}/schedstat", encoding="ascii") as file:
        return int(file.read().split()[0]) / 1e9
    with open(f"{task}/stat", encoding="utf-8") as file:  # to a hundredth of a second, where the kernel counts no finer
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
