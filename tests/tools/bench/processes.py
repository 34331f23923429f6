"""Rows of whole processes: each command from its start to its end, and a server that is idle."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from talkcli import Client
from tests.support.usage import count, descendants
from tests.tools.bench.machine import taken_in
from tests.tools.bench.stage import PYTHON, TALK, serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from tests.tools.bench.stage import Stage

#: The commands that scripts call all the time, and the others that end by themselves.
LIGHT = (("status",), ("say", "battery low"), ("cancel",))
OTHERS = (
    *(("wait",), ("log",), ("set",), ("pause",), ("resume",), ("voices",)),
    *(("serve", "--print-unit", "user"), ("--version",), ("--help",)),
)
_MORE_ROUNDS = 3
_CLICK, _PASS = "python -c 'import click'", "python -c pass"


def commands(stage: Stage) -> list[Row]:
    """Measure the commands, and bare starts of Python, at a server with the `null` player."""
    with serving("--player", "null") as talk, Client(talk.socket) as client:

        def run(*words: str) -> float:
            seconds = stage.until_end(words, talk.env)
            if words[1] == "pause":
                client.resume()
            elif words[1] == "say":
                client.cancel()  # every command meets an idle server
            return seconds

        subjects = {" ".join(each): partial(run, TALK, *each) for each in (*LIGHT, *OTHERS)}
        subjects |= {_CLICK: partial(run, PYTHON, "-c", "import click"), _PASS: partial(run, PYTHON, "-c", "pass")}
        times = stage.in_turn(subjects, stage.options.rounds * _MORE_ROUNDS)
    limits = {" ".join(each): Limit("ratio", 0.7 if each in LIGHT else 1.25) for each in (*LIGHT, *OTHERS)}
    return [
        *(Row(f"`talk {name}`", "ms", times[name], _CLICK, times[_CLICK], (each,)) for name, each in limits.items()),
        Row(f"`{_PASS}`", "ms", times[_PASS], _CLICK, times[_CLICK]),
    ]


def idle(stage: Stage) -> list[Row]:
    """Measure a server that has spoken, while it has nothing to do."""
    seconds = stage.options.idle
    with serving(sink=stage.sink) as talk:
        with Client(talk.socket) as client:
            client.say("ready").wait(10)
        found = taken_in([talk.pid, *descendants(talk.pid)], seconds)
        memory = count(talk.pid).memory / 1024
    where = f"idle for {seconds:.0f} s"
    switches, share = found.switches / seconds, 100 * found.processor / seconds
    return [
        Row(
            f"{where}: context switches of server and engine per second", "/s", [switches], limits=(Limit("median", 1),)
        ),
        # `top` shows this as 0.0.
        Row(f"{where}: processor time of server and engine", "%", [share], limits=(Limit("median", 0.05),)),
        Row("memory of server and engine process (Pss)", "MB", [memory], limits=(Limit("median", 28),)),
    ]
