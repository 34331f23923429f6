"""What engine processes write to standard error: whole lines, and no more of them than a log can take.

Pure: bytes and the time come in as arguments. A driver of somebody else's may write a line for each word, for months,
so what comes in a minute after the first lines is only counted.
"""

from __future__ import annotations

#: Lines that are passed on in a while, and the seconds of that: a whole traceback, and no flood.
LINES = 20
WHILE = 60.0

#: Bytes of a line that are kept, of one that never ends as well.
LONGEST = 1000


class Murmur:
    """Lines from standard error, of one engine process after the other."""

    def __init__(self) -> None:
        self._rest = b""
        self._since = float("-inf")
        self._passed = 0
        self._left_out = 0

    def take(self, data: bytes, now: float) -> list[str]:
        """Take what was written, and return the lines to pass on; no data means that the process wrote its last."""
        *lines, rest = (self._rest + (data or b"\n")).split(b"\n")
        self._rest = rest[:LONGEST]
        return [words for line in lines if line.strip() for words in self._admit(line, now)]

    def _admit(self, line: bytes, now: float) -> list[str]:
        admitted = []
        if now >= self._since + WHILE:
            if self._left_out:
                admitted.append(f"({self._left_out} lines were left out)")
            self._since, self._passed, self._left_out = now, 0, 0
        if self._passed < LINES:
            self._passed += 1
            admitted.append(line[:LONGEST].decode(errors="replace").rstrip())
        else:
            self._left_out += 1
        return admitted
