"""Whether the sentence in hand is to be held: the session asks for it, the playback obeys and says when it is silent.

It holds no sample and knows no player. pyttsx3 has no word for a pause, so this goes past it, to our own driver alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Hold:
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
