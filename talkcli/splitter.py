"""Cuts a stream of bytes into lines, wherever they come from: sockets, pipes, standard input, what programs complain.

Pure. What a line means, and whether one that is too long is an error, is for who reads them. It lies in the ground
because the engine process and its players cut lines, too, and their start is waited for after a crash: no JSON here.
"""

from __future__ import annotations

import sys


class Cut(bytes):
    """The beginning of a line that was longer than what is kept of one."""

    #: bytes that the whole line had
    size: int


class LineSplitter:
    """Takes bytes as they come and gives lines; holds no more than the first `most` bytes of one."""

    __slots__ = ("_begun", "_most", "size")

    def __init__(self, most: int = sys.maxsize) -> None:
        self._most = most
        self._begun = bytearray()
        #: bytes of the line that has begun and not ended, those that are not kept among them
        self.size = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that are complete now, without their newlines; those that are too long are `Cut`."""
        *lines, begun = data.split(b"\n")
        for place, line in enumerate(lines):
            if self.size or len(line) > self._most:
                self._add(line)
                lines[place] = self.end()
        self._add(begun)
        return lines

    def end(self) -> bytes:
        """Return the line that has begun and not ended, as if it ended here; empty if there is none."""
        line = bytes(self._begun)
        if self.size > self._most:
            line = Cut(line)
            line.size = self.size
        self._begun.clear()
        self.size = 0
        return line

    def _add(self, data: bytes) -> None:
        self.size += len(data)
        self._begun += data[: self._most - len(self._begun)]
