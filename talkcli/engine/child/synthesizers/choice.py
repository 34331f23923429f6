"""The synthesizer that a voice needs: libespeak-ng's own, or a neural one's, whose id says so.

To whoever speaks they are one. What neural voices take is imported when one is asked for, and never else. A neural
voice that is not loaded, or fails before anything of the sentence was heard, is no reason for silence: libespeak-ng
speaks in its place, in the same language, unless the sentence is to be heard by that voice or by none.
"""

from __future__ import annotations

import traceback

from talkcli.engine import protocol
from talkcli.engine.child.players.base import CannotSpeak, Stopped
from talkcli.engine.child.synthesizers.base import Sound
from talkcli.engine.voices import is_neural
from talkcli.frozen import TYPE_CHECKING, replace

if TYPE_CHECKING:
    from talkcli.engine.child.synthesizers.base import Output, Synthesizer
    from talkcli.engine.child.synthesizers.espeak import Espeak
    from talkcli.engine.child.synthesizers.piper import Piper
    from talkcli.engine.protocol import Drop, Grown, Load, Loaded, Unloaded, Voice


def make_espeak() -> Choice:
    """Make the default synthesizer; NotInstalled."""
    from talkcli.engine.child.synthesizers.espeak import Espeak

    return Choice(Espeak())


class Choice:
    """Libespeak-ng, and behind it the neural voices."""

    def __init__(self, espeak: Espeak) -> None:
        self._espeak = espeak
        self._neural: Piper | None = None
        self._chosen: Synthesizer = espeak
        self.version = espeak.version
        self.voice = espeak.voice

    def voices(self) -> tuple[Voice, ...]:
        """Return libespeak-ng's voices, its variants, and the neural voices whose files are there now."""
        from talkcli.engine import models

        return (*self._espeak.voices(), *models.voices())

    def load(self, voice: str) -> None:
        """Have one of them load the voice, and speak from now on."""
        chosen: Synthesizer = self._piper() if is_neural(voice) else self._espeak
        chosen.load(voice)
        self._chosen, self.voice = chosen, chosen.voice

    def speak(self, text: str, sound: Sound, output: Output) -> None:
        """Have the one that is chosen speak, or libespeak-ng in its place."""
        neural = self._neural
        if neural is None or self._chosen is not neural or sound.voice_only:
            self._chosen.speak(text, sound, output)
            return
        why = neural.error or f"{neural.voice} is not loaded"
        if neural.ready:
            first = _Given(output)
            try:
                neural.speak(text, replace(sound, pitch=Sound().pitch), first)
                return
            except Stopped:
                raise
            except CannotSpeak as error:
                if error.reason != "voice_failed" or first.anything:
                    raise
                why = str(error)
            except Exception as error:
                if first.anything:
                    raise
                traceback.print_exc()  # a bug: that, too, is no reason for silence
                why = f"{neural.voice} failed: {type(error).__name__}: {error}"
        self._espeak.load_language(neural.language)
        self._espeak.speak(text, sound, _Given(output, why))

    # -- what is loaded beside the speech

    @property
    def descriptor(self) -> int | None:
        """What is readable when a voice has been loaded; None where none is being loaded."""
        return self._neural.loader.descriptor if self._neural else None

    @property
    def due(self) -> float:
        """The monotonic time at which the voice that is being loaded is given up."""
        return self._piper().loader.due

    def obey(self, command: Load | Drop) -> None:
        """Load a neural voice beside what is spoken, or keep it no longer."""
        loader = self._piper().loader
        (loader.drop if isinstance(command, protocol.Drop) else loader.begin)(command.voice)

    def news(self) -> list[Loaded | Unloaded | Grown]:
        """Return what became of neural voices since this was asked last; never waits."""
        return self._neural.loader.news() if self._neural else []

    def _piper(self) -> Piper:
        if self._neural is None:
            from talkcli.engine.child.synthesizers.piper import Piper

            self._neural = Piper(self._espeak)
        return self._neural


class _Given:
    """An output that knows whether it was given anything of the sentence, and why another voice speaks."""

    def __init__(self, output: Output, why: str | None = None) -> None:
        self._output = output
        self._why = why
        self.anything = False
        self.wait = output.wait

    def begin(self, rate: int, voice: str, why: str | None = None) -> None:
        self._output.begin(rate, voice, why or self._why)

    def word(self, start: int, length: int, position: float) -> None:
        self.anything = True
        self._output.word(start, length, position)

    def write(self, samples: bytes) -> None:
        self.anything = self.anything or bool(samples)
        self._output.write(samples)
