"""The interface of a synthesizer, and of the sink that it writes a sentence to.

Positions in a text are characters from 0. Samples are signed 16 bit, little-endian, one channel.
`tests/engine/test_synthesizer_contract.py` tests every synthesizer against the promises of `Synthesizer`.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from typing import Protocol

    from talkcli.engine.protocol import Voice
else:
    Protocol = object


class NotInstalled(Exception):
    """A part of a synthesizer is not installed; the text says what to install."""


@frozen
class SpeechSettings:
    """The settings of a sentence besides its voice, with pyttsx3's defaults."""

    rate: int = 200  # words per minute, 80 to 450
    volume: float = 1.0  # 0.0 to 1.0; 1.0 is the voice's own
    pitch: int = 50  # 0 to 100; 50 is the voice's own
    voice_only: bool = False  # whether the sentence fails if its own voice can't speak it


class SampleSink(Protocol):
    """A receiver of the samples and words of one sentence, such as the playback.

    Each method may block for as long as the sentence is held. Each may raise Stopped if the sentence has to end, or
    CannotSpeak if it can't be played. After that, the sink must not be called again.
    """

    def begin(self, rate: int, voice: str, fallback_reason: str | None = None) -> None:
        """Announce the sample rate and the voice, before anything else.

        It may be called again with corrections as long as there are no words and no samples.

        Args:
            rate: Samples per second.
            voice: The id of the voice that speaks.
            fallback_reason: Why this is not the voice that was asked for, for people.
        """

    def word(self, start: int, length: int, position: float) -> None:
        """Announce a word.

        Args:
            start: Where the word begins in the text.
            length: The length of the word in characters, at least 1.
            position: Where the word begins in the samples, in seconds.
        """

    def write(self, samples: bytes) -> None:
        """Write whole samples. An empty write only gives the sink a chance to raise Stopped."""

    def wait(self, descriptor: int) -> None:
        """Play what was written until a descriptor is readable, for a synthesizer that works in a thread.

        It may return earlier, and may be called before `begin`. The sentence can be held or stopped meanwhile.
        """


class Synthesizer(Protocol):
    """A converter of texts into samples and words, in the voice that was loaded last.

    Only the thread that made the synthesizer calls it, and the synthesizer calls its sink in that thread only. The
    constructor raises NotInstalled if a part of the synthesizer is missing.
    """

    #: the synthesizer's name for people, such as "eSpeak NG 1.51 (system)", or None
    version: str | None
    #: the id of the current voice: the one that was loaded last, or the synthesizer's default
    voice: str

    def voices(self) -> tuple[Voice, ...]:
        """Return all voices by unique ids, the usual ones first; another call may return more.

        An id that begins with "+" is a variant, which is appended to the id of a voice.
        """

    def load(self, voice: str) -> None:
        """Speak in the voice with this id from now on.

        It returns quickly, because it can't be stopped. A voice that takes seconds to load is loaded by `speak`, which
        waits in its sink.

        Raises:
            UnknownVoice: The voice can't be loaded. The previous voice stays.
        """

    def speak(self, text: str, settings: SpeechSettings, sink: SampleSink) -> None:
        """Synthesize a sentence, and return once all of it is written.

        The order is: the sample rate, then each word before its first sample. The positions of words in the samples
        never decrease; their positions in the text may jump and repeat.

        The first samples are written as soon as they exist, and the rest in small parts, because a sentence can only be
        stopped or held in a call of the sink. A synthesizer that needs more than some milliseconds writes `b""`
        meanwhile, or works in a thread and waits in the sink.

        Every string is a valid text. Control characters and lone surrogates are silent. A text without anything to
        speak yields no words, and no samples or only silence.

        No state of a sentence is left behind, however it ends: except for noise in the samples, the next sentence is
        the same as it would be without it.

        Raises:
            CannotSpeak: `engine_failed`; `voice_failed` if the files of a voice are faulty; or `bad_option` for
                settings that the voice doesn't support, before any sample is written. What the sink raises passes
                through at once.
        """
