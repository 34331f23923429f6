"""When each word of a sentence is heard: the clock of its playback.

Pure: the time comes in as an argument (monotonic seconds). The clock starts with the first samples that a player takes
and runs by itself; it is held back while the player takes less than the clock says, so that no word is reported before
it is heard.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimedWord:
    """A word of the text and where in the audio it begins."""

    location: int  # character offset in the text
    length: int  # in characters
    position: float  # seconds into the audio


class WordClock:
    """Tells which words have begun."""

    def __init__(self) -> None:
        self._waiting: deque[TimedWord] = deque()
        self._zero: float | None = None

    def add(self, word: TimedWord) -> None:
        """Add a word; positions never decrease."""
        self._waiting.append(word)

    def start(self, now: float) -> None:
        """Let the audio begin now. A second start begins anew, with the words that are still waiting."""
        self._zero = now

    def position(self, now: float) -> float:
        """Return the seconds of audio that have been heard; 0 before the start."""
        return 0.0 if self._zero is None else now - self._zero

    def hold(self, now: float, heard: float) -> None:
        """Move the clock back to `heard` seconds if it is ahead of that: no more can have been heard."""
        if self._zero is not None and now - self._zero > heard:
            self._zero = now - heard

    def due(self, now: float) -> list[TimedWord]:
        """Take out the words that have begun by now."""
        words = []
        while self._zero is not None and self._waiting and self._waiting[0].position <= now - self._zero:
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
        return self._zero + self._waiting[0].position
