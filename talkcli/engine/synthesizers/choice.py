"""The synthesizer that a voice needs: libespeak-ng's own, or a neural one's, whose id says so.

To whoever speaks they are one. What neural voices take is imported when one is asked for, and never else.
"""

from __future__ import annotations

from talkcli.engine.synthesizers.voices import is_neural

TYPE_CHECKING = False
if TYPE_CHECKING:
    from talkcli.engine.protocol import Voice
    from talkcli.engine.synthesizers.base import Output, Sound, Synthesizer
    from talkcli.engine.synthesizers.espeak import Espeak


class Choice:
    """Libespeak-ng, and behind it the neural voices."""

    def __init__(self, espeak: Espeak) -> None:
        self._espeak = espeak
        self._neural: Synthesizer | None = None
        self._chosen: Synthesizer = espeak
        self.version = espeak.version
        self.voice = espeak.voice

    def voices(self) -> tuple[Voice, ...]:
        """Return libespeak-ng's voices, its variants, and the neural voices whose files are there now."""
        from talkcli.engine.synthesizers import models

        return (*self._espeak.voices(), *models.voices())

    def load(self, voice: str) -> None:
        """Have one of them load the voice, and speak from now on."""
        chosen: Synthesizer = self._piper() if is_neural(voice) else self._espeak
        chosen.load(voice)
        self._chosen, self.voice = chosen, chosen.voice

    def speak(self, text: str, sound: Sound, output: Output) -> None:
        """Have the one that is chosen speak."""
        self._chosen.speak(text, sound, output)

    def _piper(self) -> Synthesizer:
        if self._neural is None:
            from talkcli.engine.synthesizers.piper import Piper

            self._neural = Piper(self._espeak)
        return self._neural
