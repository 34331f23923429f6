"""The interface of a synthesizer, and of the sink that receives the sentence.

Positions in a text are characters from 0. Samples are signed 16 bit, little-endian, one channel.
`tests/engine/test_synthesizer_contract.py` tests that every synthesizer keeps the promises of `Synthesizer`.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from typing import Protocol

    from talkcli.engine.protocol import Voice
else:
    Protocol = object


class NotInstalled(Exception):
    """A part of a synthesizer is not installed. The text is an error message with what to install."""


@frozen
class SpeechSettings:
    """The settings of a sentence except its voice, with pyttsx3's defaults."""

    rate: int = 200  # words per minute, 80 to 450
    volume: float = 1.0  # 0.0 to 1.0; 1.0 is the voice's natural volume
    pitch: int = 50  # 0 to 100; 50 is the voice's natural pitch
    voice_only: bool = False  # whether the sentence fails if its voice can't speak it


class SampleSink(Protocol):
    """Receives the samples and words of one sentence, as the playback does.

    Every method may block while the sentence is held. It may raise Stopped if the sentence has to end, or CannotSpeak
    if the sentence can't be played. After such an exception, the sink must not be called again.
    """

    def begin(self, rate: int, voice: str, fallback_reason: str | None = None) -> None:
        """Announce the sample rate and the voice before anything else.

        Until the first word or sample, it may be called again with other values.

        Args:
            rate: Samples per second.
            voice: The id of the voice that speaks.
            fallback_reason: Why the requested voice doesn't speak, as a message, or None if it does.
        """

    def word(self, start: int, length: int, position: float) -> None:
        """Announce a word.

        Args:
            start: The position of the word in the text.
            length: The length of the word in characters, at least 1.
            position: The position of the word in the samples, in seconds.
        """

    def write(self, samples: bytes) -> None:
        """Write whole samples. An empty write only lets the sink raise Stopped."""

    def wait(self, descriptor: int) -> None:
        """Keep playing the written samples until a descriptor is readable, for a synthesizer that works in a thread.

        It may return earlier. It may also be called before `begin`. The sentence can be held or stopped during the
        wait.
        """


class Synthesizer(Protocol):
    """Turns texts into samples and words, in the voice that was loaded last.

    All calls come from the thread that created the synthesizer, and the synthesizer calls its sink only in this thread.
    The constructor raises NotInstalled if a part of the synthesizer is missing.
    """

    #: the synthesizer's name and version for display, such as "eSpeak NG 1.51 (system)", or None
    version: str | None
    #: the id of the voice that was loaded last, or of the default voice
    voice: str

    def voices(self) -> tuple[Voice, ...]:
        """Return all voices with unique ids, the common voices first; a later call may return more voices.

        An id that begins with "+" is a variant, to be appended to the id of a voice.
        """

    def load(self, voice: str) -> None:
        """Make this voice the current one.

        This returns quickly, because it can't be stopped. If a voice takes seconds to load, `speak` waits for it in its
        sink.

        Args:
            voice: The id of the voice.

        Raises:
            UnknownVoice: The voice can't be loaded. The previous voice stays the current one.
        """

    def speak(self, text: str, settings: SpeechSettings, sink: SampleSink) -> None:
        """Synthesize a sentence, and return after all of it was written.

        The sample rate comes first, and every word comes before its first sample. The positions of words in the samples
        never decrease, but their positions in the text may jump and repeat.

        Samples are written as soon as they exist and in small parts, because a sentence can be stopped or held only in
        a call of the sink. If a synthesizer needs more than some milliseconds for a part, it writes `b""` meanwhile, or
        works in a thread and waits in the sink.

        Every string is a valid text. Control characters and lone surrogates are silent. A text without any speech
        produces no words, and either no samples or silence.

        However a sentence ends, it doesn't affect later ones: the next sentence has the same samples as without it,
        except for noise.

        Raises:
            CannotSpeak: The reason is `engine_failed`, `voice_failed` if the files of the voice are faulty, or
                `bad_option` if the voice doesn't support the settings (before any sample is written). Exceptions of the
                sink pass through at once.
        """
