"""Neural voices: the packages that they take, their files, and the one that is spoken with, loaded and timed.

Where nothing neural is there and nothing asks for it, nothing is done, and nothing said. Voices that are not in use are
looked at, and not loaded. That takes memory and some seconds, in an engine process of the doctor's own: what a model
does to that is a fact here.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from talkcli import install
from talkcli.doctor.report import Finding, failed, ok, some, warning
from talkcli.doctor.sound import asked
from talkcli.doctor.voice import fault
from talkcli.engine import models, protocol
from talkcli.engine.parent.process import EngineFailed, PrivateEngine
from talkcli.engine.voices import NEURAL
from talkcli.frozen import frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

#: What is said to see how fast a voice is made: short, and longer than a word.
_TEXT = "If you hear this, talk works."
_RATE = 200
#: How many times as fast as it is heard a sentence must be made: below, any other work on the machine makes gaps.
_FAST_ENOUGH = 1.3
_RUNTIME, _FILES, _VOICE = "neural", "voice files", "neural voice"
#: What has a server load a voice that it has given up.
_AGAIN = "see whether it still is so: talk set --voice "
#: Imports packages one by one, for a process of its own: on an old processor that may be the end of it.
_IMPORT = """
import sys
sys.path[:] = filter(None, sys.path)  # nothing of the current directory
for each in sys.argv[1:]:
    print(each, flush=True)
    try:
        __import__(each)
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {error}")
"""
#: Seconds that this may take, from an SD card.
_IMPORT_LIMIT_S = 10.0
_LATE = f"it takes more than {_IMPORT_LIMIT_S:g} s"
_REINSTALL = f"install it again: {install.neural(again=True)}"
_CHOOSE = "choose one of espeak's: talk set --voice en, or talk serve --voice en"


@frozen
class Tried:
    """How it went with the voice that is spoken with."""

    #: seconds that loading took; None where it wasn't loaded
    loaded: float | None = None
    #: seconds of a sentence for each that it took to make
    speed: float | None = None
    #: bytes that the engine process had then
    memory: int | None = None
    #: why it can't be spoken with, and the next step, where that is known
    words: str | None = None
    step: str | None = None


@frozen
class Neural:
    """Facts about neural voices."""

    #: what is needed and not installed, in words
    missing: str | None
    #: versions of what is: "onnxruntime 1.23.2"
    installed: tuple[str, ...] = ()
    #: ids of the voices whose files are as they should be, as far as that shows without loading them
    good: tuple[str, ...] = ()
    #: of the others, why not, and the next step
    bad: tuple[tuple[str, str, str], ...] = ()
    #: the voice that is spoken with, as its user wrote it; how it went with it, if it was tried
    used: str | None = None
    tried: Tried | None = None
    #: which package is installed and cannot be imported, and why, for people
    broken: str | None = None


def look(
    used: str | None, env: Mapping[str, str] | None, limit: float, interrupt: Mapping[int, int] | None = None
) -> Neural:
    """Look at all voices, and try the one that is in use, in at most `limit` seconds; Interrupted.

    `used`: that voice, as its user wrote it; `env`, `interrupt`: as in `voice.Setting`.
    """
    missing = models.missing()
    good, bad = [], []
    for name, path in models.found(env).items():
        try:
            models.describe(path)
            models.open_checked(path).close()
            good.append(NEURAL + name)
        except models.BadFile as error:
            bad.append((NEURAL + name, *_parted(str(error))))
    broken = None if missing else _broken(os.environ if env is None else env)
    tried = None if used is None or missing or broken else _try(used, env, limit, interrupt)
    return Neural(missing, tuple(map(_installed, models.NEEDED)), tuple(good), tuple(bad), used, tried, broken)


def _broken(env: Mapping[str, str]) -> str | None:
    """Return which of the packages cannot be imported, and why; None if all can."""
    env = {**env, **models.NO_TELEMETRY}
    said = asked(sys.executable, "-c", _IMPORT, *reversed(models.NEEDED), env=env, limit=_IMPORT_LIMIT_S)
    if said.trouble is None:
        return None
    package = said.out.split()[-1] if said.out else models.NEEDED[0]
    trouble = _LATE if said.late else said.trouble
    return f"{_installed(package)} cannot be imported: {trouble}"


def _installed(package: str) -> str:
    with contextlib.suppress(PackageNotFoundError):
        return f"{package} {version(package)}"
    return f"{package} of an unknown version"


def _parted(words: str) -> tuple[str, str]:
    """Return what is wrong and the next step, of a text that ends with that behind a colon, as those of voices do."""
    what, colon, step = words.rpartition(": ")
    return (what, step) if colon else (words, _CHOOSE)


def _try(used: str, env: Mapping[str, str] | None, limit: float, interrupt: Mapping[int, int] | None) -> Tried:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        configure = protocol.Configure(os.getpid(), None, None, None, None, list_voices=False, output_fd=nowhere)
        with PrivateEngine(configure, env=env, deadline=time.monotonic() + limit, interrupt=interrupt) as engine:
            engine.wait_for(protocol.Ready)
            return _timed(engine, used)
    except EngineFailed as error:
        return Tried(words=fault(error)[1], step=_CHOOSE)
    except TimeoutError:
        return Tried(words=f"it was not loaded, and had not spoken, after {limit:g} s", step=_CHOOSE)
    finally:
        os.close(nowhere)


def _timed(engine: PrivateEngine, used: str) -> Tried:
    """Have a sound spoken, for which the voice is loaded, then a sentence; nobody hears them."""
    ended, loaded = _spoken(engine, used, "a")
    began = time.monotonic()
    if ended.outcome == protocol.OUTCOME_COMPLETED:
        ended, _ = _spoken(engine, used, _TEXT)
    if ended.outcome != protocol.OUTCOME_COMPLETED or ended.duration is None:
        return Tried(None, None, None, *_parted(ended.message or f"the sentence ended {ended.outcome}"))
    speed = ended.duration / (time.monotonic() - began)
    return Tried(loaded, speed, _memory(engine._process.pid))


def _spoken(engine: PrivateEngine, used: str, text: str) -> tuple[protocol.Ended, float | None]:
    """Have a text spoken, and return how that ended, and the seconds for which the voice was loaded before it."""
    loaded = None
    # It insists on the voice, so that espeak does not speak in its place.
    engine.speak(protocol.Speak(text, text, _RATE, 1.0, used, 50, voice_only=True))
    while True:
        event = next(engine.events)
        if isinstance(event, protocol.VoiceLoaded):
            loaded = event.seconds
        elif isinstance(event, protocol.Ended):
            return event, loaded


def _memory(process: int) -> int | None:
    """Return the bytes of memory that a process has; None where that can't be known."""
    with contextlib.suppress(OSError, ValueError, IndexError), open(f"/proc/{process}/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return None


def judge_told(voices: object) -> list[Finding]:
    """Judge neural voices by what a server says of itself, where its files can't be looked at: its `neural_voices`."""
    failed = _given_up(voices)
    loaded = tuple(each for each in voices if each not in failed) if isinstance(voices, dict) else ()
    if failed:
        voice, why = next(iter(failed.items()))
        return [warning(_VOICE, f"the server cannot speak by {voice}: {why}", f"{_AGAIN}{voice}")]
    return [ok(_VOICE, f"of the server: {some(loaded)}")] if loaded else []


def _given_up(voices: object) -> dict[str, str]:
    """Return the voices that a server has given up, and why."""
    found = voices.items() if isinstance(voices, dict) else ()
    return {voice: str(each.get("why")) for voice, each in found if each.get("state") == "failed"}


def judge(neural: Neural, *, server: bool, told: object = None) -> list[Finding]:
    """Judge neural voices; `server`: whether one runs, which speaks by espeak where a voice can't be had.

    `told`: what that says of them, as of `judge_told`.
    """
    tried = neural.tried
    broken = warning if server or neural.used is None else failed
    found = [ok(_RUNTIME, ", ".join(neural.installed))]
    if neural.missing is not None:
        found = [broken(_RUNTIME, *_parted(neural.missing))]
    elif neural.broken is not None:
        found = [broken(_RUNTIME, neural.broken, _reinstall(neural.broken))]
    if neural.bad:
        (voice, words, step), *others = neural.bad
        more = f"; and something is wrong with {some(tuple(each[0] for each in others))}" if others else ""
        found.append(warning(_FILES, f"{voice}: {words}{more}", step))
    elif neural.good:
        found.append(ok(_FILES, f"as they should be: {some(neural.good)}"))
    if tried is not None and tried.speed is not None and _given_up(told):
        return [*found, *judge_told(told)]  # as it was then, and is no more
    return found if tried is None else [*found, _tried(neural.used or "", tried, broken)]


def _reinstall(words: str) -> str:
    """Return what to do about a package that cannot be imported."""
    if _LATE in words:
        return "run talk doctor again when this machine is less busy"
    if "SIGILL" in words:
        return "this processor is too old for that version: install an older one, or use an espeak voice"
    return _REINSTALL


def _tried(used: str, tried: Tried, broken: Callable[[str, str, str], Finding]) -> Finding:
    if tried.speed is None:
        words = tried.words or "it was not spoken with"
        return broken(_VOICE, f"{used} is in use: {words}", tried.step or _CHOOSE)
    facts = [] if tried.loaded is None else [f"loaded in {tried.loaded:.1f} s"]
    facts.append(f"makes a sentence {tried.speed:.1f} times as fast as it is heard")
    facts += [] if tried.memory is None else [f"takes {tried.memory / 1e6:.0f} MB with its engine"]
    words = f"{used} is in use: {', '.join(facts)}"
    if tried.speed < _FAST_ENOUGH:
        step = "choose a voice whose quality is low or x_low, or one of espeak's: talk set --voice en"
        return warning(_VOICE, f"{words}: this machine is too slow for it, or too busy", step)
    return ok(_VOICE, words)
