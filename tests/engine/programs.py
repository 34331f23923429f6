"""Player programs made of Python code, for tests that look at the samples a player gets or have it fail."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from tests.engine.spawned import FAST
from tests.support.reference import render

if TYPE_CHECKING:
    from pathlib import Path

#: A player that takes sound in real time, holds 60 ms of it, and writes it to the file in its first argument.
PLAYS = """
import os, sys, time
heard = open(sys.argv[1], "ab", buffering=0)
began, taken = None, 0
while data := os.read(0, 882):
    began = began or time.monotonic()
    taken += len(data)
    heard.write(data)
    {during}
    time.sleep(max(0, began + taken / 44100 - 0.06 - time.monotonic()))
time.sleep(0.06)
{after}
"""
#: Never takes anything.
NEVER_READS = "import time\ntime.sleep(100)"
#: Takes everything at once, and ends well.
SWALLOWS = "import os\nwhile os.read(0, 65536): pass"


class Player:
    """Makes player programs out of Python code."""

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
    """Return all samples of the first sentence of an engine process."""
    return render([text], rate=FAST)[0].astype("<i2").tobytes()


def without_silence(heard: bytes, sentence: bytes) -> bytes:
    """Return what was heard without the zeros at the place where it first differs from the sentence."""
    same = (pair[0] == pair[1] for pair in zip(heard, sentence, strict=False))
    begin = next((at for at, each in enumerate(same) if not each), len(sentence)) // 2 * 2
    end = begin
    while heard[end : end + 2] == b"\0\0":
        end += 2
    return heard[:begin] + heard[end:]
