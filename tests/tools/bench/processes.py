"""Rows about processes: the duration of each command, and an idle server."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from talkcli import Client
from tests.support.usage import count, descendants
from tests.tools.bench.harness import PYTHON, TALK, serving
from tests.tools.bench.machine import measure_use
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from tests.tools.bench.harness import Harness

#: Commands that scripts run often, and other commands that end by themselves.
LIGHT = (("status",), ("say", "battery low"), ("cancel",))
OTHERS = (
    *(("wait",), ("log",), ("set",), ("pause",), ("resume",), ("voices",)),
    *(("serve", "--print-unit", "user"), ("--version",), ("--help",)),
)
_MORE_ROUNDS = 3
_CLICK, _PASS = "python -c 'import click'", "python -c pass"


def commands(harness: Harness) -> list[Row]:
    """Measure commands with a server that has the `null` player, and starts of Python for comparison."""
    with serving("--player", "null") as talk, Client(talk.socket) as client:

        def run(*command: str) -> float:
            seconds = harness.until_end(command, talk.env)
            if command[1] == "pause":
                client.resume()
            elif command[1] == "say":
                client.cancel()  # so that the server is idle for the next command
            return seconds

        subjects = {" ".join(words): partial(run, TALK, *words) for words in (*LIGHT, *OTHERS)}
        subjects |= {_CLICK: partial(run, PYTHON, "-c", "import click"), _PASS: partial(run, PYTHON, "-c", "pass")}
        times = harness.in_turn(subjects, harness.options.rounds * _MORE_ROUNDS)
    limits = {" ".join(words): Limit("ratio", 0.7 if words in LIGHT else 1.25) for words in (*LIGHT, *OTHERS)}
    return [
        *(Row(f"`talk {name}`", "ms", times[name], _CLICK, times[_CLICK], (limit,)) for name, limit in limits.items()),
        Row(f"`{_PASS}`", "ms", times[_PASS], _CLICK, times[_CLICK]),
    ]


def idle(harness: Harness) -> list[Row]:
    """Measure an idle server that has spoken."""
    seconds = harness.options.idle
    with serving(sink=harness.sink) as talk:
        with Client(talk.socket) as client:
            client.say("ready").wait(10)
        use = measure_use([talk.pid, *descendants(talk.pid)], seconds)
        memory = count(talk.pid).memory / 1024
    where = f"idle for {seconds:.0f} s"
    switches, share = use.switches / seconds, 100 * use.processor / seconds
    return [
        Row(
            f"{where}: context switches of server and engine per second", "/s", [switches], limits=(Limit("median", 1),)
        ),
        # `top` shows this limit as 0.0.
        Row(f"{where}: processor time of server and engine", "%", [share], limits=(Limit("median", 0.05),)),
        Row("memory of server and engine process (Pss)", "MB", [memory], limits=(Limit("median", 28),)),
    ]
