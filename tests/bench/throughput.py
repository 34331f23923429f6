"""Goals a second through the whole server, with a scripted engine that takes no time for any of them.

Each goal is accepted, queued, told to begin, ended, and its result told to the connection that sent it.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from tests.bench.failure import FailedError
from tests.bench.installed import serve
from tests.bench.table import Limit, Row
from tests.bench.wires import Wires

if TYPE_CHECKING:
    from tests.bench.installed import Server
    from tests.bench.stage import Stage

GOALS = 2_000
RESULT = b'"event": "result"'
#: Ends at once, and reports no word.
TEXT = "length=0 words=0"
#: Goals of the round that warms up.
_FIRST = 500
_MOST_ROUNDS = 6


def throughput(stage: Stage) -> list[Row]:
    """Measure one connection and fifty, in turn."""
    rounds = min(_MOST_ROUNDS, stage.options.rounds)
    rates: dict[int, list[float]] = {1: [], 50: []}
    with serve(stage.scripted("--max-queue", str(2 * GOALS)), {}) as server:
        goals_a_second(server, 50, _FIRST)
        for _ in range(rounds):
            for connections, into in rates.items():
                into.append(goals_a_second(server, connections, GOALS))
    return [
        Row(
            "throughput",
            f"goals accepted, queued and finished: {connections} connection{'s' * (connections > 1)}",
            "/s",
            tuple(found),
            limits=(Limit("median", bound, at_least=True),),
        )
        for (connections, found), bound in zip(rates.items(), (5_000, 3_000), strict=True)
    ]


def goals_a_second(server: Server, connections: int, goals: int) -> float:
    """Send so many goals over so many connections, and return how many a second had their results."""
    each = goals // connections
    lines = b"".join(
        json.dumps({"seq": number, "request": "say", "text": TEXT, "wait": True}).encode() + b"\n"
        for number in range(1, each + 1)
    )
    with Wires(server.socket, connections) as wires:
        seconds = wires.exchange([lines] * connections, RESULT, each)
        ends = [line["goal"]["state"] for line in wires.received() if line.get("event") == "result"]
    if ends != ["SUCCEEDED"] * (each * connections):
        raise FailedError(f"{ends.count('SUCCEEDED')} of {each * connections} goals SUCCEEDED")
    return each * connections / seconds
