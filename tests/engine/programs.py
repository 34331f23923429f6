"""Player programs written in Python, for tests that check the samples or need a failing player."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from tests.engine.process import FAST
from tests.support.reference import render

if TYPE_CHECKING:
    from pathlib import Path

#: A player that reads sound in real time, buffers 60 ms, and writes it to the file named by its first argument.
#: The second argument is the sample rate, if it isn't 22,050.
PLAYS = """
import os, sys, time
heard = open(sys.argv[1], "ab", buffering=0)
started_at, taken = None, 0
bytes_per_s = 2 * int(sys.argv[2]) if sys.argv[2:] and sys.argv[2].isdigit() else 44100
while data := os.read(0, bytes_per_s // 100 * 2):
    started_at = started_at or time.monotonic()
    taken += len(data)
    heard.write(data)
    {during}
    time.sleep(max(0, started_at + taken / bytes_per_s - 0.06 - time.monotonic()))
time.sleep(0.06)
{after}
"""
#: A player that never reads.
NEVER_READS = "import time\ntime.sleep(100)"
#: A player that reads everything at once and exits with status 0.
SWALLOWS = "import os\nwhile os.read(0, 65536): pass"


class Player:
    """A maker of player programs. They write the samples to the file `heard`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.heard = folder / "heard"

    def program(self, code: str, name: str = "player") -> Path:
        path = self._folder / name
        path.write_text(f"#!{sys.executable} -S\n{code}")
        path.chmod(0o755)
        return path

    def command(self, code: str) -> str:
        return f"{self.program(code)} {self.heard}"

    def plays(self, during: str = "pass", after: str = "") -> str:
        return self.command(PLAYS.format(during=during, after=after))


def sound(text: str) -> bytes:
    """Return all samples of a text that is an engine process's first sentence."""
    return render([text], rate=FAST)[0].astype("<i2").tobytes()


def without_silence(heard: bytes, sentence: bytes) -> bytes:
    """Return the heard samples without the zeros where they first differ from the sentence."""
    pairs = enumerate(zip(heard, sentence, strict=False))
    start = next((index for index, (a, b) in pairs if a != b), len(sentence)) // 2 * 2
    end = start
    while heard[end : end + 2] == b"\0\0":
        end += 2
    return heard[:start] + heard[end:]
