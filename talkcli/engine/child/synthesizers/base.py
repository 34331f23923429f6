"""Interfaces for synthesizers, and for the sinks that receive their sound.

Positions in a text are counted in characters from 0. Samples are signed 16 bit, little-endian, one channel.
`tests/engine/test_synthesizer_contract.py` tests that every synthesizer behaves as `Synthesizer` describes.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from typing import Protocol

    from talkcli.engine.protocol import Voice
else:
    Protocol = object


class NotInstalled(Exception):
    """Raised if software that a synthesizer needs is not installed.

    The message says what to install.
    """


@frozen
class SpeechSettings:
    """The settings for speaking a sentence, except the voice.

    The defaults are those of pyttsx3.
    """

    rate: int = 200  # words per minute, 80 to 450
    volume: float = 1.0  # 0.0 to 1.0; 1.0 is the voice's natural volume
    pitch: int = 50  # 0 to 100; 50 is the voice's natural pitch
    voice_only: bool = False  # whether to fail if the voice can't be used, instead of using another one
    begins_text: bool = True  # whether this is the first part of a text; silence before it may be cut
    ends_text: bool = True  # whether this is the last part of a text; a pause follows even without a punctuation mark
    phonemes: bool = False  # whether "[[" and "]]" in the text enclose phonemes of libespeak-ng


class SampleSink(Protocol):
    """Receives the samples of one sentence and the positions of its words.

    Every method may block while the sentence is paused. It may raise Stopped if the sentence has to end, or CannotSpeak
    if the sentence can't be played. After such an exception, the sink must not be called again.
    """

    def begin(self, rate: int, voice: str, fallback_reason: str | None = None) -> None:
        """Announce the sample rate and the voice that speaks.

        This must be called first. It may be called again with other values until the first word or sample.

        Args:
            rate: Samples per second.
            voice: The id of the voice that speaks.
            fallback_reason: A message saying why the requested voice is not used, or None if it is used.
        """

    def word(self, start: int, length: int, audio_start: float) -> None:
        """Announce the time at which a word will be heard.

        Args:
            start: The position of the word in the text.
            length: The length of the word in characters, at least 1.
            audio_start: The time at which the word begins, in seconds from the first sample.
        """

    def write(self, samples: bytes) -> None:
        """Play these samples. Raise Stopped if the sentence has to end, even if there are no samples."""

    def wait(self, descriptor: int) -> None:
        """Keep playing until a file descriptor becomes readable.

        A synthesizer calls this while it waits for its own thread. The method may return early, and it may be called
        before `begin`. The sentence can be paused or stopped during the wait.
        """


class Synthesizer(Protocol):
    """Turns text into sound, using the voice that was chosen last.

    All calls come from the thread that created the synthesizer, and the synthesizer calls its sink only in this thread.
    The constructor raises NotInstalled if software is missing.
    """

    #: the name and version shown to users, such as "eSpeak NG 1.51 (system)", or None if unknown
    version: str | None
    #: the id of the current voice, which is the default voice until another one is chosen
    voice: str

    def voices(self) -> tuple[Voice, ...]:
        """Return all voices, the common ones first.

        The ids are unique. An id that begins with "+" is a variant, which can be appended to the id of a voice. The
        result of a later call may contain more voices.
        """

    def choose_voice(self, voice: str) -> None:
        """Choose the voice for the next sentences.

        This must return quickly, because it can't be interrupted. If a voice takes seconds to load, `speak` waits for
        it by calling `SampleSink.wait`.

        Args:
            voice: The id of the voice.

        Raises:
            UnknownVoice: The voice can't be loaded. The synthesizer keeps the previous voice.
        """

    def speak(self, text: str, settings: SpeechSettings, sink: SampleSink) -> None:
        """Synthesize a sentence, and pass its samples and words to the sink.

        Return after writing all of it. The sample rate comes first, and every word is reported before its first sample
        is written. The times of words never decrease, but their positions in the text may jump back and repeat.

        Samples are written in small parts as soon as they are ready, because a sentence can only be stopped or paused
        while the sink is called. If the next part takes more than a few milliseconds, the synthesizer calls `write`
        with `b""` from time to time, or works in a thread and calls `wait`.

        Every string is a valid text. Control characters and lone surrogates are silent. A text without any speech
        produces no words, and either no samples or silence.

        A sentence never changes the sound of later ones, even if it was stopped or failed.

        Raises:
            CannotSpeak: The reason is `engine_failed`, `voice_failed` if the files of the voice are faulty, or
                `bad_option` if the voice doesn't support the settings (before any sample is written). Exceptions of the
                sink pass through at once.
        """
