"""`talk`'s own pyttsx3 driver for Linux: libespeak-ng, streamed to a player, with words in time and a stop that works.

It implements pyttsx3's driver interface, so everything in here is called through pyttsx3's Engine. It speaks inside
`iterate()`; the library calls back in the same thread, and that callback waits for the player. It must not let an
exception out: pyttsx3 would lose the sentence without a word.

More than pyttsx3 asks for: the property "pitch" (0 to 100), `time` in started-word and `duration` in
finished-utterance, in seconds of audio.
"""

from __future__ import annotations

import ctypes
import sys
import time
import types

from talkcli.engine.clock import TimedWord
from talkcli.engine.playback import Playback
from talkcli.engine.players.base import SAMPLE, AudioFailed, Stopped
from talkcli.engine.synthesizers import guard
from talkcli.engine.synthesizers.words import letters

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from talkcli.engine.pause import Pause
    from talkcli.engine.players.base import Wait
    from talkcli.engine.players.which import Players
    from talkcli.engine.synthesizers.library import Library

#: Its name among pyttsx3's drivers.
DRIVER = "talk_espeak"

#: English: by its file, which saves the 4 to 40 ms in which the library reads all voices to find it by its language.
DEFAULT_VOICE = "gmw/en"
_DEFAULT_LANGUAGE = "en"

#: An event that pyttsx3's binding does not name: the sample rate, before the first samples.
_EVENT_SAMPLERATE = 8

#: Seconds between two steps of pyttsx3's own loop, which `talk` does not use.
_LOOP_STEP = 0.05


class UnknownVoice(Exception):
    """The library has no such voice."""


def register(library: Library, players: Players, wait: Wait, pause: Pause) -> None:
    """Put the driver among pyttsx3's own, so that `pyttsx3.init(DRIVER)` finds it."""
    module: Any = types.ModuleType(f"pyttsx3.drivers.{DRIVER}")
    module.buildDriver = lambda proxy: EspeakDriver(proxy, library, players, wait, pause)
    sys.modules[module.__name__] = module


class EspeakDriver:
    """The driver; its methods are those that pyttsx3's DriverProxy calls."""

    def __init__(
        self,
        proxy: Any,
        library: Library,
        players: Players,
        wait: Wait,
        pause: Pause,
    ) -> None:
        self._proxy = proxy
        self._espeak = library.espeak
        self._rate = library.rate
        self._players = players
        self._wait = wait
        self._pause = pause
        self._text: str | None = None
        self._spoken = ""
        self._playback: Playback | None = None
        self._caught: BaseException | None = None
        self._looping = False
        self._voice = DEFAULT_VOICE
        if self._espeak.SetVoiceByName(DEFAULT_VOICE.encode()) != self._espeak.EE_OK:
            self.setProperty("voice", _DEFAULT_LANGUAGE)
        self._espeak.SetSynthCallback(self._on_audio)

    def destroy(self) -> None:
        """Be silent; called when the proxy goes away."""
        self.stop()

    def startLoop(self) -> None:  # noqa: N802 - pyttsx3's name
        """Run pyttsx3's own loop until `endLoop`."""
        self._looping = True
        for _ in self.iterate():
            if not self._looping:
                return
            self._wait((), time.monotonic() + _LOOP_STEP)

    def endLoop(self) -> None:  # noqa: N802 - pyttsx3's name
        """End pyttsx3's own loop."""
        self._looping = False

    def iterate(self) -> Iterator[None]:
        """Speak what was said since the last step, to its end."""
        while True:
            if self._text is None:
                self._proxy.setBusy(False)  # pyttsx3 starts busy; this hands over what waits, by a call of `say`
            if self._text is None:
                yield
                continue
            text, self._text = self._text, None
            self._speak(text)

    def say(self, text: str) -> None:
        """Take a sentence; the next step of `iterate` speaks it."""
        self._proxy.setBusy(True)
        self._text = text

    def stop(self) -> None:
        """Be silent now."""
        self._text = None
        if self._playback is not None:
            self._playback.stop()

    def getProperty(self, name: str) -> Any:  # noqa: N802 - pyttsx3's name
        """Return a property; KeyError if it is unknown."""
        espeak = self._espeak
        if name == "voices":
            return [_voice(each) for each in espeak.ListVoices(None)]
        if name == "voice":
            return self._voice
        if name == "volume":
            return espeak.GetParameter(espeak.VOLUME) / 100
        return espeak.GetParameter({"rate": espeak.RATE, "pitch": espeak.PITCH}[name])

    def setProperty(self, name: str, value: Any) -> None:  # noqa: N802 - pyttsx3's name
        """Set a property; KeyError if it is unknown, UnknownVoice."""
        espeak = self._espeak
        if name == "voice":
            self._set_voice(str(value))
        elif name == "volume":
            espeak.SetParameter(espeak.VOLUME, round(value * 100), 0)
        else:
            espeak.SetParameter({"rate": espeak.RATE, "pitch": espeak.PITCH}[name], int(value), 0)

    def _set_voice(self, voice: str) -> None:
        if not voice or self._espeak.SetVoiceByName(voice.encode("utf-8", "replace")) != self._espeak.EE_OK:
            # A voice that failed half-way (its speech files are missing) is current now, and speaks nothing.
            self._espeak.SetVoiceByName(self._voice.encode())
            raise UnknownVoice(voice)
        self._voice = voice

    def _speak(self, text: str) -> None:
        """Speak the text, with exactly one finished-utterance at its end."""
        self._proxy.notify("started-utterance")
        self._playback = playback = Playback(self._players, self._wait, self._pause, self._word_heard)
        playback.begin(self._rate)
        failure: Exception | None = None
        duration = None
        try:
            playback.prepare()
            self._synthesise(text)
            duration = playback.finish()
        except Stopped:
            pass
        except Exception as error:  # noqa: BLE001 - whatever it is, pyttsx3 would swallow it: it is told instead
            failure = error
        playback.silence()
        self._playback = None
        if failure is not None:
            self._proxy.notify("error", exception=failure)
        self._proxy.notify("finished-utterance", completed=duration is not None, duration=duration)

    def _synthesise(self, text: str) -> None:
        espeak = self._espeak
        self._caught = None
        self._spoken = guard.guarded(text, self._voice)
        encoded = self._spoken.encode("utf-8", "replace")
        status = espeak.Synth(encoded, flags=espeak.CHARS_UTF8 | espeak.ENDPAUSE)
        caught, self._caught = self._caught, None
        if caught is not None:
            raise caught
        if status != espeak.EE_OK:
            raise AudioFailed("engine_failed", f"espeak_Synth failed with {status}")

    def _on_audio(self, samples: Any, count: int, events: Any) -> int:
        """Take what the library made; 1 ends the synthesis. An exception cannot pass through the library."""
        try:
            self._take(samples, count, events)
        except BaseException as error:  # noqa: BLE001 - raised again after the library has returned
            self._caught = error
            return 1
        return 0

    def _take(self, samples: Any, count: int, events: Any) -> None:
        playback = self._playback
        if playback is None:
            raise Stopped
        for event in _until_end(events):
            if event.type == _EVENT_SAMPLERATE:
                self._rate = event.id.number
                playback.begin(self._rate)
            elif event.type == self._espeak.EVENT_WORD:
                location = event.text_position - 1
                length = event.length if event.length > 0 else letters(self._spoken, location)
                if length:
                    playback.add_word(TimedWord(location, length, event.sample / self._rate))
        if samples and count > 0:
            playback.write(ctypes.string_at(samples, count * SAMPLE))

    def _word_heard(self, word: TimedWord) -> None:
        self._proxy.notify("started-word", location=word.location, length=word.length, time=word.position)


def _until_end(events: Any) -> Iterator[Any]:
    index = 0
    while events[index].type:
        yield events[index]
        index += 1


def _voice(found: Any) -> Any:
    """Return one of the library's voices in pyttsx3's form."""
    from pyttsx3.voice import Voice

    # The first byte of the languages is a priority.
    language = (found.languages or b"")[1:].decode("utf-8", "replace")
    identifier = (found.identifier or b"").decode("utf-8", "replace")
    return Voice(identifier, (found.name or b"").decode("utf-8", "replace"), [language] if language else [])
