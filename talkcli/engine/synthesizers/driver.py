"""pyttsx3's driver in front of a synthesizer of ours: what it speaks is played, stopped, held, and told word by word.

It implements pyttsx3's driver interface, so everything in here is called through pyttsx3's Engine. It speaks inside
`iterate()`; the synthesizer writes to the playback in the same thread, and that waits for the player. It must not let
an exception out: pyttsx3 would lose the sentence without a word.

Its notifications are pyttsx3's, keyword for keyword; what else there is to be told stands in `Times`. More than pyttsx3
asks for: the property "pitch" (0 to 100).
"""

from __future__ import annotations

import sys
import time
import types

from talkcli.engine.playback import Playback
from talkcli.engine.players.base import Stopped
from talkcli.engine.synthesizers.base import Sound
from talkcli.frozen import fields, replace

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from talkcli.engine.playback import Pause
    from talkcli.engine.players.base import Wait
    from talkcli.engine.players.choice import Players
    from talkcli.engine.synthesizers.base import Synthesizer
    from talkcli.engine.words import TimedWord, Times

#: Seconds between two steps of pyttsx3's own loop, which `talk` does not use.
_LOOP_STEP = 0.05


def register(name: str, synthesizer: Synthesizer, players: Players, wait: Wait, pause: Pause, times: Times) -> None:
    """Put a driver among pyttsx3's own, so that `pyttsx3.init(name)` finds it."""
    module: Any = types.ModuleType(f"pyttsx3.drivers.{name}")
    module.buildDriver = lambda proxy: Driver(proxy, synthesizer, players, wait, pause, times)
    sys.modules[module.__name__] = module


class Driver:
    """The driver; its methods are those that pyttsx3's DriverProxy calls."""

    def __init__(
        self, proxy: Any, synthesizer: Synthesizer, players: Players, wait: Wait, pause: Pause, times: Times
    ) -> None:
        self._proxy = proxy
        self._synthesizer = synthesizer
        self._players = players
        self._wait = wait
        self._pause = pause
        self._times = times
        self._sound = Sound()
        self._text: str | None = None
        self._playback: Playback | None = None
        self._looping = False

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
        if name == "voices":
            from pyttsx3.voice import Voice

            found = self._synthesizer.voices()
            return [Voice(each.id, each.name, [each.language] if each.language else []) for each in found]
        return self._synthesizer.voice if name == "voice" else fields(self._sound)[name]

    def setProperty(self, name: str, value: Any) -> None:  # noqa: N802 - pyttsx3's name
        """Set a property; KeyError if it is unknown, UnknownVoice."""
        if name == "voice":
            self._synthesizer.load(str(value))
        else:
            kind = type(fields(self._sound)[name])
            self._sound = replace(self._sound, **{name: kind(value)})

    def _speak(self, text: str) -> None:
        """Speak the text, with exactly one finished-utterance at its end."""
        self._proxy.notify("started-utterance")
        self._playback = playback = Playback(self._players, self._wait, self._pause, self._word_heard)
        failure: Exception | None = None
        duration = None
        try:
            self._synthesizer.speak(text, self._sound, playback)
            duration = playback.finish()
        except Stopped:
            pass
        except Exception as error:  # noqa: BLE001 - whatever it is, pyttsx3 would swallow it: it is told instead
            failure = error
        playback.silence()
        self._playback = None
        if failure is not None:
            self._proxy.notify("error", exception=failure)
        self._times.duration = duration
        self._proxy.notify("finished-utterance", completed=duration is not None)

    def _word_heard(self, word: TimedWord) -> None:
        self._times.word = word.position
        self._proxy.notify("started-word", location=word.location, length=word.length)
