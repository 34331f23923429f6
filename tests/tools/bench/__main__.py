"""Compare talk with other programs, and print a table (see `python -m tests.tools.bench --help`)."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.errors import TalkError
from tests.tools.bench import fleet, growing, load, machine, processes, sound
from tests.tools.bench.harness import Harness, Options
from tests.tools.bench.table import Row, as_table

if TYPE_CHECKING:
    from collections.abc import Callable

_ABOUT = """\
Start a private sound server with a null sink, a private speech-dispatcher (if it is installed) and talk. Run talk and
the other programs in turn, record the sound at the sink, and print medians, 99th percentiles and ratios. Nothing is
played aloud. This takes less than ten minutes, one of them for the idle server. Compare the ratios of one run, because
the times depend on the machine and its load. The exit code is 1 if a row could not be measured. A missed goal is not an
error.
"""
GROUPS: dict[str, Callable[[Harness], list[Row]]] = {
    "onset": sound.onset,
    "at-once": sound.at_once,
    "cancel": sound.cancel,
    "connection": sound.connection,
    "pause": sound.pause,
    "preempt": sound.preempt,
    "gap": sound.gap,
    "long-text": sound.long_text,
    "growing": growing.growing,
    "commands": processes.commands,
    "idle": processes.idle,
    "throughput": load.throughput,
}
#: Groups that are only measured if they are named.
NAMED: dict[str, Callable[[Harness], list[Row]]] = {
    "fleet": fleet.fleet,
}


def measure(name: str, harness: Harness) -> list[Row]:
    """Return the rows of a group, or one row with the reason why they couldn't be measured."""
    try:
        return (GROUPS | NAMED)[name](harness)
    except (TalkError, AssertionError, OSError, subprocess.SubprocessError, pytest.skip.Exception) as error:
        return [Row(f"({name})", "", failure=f"{type(error).__name__}: {error}")]


def main() -> None:
    parser = argparse.ArgumentParser("python -m tests.tools.bench", description=_ABOUT)
    names = f"{', '.join(GROUPS)}; {', '.join(NAMED)} (the last one only if it is named)"
    parser.add_argument("rows", nargs="*", metavar="ROW", help=names)
    parser.add_argument("--rounds", type=int, default=15, help="rounds of each row; some rows have more (%(default)s)")
    parser.add_argument(
        "--idle", type=float, default=60, metavar="SECONDS", help="time for idle processes (%(default)g)"
    )
    options = parser.parse_args()
    unknown = set(options.rows) - {*GROUPS, *NAMED}
    if unknown:
        parser.error(f"unknown rows: {', '.join(sorted(unknown))}")
    facts, started_at, rows = machine.describe(), time.monotonic(), []
    with Harness(Options(options.rounds, options.idle)) as harness:
        for name in options.rows or GROUPS:
            print(f"{name} …", file=sys.stderr, flush=True)
            rows += measure(name, harness)
    facts["load average"] += f", at the end {machine.load()}"
    facts["took"] = f"{time.monotonic() - started_at:.0f} s"
    print("; ".join(f"{name} {value}" for name, value in facts.items()), as_table(rows), sep="\n\n")
    sys.exit(any(row.failure is not None for row in rows))


if __name__ == "__main__":
    main()
