"""The words of a text as they are reported: only ever forward.

Pure. A synthesiser repeats a place, jumps back, reports blanks and lengths that reach over the next word, and only the
first half of "it's"; what comes out of here is a word of the text, after the last one. Neighbours that are spoken as
one ("in the") are reported by the first of them: nobody knows about the second until the word after it is reported.
"""

from __future__ import annotations

import re
import unicodedata

from talkcli.frozen import frozen

#: What goes on behind a letter without a report of its own: "it's", "well-known", "U.S.A".
_GOES_ON = re.compile(r"(?:['’-][^\W\d_]\w*|\.[^\W\d_](?!\w))+")
_LETTER = re.compile(r"[^\W\d_]")
#: … and behind a number's comma: "1," of "1,000".
_NUMBER_GOES_ON = re.compile(r"\d+(?:[.,]\d+)*")
#: What ends a clause is no part of its last word.
_STOPS = ".,;:!?…"


@frozen
class FoundWord:
    """A word of the text."""

    start: int  # character offset
    end: int  # offset after its last character
    number: int  # in the sentence, from 1


def letters(text: str, start: int) -> int:
    """Return how many letters and digits, with their accents, stand there in a row.

    It is the length of a word that a synthesiser reports with none: libespeak-ng does so before a sign that is no ASCII
    ("hello" of "«hello»"), and also where there is no word at all.
    """
    end = start
    while 0 <= end < len(text) and (text[end].isalnum() or unicodedata.category(text[end]).startswith("M")):
        end += 1
    return end - start


class Words:
    """The words of one text, taken in order."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._end = 0
        self._number = 0

    def next(self, location: int, length: int) -> FoundWord | None:
        """Return the word reported there, None if nothing new is there."""
        if location < self._end:
            return None
        piece = self._text[location : location + max(length, 0)]
        if piece.isspace() and self._text[self._end : location].strip():
            # Behind a stop it is the word that follows, short of its place by one ("I go. this one is"). Right behind
            # the last word it is that one's second half ("smiling face" of a picture), and the next is still to come.
            piece = self._text[location:]
        start = location + len(piece) - len(piece.lstrip())
        parts = piece.split(maxsplit=1)
        if not parts:
            return None
        self._end = self._whole(start, start + len(parts[0]))
        self._number += 1
        return FoundWord(start, self._end, self._number)

    def _whole(self, start: int, end: int) -> int:
        """Return where a word ends of which this was reported."""
        text = self._text
        if end == len(text) or text[end].isspace():
            return start + len(text[start:end].rstrip(_STOPS) or text[start:end])
        if _LETTER.match(text, end - 1):
            goes_on = _GOES_ON.match(text, end)
        else:
            goes_on = _NUMBER_GOES_ON.match(text, end) if text[end - 1] in ".," and text[start].isdecimal() else None
        return goes_on.end() if goes_on else end
