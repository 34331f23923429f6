"""The words of a sentence: which of its text are reported, and when each is heard, by the clock of its playback.

Pure: the time comes in as an argument (monotonic seconds). The clock counts the seconds of one player's stream: it
starts with the first samples that the player takes and runs by itself; it is held back while the player takes less than
the clock says, so that no word is reported before it is heard. Where the output has a clock of its own, it goes by
that, and stands until something is heard. Silence that is put into the stream moves what follows.
"""

from __future__ import annotations

import re
import unicodedata
from collections import deque

from talkcli.frozen import frozen, replace

#: What goes on behind a letter without a report of its own: "it's", "well-known", "U.S.A".
_GOES_ON = re.compile(r"(?:['’-][^\W\d_]\w*|\.[^\W\d_](?!\w))+")
_LETTER = re.compile(r"[^\W\d_]")
#: … and behind a number's comma: "1," of "1,000".
_NUMBER_GOES_ON = re.compile(r"\d+(?:[.,]\d+)*")
#: What ends a clause is no part of its last word.
_STOPS = ".,;:!?…"


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
    """The words of one text, taken in order, and only ever forward.

    A synthesiser repeats a place, jumps back, reports blanks and lengths that reach over the next word, and only the
    first half of "it's"; what comes out of here is a word of the text, after the last one. Neighbours that are spoken
    as one ("in the") are reported by the first of them: nobody knows about the second until the word after it is
    reported.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._end = 0
        self._number = 0

    def next(self, location: int, length: int) -> tuple[int, int, int] | None:
        """Return where the word that is reported there begins and ends, and its number in the sentence, from 1.

        None if nothing new is there.
        """
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
        return start, self._end, self._number

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


@frozen
class TimedWord:
    """A word of the text and where in the audio it begins."""

    location: int  # character offset in the text
    length: int  # in characters
    position: float  # seconds into the audio


class WordClock:
    """Tells how much was heard, and which words have begun."""

    def __init__(self) -> None:
        self._waiting: deque[TimedWord] = deque()
        self._zero: float | None = None
        self._begin = 0.0
        #: silence in the stream: the position in the audio that it stands before, and its seconds; in order
        self._silences: list[tuple[float, float]] = []

    def add(self, word: TimedWord) -> None:
        """Add a word; positions never decrease."""
        self._waiting.append(word)

    def leave_out(self, until: float) -> None:
        """Have the words that would begin before that position begin there."""
        self._waiting = deque(replace(each, position=max(until, each.position)) for each in self._waiting)

    def begin(self, position: float) -> None:
        """Prepare for another stream, which begins at that position of the audio; the clock stands."""
        self._begin = position
        self._zero = None
        self._silences.clear()

    def start(self, now: float) -> None:
        """Let the stream begin now. A second start begins anew, with the words that are still waiting."""
        self._zero = now

    def insert(self, position: float, seconds: float) -> None:
        """Take note of silence in the stream before that position of the audio; positions never decrease."""
        if self._silences and self._silences[-1][0] == position:
            seconds += self._silences.pop()[1]
        self._silences.append((position, seconds))

    def elapsed(self, now: float) -> float:
        """Return the seconds of the stream that have been heard, silence included; 0 before the start."""
        return 0.0 if self._zero is None else now - self._zero

    def heard(self, now: float) -> float:
        """Return the position in the audio up to which it has been heard."""
        position = self._begin + self.elapsed(now)
        for before, seconds in self._silences:
            if position <= before:
                break
            position = max(before, position - seconds)
        return position

    def tell(self, now: float, elapsed: float) -> None:
        """Go by a better clock: so many seconds of the stream have been heard; as long as it is none, ours stands."""
        self._zero = now - elapsed if elapsed > 0 else None

    def hold(self, now: float, elapsed: float) -> None:
        """Move the clock back to `elapsed` seconds if it is ahead of that: no more can have been heard."""
        if self._zero is not None and now - self._zero > elapsed:
            self._zero = now - elapsed

    def due(self, now: float) -> list[TimedWord]:
        """Take out the words that have begun by now."""
        words = []
        while (due := self.next_due()) is not None and due <= now:
            words.append(self._waiting.popleft())
        return words

    def rest(self) -> list[TimedWord]:
        """Take out all words that are left: the sound is over, so they were heard."""
        words = list(self._waiting)
        self._waiting.clear()
        return words

    def next_due(self) -> float | None:
        """Return when the next word begins; None if there is none, or the clock stands."""
        if self._zero is None or not self._waiting:
            return None
        position = self._waiting[0].position
        silence = sum(seconds for before, seconds in self._silences if before <= position)
        return self._zero + position - self._begin + silence
