"""Whole processes: each command that ends by itself, from its start to its end, against `python -c "import click"`.

All are of one environment, started in turn, each round in another order. The server has the `null` player: nothing
needs to be heard here, and no sound takes processor time from what is timed.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from tests.bench.ear import Command
from tests.bench.onset import milliseconds
from tests.bench.table import Limit, Row

if TYPE_CHECKING:
    from tests.bench.stage import Stage

#: What scripts call all the time.
LIGHT = (("status",), ("say", "battery low"), ("cancel",))
OTHERS = (
    ("wait",),
    ("log",),
    ("set",),
    ("pause",),
    ("resume",),
    ("voices",),
    ("serve", "--print-unit", "user"),
    ("--version",),
    ("--help",),
)
#: Rounds are short here.
MORE_ROUNDS = 3
_CLICK = "python -c 'import click'"


def commands(stage: Stage) -> list[Row]:
    """Measure all of them in turn, a bare start of Python as well."""
    talk, python = stage.installed.talk, stage.installed.python
    subjects = {" ".join(each): [talk, *each] for each in (*LIGHT, *OTHERS)}
    subjects |= {_CLICK: [python, "-c", "import click"], "python -c pass": [python, "-c", "pass"]}
    times: dict[str, list[float]] = {each: [] for each in subjects}
    names = list(subjects)
    with stage.server("--player", "null", heard=False) as server, server.client() as client:
        for _ in range(stage.options.rounds * MORE_ROUNDS + 1):
            for name in stage.shuffled(names):
                began = time.monotonic()
                Command(subjects[name], server.env).finish()
                times[name].append(time.monotonic() - began)
                if name == "pause":
                    client.resume()
                elif name.startswith("say"):
                    client.cancel()  # all that is timed is timed on an idle server
    found = {name: milliseconds(each[1:]) for name, each in times.items()}

    def row(name: str, limit: float) -> Row:
        return Row("commands", f"`talk {name}`", "ms", found[name], _CLICK, found[_CLICK], (Limit("ratio", limit),))

    return [
        *(row(" ".join(each), 0.7) for each in LIGHT),
        *(row(" ".join(each), 1.25) for each in OTHERS),
        Row("commands", "`python -c pass`", "ms", found["python -c pass"], _CLICK, found[_CLICK]),
    ]
