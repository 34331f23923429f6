"""Speech through pyttsx3, including `talk`'s own driver for it.

This module starts pyttsx3's engine and sets the engine's properties for each goal. `talk`'s own driver makes a
synthesizer and the players available through pyttsx3's interface.
"""

from __future__ import annotations

import sys
import time
import types
from importlib import import_module
from math import inf

from talkcli import install
from talkcli.engine import protocol, voices
from talkcli.engine.child.playback import Playback
from talkcli.engine.child.players.base import CannotSpeak, EndedEarly, Stopped
from talkcli.engine.child.synthesizers.base import NotInstalled, SpeechSettings
from talkcli.engine.voices import SYNTHESIZERS, UnknownVoice, is_own_driver
from talkcli.frozen import TYPE_CHECKING, fields, replace
from talkcli.goals.options import ENGINE_OPTIONS, is_neural, without_speaker
from talkcli.goals.reasons import Reason
from talkcli.polling import NEVER

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any

    from talkcli.engine.child.runner import GoalRunner
    from talkcli.engine.child.synthesizers.base import Synthesizer
    from talkcli.engine.child.synthesizers.combined import CombinedSynthesizer
    from talkcli.engine.child.words import TimedWord
    from talkcli.engine.pronunciation import SpokenText

#: macOS drivers that speak only while this process runs Apple's run loop.
_RUN_LOOP_DRIVERS = ("nsss", "avspeech")


class CannotStart(Exception):
    """Raised if the engine can't start.

    Attributes:
        failure: the message for the server, which says what to install or to change.
    """

    def __init__(self, message: str, reason: Reason = Reason.ENGINE_FAILED, **more: bool) -> None:
        """Create the error and its `StartFailed` message.

        `more` contains further fields of the message.
        """
        super().__init__(message)
        self.failure = protocol.StartFailed(reason, message, **more)


def start(configure: protocol.Configure, runner: GoalRunner) -> protocol.Ready:
    """Start pyttsx3's engine and attach it to the runner. Return the `Ready` message for the server.

    Raises:
        CannotStart: a driver, a voice or a library is missing or unknown.
    """
    try:
        import pyttsx3
    except ModuleNotFoundError as error:
        raise CannotStart(f"pyttsx3 is missing ({error}); install it with: {install.command('pyttsx3')}") from error
    own = is_own_driver(configure.driver)
    driver = configure.driver or (next(iter(SYNTHESIZERS)) if own else pyttsx3.engine.default_engine_by_sys_platform())
    name = f"talk_{driver}" if own else driver
    synthesizer = _register_own_driver(driver, name, runner) if own else None
    engine = _start_engine(pyttsx3, name, user_chosen=configure.driver is not None)
    properties = DriverProperties(engine, driver)
    try:
        properties.set_voice(configure.voice)
        voice = properties.find_voice_id(configure.voice) if configure.voice else ""
    except CannotSpeak as error:
        unknown = error.reason == Reason.UNKNOWN_VOICE
        raise CannotStart(str(error), error.reason, permanent=unknown, usage_error=unknown) from error
    runner.attach_engine(engine, properties.apply, None if own else _make_run_loop_step(name), synthesizer)
    version, player = (synthesizer.version, runner.players.find_first_player()) if synthesizer else (None, None)
    return protocol.Ready(driver, version, player, voice if is_neural(voice) else None)


def _register_own_driver(synthesizer_name: str, driver_name: str, runner: GoalRunner) -> CombinedSynthesizer:
    """Create one of `talk`'s synthesizers and register a pyttsx3 driver for it. Return the synthesizer.

    Raises:
        CannotStart: a library or the default voice is missing.
    """
    module, _, function = SYNTHESIZERS[synthesizer_name].partition(":")
    try:
        imported = import_module(f"talkcli.engine.child.synthesizers.{module}")
        synthesizer: CombinedSynthesizer = getattr(imported, function)()
    except NotInstalled as error:
        raise CannotStart(str(error)) from error
    except UnknownVoice as error:  # even the default voice is missing
        raise CannotStart(_start_error_message(driver_name, error), permanent=False) from error
    register_driver(driver_name, synthesizer, runner)
    return synthesizer


def register_driver(name: str, synthesizer: Synthesizer, runner: GoalRunner) -> None:
    """Register a pyttsx3 driver that speaks with this synthesizer."""
    module: Any = types.ModuleType(f"pyttsx3.drivers.{name}")
    module.buildDriver = lambda proxy: Driver(proxy, synthesizer, runner)
    sys.modules[module.__name__] = module


def _start_engine(pyttsx3: Any, name: str, *, user_chosen: bool) -> Any:
    """Start and return a pyttsx3 engine with this driver.

    If the user has chosen the driver, a wrong name is a usage error.

    Raises:
        CannotStart: the driver is unknown or faulty.
    """
    try:
        engine = pyttsx3.init(name)
    except ModuleNotFoundError as error:
        if error.name == f"pyttsx3.drivers.{name}":
            message = f'unknown driver "{name}"; available drivers: {", ".join(_available_drivers())}'
            raise CannotStart(message, usage_error=user_chosen) from error
        raise CannotStart(f'the driver "{name}" could not be loaded: {error}', usage_error=user_chosen) from error
    except Exception as error:
        raise CannotStart(_start_error_message(name, error), permanent=False) from error
    try:
        engine.startLoop(False)
        engine.iterate()  # without this call, a faulty driver would hang at the first goal
    except TypeError as error:
        message = f'the driver "{name}" cannot be used (its iterate() is not a generator); leave out --driver'
        raise CannotStart(message, usage_error=True) from error
    return engine


def _start_error_message(driver_name: str, error: Exception) -> str:
    """Return the error message for a driver that could not be started."""
    return f'the driver "{driver_name}" could not be started: {type(error).__name__}: {error}'


def _available_drivers() -> list[str]:
    """Return the sorted names of pyttsx3's drivers and of `talk`'s own synthesizers."""
    import pkgutil

    from pyttsx3 import drivers

    found = {each.name for each in pkgutil.iter_modules(drivers.__path__) if not each.name.startswith("_")}
    return sorted(found | SYNTHESIZERS.keys())


def _make_run_loop_step(driver_name: str) -> Callable[[], None]:
    """Return a function that runs macOS's event loop once, or does nothing if the driver doesn't need it."""
    if sys.platform != "darwin" or driver_name not in _RUN_LOOP_DRIVERS:
        return lambda: None
    from Foundation import NSDate, NSRunLoop  # type: ignore[import-not-found,unused-ignore]

    return lambda: NSRunLoop.currentRunLoop().runUntilDate_(NSDate.dateWithTimeIntervalSinceNow_(0))


class DriverProperties:
    """Sets the voice, rate, volume and pitch of pyttsx3's engine.

    A property is only set if its value changes, because a third-party driver may not support all of them. The voice is
    always set by an ID from the driver's own list.
    """

    def __init__(self, engine: Any, driver: str) -> None:
        self._engine = engine
        self._driver = driver
        # pyttsx3's drivers start with these values.
        self._values = {name: value for name, value in fields(SpeechSettings()).items() if name in ENGINE_OPTIONS}
        self._default_voice: Any = None
        self._voices: tuple[protocol.Voice, ...] = ()
        self._voice: str | None = None
        self._error: Exception | None = None
        engine.connect("error", self._record_error)

    def apply(self, command: protocol.Speak) -> str | None:
        """Set the voice, rate, volume and pitch for a goal. Return the reason for a fallback voice, if any.

        A neural voice may have disappeared since the goal was accepted. The driver then falls back to another of its
        voices, preferably in the same language. It doesn't do so if `voice_only` is set.

        Returns:
            The reason for the fallback, or None if the goal has the requested voice.

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
            try:
                self.set_voice(voices.neural_language(command.voice or ""))
            except CannotSpeak:
                self.set_voice(None)
        wanted = fields(command)
        for name, value in self._values.items():
            if wanted[name] != value:
                self._set_property(name, wanted[name], f"{name} to {wanted[name]}")
                self._values[name] = wanted[name]
        return fallback_reason

    def set_voice(self, wanted: str | None) -> None:
        """Set the voice that best matches a name. None selects the default voice.

        Raises:
            CannotSpeak: there is no such voice.
        """
        if wanted == self._voice:
            return
        if self._voice is None:
            self._default_voice = self._engine.getProperty("voice")
        voice = self._default_voice if wanted is None else self.find_voice_id(wanted)
        self._set_property("voice", voice, f"the voice {wanted}")
        self._voice = wanted

    def find_voice_id(self, wanted: str) -> str:
        """Return the ID of the voice that best matches a name. Raise CannotSpeak if no voice does.

        Raises:
            CannotSpeak: there is no such voice.
        """
        found = voices.find_voice(wanted, self._voices)
        if found is not None and is_neural(found.id) and without_speaker(wanted) != without_speaker(found.id):
            found = None  # the match isn't exact, and a voice that was installed later may match better
        if found is None:  # listing the voices takes some milliseconds
            self._voices = voices.list_voices(self._engine)
            found = voices.find_voice(wanted, self._voices)
        if found is None:
            foreign = None if is_own_driver(self._driver) else self._driver
            raise CannotSpeak(Reason.UNKNOWN_VOICE, voices.unknown_voice_message(wanted, self._voices, foreign))
        return found.id

    def _set_property(self, name: str, value: Any, label: str) -> None:
        """Set a property of the engine. Raise CannotSpeak if this fails.

        pyttsx3 reports errors through notifications. This method raises them as exceptions. In their messages, `label`
        names the property and its value.

        Raises:
            CannotSpeak: the property can't be set.
        """
        self._error = None
        self._engine.setProperty(name, value)
        error, self._error = self._error, None
        if isinstance(error, UnknownVoice):
            message = f"the voice {value} cannot be loaded: {error}"
            raise CannotSpeak(Reason.UNKNOWN_VOICE, message) from error
        if error is not None:
            why = str(error.args[0] if error.args else error) or type(error).__name__
            raise CannotSpeak(Reason.BAD_OPTION, f"the driver {self._driver} cannot set {label}: {why}") from error

    def _record_error(self, exception: Exception, **_: object) -> None:
        """Store an error from pyttsx3 for `_set_property` to raise."""
        self._error = exception


class Driver:
    """A pyttsx3 driver that plays the sound of a synthesizer.

    pyttsx3's DriverProxy calls the methods. One step of `iterate` speaks a whole sentence: the synthesizer writes to
    the playback, which waits for the player. An exception must not leave this step, because pyttsx3 would drop the
    sentence without an error.

    The driver sends pyttsx3's notifications. Results for which they have no field are set as attributes of the runner.
    In addition to pyttsx3's own properties, the driver has the property "pitch" (0 to 100).
    """

    def __init__(self, proxy: Any, synthesizer: Synthesizer, runner: GoalRunner) -> None:
        self._proxy = proxy
        self._synthesizer = synthesizer
        self._runner = runner
        self._sound = SpeechSettings()
        self._text: str | None = None
        self._playback: Playback | None = None

    def iterate(self) -> Iterator[None]:
        """Speak the texts that were passed to `say`. Yield whenever no text is left."""
        while True:
            if self._text is None:
                self._proxy.setBusy(False)  # pyttsx3 sends no text while the driver is busy
            if self._text is None:
                yield
                continue
            text, self._text = self._text, None
            self._speak(text)

    def say(self, text: str) -> None:
        """Store a text for the next step of `iterate` to speak."""
        self._proxy.setBusy(True)
        self._text = text

    def stop(self) -> None:
        """Discard the stored text, and stop speaking at once."""
        self._text = None
        if self._playback is not None:
            self._playback.stop()

    #: pyttsx3 calls this method when it deletes the proxy.
    destroy = stop

    def getProperty(self, name: str) -> Any:  # noqa: N802 - pyttsx3's name
        """Return the value of a property.

        Raises:
            KeyError: the property is unknown.
        """
        if name == "voices":
            from pyttsx3.voice import Voice

            found = self._synthesizer.voices()
            return [Voice(each.id, each.name, [each.language] if each.language else []) for each in found]
        return self._synthesizer.voice if name == "voice" else fields(self._sound)[name]

    def setProperty(self, name: str, value: Any) -> None:  # noqa: N802 - pyttsx3's name
        """Choose a voice, or change a setting for the next sentences.

        Raises:
            KeyError: the property is unknown.
            UnknownVoice: the voice can't be loaded.
        """
        if name == "voice":
            self._synthesizer.choose_voice(str(value))
        else:
            kind = type(fields(self._sound)[name])
            self._sound = replace(self._sound, **{name: kind(value)})

    def _speak(self, text: str) -> None:
        """Speak a text, and notify pyttsx3. Store the length of the sound and its gaps in the runner."""
        runner = self._runner
        self._proxy.notify("started-utterance")
        self._playback = playback = Playback(runner, self._notify_word)
        runner.duration = None
        try:
            try:
                length = self._write_samples(text, playback)
                runner.duration = round(min(playback.finish(), length), 6)
            except EndedEarly as early:
                runner.ended_early = early
                if playback.started:
                    playback.finish()
            runner.gaps = playback.gaps
        except Stopped:
            pass
        except Exception as error:  # noqa: BLE001 - pyttsx3 would drop any exception
            self._proxy.notify("error", exception=error)
        runner.heard = round(playback.heard(), 3) if runner.duration is None else runner.duration
        playback.release_player()
        self._playback = None
        self._proxy.notify("finished-utterance", completed=runner.duration is not None)

    def _write_samples(self, text: str, playback: Playback) -> float:
        """Pass speech or a sound to the playback. Return the length of a sound, or infinity for speech."""
        runner, settings = self._runner, self._sound
        if runner.sound is not None:
            from talkcli.engine.child.sounds import play_sound  # rarely needed

            rate = runner.players.required_rate(runner.sound.voice)
            return play_sound(runner.sounds, runner.sound, playback, rate)
        for part, is_last in self._parts(text, playback):
            playback.begin_part(part, is_last=is_last)
            settings = replace(settings, ends_text=is_last, phonemes=part.has_phonemes)
            self._synthesizer.speak(part.text, settings, playback)
            settings = replace(settings, begins_text=False)
        return inf

    def _parts(self, text: str, playback: Playback) -> Iterator[tuple[SpokenText, bool]]:
        """Yield each part of a text once it can be spoken, and whether it is the last part.

        A text that doesn't grow is a single part. While text is missing, the playback continues.
        """
        growing, apply = self._runner.growing_text, self._runner.pronunciations.apply
        if growing is None:
            yield apply(text, self._runner.text_start), True
            return
        while True:
            if self._runner.word_end_due is not None and not growing.finished:
                raise EndedEarly(growing.position)
            now, buffered = time.monotonic(), playback.buffered()
            part = growing.take_next_part(now, buffered)
            if part is not None:
                self._runner.report_text_missing(False)
                spoken = apply(growing.text, *part)
                growing.skip_to(spoken.end)
                yield spoken, growing.finished
            elif growing.finished:
                return
            else:
                self._runner.report_text_missing(buffered <= 0)
                playback.await_text(min(growing.next_part_at(now, buffered), now + buffered if buffered > 0 else NEVER))

    def _notify_word(self, word: TimedWord) -> None:
        """Store a word in the runner, and notify pyttsx3 of the word."""
        self._runner.word = word
        self._proxy.notify("started-word", location=word.start, length=word.end - word.start)
