"""Measures talk beside what one would use instead, and prints a table: see `python -m tests.bench --help`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time

from tests.bench import machine
from tests.bench.arithmetic import edges
from tests.bench.failure import FailedError
from tests.bench.groups import GROUPS, measure
from tests.bench.stage import Options, Stage, missing
from tests.bench.table import Row, as_markdown, as_text
from tests.support.espeak import RATE
from tests.support.reference import render

_ABOUT = """\
Starts a sound server with a null sink, a speech-dispatcher and the installed talk, all private, runs talk and its
peers in turn, listens at the sink, and prints medians, 99th percentiles and ratios. Nothing is played aloud. With the
usual rounds it takes under ten minutes, of which a minute is the idle server's. Ratios of one run are what counts:
absolute times are those of the machine and of what else it does. Exit code 1 where a row could not be measured (it
says why, in the place of a figure); a goal that is not met is no error.
"""
_HEARD = ("recorder", "onset", "at-once", "cancel", "connection", "pause", "preempt", "gap", "long-text", "idle")


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser("python -m tests.bench", description=_ABOUT)
    parser.add_argument("--rounds", type=int, default=15, help="rounds of each row; short ones take more (%(default)s)")
    parser.add_argument("--idle", type=float, default=60, metavar="SECONDS", help="of the idle server (%(default)g)")
    parser.add_argument(
        "--only",
        action="append",
        choices=[*GROUPS],
        metavar="ROW",
        help=f"only this one, of {', '.join(GROUPS)}; may be repeated",
    )
    parser.add_argument("--text", default="battery low", help="what the rows of onset say (%(default)s)")
    parser.add_argument("--without-peers", action="store_true", help="leave out espeak-ng, spd-say and pyttsx3")
    parser.add_argument("--venv", help="an environment to make, or to use again; the checkout is installed into it")
    parser.add_argument("--as-installed", action="store_true", help="take the talk that --venv has, whatever it is")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--json", action="store_true", help="print one object, with every value that was measured")
    shown.add_argument("--markdown", action="store_true", help="print the table as README.md beside this has it")
    asked = parser.parse_args()
    if asked.rounds < 1 or asked.idle <= 0:
        parser.error("--rounds and --idle are more than nothing")
    if asked.as_installed and not asked.venv:
        parser.error("--as-installed needs --venv")
    names = [each for each in GROUPS if not asked.only or each in asked.only]
    _refuse_without_programs(names, peers=not asked.without_peers)
    options = Options(asked.rounds, asked.idle, not asked.without_peers, asked.venv, not asked.as_installed, asked.text)
    began = time.monotonic()
    try:
        found, rows = _run(options, names)
    except FailedError as error:
        sys.exit(f"nothing was measured: {error}")
    found["took"] = f"{time.monotonic() - began:.0f} s"
    print(_told(found, rows, "json" if asked.json else "markdown" if asked.markdown else "text"))
    sys.exit(any(each.failure is not None for each in rows))


def _run(options: Options, names: list[str]) -> tuple[dict[str, str], list[Row]]:
    rows: list[Row] = []
    with Stage(options) as stage:
        found = machine.head(stage.installed, peers=options.peers)
        if "onset" in names:
            quiet = edges(render([options.text])[0])[0] / RATE * 1000
            found["onset's text"] = f"{options.text!r}, whose own first {quiet:.1f} ms are quiet"
        for name in names:
            began = time.monotonic()
            print(f"{name} …", end=" ", file=sys.stderr, flush=True)
            rows += measure(name, stage)
            print(f"{time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        found["load average"] += f", at the end {machine.load()}"
    return found, rows


def _refuse_without_programs(names: list[str], *, peers: bool) -> None:
    lacking = missing(peers=peers) if set(names) & set(_HEARD) else {}
    if not lacking:
        return
    packages = " ".join(dict.fromkeys(" ".join(lacking.values()).split()))
    words = f"not installed: {', '.join(lacking)}. On Debian and Ubuntu: sudo apt-get install -y {packages}"
    if set(lacking) <= set(missing(peers=True)) - set(missing(peers=False)):
        words += "\nor run the rest with --without-peers"
    sys.exit(words)


def _told(found: dict[str, str], rows: list[Row], form: str) -> str:
    if form == "json":
        return json.dumps({"machine": found, "rows": [each.to_json() for each in rows]}, ensure_ascii=False, indent=1)
    table = as_markdown(rows) if form == "markdown" else as_text(rows)
    words = "; ".join(f"{name} {value}" for name, value in found.items())
    return f"{words}{os.linesep}{os.linesep}{table}"


if __name__ == "__main__":
    main()
