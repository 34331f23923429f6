"""What makes sound of a text: Python, pyttsx3, libespeak-ng with its data and voices.

An engine process of the doctor's own shows it. What libespeak-ng or a player does to it ends that process and is a fact
here; this one never loads the library.
"""

from __future__ import annotations

import contextlib
import math
import os
import platform
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from talkcli import install
from talkcli.doctor.report import Finding, failed, ok, warning
from talkcli.engine import protocol
from talkcli.engine.parent.process import EngineFailed, PrivateEngine
from talkcli.engine.voices import is_neural
from talkcli.frozen import frozen, replace

if TYPE_CHECKING:
    from collections.abc import Mapping

#: The next step if something is missing.
INSTALL_LIBRARY = install.espeak_library()
_INSTALL_PYTTSX3 = install.command("pyttsx3")
_INSTALL_NEURAL = install.neural()
#: A server's words for an engine that works.
WORKING = ("ready", "starting")


@frozen
class Engine:
    """What an engine process said that was started to look."""

    driver: str | None = None
    #: "eSpeak NG 1.51 (system)"
    synthesizer: str | None = None
    #: None where it didn't come to list them
    voices: int | None = None
    #: how many of these are neural
    neural: int = 0
    #: the player that it would try first; None if there is none, or it is not known
    player: str | None = None
    #: id of the neural voice that it was told to speak with; None for any other voice
    voice: str | None = None
    #: why it didn't start, for programs and in its own words; None where it did
    reason: str | None = None
    words: str = ""


@frozen
class Setting:
    """What the engine process is to speak with."""

    player: str | None = None
    device: str | None = None
    voice: str | None = None
    #: what ends any waiting with Interrupted, as in `connect.ready`
    interrupt: Mapping[int, int] | None = None
    driver: str | None = None
    #: the program that worked last, where no player is named
    worked: str | None = None
    #: the environment in which it is to run; None for this process's
    env: Mapping[str, str] | None = None


def python() -> Finding:
    """Return which interpreter runs this."""
    return ok("python", f"Python {platform.python_version()} ({sys.executable})")


def pyttsx3() -> str | None:
    """Return the version of pyttsx3, None where none is installed; it is not imported, as it may be broken."""
    with contextlib.suppress(PackageNotFoundError):
        return version("pyttsx3")
    return None


def look(setting: Setting) -> Engine:
    """Start an engine process, and return what it says of itself."""
    found = Engine()
    try:
        with conversation(setting) as engine:
            ready = engine.wait_for(protocol.Ready)
            found = Engine(ready.driver, ready.version, player=ready.player, voice=ready.voice)
            voices = engine.wait_for(protocol.VoiceList).voices
            return replace(found, voices=len(voices), neural=sum(is_neural(each.id) for each in voices))
    except EngineFailed as error:
        if found.driver is None or error.reason == "engine_crashed":
            reason, words = fault(error)
            return Engine(reason=reason, words=words)
    return found  # it is ready; that it lists no voices is for who judges


def conversation(setting: Setting, limit: float = math.inf) -> PrivateEngine:
    """Return what talks to an engine process of these settings, for at most `limit` seconds."""
    configure = protocol.Configure(
        os.getpid(), setting.driver, setting.player, setting.device, setting.voice, last_player=setting.worked
    )
    deadline = time.monotonic() + limit
    return PrivateEngine(configure, env=setting.env, deadline=deadline, interrupt=setting.interrupt)


def fault(error: EngineFailed) -> tuple[str, str]:
    """Return why an engine process failed, for programs and in words; whether it was ready yet makes no difference."""
    if error.silent_s is not None:
        return "engine_hung", f"the engine process said nothing for {error.silent_s:g} s"
    return error.reason, str(error)


def judge(pyttsx3: str | None, engine: Engine, *, server: str | None) -> list[Finding]:
    """Judge the voice; `pyttsx3`: its version.

    `server`: what a server says of its own engine. If that engine works, findings about this one are warnings.
    """
    broken = warning if server in WORKING else failed
    if server not in {None, *WORKING} and engine.reason is None:
        engine = Engine(reason="engine_failed", words=f"the server's engine: {server}")
    words = _without_step(engine.words)
    if engine.reason is None:
        return [ok("pyttsx3", f"{pyttsx3 or 'of an unknown version'}, driver {engine.driver}"), *_library(engine)]
    if "pyttsx3 is missing" in words or pyttsx3 is None:
        return [broken("pyttsx3", words or "pyttsx3 is missing", _INSTALL_PYTTSX3)]
    found = ok("pyttsx3", pyttsx3)
    if engine.reason == "unknown_voice":
        step = "choose one that 'talk voices' lists, in TALK_VOICE or --voice"
        if _INSTALL_NEURAL in words:
            step = _INSTALL_NEURAL
        return [found, ok("libespeak-ng", "loaded"), broken("voices", words, step)]
    step = "read what the engine said in the log of talk serve"
    if "espeak-ng data" in words:
        step = "sudo apt-get install -y espeak-ng-data"
    elif "libespeak-ng" in words:
        step = INSTALL_LIBRARY
    elif engine.reason == "engine_crashed":
        words = f"the engine process died while it loaded the library: {words}"
        step = "install it again: sudo apt-get install --reinstall -y libespeak-ng1 espeak-ng-data"
    elif engine.reason == "engine_hung":
        # It asks PulseAudio at its start, though it is to play nothing itself.
        step = "restart the sound server if that hangs (see below): libespeak-ng waits for it at its start"
    return [found, broken("libespeak-ng", words, step)]


def _without_step(words: str) -> str:
    """Return an engine's words without the next step, which the finding shows by itself."""
    for step in (_INSTALL_PYTTSX3, INSTALL_LIBRARY):
        words = words.removesuffix(f": {step}")
    return words


def _library(engine: Engine) -> list[Finding]:
    name = engine.synthesizer
    found = [] if name is None else [ok("libespeak-ng", f"{name}, with its data")]
    if engine.voices is None:
        return [*found, warning("voices", "the engine listed none in time", "run talk doctor again")]
    if not engine.voices:
        step = "sudo apt-get install --reinstall -y espeak-ng-data"
        return [*found, warning("voices", "the engine has none", step)]
    return [*found, ok("voices", f"{engine.voices}, listed by 'talk voices'")]
