"""Libespeak-ng behind the interface of a synthesizer: loaded, its voices, its words, and the guard before it.

The library speaks in one call and calls back in the same thread, with some 50 ms of samples each time; an exception
cannot pass through it, so it is kept until the library has returned. There is one of it in a process. Linux only;
elsewhere pyttsx3's own drivers find their libraries themselves.
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
from talkcli.engine.voices import VARIANT, UnknownVoice, find_voice
from talkcli.goals.reasons import Reason

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from talkcli.engine.child.synthesizers.base import SampleSink, SpeechSettings

_LIBRARY = "libespeak-ng.so.1"

#: Milliseconds of sound that the library hands over at once. It rounds up to 49 at 22,050 Hz; more would only delay
#: the first sound.
_BUFFER_MS = 20

#: Without this option the library calls exit() where its data is missing.
_DONT_EXIT = 0x8000

#: English: by its file, which saves the 4 to 40 ms in which the library reads all voices to find it by its language.
_DEFAULTS = ("gmw/en", "en")

#: An event that pyttsx3's binding does not name: the sample rate, before the first samples.
_EVENT_SAMPLERATE = 8

#: Words per minute that the library sets itself.
_USUAL = 175
#: Samples of a pause behind a clause that are none: behind "Mr." it makes a hundred at most, behind a sentence 6,000.
_NO_PAUSE = 2000

#: How sounds are to be written: in IPA.
_IPA = 2

#: Two of the lists that libespeak-ng gives only when asked by these names, in the place of a language.
_VARIANTS, _MBROLA = b"variant", b"mbrola"
#: Where it looks for the sounds of a voice of MBROLA's, which it can speak only if these and the program are there.
_MBROLA_PLACES = ("/usr/share/mbrola/{0}", "/usr/share/mbrola/{0}/{0}", "/usr/share/mbrola/voices/{0}")


class _EspeakEventId(ctypes.Union):
    """The id of an event, which takes 8 bytes even if a pointer has 4."""

    _fields_ = (("number", ctypes.c_int), ("name", ctypes.c_char_p), ("string", ctypes.c_char * 8))


class _EspeakEvent(ctypes.Structure):
    """An `espeak_EVENT` of speak_lib.h.

    The structure in pyttsx3's binding has no `id.string`. On a 32-bit system it is therefore 4 bytes too short, and
    the second of two events cannot be read.
    """

    _fields_ = (
        ("type", ctypes.c_int),
        ("unique_identifier", ctypes.c_uint),
        ("text_position", ctypes.c_int),
        ("length", ctypes.c_int),
        ("audio_position", ctypes.c_int),
        ("sample", ctypes.c_int),
        ("user_data", ctypes.c_void_p),
        ("id", _EspeakEventId),
    )


def _until_terminator(events: Any) -> Iterator[_EspeakEvent]:
    """Return the events of one callback; an event of type 0 follows the last one."""
    return itertools.takewhile(lambda each: each.type, iter(ctypes.cast(events, ctypes.POINTER(_EspeakEvent))))


def load() -> tuple[Any, str, int]:
    """Load the system's library where there is one, else the wheel's, and initialise it, once a process.

    Return pyttsx3's binding of it, what it is for people, "eSpeak NG 1.51 (system)", and its samples per second until a
    voice says otherwise. NotInstalled; OSError where it may be loaded later. It must run before anything imports
    `pyttsx3.drivers._espeak`, which loads the library when it is imported.
    """
    origin, data = _preload()
    from pyttsx3.drivers import _espeak

    with _no_sound_server():
        rate = _espeak.Initialize(_espeak.AUDIO_OUTPUT_SYNCHRONOUS, _BUFFER_MS, data, _DONT_EXIT)
    if rate <= 0:
        raise NotInstalled("there is no espeak-ng data: sudo apt-get install -y libespeak-ng1 espeak-ng-data")
    version = (_espeak.Info(None) or b"").decode("utf-8", "replace").split(" ")[0]
    return _espeak, f"eSpeak NG {version} ({origin})", rate


@contextlib.contextmanager
def _no_sound_server() -> Iterator[None]:
    """Let no PulseAudio be found meanwhile.

    The library connects to one whenever it is initialised, though it is never to play: 7 ms where one answers, and 30 s
    where one hangs, in which the engine would be given up.
    """
    before = os.environ.get("PULSE_SERVER")
    os.environ["PULSE_SERVER"] = "unix:/dev/null"
    try:
        yield
    finally:
        del os.environ["PULSE_SERVER"]
        if before is not None:
            os.environ["PULSE_SERVER"] = before


def _preload() -> tuple[str, bytes | None]:
    """Have the library in the process, so that the binding finds it; return its origin and its data's directory."""
    try:
        ctypes.CDLL(_LIBRARY)
        return "system", None
    except OSError as error:
        if _passes(error):
            raise
        missing = error
    try:
        import espeakng_loader

        # Global, as the binding asks for the name that the system's library would have, and gets the one that is there.
        ctypes.CDLL(espeakng_loader.get_library_path(), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError) as error:
        if _passes(error):
            raise
        raise NotInstalled(f"libespeak-ng is missing ({missing}): {install.espeak_library()}") from error
    return "espeakng-loader", str(espeakng_loader.get_data_path()).encode()


def _passes(error: Exception) -> bool:
    """Tell whether a library that is there could not be loaded for want of memory or descriptors.

    The loader has but words for it, which end in the system's.
    """
    return str(error).endswith(tuple(map(os.strerror, (errno.EMFILE, errno.ENFILE, errno.ENOMEM))))


class Espeak:
    """The library as a synthesizer."""

    version: str | None

    def __init__(self) -> None:
        """Load the library, as `load`; UnknownVoice if it has no English."""
        self._espeak, self.version, self._rate = load()
        espeak = self._espeak
        self._listed: tuple[Voice, ...] = ()
        #: what its parameters were last set to; they are left alone where they need not be set, so that the first
        #: sentence of a fresh process is what the library alone would make
        self._set = {espeak.RATE: _USUAL, espeak.VOLUME: 100, espeak.PITCH: 50}
        self._text = ""
        self._output: SampleSink | None = None
        self._raised: BaseException | None = None
        #: to whom the library was lent last, who may still be at work with it; None where it was taken back
        self._lent: Spelling | None = None
        found = (each for each in _DEFAULTS if espeak.SetVoiceByName(each.encode()) == espeak.EE_OK)
        self.voice = next(found, "")
        if not self.voice:
            raise UnknownVoice(_DEFAULTS[-1])
        espeak.SetSynthCallback(self._on_audio)

    def voices(self) -> tuple[Voice, ...]:
        """Return the library's voices, those of MBROLA's that can be spoken with, and the variants."""
        self._take_back()
        espeak = self._espeak
        return (*_listed(espeak, None), *_mbrola_voices(espeak), *_variants(espeak))

    def load(self, voice: str) -> None:
        """Take an id of `voices`, with a variant behind it or without, or what else the library takes for a voice."""
        self._take_back()
        # Some voices leave their own speed to the next one, up to a third slower, unless the rate is set after it.
        self._set.clear()
        if not voice or self._espeak.SetVoiceByName(voice.encode("utf-8", "replace")) != self._espeak.EE_OK:
            # A voice that failed half-way (its speech files are missing) is current now, and speaks nothing.
            self._espeak.SetVoiceByName(self.voice.encode())
            raise UnknownVoice("part of it is missing")
        self.voice = voice

    def speak(self, text: str, sound: SpeechSettings, output: SampleSink) -> None:
        """Speak as `Synthesizer` says; with this library the samples differ a little each time."""
        self._take_back()
        output.begin(self._rate, self.voice)
        espeak = self._espeak
        self._obey(sound)
        self._text = guard.guarded(text, self.voice)
        self._output = output
        status = espeak.Synth(self._text.encode("utf-8", "replace"), flags=espeak.CHARS_UTF8 | espeak.ENDPAUSE)
        raised, self._raised, self._output = self._raised, None, None
        if raised is not None:
            raise raised
        if status != espeak.EE_OK:
            raise CannotSpeak(Reason.ENGINE_FAILED, f"espeak_Synth failed with {status}")

    def load_language(self, language: str) -> None:
        """Take a voice of this language, "de-at", or else of its first part, or else English."""
        self._take_back()
        self._listed = self._listed or _listed(self._espeak, None)
        words = (language, language.partition("-")[0], *_DEFAULTS)
        found = (find_voice(each, self._listed) for each in words)
        self.load(next((each.id for each in found if each), self.voice))

    @contextlib.contextmanager
    def spelling(self, language: str) -> Iterator[Spelling]:
        """Lend the library, for what it knows of the sounds of a language, by one of its voices; UnknownVoice.

        Until the end of the `with` it speaks nothing else. It may be asked in another thread, in one at a time; what it
        is asked there at the end, or later, ends with Stopped. The end waits for nothing: what the library does then
        for that thread ends within milliseconds where it speaks, and in up to 130 where it is asked for sounds, and
        whatever uses the library next waits for it.
        """
        self._take_back()
        self._listed = self._listed or _listed(self._espeak, None)
        voice = find_voice(language, self._listed)
        if voice is None:
            raise self._knows_none(language)
        self._lent = speller = Spelling(self._espeak, voice.id)
        try:
            if self._espeak.SetVoiceByName(voice.id.encode()) != self._espeak.EE_OK:
                raise self._knows_none(language)
            self._espeak.SetParameter(self._espeak.RATE, _USUAL, 0)
            yield speller
        finally:
            speller.end()

    def _knows_none(self, language: str) -> UnknownVoice:
        return UnknownVoice(f'{self.version} has no voice "{language}", which knows its sounds')

    def _take_back(self) -> None:
        """Have the library as it was before it was lent."""
        lent, self._lent = self._lent, None
        if lent is not None:
            lent.wait()
            self._espeak.SetSynthCallback(self._on_audio)
            self._espeak.SetVoiceByName(self.voice.encode())
            self._set.clear()

    def _obey(self, sound: SpeechSettings) -> None:
        espeak = self._espeak
        wanted = {espeak.RATE: sound.rate, espeak.VOLUME: round(sound.volume * 100), espeak.PITCH: sound.pitch}
        for parameter, value in wanted.items():
            if self._set.get(parameter) != value:
                espeak.SetParameter(parameter, value, 0)
                self._set[parameter] = value

    def _on_audio(self, samples: Any, count: int, events: Any) -> int:
        """Hand on what the library made; 1 ends the synthesis."""
        if self._output is None or self._raised is not None:
            return 1
        try:
            self._hand_on(self._output, samples, count, events)
        except BaseException as error:  # noqa: BLE001 - raised again after the library has returned
            self._raised = error
            return 1
        return 0

    def _hand_on(self, output: SampleSink, samples: Any, count: int, events: Any) -> None:
        for event in _until_terminator(events):
            if event.type == _EVENT_SAMPLERATE:
                if event.id.number != self._rate:
                    self._rate = event.id.number
                    output.begin(self._rate, self.voice)
            elif event.type == self._espeak.EVENT_WORD:
                word = _place(event, self._text)
                if word is not None:
                    output.word(*word, event.sample / self._rate)
        if samples and count > 0:
            output.write(ctypes.string_at(samples, count * SAMPLE_BYTES))


class Spelling:
    """The library as a `phonemes.Speller`, which makes no sound; the guard is before it here, too."""

    def __init__(self, espeak: Any, voice: str) -> None:
        """`voice`: the id of the one in force."""
        import threading

        self._espeak = espeak
        self._voice = voice
        #: held while the library is at work, and whether it is nobody's any more
        self._at_work = threading.Lock()
        self._over = False
        self._text = ""
        self._places: list[tuple[int, int]] = []
        self._ends: list[int] = []
        self._to_phonemes = espeak.dll.espeak_TextToPhonemes
        self._to_phonemes.restype = ctypes.c_char_p
        espeak.SetSynthCallback(self._on_audio)

    def clauses(self, text: str) -> list[tuple[str, str]]:
        """Return the clauses; all of them, as what it has read ahead is lost when anything else is asked for."""
        raw = ctypes.create_string_buffer(guard.guarded(text, self._voice).encode("utf-8", "replace"))
        base = ctypes.addressof(raw)
        at = ctypes.c_void_p(base)
        found: list[tuple[str, str]] = []
        begin = begin_character = 0
        while at.value:
            said = self._asked(self._to_phonemes, ctypes.byref(at), self._espeak.CHARS_UTF8, _IPA) or b""
            end = len(raw) - 1 if at.value is None else at.value - base
            clause = raw.raw[begin:end].decode("utf-8", "replace")
            if at.value and clause and not clause[-1].isspace():  # it has read the first character of the next
                end -= len(clause[-1].encode())
                clause = clause[:-1]
            end_character = begin_character + len(clause)
            found.append((text[begin_character:end_character], said.decode("utf-8", "replace")))
            begin, begin_character = end, end_character
        return found

    def places(self, clause: str) -> list[tuple[int, int]]:
        """Return where its words are, by having it spoken to nobody: 1 ms a second of sound."""
        self._speak(clause)
        return self._places

    def abbreviates(self, clause: str) -> bool:
        """Tell it by the pause that the library makes behind that word, where another one follows."""
        word = clause.rsplit(maxsplit=1)[-1]
        alone = self._speak(word)
        return self._speak(f"{word} A") - alone < _NO_PAUSE

    def end(self) -> None:
        """Have all that is asked, now or later, end with Stopped; from any thread."""
        self._over = True

    def wait(self) -> None:
        """Wait, once it was ended, until the library does nothing for it any more."""
        with self._at_work:
            pass

    def _asked(self, function: Any, *arguments: Any, **more: Any) -> Any:
        with self._at_work:
            if self._over:
                raise Stopped
            result = function(*arguments, **more)
        if self._over:  # and so it may be half of it
            raise Stopped
        return result

    def _speak(self, text: str) -> int:
        """Have a text spoken to nobody; return where the first clause of it ends, in samples, and keep its words."""
        self._text, self._places, self._ends = guard.guarded(text, self._voice), [], []
        self._asked(self._espeak.Synth, self._text.encode("utf-8", "replace"), flags=self._espeak.CHARS_UTF8)
        return self._ends[0] if self._ends else 0

    def _on_audio(self, _samples: Any, _count: int, events: Any) -> int:
        if self._over:
            return 1  # ends the synthesis
        for event in _until_terminator(events):
            if event.type == self._espeak.EVENT_WORD and (word := _place(event, self._text)):
                self._places.append(word)
            elif event.type == self._espeak.EVENT_END:
                self._ends.append(event.sample)
        return 0


def _place(event: _EspeakEvent, text: str) -> tuple[int, int] | None:
    """Return where in the text the word of an event is, and its length there; None if there is none."""
    start = event.text_position - 1
    length = event.length if event.length > 0 else count_letters(text, start)
    return (start, length) if length else None


def _variants(espeak: Any) -> list[Voice]:
    """Return the variants, whose ids are files: "!v/f3"."""
    found = [(each.id.rpartition("/")[2], each.name) for each in _listed(espeak, _VARIANTS)]
    return [Voice(VARIANT + file, None, f"variant {name}") for file, name in found]


def _mbrola_voices(espeak: Any) -> list[Voice]:
    """Return those of MBROLA's voices that are installed; libespeak-ng lists all that it knows of."""
    if not on_path("mbrola"):
        return []
    return [each for each in _listed(espeak, _MBROLA) if _has_sounds(each.id)]


def _has_sounds(identifier: str) -> bool:
    """Tell whether the sounds of "mb/mb-de4-en", which are called "de4", are there."""
    sounds = identifier.rpartition("/")[2].split("-")[1]
    return any(os.path.isfile(place.format(sounds)) for place in _MBROLA_PLACES)


def _listed(espeak: Any, kind: bytes | None) -> tuple[Voice, ...]:
    """Return what libespeak-ng lists under a name; its voices under none."""
    found = []
    for each in espeak.ListVoices(None if kind is None else espeak.VOICE(languages=kind)):
        # The first byte of the languages is a priority.
        fields = (each.identifier, (each.languages or b"")[1:], each.name)
        identifier, language, name = ((field or b"").decode("utf-8", "replace") for field in fields)
        found.append(Voice(identifier, language or None, name or identifier))
    return tuple(found)
