"""A synthesizer that uses libespeak-ng, which also provides the phonemes for neural voices.

The library speaks a whole text in one call. During this call, it passes about 50 ms of samples at a time to a callback
in the same thread. An exception can't pass through the library, so it is stored until the call returns. A process has
only one instance of the library. This module is for Linux. Other systems use pyttsx3's drivers.
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

#: How many milliseconds of sound each callback receives. The library rounds this up to 49 ms at 22,050 Hz. A higher
#: value would delay the first sound.
_CALLBACK_MS = 20

#: A flag that stops the library from calling exit() if its data is missing.
_DONT_EXIT = 0x8000

#: Two names of the English voice. The first is a file name, with which the library finds the voice without reading all
#: others. This saves 4 to 40 ms.
_ENGLISH = ("gmw/en", "en")

#: A flag with which `[[` and `]]` enclose phonemes. pyttsx3's binding doesn't define it.
_PHONEMES = 0x100

#: The type of the event that reports the sample rate. pyttsx3's binding doesn't define it.
_EVENT_SAMPLERATE = 8

#: The library's default rate in words per minute.
_ESPEAK_DEFAULT_WPM = 175
#: The minimum pause after a sentence. If the pause after a dot is shorter, the dot belongs to an abbreviation. The
#: library pauses for 6,000 samples after a sentence, but for at most 100 after an abbreviation such as "Mr.".
_PAUSE_SAMPLES = 2000

#: The mode in which the library returns phonemes in IPA.
_IPA = 2

#: If the library is asked for these languages, it lists its variants or the MBROLA voices.
_VARIANTS, _MBROLA = b"variant", b"mbrola"
#: Paths of the data of an MBROLA voice. The library also needs the program mbrola to use such a voice.
_MBROLA_PATHS = ("/usr/share/mbrola/{0}", "/usr/share/mbrola/{0}/{0}", "/usr/share/mbrola/voices/{0}")


class _EspeakEvent(ctypes.Structure):
    """The C structure `espeak_EVENT` of speak_lib.h.

    pyttsx3's binding has this structure without `id.string`. On 32-bit systems, it is therefore 4 bytes too short to
    read the second event of a callback.
    """

    _fields_ = (
        ("type", ctypes.c_int),
        ("unique_identifier", ctypes.c_uint),
        ("text_position", ctypes.c_int),
        ("length", ctypes.c_int),
        ("audio_position", ctypes.c_int),
        ("sample", ctypes.c_int),
        ("user_data", ctypes.c_void_p),
        # These two fields are the union `id`, which always has 8 bytes.
        ("id_number", ctypes.c_int),
        ("id_padding", ctypes.c_int),
    )


def _events_of(pointer: Any) -> Iterator[_EspeakEvent]:
    """Yield the events passed to a callback. An event of type 0 marks the end."""
    return itertools.takewhile(lambda each: each.type, iter(ctypes.cast(pointer, ctypes.POINTER(_EspeakEvent))))


def load_library() -> tuple[Any, str, int]:
    """Initialize libespeak-ng. Return pyttsx3's binding, the library's version and the sample rate.

    The library of the system is preferred. If it is missing, the library from the package espeakng-loader is used. Call
    this once per process, before anything imports `pyttsx3.drivers._espeak`, which also loads the library.

    Returns:
        pyttsx3's binding, the name and version of the library to show to users ("eSpeak NG 1.51 (system)"), and the
        number of samples per second, which a voice may change.

    Raises:
        NotInstalled: The library or its data is missing.
        OSError: There is not enough memory, or too many files are open. A later attempt may succeed.
    """
    origin, data = _preload_library()
    from pyttsx3.drivers import _espeak

    # The library connects to PulseAudio although it won't play anything. This takes 7 ms, or 30 s if PulseAudio hangs.
    # The server wouldn't wait that long, so the connection is prevented with a false address.
    sound_server = os.environ.get("PULSE_SERVER")
    os.environ["PULSE_SERVER"] = "unix:/dev/null"
    rate = _espeak.Initialize(_espeak.AUDIO_OUTPUT_SYNCHRONOUS, _CALLBACK_MS, data, _DONT_EXIT)
    del os.environ["PULSE_SERVER"]
    if sound_server is not None:
        os.environ["PULSE_SERVER"] = sound_server
    if rate <= 0:
        step = "install it with: sudo apt-get install -y libespeak-ng1 espeak-ng-data"
        raise NotInstalled(f"espeak-ng data is missing; {step}")
    version = (_espeak.Info(None) or b"").decode("utf-8", "replace").split(" ")[0]
    return _espeak, f"eSpeak NG {version} ({origin})", rate


def _preload_library() -> tuple[str, bytes | None]:
    """Load libespeak-ng. Return its origin ("system" or "espeakng-loader") and its data directory."""
    try:
        ctypes.CDLL(_LIBESPEAK)
        return "system", None
    except OSError as error:
        if _is_temporary(error):
            raise
        missing = error
    try:
        import espeakng_loader

        # pyttsx3's binding looks for the system's library by name, and finds this one because it is loaded globally.
        ctypes.CDLL(espeakng_loader.get_library_path(), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError) as error:
        if _is_temporary(error):
            raise
        step = f"install it with: {install.espeak_command()}"
        raise NotInstalled(f"libespeak-ng is missing ({missing}); {step}") from error
    return "espeakng-loader", str(espeakng_loader.get_data_path()).encode()


def _is_temporary(error: Exception) -> bool:
    """Return whether an error was caused by a lack of memory or by too many open files."""
    return str(error).endswith(tuple(map(os.strerror, (errno.EMFILE, errno.ENFILE, errno.ENOMEM))))


class Espeak:
    """A synthesizer that uses libespeak-ng."""

    version: str | None

    def __init__(self) -> None:
        """Load the library and its English voice.

        Raises:
            NotInstalled, OSError: See `load_library`.
            UnknownVoice: The library has no English voice.
        """
        self._espeak, self.version, self._rate = load_library()
        espeak = self._espeak
        self._listed: tuple[Voice, ...] = ()
        #: the parameters last passed to the library. Setting a parameter can change the sound even if its value stays
        #: the same, so only changed parameters are passed.
        self._parameters = {espeak.RATE: _ESPEAK_DEFAULT_WPM, espeak.VOLUME: 100, espeak.PITCH: 50}
        #: the last phonemizer, which may still be using the library, or None if it has been stopped
        self._phonemizer: EspeakPhonemizer | None = None
        found = (each for each in _ENGLISH if espeak.SetVoiceByName(each.encode()) == espeak.EE_OK)
        self.voice = next(found, "")
        if not self.voice:
            raise UnknownVoice(_ENGLISH[-1])

    def voices(self) -> tuple[Voice, ...]:
        """Return the normal voices, the installed MBROLA voices, and the variants."""
        self._finish_phonemizer()
        return (*_list_voices(self._espeak, None), *_list_mbrola_voices(self._espeak), *_list_variants(self._espeak))

    def choose_voice(self, voice: str) -> None:
        """Choose a voice by its id or by another name known to the library.

        Raises:
            UnknownVoice: One of the voice's files is missing. The library keeps the previous voice.
        """
        self._finish_phonemizer()
        # Forget the rate, so that the next text sets it again. Otherwise, some voices would slow down the next voice by
        # up to a third.
        self._parameters.clear()
        if not voice or self._espeak.SetVoiceByName(voice.encode("utf-8", "replace")) != self._espeak.EE_OK:
            # The library has switched to the new voice even though it reports an error. Switch back, because a voice
            # with a missing file is silent.
            self._espeak.SetVoiceByName(self.voice.encode())
            raise UnknownVoice("one of its files is missing")
        self.voice = voice

    def speak(self, text: str, settings: SpeechSettings, sink: SampleSink, fallback_reason: str | None = None) -> None:
        """Synthesize a sentence, and pass its samples and words to the sink.

        The samples vary slightly from call to call. If another voice was requested, `fallback_reason` is a message
        saying why it is not used.
        """
        self._finish_phonemizer()
        sink.begin(self._rate, self.voice, fallback_reason)
        espeak = self._espeak
        self._set_parameters(settings)
        text = guard.guarded(text, self.voice)
        errors: list[BaseException] = []

        def on_audio(samples: Any, count: int, events: Any) -> int:
            """Pass samples and events to the sink.

            Return 0 to continue the synthesis, or 1 to stop it.
            """
            if errors:
                return 1
            try:
                for event in _events_of(events):
                    if event.type == _EVENT_SAMPLERATE and event.id_number != self._rate:
                        self._rate = event.id_number
                        sink.begin(self._rate, self.voice, fallback_reason)
                    elif event.type == espeak.EVENT_WORD and (position := _word_position(event, text)):
                        sink.word(*position, event.sample / self._rate)
                if samples and count > 0:
                    sink.write(ctypes.string_at(samples, count * SAMPLE_BYTES))
            except BaseException as error:  # noqa: BLE001 - raised again below
                errors.append(error)
            return len(errors)

        espeak.SetSynthCallback(on_audio)
        flags = espeak.CHARS_UTF8 | espeak.ENDPAUSE | (_PHONEMES if settings.phonemes else 0)
        status = espeak.Synth(text.encode("utf-8", "replace"), flags=flags)
        if errors:
            raise errors.pop()
        if status != espeak.EE_OK:
            raise CannotSpeak(Reason.ENGINE_FAILED, f"espeak_Synth failed with {status}")

    def choose_language(self, language: str) -> None:
        """Choose the best voice for a language code such as "de-at", or English if there is none."""
        self._finish_phonemizer()
        found = (self._find_voice(each) for each in (language, language.partition("-")[0], *_ENGLISH))
        self.choose_voice(next((each.id for each in found if each), self.voice))

    @contextlib.contextmanager
    def phonemizer(self, language: str, *, has_phonemes: bool = False) -> Iterator[EspeakPhonemizer]:
        """Provide a phonemizer for a language in a `with` block.

        With `has_phonemes`, the marks `[[` and `]]` in a text enclose phonemes.

        Another thread may use the phonemizer during the block, but nothing may use the synthesizer. After the block,
        calls of the phonemizer raise Stopped. If a call is still running at the end of the block, it continues for a
        few milliseconds, or for up to 130 ms in `clauses`. The block doesn't wait for this call, but the next use of
        the synthesizer does.

        Raises:
            UnknownVoice: The library has no voice of this language.
        """
        self._finish_phonemizer()
        voice = self._find_voice(language)
        voice_id = voice.id if voice is not None else ""
        self._phonemizer = phonemizer = EspeakPhonemizer(self._espeak, voice_id, has_phonemes=has_phonemes)
        if not voice_id or self._espeak.SetVoiceByName(voice_id.encode()) != self._espeak.EE_OK:
            raise UnknownVoice(f'{self.version} has no voice "{language}", which this voice needs for its phonemes')
        self._espeak.SetParameter(self._espeak.RATE, _ESPEAK_DEFAULT_WPM, 0)
        try:
            yield phonemizer
        finally:
            phonemizer.end()

    def _find_voice(self, name: str) -> Voice | None:
        """Return the library's voice with this name or language, or None if there is none."""
        self._listed = self._listed or _list_voices(self._espeak, None)
        return find_voice(name, self._listed)

    def _finish_phonemizer(self) -> None:
        """Wait until the last phonemizer has finished its call, and restore the synthesizer's voice."""
        phonemizer, self._phonemizer = self._phonemizer, None
        if phonemizer is not None:
            with phonemizer.busy:  # The phonemizer's last call may still be running.
                self._espeak.SetVoiceByName(self.voice.encode())
            self._parameters.clear()

    def _set_parameters(self, settings: SpeechSettings) -> None:
        """Pass the rate, volume and pitch to the library if they have changed."""
        espeak = self._espeak
        volume = round(settings.volume * 100)
        wanted = {espeak.RATE: settings.rate, espeak.VOLUME: volume, espeak.PITCH: settings.pitch}
        for parameter, value in wanted.items():
            if self._parameters.get(parameter) != value:
                espeak.SetParameter(parameter, value, 0)
                self._parameters[parameter] = value


class EspeakPhonemizer:
    """Converts text to phonemes with libespeak-ng.

    Args:
        espeak: pyttsx3's binding of the library.
        voice: The id of the library's current voice.
        has_phonemes: Whether `[[` and `]]` in a text enclose phonemes.
    """

    def __init__(self, espeak: Any, voice: str, *, has_phonemes: bool = False) -> None:
        import threading

        self._espeak = espeak
        self._voice = voice
        self._flags = espeak.CHARS_UTF8 | (_PHONEMES if has_phonemes else 0)
        #: a lock that is held during each call to the library
        self.busy = threading.Lock()
        self._ended = False
        self._to_phonemes = espeak.dll.espeak_TextToPhonemes
        self._to_phonemes.restype = ctypes.c_char_p

    def clauses(self, text: str) -> list[tuple[str, str]]:
        """Split a text into clauses. Return pairs of a clause's text and its phonemes in IPA."""
        # The next calls treat phonemes in the same way as the last call of `Synth`, so speak a blank with the right
        # flags.
        self._speak_silently(" ")
        # The library reads ahead, and any other call would discard the text that it has read. Get all clauses first.
        raw = ctypes.create_string_buffer(guard.guarded(text, self._voice).encode("utf-8", "replace"))
        base = ctypes.addressof(raw)
        at = ctypes.c_void_p(base)
        found: list[tuple[str, str]] = []
        begin = begin_character = 0
        while at.value:
            with self._library_call():
                ipa = self._to_phonemes(ctypes.byref(at), self._espeak.CHARS_UTF8, _IPA) or b""
            end = len(raw) - 1 if at.value is None else at.value - base
            clause = raw.raw[begin:end].decode("utf-8", "replace")
            if at.value and clause and not clause[-1].isspace():  # the last character belongs to the next clause
                end -= len(clause[-1].encode())
                clause = clause[:-1]
            end_character = begin_character + len(clause)
            found.append((text[begin_character:end_character], ipa.decode("utf-8", "replace")))
            begin, begin_character = end, end_character
        return found

    def word_positions(self, clause: str) -> list[tuple[int, int]]:
        """Return the start and the length of each word in a clause.

        The library has to speak the clause without output, which takes 1 ms per second of sound.
        """
        positions, _ = self._speak_silently(clause)
        return positions

    def ends_with_abbreviation(self, clause: str) -> bool:
        """Return whether a clause ends with an abbreviation such as "Mr."."""
        word = clause.rsplit(maxsplit=1)[-1]
        _, alone = self._speak_silently(word)
        _, with_pause = self._speak_silently(f"{word} A")
        return with_pause - alone < _PAUSE_SAMPLES

    def end(self) -> None:
        """Stop the phonemizer. The current call and all later ones raise Stopped.

        Any thread may call this.
        """
        self._ended = True

    @contextlib.contextmanager
    def _library_call(self) -> Iterator[None]:
        """Hold the library's lock during a `with` block. Raise Stopped if `end` was called.

        Raises:
            Stopped: `end` was called before or during the block. The result of the call may be incomplete.
        """
        with self.busy:
            if self._ended:
                raise Stopped
            yield
        if self._ended:
            raise Stopped

    def _speak_silently(self, text: str) -> tuple[list[tuple[int, int]], int]:
        """Synthesize a text silently. Return its word positions and the number of samples in its first clause."""
        text = guard.guarded(text, self._voice)
        positions: list[tuple[int, int]] = []
        clause_ends: list[int] = []

        def on_audio(_samples: Any, _count: int, events: Any) -> int:
            for event in _events_of(events):
                if event.type == self._espeak.EVENT_WORD and (position := _word_position(event, text)):
                    positions.append(position)
                elif event.type == self._espeak.EVENT_END:
                    clause_ends.append(event.sample)
            return int(self._ended)  # returning 1 stops the synthesis

        with self._library_call():
            self._espeak.SetSynthCallback(on_audio)
            self._espeak.Synth(text.encode("utf-8", "replace"), flags=self._flags)
        return positions, next(iter(clause_ends), 0)


def _word_position(event: _EspeakEvent, text: str) -> tuple[int, int] | None:
    """Return the start and length of the word in an event, if any."""
    start = event.text_position - 1
    length = event.length if event.length > 0 else count_letters(text, start)
    return (start, length) if length else None


def _list_variants(espeak: Any) -> list[Voice]:
    """Return all voice variants of the library."""
    found = [(each.id.rpartition("/")[2], each.name) for each in _list_voices(espeak, _VARIANTS)]
    return [Voice(VARIANT_PREFIX + file, None, f"variant {name}") for file, name in found]


def _list_mbrola_voices(espeak: Any) -> list[Voice]:
    """Return the library's MBROLA voices that are installed."""
    if not on_path("mbrola"):
        return []
    return [each for each in _list_voices(espeak, _MBROLA) if _has_mbrola_data(each.id)]


def _has_mbrola_data(identifier: str) -> bool:
    """Return whether the data of an MBROLA voice is installed.

    For the id "mb/mb-de4-en", the data is called "de4".
    """
    name = identifier.rpartition("/")[2].split("-")[1]
    return any(os.path.isfile(path.format(name)) for path in _MBROLA_PATHS)


def _list_voices(espeak: Any, kind: bytes | None) -> tuple[Voice, ...]:
    """Return the library's voices of one kind. None selects the normal voices."""
    found = []
    for each in espeak.ListVoices(None if kind is None else espeak.VOICE(languages=kind)):
        # The first byte of `languages` is a priority, not a part of the language.
        fields = (each.identifier, (each.languages or b"")[1:], each.name)
        identifier, language, name = ((field or b"").decode("utf-8", "replace") for field in fields)
        found.append(Voice(identifier, language or None, name or identifier))
    return tuple(found)
