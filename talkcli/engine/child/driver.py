"""pyttsx3's engine: its driver, a goal's settings as its properties, and our own driver in front of a synthesizer.

It starts no goal. What is missing is an answer that says what to install, and no traceback.
"""

from __future__ import annotations

import contextlib
import os
import sys
import types
from importlib import import_module

from talkcli import install
from talkcli.engine.child.playback import Playback
from talkcli.engine.child.players.base import CannotSpeak, Stopped
from talkcli.engine.child.synthesizers.base import NotInstalled, SpeechSettings
from talkcli.engine.protocol import Ready, StartFailed
from talkcli.engine.voices import (
    SYNTHESIZERS,
    UnknownVoice,
    find_voice,
    is_neural,
    is_own_driver,
    language_of,
    list_voices,
    unknown_voice,
)
from talkcli.frozen import TYPE_CHECKING, fields, replace
from talkcli.goals.options import model_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any

    from talkcli.engine.child.session import Session
    from talkcli.engine.child.synthesizers.base import Synthesizer
    from talkcli.engine.child.synthesizers.combined import CombinedSynthesizer
    from talkcli.engine.child.words import TimedWord
    from talkcli.engine.protocol import Configure, Say, Voice

#: The drivers of macOS that speak in Apple's run loop, which somebody has to run.
_RUN_LOOP_DRIVERS = ("nsss", "avspeech")


class CannotStart(Exception):
    """The engine cannot start: the text names what to install or to change, `failed` is what the server is told."""

    def __init__(self, message: str, reason: str = "engine_failed", **more: bool) -> None:
        """`more`: as in `StartFailed`."""
        super().__init__(message)
        self.failed = StartFailed(reason, message, **more)


def start(configure: Configure, session: Session) -> Ready:
    """Build the engine, with its loop started, and hand it to the session; CannotStart."""
    try:
        import pyttsx3
    except ModuleNotFoundError as error:
        raise CannotStart(f"pyttsx3 is missing ({error}): {install.command('pyttsx3')}") from error
    own = is_own_driver(configure.driver)
    shown = configure.driver or (next(iter(SYNTHESIZERS)) if own else pyttsx3.engine.default_engine_by_sys_platform())
    name = f"talk_{shown}" if own else shown
    made = _register_own(shown, name, session) if own else None
    engine = _init(pyttsx3, name, named=configure.driver is not None)
    settings = Settings(engine, shown)
    _start_loop(engine, name)
    try:
        settings.set_voice(configure.voice)
        voice = settings.driver_id(configure.voice) if configure.voice else ""
    except CannotSpeak as error:
        unknown = error.reason == "unknown_voice"
        raise CannotStart(str(error), error.reason, lasting=unknown, usage=unknown) from error
    session.open(engine, settings.apply, None if own else _pump(name), made)
    neural = voice if is_neural(voice) else None
    return Ready(shown, made.version if made else None, session.players.first_player() if own else None, neural)


def _register_own(synthesizer: str, driver: str, session: Session) -> CombinedSynthesizer:
    """Make a synthesizer, and put a driver for it among pyttsx3's."""
    try:
        module, _, function = SYNTHESIZERS[synthesizer].partition(":")
        made: CombinedSynthesizer = getattr(import_module(f"talkcli.engine.child.synthesizers.{module}"), function)()
    except NotInstalled as error:
        raise CannotStart(str(error)) from error
    except UnknownVoice as error:  # not even its own: a part of it is missing
        raise CannotStart(_cannot_be_started(driver, error), lasting=False) from error
    register(driver, made, session)
    return made


def register(name: str, synthesizer: Synthesizer, session: Session) -> None:
    """Put a driver among pyttsx3's own, so that `pyttsx3.init(name)` finds it."""
    module: Any = types.ModuleType(f"pyttsx3.drivers.{name}")
    module.buildDriver = lambda proxy: Driver(proxy, synthesizer, session)
    sys.modules[module.__name__] = module


def _init(pyttsx3: Any, name: str, *, named: bool) -> Any:
    """Return the engine of a driver; `named`: whether an option has named it."""
    try:
        return pyttsx3.init(name)
    except ModuleNotFoundError as error:
        if error.name == f"pyttsx3.drivers.{name}":
            words = f'unknown driver "{name}": there are {", ".join(_driver_names(pyttsx3))}'
            raise CannotStart(words, usage=named) from error
        raise CannotStart(f'the driver "{name}" cannot be loaded: {error}', usage=named) from error
    except Exception as error:
        raise CannotStart(_cannot_be_started(name, error), lasting=False) from error


def _cannot_be_started(driver: str, error: Exception) -> str:
    return f'the driver "{driver}" cannot be started: {type(error).__name__}: {error}'


def _driver_names(pyttsx3: Any) -> list[str]:
    import pkgutil

    folder = os.path.join(os.path.dirname(pyttsx3.__file__), "drivers")
    found = {module.name for module in pkgutil.iter_modules([folder]) if not module.name.startswith("_")}
    return sorted(found | SYNTHESIZERS.keys())


def _start_loop(engine: Any, name: str) -> None:
    """Start the loop and take its first step: some drivers cannot, and would hang at the first goal."""
    try:
        engine.startLoop(False)
        engine.iterate()
    except TypeError as error:
        text = f'the driver "{name}" cannot be stepped (its iterate() is no generator)'
        raise CannotStart(f"{text}: leave --driver out", usage=True) from error


def _pump(name: str) -> Callable[[], None]:
    if sys.platform != "darwin" or name not in _RUN_LOOP_DRIVERS:
        return lambda: None
    from Foundation import NSDate, NSRunLoop  # type: ignore[import-not-found,unused-ignore]

    def run_loop() -> None:
        NSRunLoop.currentRunLoop().runUntilDate_(NSDate.dateWithTimeIntervalSinceNow_(0))

    return run_loop


class Settings:
    """A goal's settings as properties of one engine, by what they were last set to.

    A property is set only where it differs from what the driver has: a foreign driver may not know a property that
    nobody asked for. A voice is always set by an id that the driver itself lists.
    """

    def __init__(self, engine: Any, driver: str) -> None:
        self._engine = engine
        self._driver = driver
        self._set = fields(SpeechSettings())  # what pyttsx3's drivers set themselves
        self._default_voice: Any = None
        self._voices: tuple[Voice, ...] = ()
        self._voice: str | None = None
        self._error: Exception | None = None
        engine.connect("error", self._note)

    def apply(self, say: Say) -> str | None:
        """Set what the goal wants; CannotSpeak if that cannot be had.

        A neural voice that is gone, since the goal was accepted or the server was told to speak by it, is no reason for
        silence: the driver's own speaks then, in its language if it can, and why is returned.
        """
        why = None
        try:
            self.set_voice(say.voice)
        except CannotSpeak as error:
            if say.voice_only or not is_neural(say.voice or ""):
                raise
            why = str(error)
            self._set_language(language_of(say.voice or ""))
        wanted = fields(say)
        for name in self._set:
            value = wanted[name]
            if self._set[name] != value:
                self._put(name, value, f"{name} to {value}")
                self._set[name] = value
        return why

    def set_voice(self, wanted: str | None) -> None:
        """Set the voice; None is the one that the driver started with. CannotSpeak if there is no such voice."""
        if wanted == self._voice:
            return
        if self._voice is None:
            self._default_voice = self._engine.getProperty("voice")
        self._put("voice", self._default_voice if wanted is None else self.driver_id(wanted), f"the voice {wanted}")
        self._voice = wanted

    def _set_language(self, language: str) -> None:
        for each in (language, language.partition("-")[0]):
            with contextlib.suppress(CannotSpeak):
                self.set_voice(each)
                return
        self.set_voice(None)

    def driver_id(self, wanted: str) -> str:
        """Return the id of a voice; CannotSpeak if there is no such voice."""
        found = find_voice(wanted, self._voices)
        if found is not None and is_neural(found.id) and model_of(wanted) != model_of(found.id):
            found = None  # a part of its name: another voice may have been put there since that it means
        if found is None:  # not each time: it takes some milliseconds, and what is new is seldom asked for
            self._voices = list_voices(self._engine)
            found = find_voice(wanted, self._voices)
        if found is None:
            foreign = None if is_own_driver(self._driver) else self._driver
            raise CannotSpeak("unknown_voice", unknown_voice(wanted, self._voices, foreign))
        return found.id

    def _put(self, name: str, value: Any, shown: str) -> None:
        """Set a property; what goes wrong pyttsx3 reports by a notification, not by an exception."""
        self._error = None
        self._engine.setProperty(name, value)
        error, self._error = self._error, None
        if isinstance(error, UnknownVoice):
            text = f"the voice {value} is listed, but it cannot be loaded: {error}"
            raise CannotSpeak("unknown_voice", text) from error
        if error is not None:
            why = str(error.args[0] if error.args else error) or type(error).__name__
            raise CannotSpeak("bad_option", f"the driver {self._driver} cannot set {shown}: {why}") from error

    def _note(self, exception: Exception, **_: object) -> None:
        self._error = exception


class Driver:
    """Our driver; its methods are those that pyttsx3's DriverProxy calls for an engine whose loop is another's.

    What it speaks is played, stopped, held, and told word by word. It speaks inside `iterate()`; the synthesizer writes
    to the playback in the same thread, and that waits for the player. It must not let an exception out: pyttsx3 would
    lose the sentence without a word.

    Its notifications are pyttsx3's, keyword for keyword; what else there is to be told stands in the session. More than
    pyttsx3 asks for: the property "pitch" (0 to 100).
    """

    def __init__(self, proxy: Any, synthesizer: Synthesizer, session: Session) -> None:
        self._proxy = proxy
        self._synthesizer = synthesizer
        self._session = session
        self._sound = SpeechSettings()
        self._text: str | None = None
        self._playback: Playback | None = None

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

    #: Called when the proxy goes away.
    destroy = stop

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
        session = self._session
        self._proxy.notify("started-utterance")
        self._playback = playback = Playback(session, self._word_heard)
        failure: Exception | None = None
        session.duration = None
        try:
            self._synthesizer.speak(text, self._sound, playback)
            session.duration = playback.finish()
            session.gaps = playback.gaps
        except Stopped:
            pass
        except Exception as error:  # noqa: BLE001 - whatever it is, pyttsx3 would swallow it: it is told instead
            failure = error
        playback.silence()
        self._playback = None
        if failure is not None:
            self._proxy.notify("error", exception=failure)
        self._proxy.notify("finished-utterance", completed=session.duration is not None)

    def _word_heard(self, word: TimedWord) -> None:
        self._session.position = word.position
        self._proxy.notify("started-word", location=word.location, length=word.length)
