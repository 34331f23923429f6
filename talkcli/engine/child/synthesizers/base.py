"""What makes sound of a text: the interface of a synthesizer, its contract, and what it speaks into.

Places in a text are characters from 0, samples are signed 16 bit, little-endian, one channel. Nothing here loads or
makes anything. `tests/engine/test_synthesizer_contract.py` puts every synthesizer through what `Synthesizer` says.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from typing import Protocol

    from talkcli.engine.protocol import Voice
else:
    Protocol = object


class NotInstalled(Exception):
    """A part that a synthesizer needs is not there, until somebody installs it: the text says what."""


@frozen
class Sound:
    """How a sentence is to sound, besides its voice. What it is where nobody asks for another is pyttsx3's."""

    rate: int = 200  # words per minute, 80 to 450
    volume: float = 1.0  # 0.0 to 1.0, of the voice's own
    pitch: int = 50  # 0 to 100; 50 is the voice's own
    voice_only: bool = False  # whether it is the voice that was loaded, or none


class Output(Protocol):
    """Where one sentence goes; the playback is one.

    Each method may wait, for as long as a sentence is held, and may raise: Stopped when the sentence is to end,
    CannotSpeak when it can't be played. It was told everything then, and is told no more.
    """

    def begin(self, rate: int, voice: str, why: str | None = None) -> None:
        """Take note of the samples per second, before anything else: a player is started by it; and of who speaks.

        `voice`: its id; `why`: why that is another than was asked for, for people. Once more, if any of it turns out to
        be wrong, while there are no words and no samples yet.
        """

    def word(self, start: int, length: int, position: float) -> None:
        """Take note that `length` characters from `start`, 1 or more, begin `position` seconds into the samples."""

    def write(self, samples: bytes) -> None:
        """Take samples, whole ones. With none it only lets in what may have come: it raises Stopped, or returns."""

    def wait(self, descriptor: int) -> None:
        """Go on with what was written until this is readable, for who makes the sentence in a thread of its own.

        It may return before. What was asked of the sentence is done meanwhile: it is held, or Stopped is raised. It may
        be called before `begin`.
        """


class Synthesizer(Protocol):
    """Makes samples and words of texts, one at a time, in the voice that was loaded last.

    All of it is called in the one thread that made it, the engine process's main thread, and calls its output in no
    other. It plays nothing, and knows of no goals. What makes one raises NotInstalled where a part is missing.
    """

    #: what speaks, for people: "eSpeak NG 1.51 (system)"; None if there is nothing to be said
    version: str | None
    #: id of the voice in force: the one that was loaded last, before that the synthesizer's own
    voice: str

    def voices(self) -> tuple[Voice, ...]:
        """Return all voices, each by an id of its own, the usual ones first. More may be there the next time.

        One whose id begins with "+" is no voice but a variant, which is written behind the id of another.
        """

    def load(self, voice: str) -> None:
        """Speak with the voice of this id from now on; UnknownVoice leaves the one in force that was before.

        It returns soon, as nothing can be stopped meanwhile, and no sign of life given: what takes seconds is for
        `speak`, which waits in its output.
        """

    def speak(self, text: str, sound: Sound, output: Output) -> None:
        """Make the sentence, and return when all of it was written.

        The rate comes first, then each word before its first sample, at positions that never decrease; where in the
        text they are may jump and repeat. The first samples are written as soon as there are any, the rest bit by bit:
        between two calls of the output nothing can stop or hold the sentence, so that one that needs longer than some
        milliseconds writes nothing (`b""`) meanwhile, or has it done by a thread of its own, and waits. A text in which
        nothing can be spoken, the empty one too, has no words, and silence at most. Any string is a text: control
        characters and lone surrogates are silent.

        What the output raises comes out of here, at once, and the output is not called again. Of its own it raises
        CannotSpeak, no other: `engine_failed`, `voice_failed` where a voice's files are to blame, and `bad_option` for
        a sound that it can't make, before anything is spoken. Nothing of a sentence stays, whichever way it ended: the
        next is what it would have been without it, but for what of the samples is noise.
        """
