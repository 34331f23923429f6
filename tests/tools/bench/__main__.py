"""Measures talk beside its alternatives, and prints a table: see `python -m tests.tools.bench --help`."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.errors import TalkError
from tests.tools.bench import fleet, growing, heard, load, machine, marathon, processes
from tests.tools.bench.stage import Options, Stage
from tests.tools.bench.table import Row, as_table

if TYPE_CHECKING:
    from collections.abc import Callable

_ABOUT = """\
Starts a sound server with a null sink, a speech-dispatcher (if it is installed) and talk, all private. Runs talk and
its peers in turn, listens at the sink, and prints medians, 99th percentiles and ratios. Nothing is played aloud. It
takes under ten minutes, one of them for the idle server. Compare the ratios of one run: the times depend on the
machine and on its load. The exit code is 1 if a row could not be measured. A goal that is not met is no error.
"""
GROUPS: dict[str, Callable[[Stage], list[Row]]] = {
    "recorder": heard.recorder,
    "onset": heard.onset,
    "at-once": heard.at_once,
    "cancel": heard.cancel,
    "connection": heard.connection,
    "pause": heard.pause,
    "preempt": heard.preempt,
    "gap": heard.gap,
    "long-text": heard.long_text,
    "growing": growing.growing,
    "commands": processes.commands,
    "idle": processes.idle,
    "throughput": load.throughput,
    "queue": load.queue,
    "crowd": load.crowd,
}
#: Measured only if they are named.
NAMED: dict[str, Callable[[Stage], list[Row]]] = {
    "neural": heard.neural,
    "fleet": fleet.fleet,
    "marathon": marathon.marathon,
}


def measure(name: str, stage: Stage) -> list[Row]:
    """Return the rows of a group, or one row with the reason why they could not be measured."""
    try:
        return (GROUPS | NAMED)[name](stage)
    except (TalkError, AssertionError, OSError, subprocess.SubprocessError, pytest.skip.Exception) as error:
        return [Row(f"({name})", "", failure=f"{type(error).__name__}: {error}")]


def main() -> None:
    """Measure the rows that the command line names."""
    parser = argparse.ArgumentParser("python -m tests.tools.bench", description=_ABOUT)
    names = f"{', '.join(GROUPS)}; {', '.join(NAMED)} (these three only if they are named)"
    parser.add_argument("rows", nargs="*", metavar="ROW", help=names)
    parser.add_argument("--rounds", type=int, default=15, help="rounds of each row; some take more (%(default)s)")
    parser.add_argument("--idle", type=float, default=60, metavar="SECONDS", help="of idle processes (%(default)g)")
    parser.add_argument("--sentences", type=int, default=10_000, help="of the marathon (%(default)s)")
    asked = parser.parse_args()
    unknown = set(asked.rows) - {*GROUPS, *NAMED}
    if unknown:
        parser.error(f"unknown rows: {', '.join(sorted(unknown))}")
    found, began, rows = machine.head(), time.monotonic(), []
    with Stage(Options(asked.rounds, asked.idle, asked.sentences)) as stage:
        for name in asked.rows or GROUPS:
            print(f"{name} …", file=sys.stderr, flush=True)
            rows += measure(name, stage)
    found["load average"] += f", at the end {machine.load()}"
    found["took"] = f"{time.monotonic() - began:.0f} s"
    print("; ".join(f"{name} {value}" for name, value in found.items()), as_table(rows), sep="\n\n")
    sys.exit(any(each.failure is not None for each in rows))


if __name__ == "__main__":
    main()
