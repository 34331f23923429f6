"""Goals a second through the whole server, with a scripted engine that takes no time for any of them.

Each goal is accepted, queued, told to begin, ended, and its result told to the connection that sent it. The floor is
measured beside it, in turn and by the same client: a bare server, which tells the client as much and decides nothing,
with an engine process and a thread that hears it, as talk has them, and without.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
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
#: What is asked for: goals a second, by the number of connections.
_BOUNDS = {1: 5_000, 50: 3_000}
_BARE = str(Path(__file__).with_name("bare_serve.py"))
#: Goals of the round that warms up.
_FIRST = 500
_MOST_ROUNDS = 6


def throughput(stage: Stage) -> list[Row]:
    """Measure talk and the bare servers, with one connection and with fifty, in turn."""
    rounds = min(_MOST_ROUNDS, stage.options.rounds)
    bare = [stage.installed.python, _BARE]
    commands = {"talk": stage.scripted("--max-queue", str(2 * GOALS)), "bare": bare, "alone": [*bare, "--alone"]}
    rates: dict[tuple[str, int], list[float]] = {(name, count): [] for name in commands for count in _BOUNDS}
    with contextlib.ExitStack() as stack:
        servers = {name: stack.enter_context(serve(command, {})) for name, command in commands.items()}
        for server in servers.values():
            goals_a_second(server, 50, _FIRST)
        for _ in range(rounds):
            for (name, connections), into in rates.items():
                into.append(goals_a_second(servers[name], connections, GOALS))
    rows = []
    for connections, bound in _BOUNDS.items():
        over = f"{connections} connection{'s' * (connections > 1)}"
        ours, floor, alone = (tuple(rates[name, connections]) for name in commands)
        rows += [
            Row(
                "throughput",
                f"goals accepted, queued and finished: {over}",
                "/s",
                ours,
                "bare server",
                floor,
                (Limit("median", bound, at_least=True),),
            ),
            Row(
                "throughput", f"… the bare server, alone or with an engine process: {over}", "/s", alone, "bare", floor
            ),
        ]
    return rows


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
