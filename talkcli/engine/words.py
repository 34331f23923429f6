"""The words of a text as they are reported: only ever forward.

Pure. A synthesiser repeats a place, jumps back, reports blanks and lengths that reach over the next word; what comes
out of here is a word of the text, after the last one.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FoundWord:
    """A word of the text."""

    start: int  # character offset
    end: int  # offset after its last character
    number: int  # in the sentence, from 1


class Words:
    """The words of one text, taken in order."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._end = 0
        self._number = 0

    def next(self, location: int, length: int) -> FoundWord | None:
        """Return the word reported there, None if nothing new is there."""
        start = max(location, 0)
        if start < self._end or location < 0:
            return None
        piece = self._text[start : start + max(length, 0)]
        start += len(piece) - len(piece.lstrip())
        parts = piece.split()
        if not parts:
            return None
        self._end = start + len(parts[0])
        self._number += 1
        return FoundWord(start, self._end, self._number)
