"""Whether the sentence in hand is to be held: the session asks for it, the playback obeys and says when it is silent.

It holds no sample and knows no player; how long things may take in a pause is here, too. pyttsx3 has no word for a
pause, so this goes past it, to our own driver alone.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

#: Seconds within which a sentence that is to be held must be silent. A player has 42 to 98 ms of it to play; one that
#: has more, or stands still, is ended instead and the sentence goes on with another.
SILENT_WITHIN = 0.15

#: Seconds by which the word clock may be ahead of what is heard: 4 to 8 ms were measured.
CLOCK_AHEAD = 0.01

#: Seconds that are said again where a player had to be ended before all it held was heard: the clock is no better than
#: this, and nothing may be lost.
SAID_AGAIN = 0.03

#: Seconds of a pause after which the player is let go of: long enough for a question in between, after which the next
#: sample is heard at once; a longer one must leave the device to other programs, and let it sleep.
RELEASE_AFTER = 10.0


class Pause:
    """A pause of the sentence in hand."""

    def __init__(self, on_silent: Callable[[int], None]) -> None:
        """`on_silent` is called once in each pause, with its number, when the sentence is silent."""
        #: whether the sentence is to be held now
        self.asked = False
        self._on_silent = on_silent
        #: the pause that was asked for last, and the one that was confirmed last
        self._number = self._confirmed = 0

    def ask(self, number: int) -> None:
        """Hold the sentence; `number` counts the pauses in it, from 1."""
        self.asked = True
        self._number = number

    def release(self) -> None:
        """Let the sentence go on, or a new one begin."""
        self.asked = False
        self._confirmed = 0

    def confirm(self) -> None:
        """Take note that the sentence is silent; may be called again and again."""
        if self.asked and self._confirmed != self._number:
            self._confirmed = self._number
            self._on_silent(self._number)
