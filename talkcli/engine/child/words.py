"""The words of a sentence: which parts of its text are reported as words, and when each word is heard.

Pure: the time is an argument, in monotonic seconds.
"""

from __future__ import annotations

import re
import unicodedata
from collections import deque

from talkcli.frozen import frozen, replace

#: The rest of a word after a letter, which synthesizers don't report: "it's", "well-known", "U.S.A".
_WORD_REST = re.compile(r"(?:['’-][^\W\d_]\w*|\.[^\W\d_](?!\w))+")
_LETTER = re.compile(r"[^\W\d_]")
#: The rest of a number after a comma or a dot: "000" of "1,000".
_NUMBER_REST = re.compile(r"\d+(?:[.,]\d+)*")
#: Marks at the end of a clause, which don't belong to its last word.
_END_MARKS = ".,;:!?…"


def count_letters(text: str, start: int) -> int:
    """Return the number of consecutive letters and digits from `start` on, including their accents.

    It replaces the length of a word that is reported with length 0. libespeak-ng does that before a character outside
    ASCII ("hello" of "«hello»"), and also if there is no word at all.
    """
    end = start
    while 0 <= end < len(text) and (text[end].isalnum() or unicodedata.category(text[end]).startswith("M")):
        end += 1
    return end - start


class WordFinder:
    """A converter from a synthesizer's reports to the words of one text.

    Synthesizers repeat places, jump back, report blanks, give lengths that reach into the next word, and report only
    the first half of "it's". Each word found here is a whole word of the text, after the previous one. Words spoken as
    one ("in the") are found by the first of them, because the end of the pair is only known at the next report.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._end = 0
        self._count = 0

    def find(self, location: int, length: int) -> tuple[int, int, int] | None:
        """Return the start, the end and the number of the word reported there. The first word has number 1.

        Returns None if no new word is there.
        """
        if location < self._end:
            return None
        reported = self._text[location : location + max(length, 0)]
        if reported.isspace() and self._text[self._end : location].strip():
            # After a full stop, the place of the next word is reported one too low ("I go. this one is"). A blank right
            # after the previous word is that word's second half ("smiling face" of a picture), and no new word.
            reported = self._text[location:]
        start = location + len(reported) - len(reported.lstrip())
        parts = reported.split(maxsplit=1)
        if not parts:
            return None
        self._end = self._whole_end(start, start + len(parts[0]))
        self._count += 1
        return start, self._end, self._count

    def _whole_end(self, start: int, end: int) -> int:
        """Return the end of the whole word of which the part from `start` to `end` was reported."""
        text = self._text
        if end == len(text) or text[end].isspace():
            return start + len(text[start:end].rstrip(_END_MARKS) or text[start:end])
        if _LETTER.match(text, end - 1):
            rest = _WORD_REST.match(text, end)
        else:
            rest = _NUMBER_REST.match(text, end) if text[end - 1] in ".," and text[start].isdecimal() else None
        return rest.end() if rest else end


@frozen
class TimedWord:
    """A word of the text, with the position in the audio at which it begins."""

    location: int  # character offset in the text
    length: int  # in characters
    position: float  # seconds into the audio


class WordClock:
    """The clock of one player's stream, which tells how much of the audio was heard and which words have begun.

    It starts with the first samples that the player takes, and then runs by itself. It is held back if the player takes
    less than the clock expects, so that no word is reported before it is heard. An output with a clock of its own sets
    it. Silence inserted into the stream delays what follows.
    """

    def __init__(self) -> None:
        self._waiting: deque[TimedWord] = deque()
        #: when the stream began to be heard; None while the clock is stopped
        self._zero: float | None = None
        self._begin = 0.0
        #: silences in the stream, each with the position of the audio that follows it and its seconds
        self._silences: list[tuple[float, float]] = []

    def add(self, word: TimedWord) -> None:
        """Add a word. Positions never decrease."""
        self._waiting.append(word)

    def skip_until(self, position: float) -> None:
        """Move the words before this position to it, because the audio before it is left out."""
        self._waiting = deque(replace(each, position=max(position, each.position)) for each in self._waiting)

    def reset(self, position: float) -> None:
        """Stop the clock and prepare for another stream, which begins at this position of the audio."""
        self._begin = position
        self._zero = None
        self._silences.clear()

    def start(self, now: float) -> None:
        """Start the clock at the beginning of the stream. It may be started again."""
        self._zero = now

    def add_silence(self, position: float, seconds: float) -> None:
        """Note that silence was put into the stream before this position of the audio. Positions never decrease."""
        if self._silences and self._silences[-1][0] == position:
            seconds += self._silences.pop()[1]
        self._silences.append((position, seconds))

    def set_elapsed(self, now: float, elapsed: float) -> None:
        """Set the seconds of the stream that were heard, as the output reports. With 0, the clock is stopped."""
        self._zero = now - elapsed if elapsed > 0 else None

    def limit_elapsed(self, now: float, elapsed: float) -> None:
        """Set the clock back to this many seconds if it is ahead."""
        if self._zero is not None and now - self._zero > elapsed:
            self._zero = now - elapsed

    def elapsed(self, now: float) -> float:
        """Return the seconds of the stream that were heard, including silence."""
        return 0.0 if self._zero is None else now - self._zero

    def heard_position(self, now: float) -> float:
        """Return the position up to which the audio was heard."""
        position = self._begin + self.elapsed(now)
        for before, seconds in self._silences:
            if position <= before:
                break
            position = max(before, position - seconds)
        return position

    def next_word_at(self) -> float | None:
        """Return when the next word begins; None if there is none or the clock is stopped."""
        if self._zero is None or not self._waiting:
            return None
        position = self._waiting[0].position
        silence = sum(seconds for before, seconds in self._silences if before <= position)
        return self._zero + position - self._begin + silence

    def take_begun(self, now: float) -> list[TimedWord]:
        """Remove and return the words that have begun."""
        words = []
        while (begins_at := self.next_word_at()) is not None and begins_at <= now:
            words.append(self._waiting.popleft())
        return words

    def take_rest(self) -> list[TimedWord]:
        """Remove and return all remaining words, because all of the sound was heard."""
        words = list(self._waiting)
        self._waiting.clear()
        return words
