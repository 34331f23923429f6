"""pyttsx3's engine: starting its driver, setting the properties for a goal, and `talk`'s own driver.

`talk`'s own driver puts a synthesizer and the players behind pyttsx3's interface. If something is missing, the error
says what to install.
"""

from __future__ import annotations

import contextlib
import os
import sys
import types
from importlib import import_module

from talkcli import install
from talkcli.engine import voices
from talkcli.engine.child.playback import Playback
from talkcli.engine.child.players.base import CannotSpeak, Stopped
from talkcli.engine.child.synthesizers.base import NotInstalled, SpeechSettings
from talkcli.engine.protocol import Ready, StartFailed
from talkcli.engine.voices import SYNTHESIZERS, UnknownVoice, is_own_driver
from talkcli.frozen import TYPE_CHECKING, fields, replace
from talkcli.goals.options import is_neural, without_speaker
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any

    from talkcli.engine.child.runner import GoalRunner
    from talkcli.engine.child.synthesizers.base import Synthesizer
    from talkcli.engine.child.synthesizers.combined import CombinedSynthesizer
    from talkcli.engine.child.words import TimedWord
    from talkcli.engine.protocol import Configure, Speak, Voice

#: Drivers of macOS that speak in Apple's run loop, which this process has to run.
_RUN_LOOP_DRIVERS = ("nsss", "avspeech")


class CannotStart(Exception):
    """The engine can't start. `failure` is the message for the server; it says what to install or to change."""

    def __init__(self, message: str, reason: Reason = Reason.ENGINE_FAILED, **more: bool) -> None:
        """Build the message for the server. `more` are further fields of `StartFailed`."""
        super().__init__(message)
        self.failure = StartFailed(reason, message, **more)


def start(configure: Configure, runner: GoalRunner) -> Ready:
    """Build the engine, start its loop, and attach it to the runner.

    Raises:
        CannotStart: something is missing or unknown.
    """
    try:
        import pyttsx3
    except ModuleNotFoundError as error:
        raise CannotStart(f"pyttsx3 is missing ({error}): {install.command('pyttsx3')}") from error
    own = is_own_driver(configure.driver)
    driver = configure.driver or (next(iter(SYNTHESIZERS)) if own else pyttsx3.engine.default_engine_by_sys_platform())
    name = f"talk_{driver}" if own else driver
    synthesizer = _register_own(driver, name, runner) if own else None
    engine = _start_engine(pyttsx3, name, named=configure.driver is not None)
    properties = DriverProperties(engine, driver)
    try:
        properties.set_voice(configure.voice)
        voice = properties.voice_id(configure.voice) if configure.voice else ""
    except CannotSpeak as error:
        unknown = error.reason == Reason.UNKNOWN_VOICE
        raise CannotStart(str(error), error.reason, permanent=unknown, usage_error=unknown) from error
    runner.attach_engine(engine, properties.apply, None if own else _pump(name), synthesizer)
    neural_voice = voice if is_neural(voice) else None
    if synthesizer is None:
        return Ready(driver, None, None, neural_voice)
    return Ready(driver, synthesizer.version, runner.players.first_player(), neural_voice)


def _register_own(synthesizer_name: str, driver_name: str, runner: GoalRunner) -> CombinedSynthesizer:
    """Make a synthesizer and register a driver for it."""
    module, _, function = SYNTHESIZERS[synthesizer_name].partition(":")
    try:
        synthesizer: CombinedSynthesizer = getattr(
            import_module(f"talkcli.engine.child.synthesizers.{module}"), function
        )()
    except NotInstalled as error:
        raise CannotStart(str(error)) from error
    except UnknownVoice as error:  # even its own voice is missing
        raise CannotStart(_start_error(driver_name, error), permanent=False) from error
    register(driver_name, synthesizer, runner)
    return synthesizer


def register(name: str, synthesizer: Synthesizer, runner: GoalRunner) -> None:
    """Add a driver to pyttsx3's own, so that `pyttsx3.init(name)` finds it."""
    module: Any = types.ModuleType(f"pyttsx3.drivers.{name}")
    module.buildDriver = lambda proxy: Driver(proxy, synthesizer, runner)
    sys.modules[module.__name__] = module


def _start_engine(pyttsx3: Any, name: str, *, named: bool) -> Any:
    """Return pyttsx3's engine for a driver, with its loop started. `named` says that an option named the driver."""
    try:
        engine = pyttsx3.init(name)
    except ModuleNotFoundError as error:
        if error.name == f"pyttsx3.drivers.{name}":
            message = f'unknown driver "{name}": there are {", ".join(_driver_names(pyttsx3))}'
            raise CannotStart(message, usage_error=named) from error
        raise CannotStart(f'the driver "{name}" cannot be loaded: {error}', usage_error=named) from error
    except Exception as error:
        raise CannotStart(_start_error(name, error), permanent=False) from error
    try:
        engine.startLoop(False)
        engine.iterate()  # fails with some drivers, which would hang at the first goal
    except TypeError as error:
        message = f'the driver "{name}" cannot be stepped (its iterate() is no generator): leave --driver out'
        raise CannotStart(message, usage_error=True) from error
    return engine


def _start_error(driver_name: str, error: Exception) -> str:
    return f'the driver "{driver_name}" cannot be started: {type(error).__name__}: {error}'


def _driver_names(pyttsx3: Any) -> list[str]:
    import pkgutil

    folder = os.path.join(os.path.dirname(pyttsx3.__file__), "drivers")
    found = {module.name for module in pkgutil.iter_modules([folder]) if not module.name.startswith("_")}
    return sorted(found | SYNTHESIZERS.keys())


def _pump(driver_name: str) -> Callable[[], None]:
    """Return the function that lets a foreign driver go on between two steps."""
    if sys.platform != "darwin" or driver_name not in _RUN_LOOP_DRIVERS:
        return lambda: None
    from Foundation import NSDate, NSRunLoop  # type: ignore[import-not-found,unused-ignore]

    return lambda: NSRunLoop.currentRunLoop().runUntilDate_(NSDate.dateWithTimeIntervalSinceNow_(0))


class DriverProperties:
    """The properties of the engine, set for each goal.

    A property is only set if its value changes, because a foreign driver may not know a property that nobody asked
    for. A voice is always set by an id that the driver itself lists.
    """

    def __init__(self, engine: Any, driver: str) -> None:
        self._engine = engine
        self._driver = driver
        self._values = fields(SpeechSettings())  # the initial values of pyttsx3's drivers
        self._default_voice: Any = None
        self._voices: tuple[Voice, ...] = ()
        self._voice: str | None = None
        self._error: Exception | None = None
        engine.connect("error", self._note_error)

    def apply(self, command: Speak) -> str | None:
        """Set the properties for a goal, and return why another voice speaks; None if none does.

        A neural voice may have disappeared since the goal was accepted. Then, unless the goal is to be spoken by that
        voice only, the driver speaks with a voice of its own, in the same language if possible.

        Raises:
            CannotSpeak: the driver doesn't have the voice or the property.
        """
        fallback_reason = None
        try:
            self.set_voice(command.voice)
        except CannotSpeak as error:
            if command.voice_only or not is_neural(command.voice or ""):
                raise
            fallback_reason = str(error)
            self._set_language(voices.neural_language(command.voice or ""))
        wanted = fields(command)
        for name, value in self._values.items():
            if wanted[name] != value:
                self._set(name, wanted[name], f"{name} to {wanted[name]}")
                self._values[name] = wanted[name]
        return fallback_reason

    def set_voice(self, wanted: str | None) -> None:
        """Set a voice, or the driver's default if `wanted` is None.

        Raises:
            CannotSpeak: there is no such voice.
        """
        if wanted == self._voice:
            return
        if self._voice is None:
            self._default_voice = self._engine.getProperty("voice")
        self._set("voice", self._default_voice if wanted is None else self.voice_id(wanted), f"the voice {wanted}")
        self._voice = wanted

    def _set_language(self, language: str) -> None:
        for each in (language, language.partition("-")[0]):
            with contextlib.suppress(CannotSpeak):
                self.set_voice(each)
                return
        self.set_voice(None)

    def voice_id(self, wanted: str) -> str:
        """Return the id of the voice that the user asked for.

        Raises:
            CannotSpeak: there is no such voice.
        """
        found = voices.find_voice(wanted, self._voices)
        if found is not None and is_neural(found.id) and without_speaker(wanted) != without_speaker(found.id):
            found = None  # only a part of its name matches, so a voice added since then may match better
        if found is None:  # listing takes some milliseconds, so it is only done for voices that are not known yet
            self._voices = voices.list_voices(self._engine)
            found = voices.find_voice(wanted, self._voices)
        if found is None:
            foreign = None if is_own_driver(self._driver) else self._driver
            raise CannotSpeak(Reason.UNKNOWN_VOICE, voices.unknown_voice_message(wanted, self._voices, foreign))
        return found.id

    def _set(self, name: str, value: Any, shown: str) -> None:
        """Set a property. pyttsx3 reports errors by a notification instead of an exception."""
        self._error = None
        self._engine.setProperty(name, value)
        error, self._error = self._error, None
        if isinstance(error, UnknownVoice):
            message = f"the voice {value} is listed, but it cannot be loaded: {error}"
            raise CannotSpeak(Reason.UNKNOWN_VOICE, message) from error
        if error is not None:
            why = str(error.args[0] if error.args else error) or type(error).__name__
            raise CannotSpeak(Reason.BAD_OPTION, f"the driver {self._driver} cannot set {shown}: {why}") from error

    def _note_error(self, exception: Exception, **_: object) -> None:
        self._error = exception


class Driver:
    """`talk`'s own driver, with the methods that pyttsx3's DriverProxy calls.

    It plays what a synthesizer makes. It can stop and hold, and it reports each word. It speaks inside `iterate`, where
    the synthesizer writes to the playback in the same thread, and the playback waits for the player. No exception may
    leave it, because pyttsx3 would lose the sentence silently.

    Its notifications are pyttsx3's. Anything else is set as an attribute of the runner. Beyond pyttsx3's interface, it
    has the property "pitch" (0 to 100).
    """

    def __init__(self, proxy: Any, synthesizer: Synthesizer, runner: GoalRunner) -> None:
        self._proxy = proxy
        self._synthesizer = synthesizer
        self._runner = runner
        self._sound = SpeechSettings()
        self._text: str | None = None
        self._playback: Playback | None = None

    def iterate(self) -> Iterator[None]:
        """Speak the waiting text, if there is one, and yield. pyttsx3 takes one step at a time."""
        while True:
            if self._text is None:
                self._proxy.setBusy(False)  # pyttsx3 starts busy; this makes it call `say` with a text that waits
            if self._text is None:
                yield
                continue
            text, self._text = self._text, None
            self._speak(text)

    def say(self, text: str) -> None:
        """Take a text to be spoken by the next step of `iterate`."""
        self._proxy.setBusy(True)
        self._text = text

    def stop(self) -> None:
        """Be silent now."""
        self._text = None
        if self._playback is not None:
            self._playback.stop()

    #: Called when the proxy is deleted.
    destroy = stop

    def getProperty(self, name: str) -> Any:  # noqa: N802 - pyttsx3's name
        """Return a property.

        Raises:
            KeyError: it is unknown.
        """
        if name == "voices":
            from pyttsx3.voice import Voice

            found = self._synthesizer.voices()
            return [Voice(each.id, each.name, [each.language] if each.language else []) for each in found]
        return self._synthesizer.voice if name == "voice" else fields(self._sound)[name]

    def setProperty(self, name: str, value: Any) -> None:  # noqa: N802 - pyttsx3's name
        """Set a property.

        Raises:
            KeyError: it is unknown.
            UnknownVoice: the voice can't be loaded.
        """
        if name == "voice":
            self._synthesizer.load(str(value))
        else:
            kind = type(fields(self._sound)[name])
            self._sound = replace(self._sound, **{name: kind(value)})

    def _speak(self, text: str) -> None:
        """Speak a text, and notify pyttsx3 exactly once that it is finished."""
        runner = self._runner
        self._proxy.notify("started-utterance")
        self._playback = playback = Playback(runner, self._report_word)
        failure: Exception | None = None
        runner.duration = None
        try:
            self._synthesizer.speak(text, self._sound, playback)
            runner.duration = round(playback.finish(), 6)
            runner.gaps = playback.gaps
        except Stopped:
            pass
        except Exception as error:  # noqa: BLE001 - pyttsx3 would drop it, whatever it is
            failure = error
        playback.silence()
        self._playback = None
        if failure is not None:
            self._proxy.notify("error", exception=failure)
        self._proxy.notify("finished-utterance", completed=runner.duration is not None)

    def _report_word(self, word: TimedWord) -> None:
        self._runner.position = word.position
        self._proxy.notify("started-word", location=word.location, length=word.length)
