"""The default synthesizer, which combines libespeak-ng and Piper's neural voices.

The code for neural voices is imported when a neural voice is first requested. If a neural voice isn't loaded yet, or
fails before any sound was heard, libespeak-ng speaks in the same language instead. With `voice_only`, the sentence
fails instead.
"""

from __future__ import annotations

import traceback

from talkcli.engine import models, protocol
from talkcli.engine.child.players.base import CannotSpeak, Stopped
from talkcli.engine.child.synthesizers.base import SpeechSettings
from talkcli.engine.child.synthesizers.espeak import Espeak
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.options import is_neural
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from talkcli.engine.child.synthesizers.base import SampleSink, Synthesizer
    from talkcli.engine.child.synthesizers.loader import ModelLoader
    from talkcli.engine.child.synthesizers.piper import Piper
    from talkcli.engine.protocol import DropVoice, LoadVoice, Voice


class CombinedSynthesizer:
    """A synthesizer that supports the voices of both libespeak-ng and Piper."""

    def __init__(self, espeak: Espeak | None = None) -> None:
        self._espeak = espeak or Espeak()
        self._neural: Piper | None = None
        self._current: Synthesizer = self._espeak
        self.version = self._espeak.version
        self.voice = self._espeak.voice
        #: reason why libespeak-ng speaks the current text instead of a neural voice, or None
        self._fallback_reason: str | None = None

    def voices(self) -> tuple[Voice, ...]:
        """Return all voices of libespeak-ng, and then all installed neural voices."""
        return (*self._espeak.voices(), *models.installed_voices())

    def choose_voice(self, voice: str) -> None:
        """Choose the voice for the next sentences."""
        current: Synthesizer = self._get_piper() if is_neural(voice) else self._espeak
        current.choose_voice(voice)
        self._current, self.voice = current, current.voice

    def speak(self, text: str, settings: SpeechSettings, sink: SampleSink) -> None:
        """Speak a text with the current voice, or with libespeak-ng if a neural voice fails.

        The error is raised instead if `settings.voice_only` is set, or if samples have already been written. The voice
        never changes between two parts of a text.
        """
        neural = self._neural
        if neural is None or self._current is not neural or settings.voice_only:
            self._current.speak(text, settings, sink)
            return
        if settings.begins_text:
            self._fallback_reason = neural.problem
        if self._fallback_reason is None:
            try:
                neural.speak(text, replace(settings, pitch=SpeechSettings().pitch), sink)
                return
            except Stopped:
                raise
            except CannotSpeak as error:
                if error.reason != Reason.VOICE_FAILED or neural.has_written:
                    raise
                self._fallback_reason = str(error)
            except Exception as error:
                if neural.has_written:
                    raise
                traceback.print_exc()  # Log the bug, and let the other synthesizer speak instead.
                self._fallback_reason = f"{neural.voice} failed: {type(error).__name__}: {error}"
        self._espeak.choose_language(neural.language)
        self._espeak.speak(text, settings, sink, self._fallback_reason)

    @property
    def loader(self) -> ModelLoader | None:
        """The model loader, or None if no neural voice has been requested yet."""
        return self._neural.loader if self._neural else None

    def load_or_unload(self, command: LoadVoice | DropVoice) -> None:
        """Start loading a neural voice in the background, or unload one."""
        loader = self._get_piper().loader
        if isinstance(command, protocol.DropVoice):
            loader.unload(command.voice)
        else:
            loader.queue(command.voice)

    def _get_piper(self) -> Piper:
        """Return the synthesizer for neural voices. The first call creates it."""
        if self._neural is None:
            from talkcli.engine.child.synthesizers.piper import Piper

            self._neural = Piper(self._espeak)
        return self._neural
