"""Code that finds the words of a sentence, and determines when each word is heard.

Nothing here reads the clock. All times are arguments, in monotonic seconds.
"""

from __future__ import annotations

import re
import unicodedata
from collections import deque

from talkcli.frozen import frozen, replace

#: The rest of a word after its first part. Synthesizers report only "it" for "it's", and "well" for "well-known".
_WORD_REST = re.compile(r"(?:['’-][^\W\d_]\w*|\.[^\W\d_](?!\w))+")
_LETTER = re.compile(r"[^\W\d_]")
#: The rest of a number after a comma or a dot, such as the "000" of "1,000".
_NUMBER_REST = re.compile(r"\d+(?:[.,]\d+)*")
#: Punctuation that ends a clause and isn't part of its last word.
_END_MARKS = ".,;:!?…"


def count_letters(text: str, start: int) -> int:
    """Count the consecutive letters, digits and accents that begin at `start`.

    The result is used as the length of a word if libespeak-ng reports a length of 0. libespeak-ng does so if the next
    character isn't ASCII (as in "«hello»"), and also if there is no word at all.
    """
    end = start
    while 0 <= end < len(text) and (text[end].isalnum() or unicodedata.category(text[end]).startswith("M")):
        end += 1
    return end - start


class WordFinder:
    """Finds whole words in a text from the locations that a synthesizer reports.

    Synthesizers repeat locations, go back, report blanks, return lengths that extend into the next word, and report
    only the first part of "it's". `find` returns each word at most once, in the order of the text. If two words are
    spoken as one ("in the"), it returns only the first. The end of the pair isn't known until the next report.
    """

    def __init__(self, text: str, end: int = 0, count: int = 0) -> None:
        """Start at the offset `end`, before which `count` words have been found."""
        #: the text, which may grow at the end
        self.text = text
        self._end = end
        self._count = count

    def find(self, location: int, length: int) -> tuple[int, int, int] | None:
        """Find the word at a location. Return its start, end and number, or None if the word isn't new.

        The first word has number 1.
        """
        if location < self._end:
            return None
        reported = self.text[location : location + max(length, 0)]
        if reported.isspace() and self.text[self._end : location].strip():
            # After a full stop, the reported location of the next word is one character too low ("I go. this one is").
            # A blank directly after the previous word isn't a new word. Such a blank is reported for the second half of
            # an emoji's name ("smiling face").
            reported = self.text[location:]
        start = location + len(reported) - len(reported.lstrip())
        parts = reported.split(maxsplit=1)
        if not parts:
            return None
        self._end = self._whole_end(start, start + len(parts[0]))
        self._count += 1
        return start, self._end, self._count

    def _whole_end(self, start: int, end: int) -> int:
        """Return the end of a whole word, given the part of the word that the synthesizer reported."""
        text = self.text
        if end == len(text) or text[end].isspace():
            return start + len(text[start:end].rstrip(_END_MARKS) or text[start:end])
        if _LETTER.match(text, end - 1):
            rest = _WORD_REST.match(text, end)
        else:
            rest = _NUMBER_REST.match(text, end) if text[end - 1] in ".," and text[start].isdecimal() else None
        return rest.end() if rest else end


@frozen
class TimedWord:
    """A word of the text, with its position in the audio."""

    start: int  # offset of the first character in the text
    end: int  # offset after the last character
    number: int  # number of the word in the text, starting at 1
    position: float  # position at which the word starts in the audio, in seconds


class WordClock:
    """Tracks how much audio has been heard and which words have started.

    The clock measures the stream to one player. It starts when the player accepts the first samples. It is set back if
    the player falls behind, so that no word is reported before it is heard. If the output has its own clock, this clock
    follows it. Silence in the stream delays the words after it.
    """

    def __init__(self) -> None:
        self._waiting: deque[TimedWord] = deque()
        #: time at which the first sample of the stream was heard; None while the clock is stopped
        self._started_at: float | None = None
        #: position in the audio at which the stream begins, in seconds
        self._begin = 0.0
        #: position in the audio and length in seconds of each silence in the stream
        self._silences: list[tuple[float, float]] = []

    def add(self, word: TimedWord) -> None:
        """Add a word. Words must be added in the order of their positions."""
        self._waiting.append(word)

    def next_word_from(self, position: float) -> TimedWord | None:
        """Return the first waiting word at this position or after it, if any."""
        return next((each for each in self._waiting if each.position >= position), None)

    def drop_from(self, position: float) -> None:
        """Remove the words at this position and after it."""
        self._waiting = deque(each for each in self._waiting if each.position < position)

    def delay_words_until(self, position: float) -> None:
        """Move all words that begin before this position in the audio to this position."""
        self._waiting = deque(replace(each, position=max(position, each.position)) for each in self._waiting)

    def reset(self, position: float) -> None:
        """Stop the clock, and prepare it for a stream that begins at this position in the audio."""
        self._begin = position
        self._started_at = None
        self._silences.clear()

    def start(self, now: float) -> None:
        """Start or restart the clock at the beginning of the stream."""
        self._started_at = now

    def add_silence(self, position: float, seconds: float) -> None:
        """Record that silence is played before this position in the audio.

        Positions must not decrease.
        """
        if self._silences and self._silences[-1][0] == position:
            seconds += self._silences.pop()[1]
        self._silences.append((position, seconds))

    def set_elapsed(self, now: float, elapsed: float) -> None:
        """Set the number of seconds heard, as reported by the output.

        A value of 0 stops the clock.
        """
        self._started_at = now - elapsed if elapsed > 0 else None

    def limit_elapsed(self, now: float, elapsed: float) -> None:
        """Set the clock back if it shows more than this number of seconds."""
        if self._started_at is not None and now - self._started_at > elapsed:
            self._started_at = now - elapsed

    def elapsed(self, now: float) -> float:
        """Return how many seconds of the stream have been heard, including silence."""
        return 0.0 if self._started_at is None else now - self._started_at

    def heard_seconds(self, now: float) -> float:
        """Return how many seconds of the audio have been heard. Added silence doesn't count."""
        position = self._begin + self.elapsed(now)
        for before, seconds in self._silences:
            if position <= before:
                break
            position = max(before, position - seconds)
        return position

    def next_word_at(self) -> float:
        """Return the start time of the next word, or infinity if there is none or the clock is stopped."""
        if self._started_at is None or not self._waiting:
            return float("inf")
        position = self._waiting[0].position
        silence = sum(seconds for before, seconds in self._silences if before <= position)
        return self._started_at + position - self._begin + silence

    def pop_started(self, now: float) -> list[TimedWord]:
        """Remove and return the words that have started."""
        words = []
        while self.next_word_at() <= now:
            words.append(self._waiting.popleft())
        return words

    def pop_all(self) -> list[TimedWord]:
        """Remove and return all remaining words."""
        words, self._waiting = self._waiting, deque()
        return list(words)
