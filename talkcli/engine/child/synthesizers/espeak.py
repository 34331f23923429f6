"""libespeak-ng as a synthesizer, and as the source of phonemes for neural voices.

The library speaks a text in a single call. In this call, it passes about 50 ms of samples at a time to a callback in
the same thread. An exception can't pass through the library, so it is stored until the call returns. A process has only
one instance of the library. This module is for Linux. On other systems, pyttsx3's own drivers find their libraries.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import itertools
import os

from talkcli import install
from talkcli.engine.child.players.base import CannotSpeak, Stopped
from talkcli.engine.child.synthesizers import guard
from talkcli.engine.child.synthesizers.base import NotInstalled
from talkcli.engine.child.words import count_letters
from talkcli.engine.players import SAMPLE_BYTES, on_path
from talkcli.engine.protocol import Voice
from talkcli.engine.voices import VARIANT_PREFIX, UnknownVoice, find_voice
from talkcli.goals.reasons import Reason

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from talkcli.engine.child.synthesizers.base import SampleSink, SpeechSettings

_LIBESPEAK = "libespeak-ng.so.1"

#: Milliseconds of sound per callback. The library rounds this up to 49 ms at 22,050 Hz. Longer parts would delay the
#: first sound.
_CALLBACK_MS = 20

#: The option that keeps the library from calling exit() if its data is missing.
_DONT_EXIT = 0x8000

#: The names of the English voice. The first is a file name, which saves 4 to 40 ms, because the library doesn't have to
#: read all voices to find the language.
_ENGLISH = ("gmw/en", "en")

#: The type of the event that reports the sample rate before the first samples, which pyttsx3's binding doesn't define.
_EVENT_SAMPLERATE = 8

#: The library's default rate in words per minute.
_ESPEAK_DEFAULT_WPM = 175
#: The shortest pause after a sentence in samples. The pause after an abbreviation such as "Mr." has at most a hundred
#: samples, and the pause after a sentence has 6,000.
_PAUSE_SAMPLES = 2000

#: The library's output mode for phonemes in IPA.
_IPA = 2

#: The names of the lists of variants and of MBROLA voices, which the library accepts in place of a language.
_VARIANTS, _MBROLA = b"variant", b"mbrola"
#: The paths of an MBROLA voice's data. Without its data and the program mbrola, the library can't speak the voice.
_MBROLA_PATHS = ("/usr/share/mbrola/{0}", "/usr/share/mbrola/{0}/{0}", "/usr/share/mbrola/voices/{0}")


class _EspeakEvent(ctypes.Structure):
    """The C structure `espeak_EVENT` of speak_lib.h.

    The structure in pyttsx3's binding lacks `id.string`, so it is 4 bytes too short on 32-bit systems. The second event
    of a callback can't be read there.
    """

    _fields_ = (
        ("type", ctypes.c_int),
        ("unique_identifier", ctypes.c_uint),
        ("text_position", ctypes.c_int),
        ("length", ctypes.c_int),
        ("audio_position", ctypes.c_int),
        ("sample", ctypes.c_int),
        ("user_data", ctypes.c_void_p),
        # The union `id`, which has 8 bytes even if pointers have 4.
        ("id_number", ctypes.c_int),
        ("id_padding", ctypes.c_int),
    )


def _events_of(pointer: Any) -> Iterator[_EspeakEvent]:
    """Yield the events of a callback, up to the final event of type 0."""
    return itertools.takewhile(lambda each: each.type, iter(ctypes.cast(pointer, ctypes.POINTER(_EspeakEvent))))


def load_library() -> tuple[Any, str, int]:
    """Load and initialize libespeak-ng, from the system or else from the package espeakng-loader.

    This must be called once per process, before anything imports `pyttsx3.drivers._espeak`, which loads the library.

    Returns:
        pyttsx3's binding, the library's name and version for display ("eSpeak NG 1.51 (system)"), and the number of
        samples per second, which a voice may change.

    Raises:
        NotInstalled: The library or its data is missing.
        OSError: There is not enough memory, or there are not enough descriptors. A later attempt may succeed.
    """
    origin, data = _preload()
    from pyttsx3.drivers import _espeak

    # The library connects to PulseAudio, although it doesn't play anything. This takes 7 ms, or 30 s if PulseAudio
    # hangs. The server gives up the engine process earlier than that, so the sound server is hidden.
    sound_server = os.environ.get("PULSE_SERVER")
    os.environ["PULSE_SERVER"] = "unix:/dev/null"
    rate = _espeak.Initialize(_espeak.AUDIO_OUTPUT_SYNCHRONOUS, _CALLBACK_MS, data, _DONT_EXIT)
    del os.environ["PULSE_SERVER"]
    if sound_server is not None:
        os.environ["PULSE_SERVER"] = sound_server
    if rate <= 0:
        raise NotInstalled("there is no espeak-ng data: sudo apt-get install -y libespeak-ng1 espeak-ng-data")
    version = (_espeak.Info(None) or b"").decode("utf-8", "replace").split(" ")[0]
    return _espeak, f"eSpeak NG {version} ({origin})", rate


def _preload() -> tuple[str, bytes | None]:
    """Load the library so that the binding finds it, and return its origin and the directory of its data."""
    try:
        ctypes.CDLL(_LIBESPEAK)
        return "system", None
    except OSError as error:
        if _is_temporary(error):
            raise
        missing = error
    try:
        import espeakng_loader

        # The binding loads the library by the name of the system's. As this library is loaded globally, it is found by
        # that name.
        ctypes.CDLL(espeakng_loader.get_library_path(), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError) as error:
        if _is_temporary(error):
            raise
        raise NotInstalled(f"libespeak-ng is missing ({missing}): {install.espeak_library()}") from error
    return "espeakng-loader", str(espeakng_loader.get_data_path()).encode()


def _is_temporary(error: Exception) -> bool:
    """Return whether an error message reports a lack of memory or descriptors."""
    return str(error).endswith(tuple(map(os.strerror, (errno.EMFILE, errno.ENFILE, errno.ENOMEM))))


class Espeak:
    """A synthesizer that uses libespeak-ng."""

    version: str | None

    def __init__(self) -> None:
        """Load the library.

        Raises:
            NotInstalled, OSError: See `load_library`.
            UnknownVoice: The library has no English voice.
        """
        self._espeak, self.version, self._rate = load_library()
        espeak = self._espeak
        self._listed: tuple[Voice, ...] = ()
        #: the current parameters. Only changed parameters are set, so that a new process makes the same samples as the
        #: library with its defaults.
        self._parameters = {espeak.RATE: _ESPEAK_DEFAULT_WPM, espeak.VOLUME: 100, espeak.PITCH: 50}
        self._text = ""
        self._sink: SampleSink | None = None
        self._raised: BaseException | None = None
        #: the last phonemizer, which may still be using the library; None after it was stopped
        self._phonemizer: EspeakPhonemizer | None = None
        found = (each for each in _ENGLISH if espeak.SetVoiceByName(each.encode()) == espeak.EE_OK)
        self.voice = next(found, "")
        if not self.voice:
            raise UnknownVoice(_ENGLISH[-1])
        espeak.SetSynthCallback(self._on_audio)

    def voices(self) -> tuple[Voice, ...]:
        """Return the normal voices, the usable MBROLA voices, and the variants."""
        self._stop_phonemizer()
        espeak = self._espeak
        return (*_list_voices(espeak, None), *_mbrola_voices(espeak), *_variants(espeak))

    def load(self, voice: str) -> None:
        """Load a voice by its id, with or without a variant, or by another name that the library knows."""
        self._stop_phonemizer()
        # After some voices, the next voice is up to a third slower unless the rate is set again.
        self._parameters.clear()
        if not voice or self._espeak.SetVoiceByName(voice.encode("utf-8", "replace")) != self._espeak.EE_OK:
            # If a part of the voice is missing, the library has switched to the voice nevertheless, and would be
            # silent.
            self._espeak.SetVoiceByName(self.voice.encode())
            raise UnknownVoice("part of it is missing")
        self.voice = voice

    def speak(self, text: str, settings: SpeechSettings, sink: SampleSink) -> None:
        """Speak as `Synthesizer` describes; the samples vary slightly between calls."""
        self._stop_phonemizer()
        sink.begin(self._rate, self.voice)
        espeak = self._espeak
        self._set_parameters(settings)
        self._text = guard.guarded(text, self.voice)
        self._sink = sink
        status = espeak.Synth(self._text.encode("utf-8", "replace"), flags=espeak.CHARS_UTF8 | espeak.ENDPAUSE)
        raised, self._raised, self._sink = self._raised, None, None
        if raised is not None:
            raise raised
        if status != espeak.EE_OK:
            raise CannotSpeak(Reason.ENGINE_FAILED, f"espeak_Synth failed with {status}")

    def load_language(self, language: str) -> None:
        """Load a voice of a language such as "de-at".

        If there is no such voice, load a voice of the language's first part ("de"), or else an English voice.
        """
        self._stop_phonemizer()
        found = (self._find_voice(each) for each in (language, language.partition("-")[0], *_ENGLISH))
        self.load(next((each.id for each in found if each), self.voice))

    @contextlib.contextmanager
    def phonemizer(self, language: str) -> Iterator[EspeakPhonemizer]:
        """Return a context manager with a phonemizer, which another thread may use until the end of the `with` block.

        The synthesizer must not be used in the block. After it, calls of the phonemizer raise Stopped. A call that is
        still running at the end of the block continues for some milliseconds, or up to 130 ms if it gets phonemes. The
        block doesn't wait for this call, but the next use of the synthesizer does.

        Raises:
            UnknownVoice: The library has no voice of this language.
        """
        self._stop_phonemizer()
        voice = self._find_voice(language)
        voice_id = voice.id if voice is not None else ""
        self._phonemizer = phonemizer = EspeakPhonemizer(self._espeak, voice_id)
        if not voice_id or self._espeak.SetVoiceByName(voice_id.encode()) != self._espeak.EE_OK:
            raise UnknownVoice(f'{self.version} has no voice "{language}", which knows its sounds')
        self._espeak.SetParameter(self._espeak.RATE, _ESPEAK_DEFAULT_WPM, 0)
        try:
            yield phonemizer
        finally:
            phonemizer.end()

    def _find_voice(self, word: str) -> Voice | None:
        """Return the voice with a name or language, or None."""
        self._listed = self._listed or _list_voices(self._espeak, None)
        return find_voice(word, self._listed)

    def _stop_phonemizer(self) -> None:
        """Wait until the last phonemizer has finished, and restore the synthesizer's voice."""
        phonemizer, self._phonemizer = self._phonemizer, None
        if phonemizer is not None:
            phonemizer.wait()
            self._espeak.SetSynthCallback(self._on_audio)
            self._espeak.SetVoiceByName(self.voice.encode())
            self._parameters.clear()

    def _set_parameters(self, settings: SpeechSettings) -> None:
        espeak = self._espeak
        volume = round(settings.volume * 100)
        wanted = {espeak.RATE: settings.rate, espeak.VOLUME: volume, espeak.PITCH: settings.pitch}
        for parameter, value in wanted.items():
            if self._parameters.get(parameter) != value:
                espeak.SetParameter(parameter, value, 0)
                self._parameters[parameter] = value

    def _on_audio(self, samples: Any, count: int, events: Any) -> int:
        """Process samples and events from the library, and return 1 to end the synthesis."""
        if self._sink is None or self._raised is not None:
            return 1
        try:
            self._pass_on(self._sink, samples, count, events)
        except BaseException as error:  # noqa: BLE001 - raised again after the library has returned
            self._raised = error
            return 1
        return 0

    def _pass_on(self, sink: SampleSink, samples: Any, count: int, events: Any) -> None:
        for event in _events_of(events):
            if event.type == _EVENT_SAMPLERATE:
                if event.id_number != self._rate:
                    self._rate = event.id_number
                    sink.begin(self._rate, self.voice)
            elif event.type == self._espeak.EVENT_WORD:
                position = _word_position(event, self._text)
                if position is not None:
                    sink.word(*position, event.sample / self._rate)
        if samples and count > 0:
            sink.write(ctypes.string_at(samples, count * SAMPLE_BYTES))


class EspeakPhonemizer:
    """A `phonemes.Phonemizer` that uses libespeak-ng without any sound.

    Args:
        espeak: The binding of the library.
        voice: The id of the library's current voice.
    """

    def __init__(self, espeak: Any, voice: str) -> None:
        import threading

        self._espeak = espeak
        self._voice = voice
        #: held during each call of the library
        self._busy = threading.Lock()
        self._ended = False
        self._text = ""
        self._positions: list[tuple[int, int]] = []
        self._clause_ends: list[int] = []
        self._to_phonemes = espeak.dll.espeak_TextToPhonemes
        self._to_phonemes.restype = ctypes.c_char_p
        espeak.SetSynthCallback(self._on_audio)

    def clauses(self, text: str) -> list[tuple[str, str]]:
        # All clauses are read at once, because any other call would discard the text that the library has read ahead.
        raw = ctypes.create_string_buffer(guard.guarded(text, self._voice).encode("utf-8", "replace"))
        base = ctypes.addressof(raw)
        at = ctypes.c_void_p(base)
        found: list[tuple[str, str]] = []
        begin = begin_character = 0
        while at.value:
            ipa = self._call(self._to_phonemes, ctypes.byref(at), self._espeak.CHARS_UTF8, _IPA) or b""
            end = len(raw) - 1 if at.value is None else at.value - base
            clause = raw.raw[begin:end].decode("utf-8", "replace")
            if at.value and clause and not clause[-1].isspace():  # this is the first character of the next clause
                end -= len(clause[-1].encode())
                clause = clause[:-1]
            end_character = begin_character + len(clause)
            found.append((text[begin_character:end_character], ipa.decode("utf-8", "replace")))
            begin, begin_character = end, end_character
        return found

    def word_positions(self, clause: str) -> list[tuple[int, int]]:
        """Return the positions after speaking the clause without output, which takes 1 ms per second of sound."""
        self._speak(clause)
        return self._positions

    def ends_with_abbreviation(self, clause: str) -> bool:
        """Return whether the library makes no pause between the clause's last word and another word after it."""
        word = clause.rsplit(maxsplit=1)[-1]
        alone = self._speak(word)
        return self._speak(f"{word} A") - alone < _PAUSE_SAMPLES

    def end(self) -> None:
        """Make the current call and all later calls raise Stopped; may be called from any thread."""
        self._ended = True

    def wait(self) -> None:
        """Wait until the current call of the library returns; `end` has to be called first."""
        with self._busy:
            pass

    def _call(self, function: Any, *arguments: Any, **more: Any) -> Any:
        with self._busy:
            if self._ended:
                raise Stopped
            result = function(*arguments, **more)
        if self._ended:  # the result may be incomplete
            raise Stopped
        return result

    def _speak(self, text: str) -> int:
        """Speak a text without output, store its words, and return the end of its first clause in samples."""
        self._text, self._positions, self._clause_ends = guard.guarded(text, self._voice), [], []
        self._call(self._espeak.Synth, self._text.encode("utf-8", "replace"), flags=self._espeak.CHARS_UTF8)
        return self._clause_ends[0] if self._clause_ends else 0

    def _on_audio(self, _samples: Any, _count: int, events: Any) -> int:
        if self._ended:
            return 1  # ends the synthesis
        for event in _events_of(events):
            if event.type == self._espeak.EVENT_WORD and (position := _word_position(event, self._text)):
                self._positions.append(position)
            elif event.type == self._espeak.EVENT_END:
                self._clause_ends.append(event.sample)
        return 0


def _word_position(event: _EspeakEvent, text: str) -> tuple[int, int] | None:
    """Return the start and length of an event's word in the text, or None if there is no word."""
    start = event.text_position - 1
    length = event.length if event.length > 0 else count_letters(text, start)
    return (start, length) if length else None


def _variants(espeak: Any) -> list[Voice]:
    """Return the variants, whose ids in the library's list are files such as "!v/f3"."""
    found = [(each.id.rpartition("/")[2], each.name) for each in _list_voices(espeak, _VARIANTS)]
    return [Voice(VARIANT_PREFIX + file, None, f"variant {name}") for file, name in found]


def _mbrola_voices(espeak: Any) -> list[Voice]:
    """Return the installed MBROLA voices, which are only a part of the library's list."""
    if not on_path("mbrola"):
        return []
    return [each for each in _list_voices(espeak, _MBROLA) if _has_mbrola_data(each.id)]


def _has_mbrola_data(identifier: str) -> bool:
    """Return whether the data of an MBROLA voice is installed, which is "de4" for the id "mb/mb-de4-en"."""
    name = identifier.rpartition("/")[2].split("-")[1]
    return any(os.path.isfile(path.format(name)) for path in _MBROLA_PATHS)


def _list_voices(espeak: Any, kind: bytes | None) -> tuple[Voice, ...]:
    """Return one of the library's lists of voices, or the normal voices if `kind` is None."""
    found = []
    for each in espeak.ListVoices(None if kind is None else espeak.VOICE(languages=kind)):
        # The first byte of the languages is a priority.
        fields = (each.identifier, (each.languages or b"")[1:], each.name)
        identifier, language, name = ((field or b"").decode("utf-8", "replace") for field in fields)
        found.append(Voice(identifier, language or None, name or identifier))
    return tuple(found)
