"""Rows about a busy server: goals per second."""

from __future__ import annotations

import contextlib
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from talkcli.protocol.lines import encode
from tests.support.connection import Wire
from tests.tools.bench.harness import serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from tests.tools.bench.harness import Harness

_PATIENCE_S = 60.0
#: Goals per round. Each ends at once, without words.
GOALS = 2_000
_TEXT = "length=0 words=0"
#: Required goals per second, by the number of connections.
_REQUIRED_RATES = {1: 5_000, 50: 3_000}
_MOST_ROUNDS = 6


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
    with contextlib.ExitStack() as stack:
        wires = [stack.enter_context(Wire(path)) for _ in range(connections)]
        pool = stack.enter_context(ThreadPoolExecutor(connections))
        started_at = time.monotonic()
        ends = [end for each in pool.map(_speak, wires, [GOALS // connections] * connections) for end in each]
        seconds = time.monotonic() - started_at
    assert ends == ["SUCCEEDED"] * GOALS, f"{ends.count('SUCCEEDED')} of {GOALS} goals"
    return GOALS / seconds


def _speak(wire: Wire, count: int) -> list[str]:
    """Send goals on a connection, and return their final states."""
    lines = [encode({"seq": n + 1, "request": "say", "text": _TEXT, "wait": True}) for n in range(count)]
    threading.Thread(target=wire.send_raw, args=(b"".join(lines),), daemon=True).start()
    return [wire.receive_event("result", _PATIENCE_S)["goal"]["state"] for _ in range(count)]
