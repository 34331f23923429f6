"""Piper's neural voices as a synthesizer: a text's sounds by libespeak-ng, and a model that speaks them.

A model is loaded (`loader.py`), and run, in a thread beside the one that calls, which waits in the output: signs of
life, a stop and a pause go on, and so does what is being heard. Libespeak-ng is asked for sounds in that thread, too,
and by nobody else meanwhile.
"""

from __future__ import annotations

import contextlib
import itertools

from talkcli.engine import models
from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.synthesizers.inference import Run
from talkcli.engine.child.synthesizers.loader import Loader
from talkcli.engine.child.synthesizers.phonemes import STOPS, pieces
from talkcli.engine.child.synthesizers.work import Work
from talkcli.engine.models import BEGIN, END, PAD, BadFile
from talkcli.engine.players import SAMPLE_BYTES
from talkcli.engine.voices import NEURAL, UnknownVoice, language_of, speaker_number
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import SPEAKER
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import Any

    from talkcli.engine.child.synthesizers.base import SampleSink, SpeechSettings
    from talkcli.engine.child.synthesizers.espeak import Espeak
    from talkcli.engine.child.synthesizers.inference import Model
    from talkcli.engine.child.synthesizers.phonemes import Piece
    from talkcli.engine.models import Description
    from talkcli.engine.protocol import Voice

#: Frames that are made into samples at once, at first and at most: 0.23 s of sound, so that the first is soon there,
#: and 0.93, as each time some on both sides are made once more (`inference.AROUND`).
_FIRST, _MOST = 20, 80
#: How many of these may lie ready, so that a slow moment of the machine is not heard: seven seconds.
_AHEAD = 8
#: Seconds from the last sound of a sentence that can be heard to its end, as libespeak-ng has it: 0.24 to 0.28. A
#: player may end 0.25 early. What a model itself makes of it, 0.07 to 0.2, is fainter than this, of 1.0.
_PAUSE, _FAINT = 0.26, 0.01
#: Sound before a sentence that is no louder than this, of 1.0, is left out, but for so many seconds: 26 to 60 ms, by
#: which a voice would be later than it must be.
_UNHEARD, _BEFORE = 0.0015, 0.005
#: Seconds between two words up to which the second one begins where the first ends: what is between them is the blank
#: and its pads, which sound like the word that comes; what is longer is a pause.
_BETWEEN = 0.15
#: Samples no louder than this, of 1.0, all through a piece, are no speech.
_SILENT = 0.001
#: Seconds of sound that are handed on at once.
_AT_ONCE = 0.1
#: What 1.0 is in samples of 16 bit.
_FULL = 32767
_PITCH = 50
#: Words per minute of libespeak-ng's that are as fast as a voice as it was trained, and how much of its time is no
#: matter of its pace, as each duration is rounded up to whole frames. Five sentences, from 80 to 450 words per minute,
#: by libespeak-ng 1.51 (gmw/en-US) and by en_US-joe-medium at paces from 0.2 to 2.2, from first to last sound: from 120
#: to 400 the two are within 5 % then, at 80 and 450 the model is slower, by 11 and 13 %.
_NATURAL, _ROUNDED = 195, 0.30
_LEAST_PACE = 0.1


@frozen
class Made:
    """Some sound, and before it the words that begin in it or later."""

    samples: bytes
    #: where in the text, the length there, and the seconds from the beginning of these samples
    words: tuple[tuple[int, int, float], ...] = ()


class Piper:
    """The neural voices that there are, as one synthesizer."""

    version: str | None = None

    def __init__(self, espeak: Espeak) -> None:
        """`espeak` knows the sounds; it is used only while this one speaks."""
        self._espeak = espeak
        self.loader = Loader()
        #: id of the voice in force, with its speaker
        self.voice = ""
        self._model_id, self._speaker, self._path = "", "", ""

    @property
    def ready(self) -> bool:
        """Whether the voice in force is loaded."""
        return self.loader.model(self._model_id) is not None

    @property
    def error(self) -> str | None:
        """Why the voice in force can't be had, by the last attempt to load it."""
        return self.loader.error(self._model_id)

    @property
    def language(self) -> str:
        """The language of the voice in force, by libespeak-ng's name for it: its files say it, or else its name."""
        try:
            return models.describe(self._path).speller
        except BadFile:
            return language_of(self._model_id)

    def voices(self) -> tuple[Voice, ...]:
        """Return the voices whose files are there now."""
        return models.voices()

    def load(self, voice: str) -> None:
        """Take a voice of `voices`, with a speaker behind it or without; `speak` waits for what takes seconds.

        What is wrong with its files is said by `speak`, too, so that a goal says it, each time anew.
        """
        lacking = models.missing()
        if lacking is not None:
            raise UnknownVoice(lacking)
        model, _, speaker = voice.partition(SPEAKER)
        path = models.found().get(model.removeprefix(NEURAL)) if voice.startswith(NEURAL) else None
        if path is None:
            raise UnknownVoice("its file is not there any more")
        with contextlib.suppress(BadFile):  # it comes again where the model is loaded
            _number(models.describe(path), speaker)
        self.voice, self._model_id, self._speaker, self._path = voice, model, speaker, path

    def speak(self, text: str, sound: SpeechSettings, output: SampleSink) -> None:
        """Speak as `Synthesizer` says; the samples differ each time, as far as the voice's noise is not 0.

        Where the voice is not loaded yet, it waits until it is.
        """
        if sound.pitch != _PITCH:
            words = f"the voice {self.voice} has no pitch but its own: leave --pitch out, or choose one of espeak's"
            raise CannotSpeak(Reason.BAD_OPTION, words)
        voice = self._model_id
        model = self._loaded(voice, output)
        try:
            speaker = _number(model.description, self._speaker)
        except UnknownVoice as error:
            raise CannotSpeak(Reason.UNKNOWN_VOICE, f"{self.voice}: {error}") from error
        try:
            output.begin(model.description.rate, self.voice)
            with self._espeak.spelling(model.description.speller) as speller:
                self._write(model, speaker, pieces(speller, text), sound, output)
        except BadFile as error:
            self.loader.suspect(voice)
            raise CannotSpeak(Reason.VOICE_FAILED, str(error)) from error
        except MemoryError as error:
            words = f"{self._path} cannot be spoken with: there is no memory for it; end another program"
            raise CannotSpeak(Reason.VOICE_FAILED, words) from error
        except UnknownVoice as error:
            self.loader.suspect(voice)
            raise CannotSpeak(Reason.VOICE_FAILED, f"{model.path}.json: {error}: get the voice anew") from error

    def _loaded(self, voice: str, output: SampleSink) -> Model:
        """Return the model of a voice, as soon as it is loaded."""
        loader = self.loader
        if loader.model(voice) is None:
            loader.start(voice)  # what was wrong with it may be mended
        while (model := loader.model(voice)) is None:
            why = loader.error(voice)
            if why is not None:
                raise CannotSpeak(Reason.VOICE_FAILED, why)
            assert loader.descriptor is not None
            output.wait(loader.descriptor)
        return model

    def _write(
        self, model: Model, speaker: int, spelled: Iterator[Piece], sound: SpeechSettings, output: SampleSink
    ) -> None:
        """Write what a thread makes of the pieces, which are spelled there, too, as they are needed."""
        run = Run()
        rate = model.description.rate
        at_once = int(_AT_ONCE * rate) * SAMPLE_BYTES
        seconds = 0.0
        work = Work(_made(model, spelled, speaker, sound, run), _AHEAD)
        try:
            while (made := work.take(output.wait)) is not None:
                for start, length, position in made.words:
                    output.word(start, length, seconds + position)
                for at in range(0, len(made.samples), at_once):
                    output.write(made.samples[at : at + at_once])
                seconds += len(made.samples) / SAMPLE_BYTES / rate
        finally:
            run.end()
            work.close()
            self.loader.spoken(self._model_id)


def _made(model: Model, spelled: Iterator[Piece], speaker: int, sound: SpeechSettings, run: Run) -> Iterator[Made]:
    """Yield the sound of the pieces."""
    pause = int(_PAUSE * model.description.rate)
    known, lacking = False, ""
    first = True
    for piece in spelled:
        numbers, places = _numbered(piece.sounds, model.description.sounds)
        if not places:
            lacking = lacking or "".join(piece.sounds)
            continue
        known = True
        frames = model.encode(numbers, speaker, _pace(sound.rate), run)
        begins = [0, *frames.ends]
        # One that lacks all of its sounds is put to the next, which may be heard before that.
        heard_at = itertools.accumulate((_begin(model, piece, places, begins, at) for at, _, _ in piece.words), max)
        words = tuple((start, length, at) for (_, start, length), at in zip(piece.words, heard_at, strict=True))
        loudest = 0.0
        faint = 0  # samples, up to here
        begin, many = 0, _FIRST
        silent: list[Made] = []  # all so far: what makes no sound can be spoken by another voice
        while begin < frames.count:
            end = min(frames.count, begin + many)
            part = model.decode(frames, begin, end, run)
            heights = abs(part)
            loudest = max(loudest, float(heights.max()))
            heard = (heights > _FAINT).nonzero()[0]
            faint = len(part) - 1 - int(heard[-1]) if len(heard) else faint + len(part)
            if first:
                part, words, first = *_from_its_sound(part, heights, words, model.description.rate), False
            silent.append(Made(_samples(part, sound.volume), words))
            if loudest >= _SILENT:
                yield from silent
                silent.clear()
            words, begin, many = (), end, min(_MOST, 2 * many)
        if loudest < _SILENT:
            raise BadFile(f"{model.path} makes no sound of a text: get the voice anew")
        if piece.ends and faint < pause:
            yield Made(bytes((pause - faint) * SAMPLE_BYTES))
    if lacking and not known:
        why = f"has no number for a sound of the text ({lacking[:20]})"
        raise BadFile(f"{model.path}.json {why}: get both files from the same place")


def _begin(model: Model, piece: Piece, places: Sequence[int], begins: Sequence[int], at: int) -> float:
    """Return the seconds into a piece at which the word is heard that begins with the sound at this place.

    By 300 words at 120, 200 and 300 words per minute against a recognizer's alignment: at most 9 ms early in the
    median, where the word's own first sound is 41 to 93 ms late.
    """
    own = begins[places[at]]
    if at >= 2 and piece.sounds[at - 1] == " " and piece.sounds[at - 2] not in STOPS:
        end = begins[places[at - 1] - len(model.description.sounds[PAD])]
        if model.seconds(own - end) < _BETWEEN:
            return model.seconds(end)
    return model.seconds(own)


def _from_its_sound(
    part: Any, heights: Any, words: tuple[tuple[int, int, float], ...], rate: int
) -> tuple[Any, tuple[tuple[int, int, float], ...]]:
    """Return the beginning of a sentence without what can't be heard of it, and its words in their new places."""
    heard = (heights > _UNHEARD).nonzero()[0]
    cut = max(0, int(heard[0]) - int(_BEFORE * rate)) if len(heard) else 0
    return part[cut:], tuple((start, length, max(0.0, at - cut / rate)) for start, length, at in words)


def _samples(part: Any, volume: float) -> bytes:
    made: bytes = (part * (_FULL * volume)).clip(-_FULL, _FULL).astype("<i2").tobytes()
    return made


def _numbered(sounds: Sequence[str], numbers: Mapping[str, tuple[int, ...]]) -> tuple[list[int], list[int]]:
    """Return the model's numbers for some sounds, and where among them each sound begins; no places if it knows none.

    One that it doesn't know begins where the next one does that it knows, or the end.
    """
    result = [*numbers[BEGIN], *numbers[PAD]]
    places = []
    for sound in sounds:
        places.append(len(result))
        if numbers.get(sound):
            result += [*numbers[sound], *numbers[PAD]]
    known = any(numbers.get(each) for each in sounds)
    return [*result, *numbers[END]], places if known else []


def _pace(rate: int) -> float:
    """Return what durations are to be multiplied with, so that a sentence takes as long as by libespeak-ng.

    Above 400 words per minute a model is slower than that: no sound is shorter than a frame.
    """
    return max(_LEAST_PACE, (_NATURAL / rate - _ROUNDED) / (1 - _ROUNDED))


def _number(about: Description, speaker: str) -> int:
    return speaker_number(speaker, about.speaker_names, about.speakers)
