"""Builds the pyttsx3 engine of an engine process: which driver or synthesizer, and what to install if it is missing.

It starts no goal. Everything heavy is imported inside, so that a missing part is an answer and no traceback.
"""

from __future__ import annotations

import sys

from talkcli.engine.settings import SettingFailed, Settings
from talkcli.frozen import frozen

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from talkcli.engine.players.choice import Players
    from talkcli.engine.session import Session
    from talkcli.engine.synthesizers.base import Synthesizer

#: The drivers of macOS that speak in Apple's run loop, which somebody has to run.
_RUN_LOOP_DRIVERS = ("nsss", "avspeech")


class CannotStart(Exception):
    """The engine cannot start: `reason` is for programs, the text names what to install or to change.

    `lasting` and `usage` as in `protocol.StartFailed`.
    """

    def __init__(
        self, message: str, reason: str = "engine_failed", *, lasting: bool = True, usage: bool = False
    ) -> None:
        super().__init__(message)
        self.reason = reason
        self.lasting = lasting
        self.usage = usage


@frozen
class OpenEngine:
    """An engine that is ready."""

    engine: Any
    settings: Settings
    driver: str
    version: str | None
    #: what a foreign driver needs between two steps; None for our own driver, which needs no steps.
    pump: Callable[[], None] | None


def _espeak() -> Synthesizer:
    from talkcli.engine.synthesizers.espeak import Espeak
    from talkcli.engine.synthesizers.library import load

    return Espeak(load())


#: `talk`'s own synthesizers, the usual one first: what makes each, by what users call it. It stands in for a driver of
#: pyttsx3's of that name.
SYNTHESIZERS: dict[str, Callable[[], Synthesizer]] = {"espeak": _espeak}


def start(driver: str | None, voice: str | None, players: Players, session: Session) -> OpenEngine:
    """Build the engine, with its loop started; CannotStart. What is ours speaks into the players, by the session."""
    try:
        import pyttsx3
    except ModuleNotFoundError as error:
        raise CannotStart(f"pyttsx3 is missing: pip install pyttsx3 ({error})") from error
    own = is_own(driver)
    shown = driver or (next(iter(SYNTHESIZERS)) if own else pyttsx3.engine.default_engine_by_sys_platform())
    name = f"talk_{shown}" if own else shown
    version = _register_own(shown, name, players, session) if own else None
    engine = _init(pyttsx3, name, named=driver is not None)
    settings = Settings(engine, name)
    _start_loop(engine, name)
    try:
        settings.set_voice(voice)
    except SettingFailed as error:
        unknown = error.reason == "unknown_voice"
        raise CannotStart(str(error), error.reason, lasting=unknown, usage=unknown) from error
    return OpenEngine(engine, settings, shown, version, None if own else _pump(name))


def is_own(driver: str | None) -> bool:
    """Tell whether a driver is `talk`'s own, which plays through a player; others play by themselves."""
    return sys.platform.startswith("linux") and driver in (None, *SYNTHESIZERS)


def _register_own(synthesizer: str, driver: str, players: Players, session: Session) -> str | None:
    """Make a synthesizer, and put a driver for it among pyttsx3's; return its version, for people."""
    from talkcli.engine.synthesizers.base import NotInstalled, UnknownVoice
    from talkcli.engine.synthesizers.driver import register

    try:
        made = SYNTHESIZERS[synthesizer]()
    except NotInstalled as error:
        raise CannotStart(str(error)) from error
    except UnknownVoice as error:  # not even its own: a part of it is missing
        raise CannotStart(_cannot_be_started(driver, error), lasting=False) from error
    register(driver, made, players, session.wait, session.pause, session.times)
    return made.version


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


def _start_loop(engine: Any, name: str) -> None:
    """Start the loop and take its first step: some drivers cannot, and would hang at the first goal."""
    try:
        engine.startLoop(False)
        engine.iterate()
    except TypeError as error:
        text = f'the driver "{name}" cannot be stepped (its iterate() is no generator)'
        raise CannotStart(f"{text}: leave --driver out", usage=True) from error


def _driver_names(pyttsx3: Any) -> list[str]:
    import os
    import pkgutil

    folder = os.path.join(os.path.dirname(pyttsx3.__file__), "drivers")
    found = {module.name for module in pkgutil.iter_modules([folder]) if not module.name.startswith("_")}
    return sorted(found | SYNTHESIZERS.keys())


def _pump(name: str) -> Callable[[], None]:
    if sys.platform != "darwin" or name not in _RUN_LOOP_DRIVERS:
        return lambda: None
    from Foundation import NSDate, NSRunLoop  # type: ignore[import-not-found,unused-ignore]

    def run_loop() -> None:
        NSRunLoop.currentRunLoop().runUntilDate_(NSDate.dateWithTimeIntervalSinceNow_(0))

    return run_loop
