"""A synthesizer for Piper's neural voices, which gets its phonemes from libespeak-ng.

Models are loaded and run in background threads. Meanwhile, the calling thread waits in its sink, so a sentence can
still be played, paused and stopped. The thread that runs a model also calls libespeak-ng, which no other thread uses
during that time.
"""

from __future__ import annotations

import contextlib
import itertools

from talkcli.engine import models
from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.synthesizers.inference import ModelRun, no_memory_error
from talkcli.engine.child.synthesizers.loader import BackgroundIterator, ModelLoader
from talkcli.engine.child.synthesizers.phonemes import PAUSE_MARKS, split_text
from talkcli.engine.models import BEGIN_SYMBOL, END_SYMBOL, PAD_SYMBOL, VoiceFileError
from talkcli.engine.players import SAMPLE_BYTES
from talkcli.engine.voices import UnknownVoice, neural_language, speaker_number
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import NEURAL_PREFIX, SPEAKER_MARK
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import Any

    from talkcli.engine.child.synthesizers.base import SampleSink, SpeechSettings
    from talkcli.engine.child.synthesizers.espeak import Espeak
    from talkcli.engine.child.synthesizers.inference import Model
    from talkcli.engine.child.synthesizers.phonemes import SpeechPart
    from talkcli.engine.protocol import Voice

    #: for each word, its start and length in the text, and its time in seconds from the start of the part
    WordTimes = tuple[tuple[int, int, float], ...]
    #: the samples of a piece of sound, and the words that begin in it or later
    SpokenPart = tuple[bytes, WordTimes]

#: The initial and the maximum number of frames to decode at a time. A small first part of 0.23 s is ready quickly.
#: Later parts have up to 0.93 s, because extra frames have to be decoded before and after each part
#: (`inference.CONTEXT_FRAMES`).
_MIN_DECODED_FRAMES, _MAX_DECODED_FRAMES = 20, 80
#: The maximum number of decoded parts that wait to be played. They have up to seven seconds of sound, so playback
#: continues if the computer is busy for a while.
_MAX_PARTS_AHEAD = 8
#: The length of the pause after a sentence, and the level below which sound counts as silence there (1.0 is full
#: scale). A model's own pause has 0.07 to 0.2 s, which is too short if a player stops 0.25 s early. libespeak-ng makes
#: pauses of 0.24 to 0.28 s.
_PAUSE_S, _PAUSE_LEVEL = 0.26, 0.01
#: The level below which sound counts as silence at the start of a sentence (1.0 is full scale), and how much of this
#: silence is kept. Models produce 26 to 60 ms of silence, which would delay every sentence.
_LEADING_LEVEL, _LEADING_S = 0.0015, 0.005
#: The minimum length of a pause between two words. If the silence is shorter, the second word is taken to begin where
#: the first one ends, because the blank between them already sounds like the second word.
_WORD_GAP_S = 0.15
#: A part whose sound is always below this level counts as silent (1.0 is full scale).
_SPEECH_LEVEL = 0.001
#: How much sound to write to the sink at a time.
_WRITE_S = 0.1
_FULL_SCALE = 32767
_DEFAULT_PITCH = 50
#: The rate at which libespeak-ng is as fast as Piper's voices at their natural pace, and the share of the speaking time
#: that doesn't depend on the rate. Both values were fitted to five sentences, spoken by libespeak-ng 1.51 (gmw/en-US)
#: at 80 to 450 words per minute, and by en_US-joe-medium at scales of 0.2 to 2.2. From 120 to 400 words per minute, the
#: durations agree within 5 %. At 80 and 450, the model is 11 and 13 % slower.
_NATURAL_WPM, _CONSTANT_SHARE = 195, 0.30
_MIN_SCALE = 0.1


class Piper:
    """A synthesizer for Piper's neural voices."""

    version: str | None = None

    def __init__(self, espeak: Espeak) -> None:
        self._espeak = espeak
        self.loader = ModelLoader()
        self.voice = ""
        #: whether the last text has produced any sound
        self.has_written = False
        #: the id of the current voice without the speaker, the speaker, and the path of the model
        self._model_id, self._speaker, self._path = "", "", ""

    @property
    def problem(self) -> str | None:
        """The reason why the current voice can't speak, or None if the voice is loaded."""
        if self.loader.get_model(self._model_id) is not None:
            return None
        return self.loader.errors.get(self._model_id) or f"{self.voice} is not loaded"

    @property
    def language(self) -> str:
        """The libespeak-ng voice or language to use if the current voice fails.

        It comes from the description of the voice, or from its name if the description can't be read.
        """
        try:
            return models.read_description(self._path).espeak_voice
        except VoiceFileError:
            return neural_language(self._model_id)

    def voices(self) -> tuple[Voice, ...]:
        """Return all installed neural voices."""
        return models.installed_voices()

    def choose_voice(self, voice: str) -> None:
        """Choose a voice by its id, which may end with "#" and a speaker.

        If a file of the voice is faulty, `speak` reports the error later.

        Raises:
            UnknownVoice: A package, the voice or the speaker is missing.
        """
        if missing := models.missing_package():
            raise UnknownVoice(missing)
        model, _, speaker = voice.partition(SPEAKER_MARK)
        path = models.find_models().get(model.removeprefix(NEURAL_PREFIX))
        if path is None:
            raise UnknownVoice("its file no longer exists")
        with contextlib.suppress(VoiceFileError):
            description = models.read_description(path)
            speaker_number(speaker, description.speaker_names, description.speakers)
        self.voice, self._model_id, self._speaker, self._path = voice, model, speaker, path

    def speak(self, text: str, settings: SpeechSettings, sink: SampleSink) -> None:
        """Load the voice if necessary, synthesize a sentence, and pass its samples and words to the sink.

        The samples vary from call to call, unless the description of the voice sets its noise to 0.
        """
        if settings.pitch != _DEFAULT_PITCH:
            words = f"the pitch of {self.voice} can't be changed; leave out --pitch, or choose an espeak voice"
            raise CannotSpeak(Reason.BAD_OPTION, words)
        self.has_written = self.has_written and not settings.begins_text
        voice = self._model_id
        model = self._wait_for_model(voice, sink)
        description = model.description
        try:
            speaker = speaker_number(self._speaker, description.speaker_names, description.speakers)
        except UnknownVoice as error:
            raise CannotSpeak(Reason.UNKNOWN_VOICE, f"{self.voice}: {error}") from error
        try:
            sink.begin(description.rate, self.voice)
            with self._espeak.phonemizer(description.espeak_voice, has_phonemes=settings.phonemes) as phonemizer:
                run = ModelRun()
                phonemes = split_text(phonemizer, text, ends_text=settings.ends_text)
                parts = _speak_parts(model, phonemes, speaker, settings, run)
                self._write_sound(parts, description.rate, run, sink)
        except MemoryError as error:
            raise CannotSpeak(Reason.VOICE_FAILED, str(no_memory_error(self._path))) from error
        except (VoiceFileError, UnknownVoice) as error:
            unknown = isinstance(error, UnknownVoice)
            words = f"{model.path}.json: {error}; download the voice again" if unknown else str(error)
            self.loader.errors[voice] = words
            raise CannotSpeak(Reason.VOICE_FAILED, words) from error

    def _wait_for_model(self, voice: str, sink: SampleSink) -> Model:
        """Return the model of a voice. Load the model first if necessary.

        While it loads, the sink keeps playing.

        Raises:
            CannotSpeak: The voice can't be loaded.
        """
        loader = self.loader
        if loader.get_model(voice) is None:
            loader.queue(voice)  # Try again even after an error, because the files may have been repaired.
        while (model := loader.get_model(voice)) is None:
            if voice in loader.errors:
                raise CannotSpeak(Reason.VOICE_FAILED, loader.errors[voice])
            assert loader.descriptor is not None
            sink.wait(loader.descriptor)
        return model

    def _write_sound(self, parts: Iterator[SpokenPart], rate: int, run: ModelRun, sink: SampleSink) -> None:
        """Write sound to the sink. A thread synthesizes the next parts in the meantime."""
        write_bytes = int(_WRITE_S * rate) * SAMPLE_BYTES
        seconds = 0.0
        spoken_parts = BackgroundIterator(parts, _MAX_PARTS_AHEAD)
        try:
            while (spoken := spoken_parts.take(sink.wait)) is not None:
                samples, words = spoken
                self.has_written = True
                for start, length, position in words:
                    sink.word(start, length, seconds + position)
                for at in range(0, len(samples), write_bytes):
                    sink.write(samples[at : at + write_bytes])
                seconds += len(samples) / SAMPLE_BYTES / rate
        finally:
            run.end()
            spoken_parts.close()
            self.loader.mark_spoken(self._model_id)


def _speak_parts(
    model: Model, parts: Iterator[SpeechPart], speaker: int, settings: SpeechSettings, run: ModelRun
) -> Iterator[SpokenPart]:
    """Synthesize the parts of a text. Yield small pieces of sound with their words.

    Raises:
        VoiceFileError: The model is faulty, or knows none of the phonemes with which the text begins.
    """
    pause = int(_PAUSE_S * model.description.rate)
    first, unknown = True, ""
    for part in parts:
        ids, places = _phoneme_ids(part.phonemes, model.description.phoneme_ids)
        if not places:
            unknown = unknown or "".join(part.phonemes)
            continue
        frames = model.encode(ids, speaker, _duration_scale(settings.rate), run)
        begins = [0, *frames.ends]
        # If a word has no known phonemes, it gets the time of the next phoneme. `max` keeps the times from decreasing.
        times = itertools.accumulate((_word_time(model, part, places, begins, at) for at, _, _ in part.words), max)
        words = tuple((start, length, time) for (_, start, length), time in zip(part.words, times, strict=True))
        loudest = 0.0
        quiet = 0  # how many silent samples come after the last sound
        begin, count = 0, _MIN_DECODED_FRAMES
        # Don't play initial silence at once. If the whole part of the text turns out to be silent, another voice can
        # speak it instead.
        silent: list[SpokenPart] = []
        while begin < frames.count:
            end = min(frames.count, begin + count)
            samples = model.decode(frames, begin, end, run)
            levels = abs(samples)
            loudest = max(loudest, float(levels.max()))
            audible = (levels > _PAUSE_LEVEL).nonzero()[0]
            quiet = len(samples) - 1 - int(audible[-1]) if len(audible) else quiet + len(samples)
            if first and settings.begins_text:
                samples, words = _cut_leading_silence(samples, levels, words, model.description.rate)
            first = False
            silent.append((_to_bytes(samples, settings.volume), words))
            if loudest >= _SPEECH_LEVEL:
                yield from silent
                silent.clear()
            words, begin, count = (), end, min(_MAX_DECODED_FRAMES, 2 * count)
        if loudest < _SPEECH_LEVEL:
            raise VoiceFileError(f"{model.path} produced only silence; download the voice again")
        if part.ends_sentence and quiet < pause:
            yield bytes((pause - quiet) * SAMPLE_BYTES), ()
    if unknown and first and settings.begins_text:  # otherwise, the voice can speak other parts
        why = f"has no id for a phoneme of the text ({unknown[:20]})"
        raise VoiceFileError(f"{model.path}.json {why}; download both files from the same source")


def _word_time(
    model: Model, part: SpeechPart, id_indexes: Sequence[int], id_frames: Sequence[int], phoneme: int
) -> float:
    """Return the time at which a word is heard, in seconds from the start of its part.

    Usually, this is when the word before it ends. The start of the word's first phoneme would be 41 to 93 ms too late.
    Compared with a speech recognizer, the result is at most 9 ms too early. These are medians for 300 words at 120, 200
    and 300 words per minute.

    Args:
        model: The model that speaks the part.
        part: The part of the text.
        id_indexes: For each phoneme, the index of its first id.
        id_frames: For each id, the frame at which it begins.
        phoneme: The index of the word's first phoneme.
    """
    own = id_frames[id_indexes[phoneme]]
    if phoneme >= 2 and part.phonemes[phoneme - 1] == " " and part.phonemes[phoneme - 2] not in PAUSE_MARKS:
        end = id_frames[id_indexes[phoneme - 1] - len(model.description.phoneme_ids[PAD_SYMBOL])]
        if model.seconds(own - end) < _WORD_GAP_S:
            return model.seconds(end)
    return model.seconds(own)


def _cut_leading_silence(samples: Any, levels: Any, words: WordTimes, rate: int) -> tuple[Any, WordTimes]:
    """Cut the silence at the start of a sentence, and adjust the times of its words."""
    audible = (levels > _LEADING_LEVEL).nonzero()[0]
    cut = max(0, int(audible[0]) - int(_LEADING_S * rate)) if len(audible) else 0
    return samples[cut:], tuple((start, length, max(0.0, time - cut / rate)) for start, length, time in words)


def _to_bytes(samples: Any, volume: float) -> bytes:
    """Scale float samples by the volume, and convert them to 16-bit integers."""
    return bytes((samples * (_FULL_SCALE * volume)).clip(-_FULL_SCALE, _FULL_SCALE).astype("<i2"))


def _phoneme_ids(phonemes: Sequence[str], id_map: Mapping[str, tuple[int, ...]]) -> tuple[list[int], list[int]]:
    """Return the model's ids for phonemes, and the index of each phoneme's first id.

    If the model doesn't know a phoneme, it gets the index of the next known phoneme, or of the end. If the model knows
    none of them, the list of indexes is empty.
    """
    result = [*id_map[BEGIN_SYMBOL], *id_map[PAD_SYMBOL]]
    places = []
    for phoneme in phonemes:
        places.append(len(result))
        if id_map.get(phoneme):
            result += [*id_map[phoneme], *id_map[PAD_SYMBOL]]
    known = any(id_map.get(each) for each in phonemes)
    return [*result, *id_map[END_SYMBOL]], places if known else []


def _duration_scale(rate: int) -> float:
    """Convert a rate in words per minute to a factor for all durations.

    The factor makes a sentence take as long as with libespeak-ng. Above 400 words per minute, the model is slower,
    because no phoneme can be shorter than a frame.
    """
    return max(_MIN_SCALE, (_NATURAL_WPM / rate - _CONSTANT_SHARE) / (1 - _CONSTANT_SHARE))
