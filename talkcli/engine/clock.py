"""What has been heard of a sentence, and which of its words: the clock of its playback.

Pure: the time comes in as an argument (monotonic seconds). The clock counts the seconds of one player's stream: it
starts with the first samples that the player takes and runs by itself; it is held back while the player takes less than
the clock says, so that no word is reported before it is heard. Silence that is put into the stream moves what follows.
"""

from __future__ import annotations

from collections import deque

from talkcli.frozen import frozen


@frozen
class TimedWord:
    """A word of the text and where in the audio it begins."""

    location: int  # character offset in the text
    length: int  # in characters
    position: float  # seconds into the audio


class Times:
    """What pyttsx3's notifications have no word for, for who gets one: it is true as long as he is told.

    Our own driver sets it. None where another speaks, which doesn't know.
    """

    def __init__(self) -> None:
        #: of the word that begins: its place in the audio, in seconds
        self.word: float | None = None
        #: of the sentence that has ended: the seconds of its audio, None if not all of it was heard
        self.duration: float | None = None


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
