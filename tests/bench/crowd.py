"""A thousand clients that wait for one goal: when the last of them knows that it has ended."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from tests.bench.installed import serve
from tests.bench.onset import milliseconds
from tests.bench.table import Limit, Row
from tests.bench.throughput import RESULT
from tests.bench.wires import Wires

if TYPE_CHECKING:
    from tests.bench.installed import Server
    from tests.bench.stage import Stage

CLIENTS = 1_000


def crowd(stage: Stage) -> list[Row]:
    """Measure from a cancel, sent by another client, to its result's arrival at the last of those who wait."""
    with serve(stage.scripted("--max-clients", str(CLIENTS + 100)), {}) as server:
        times = [last_to_know(server, CLIENTS) for _ in range(min(10, stage.options.rounds) + 1)][1:]
    name = f"{CLIENTS:,} waiting clients: cancel → result at the last of them"
    return [Row("crowd", name, "ms", milliseconds(times), limits=(Limit("median", 50),))]


def last_to_know(server: Server, clients: int) -> float:
    """Return the seconds from a cancel to the result's arrival at the last of so many clients."""
    with server.client() as client, Wires(server.socket, clients) as wires:
        goal = client.say("never-ends", follow=False)
        wait = json.dumps({"seq": 1, "request": "wait", "ids": [goal.id]}).encode() + b"\n"
        wires.exchange([wait] * clients, b'"ok": true', 1)
        handle = client.follow([goal.id])[0]
        seconds = wires.exchange([b""] * clients, RESULT, 1, handle.request_cancel)
        handle.wait(10)
    return seconds
