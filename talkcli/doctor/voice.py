"""The voice checks: Python, pyttsx3, libespeak-ng and neural voices.

Most facts come from an engine process that the doctor starts. The doctor itself loads neither libraries nor voices, so
that a faulty one can't crash it.

Neural voices are only examined if one is installed or in use. Only the voice in use is loaded and timed, because
loading takes memory and some seconds.
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
from talkcli.doctor.report import WARNING, Finding, failure, join_names, ok, warning
from talkcli.doctor.sound import run_program
from talkcli.engine import models, protocol
from talkcli.engine.parent.process import EngineFailed, PrivateEngine
from talkcli.frozen import frozen
from talkcli.goals.options import NEURAL_PREFIX
from talkcli.goals.reasons import Reason
from talkcli.peers import read_proc_file

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

#: The sentence that the doctor speaks, and its speed in words per minute.
SENTENCE_TEXT, SENTENCE_RATE_WPM = "If you hear this, talk works.", 200
#: The states in which a server's engine works.
WORKING_STATES = ("ready", "starting")
#: The commands to show if a package is missing.
INSTALL_LIBRARY = install.espeak_command()
_INSTALL_PYTTSX3 = install.command("pyttsx3")
_INSTALL_NEURAL = install.neural_command()

#: Advice if libespeak-ng can't be used, by a part of the engine's message or by the reason for the failure.
_LIBRARY_ADVICE = {
    "espeak-ng data": "sudo apt-get install -y espeak-ng-data",
    "libespeak-ng": INSTALL_LIBRARY,
    Reason.ENGINE_CRASHED: "install it again: sudo apt-get install --reinstall -y libespeak-ng1 espeak-ng-data",
    # libespeak-ng connects to PulseAudio when it starts, even if it doesn't play anything.
    Reason.ENGINE_HUNG: "if the sound server hangs (see below), restart it, because libespeak-ng waits for it",
}
_PACKAGES_CHECK, _FILES_CHECK, _NEURAL_CHECK = "neural", "voice files", "neural voice"
#: The minimum speed of a neural voice, as a multiple of real time. If a voice is slower, other programs on the machine
#: can cause gaps in its speech.
_MIN_REAL_TIME_FACTOR = 1.3
#: A program that tries to import a package. It runs in a separate process, because onnxruntime can crash on an old
#: processor. It ignores the current directory, and prints only the last line of a traceback.
_IMPORT_PROGRAM = "import sys; sys.tracebacklimit = 0; sys.path[:] = filter(None, sys.path); import "
#: Time limit for an import, which is slow from an SD card.
_IMPORT_LIMIT_S = 10.0
_IMPORT_TIMED_OUT = f"it takes more than {_IMPORT_LIMIT_S:g} s"
#: Advice if a package can't be imported, by a part of the error message. The advice for "" is the default.
_IMPORT_ADVICE = {
    _IMPORT_TIMED_OUT: "run talk doctor again when this machine is less busy",
    "SIGILL": "this processor is too old for that version: install an older version, or use an espeak voice",
    "": f"install it again: {install.neural_command(reinstall=True)}",
}
_CHOOSE_ESPEAK = "choose an espeak voice: talk set --voice en, or talk serve --voice en"


@frozen
class EngineOptions:
    """Options for starting an engine process."""

    player: str | None = None
    device: str | None = None
    voice: str | None = None
    driver: str | None = None
    #: the player to try first, if `player` is None
    first_player: str | None = None
    #: environment of the engine process, or None for this process's environment
    env: Mapping[str, str] | None = None
    #: descriptors that interrupt any wait, as in `wait_ready`
    interrupt: Mapping[int, int] | None = None


@frozen
class EngineReport:
    """What an engine process reported when it started, or why it could not start."""

    #: the engine's first message, or None if the engine did not start
    ready: protocol.Ready | None = None
    #: ids of the voices, or None if the engine did not list them
    voices: tuple[str, ...] | None = None
    #: the machine-readable reason why the engine did not start, or None if it did
    reason: str | None = None
    message: str = ""


@frozen
class VoiceTrial:
    """The loading time, speed and memory use of a neural voice, or the reason why it failed."""

    #: loading time in seconds, or None if the voice was not loaded
    load_s: float | None = None
    #: seconds of speech synthesized per second, or None if the voice failed
    speed: float | None = None
    #: memory used by the engine process after speaking, or None if unknown
    memory_bytes: int | None = None
    #: why the voice failed, and what the user should do next
    fault: tuple[str, str] = ("", "")


def installed_version(package: str) -> str | None:
    """Return the version of a package without importing it. Return None if it isn't installed."""
    with contextlib.suppress(PackageNotFoundError):
        return version(package)
    return None


def start_engine(options: EngineOptions, limit: float = math.inf, wav_fd: int | None = None) -> PrivateEngine:
    """Start an engine process. Return the object that controls it.

    Args:
        options: the options of the engine.
        limit: seconds after which waiting for the process raises TimeoutError.
        wav_fd: descriptor to which the sound is written as a WAV file instead of being played. The engine then lists no
            voices.
    """
    given = options.driver, options.player, options.device, options.voice
    configure = protocol.Configure(
        os.getpid(), *given, list_voices=wav_fd is None, output_fd=wav_fd, last_player=options.first_player
    )
    deadline = time.monotonic() + limit
    return PrivateEngine(configure, env=options.env, deadline=deadline, interrupt=options.interrupt)


def probe_engine(options: EngineOptions) -> EngineReport:
    """Start an engine process and end it. Return what it reported, or why it could not start."""
    ready = None
    try:
        with start_engine(options) as engine:
            ready = engine.wait_for(protocol.Ready)
            return EngineReport(ready, tuple(each.id for each in engine.wait_for(protocol.VoiceList).voices))
    except EngineFailed as error:
        if ready is None or error.reason == Reason.ENGINE_CRASHED:
            reason, message = explain_failure(error)
            return EngineReport(reason=reason, message=message)
    return EngineReport(ready)  # the engine started, but didn't list its voices


def explain_failure(error: EngineFailed) -> tuple[str, str]:
    """Return why an engine failed: a machine-readable reason and a message.

    The reason is `engine_hung` if the engine stopped responding.
    """
    if error.silent_s is not None:
        return Reason.ENGINE_HUNG, f"the engine process did not respond for {error.silent_s:g} s"
    return error.reason, str(error)


def judge_python() -> Finding:
    """Return a finding that states the version and the path of Python."""
    return ok("python", f"Python {platform.python_version()} ({sys.executable})")


def judge_engine(pyttsx3_version: str | None, report: EngineReport, *, server_engine: str | None) -> list[Finding]:
    """Return the findings about pyttsx3, libespeak-ng and the voices, based on an engine's report.

    Args:
        pyttsx3_version: version of pyttsx3, or None if it is not installed.
        report: the report of the doctor's engine process.
        server_engine: the state of the server's engine, or None if there is no server. If that engine works, faults
            of the doctor's own engine are only warnings.
    """
    broken = warning if server_engine in WORKING_STATES else failure
    if report.ready is not None and server_engine not in {None, *WORKING_STATES}:
        report = EngineReport(reason=Reason.ENGINE_FAILED, message=f"the server's engine: {server_engine}")
    if report.ready is not None:
        words = f"{pyttsx3_version or 'unknown version'}, driver {report.ready.driver}"
        return [ok("pyttsx3", words), *_judge_library(report.ready.version, report.voices)]
    message = report.message.partition("; install it with: ")[0]  # the finding shows the advice separately
    if "pyttsx3 is missing" in message or pyttsx3_version is None:
        return [broken("pyttsx3", message or "pyttsx3 is missing", _INSTALL_PYTTSX3)]
    found = ok("pyttsx3", pyttsx3_version)
    if report.reason == Reason.UNKNOWN_VOICE:
        step = "set TALK_VOICE or --voice to a voice that 'talk voices' lists"
        step = _INSTALL_NEURAL if _INSTALL_NEURAL in report.message else step
        return [found, ok("libespeak-ng", "loaded"), broken("voices", message, step)]
    clue = next((each for each in _LIBRARY_ADVICE if each in message or each == report.reason), "")
    if clue == Reason.ENGINE_CRASHED:
        message = f"the engine process crashed while it loaded the library: {message}"
    step = _LIBRARY_ADVICE.get(clue, "read the engine's error messages in the log of talk serve")
    return [found, broken("libespeak-ng", message, step)]


def _judge_library(library_version: str | None, voices: tuple[str, ...] | None) -> list[Finding]:
    """Return the findings about libespeak-ng's version and the number of voices."""
    found = [] if library_version is None else [ok("libespeak-ng", f"{library_version}, with its data")]
    if voices is None:
        return [*found, warning("voices", "the engine did not list its voices in time", "run talk doctor again")]
    if not voices:
        step = "sudo apt-get install --reinstall -y espeak-ng-data"
        return [*found, warning("voices", "the engine has no voices", step)]
    return [*found, ok("voices", f"{len(voices)} voices; list them with: talk voices")]


def check_neural(
    used_voice: str | None, options: EngineOptions, limit: float, server_voices: dict[str, Any] | None
) -> Iterator[Finding]:
    """Check the packages and files of neural voices, and try the voice in use. Yield the findings.

    Args:
        used_voice: the voice in use, as the user wrote it, or None if no neural voice is in use.
        options: options for the engine process.
        limit: time limit for trying the voice, in seconds.
        server_voices: the server's description of its neural voices, or None if there is no server. A server speaks
            with espeak if a neural voice fails.
    """
    broken = failure if used_voice is not None and server_voices is None else warning
    fault = _find_package_fault(os.environ if options.env is None else options.env)
    if fault is None:
        yield ok(_PACKAGES_CHECK, ", ".join(map(_with_version, install.NEURAL_PACKAGES)))
    else:
        yield broken(_PACKAGES_CHECK, *fault)
    yield from _check_voice_files(options.env)
    if used_voice is not None and fault is None:
        yield judge_trial(used_voice, _try_voice(used_voice, options, limit), server_voices)


def _check_voice_files(env: Mapping[str, str] | None) -> Iterator[Finding]:
    """Check the files of all installed neural voices. Yield one finding if there are any voices."""
    valid, invalid = [], []
    for name, path in models.find_models(env).items():
        try:
            models.read_description(path)
            models.open_checked(path).close()
            valid.append(NEURAL_PREFIX + name)
        except models.VoiceFileError as error:
            invalid.append((NEURAL_PREFIX + name, str(error)))
    if invalid:
        (voice, error_message), *others = invalid
        message, step = _split_advice(error_message)
        names = join_names([each for each, _ in others])
        more = f"; also faulty: {names}" if others else ""
        yield warning(_FILES_CHECK, f"{voice}: {message}{more}", step)
    elif valid:
        yield ok(_FILES_CHECK, f"the files of {join_names(valid)} are complete and safe")


def _find_package_fault(env: Mapping[str, str]) -> tuple[str, str] | None:
    """Try to import the packages for neural voices. Return a fault with advice, or None."""
    missing = models.missing_package()
    if missing is not None:
        return _split_advice(missing)
    env = {**env, **models.PACKAGE_VARIABLES}
    fault = None
    for package in install.NEURAL_PACKAGES:  # the first package imports numpy, which may be the faulty one
        output = run_program(sys.executable, "-c", _IMPORT_PROGRAM + package, env=env, limit=_IMPORT_LIMIT_S)
        if output.error is None:
            break
        message = f"{_with_version(package)} cannot be imported: "
        message += _IMPORT_TIMED_OUT if output.timed_out else output.error
        fault = message, next(step for clue, step in _IMPORT_ADVICE.items() if clue in message)
    return fault


def _with_version(package: str) -> str:
    """Return the name and version of an installed package."""
    return f"{package} {installed_version(package) or '(unknown version)'}"


def _split_advice(message: str) -> tuple[str, str]:
    """Split an error message into the fault and the advice.

    The default advice is to choose another voice.
    """
    what, semicolon, step = message.rpartition("; ")
    return (what, step.partition("it with: ")[2] or step) if semicolon else (message, _CHOOSE_ESPEAK)


def _try_voice(voice: str, options: EngineOptions, limit: float) -> VoiceTrial:
    """Load a voice, and measure how fast it synthesizes speech. Return the figures or the fault.

    Nothing is played.
    """
    try:
        with open(os.devnull, "wb") as output, start_engine(options, limit, output.fileno()) as engine:
            engine.wait_for(protocol.Ready)
            ended, load_s = _speak(engine, voice, "a")  # speaking for the first time also loads the voice
            began = time.monotonic()
            if ended.outcome == protocol.OUTCOME_COMPLETED:
                ended, _ = _speak(engine, voice, SENTENCE_TEXT)
            if ended.outcome != protocol.OUTCOME_COMPLETED or ended.duration is None:
                return VoiceTrial(fault=_split_advice(ended.message or "the sentence was not completed"))
            speed = ended.duration / (time.monotonic() - began)
            return VoiceTrial(load_s, speed, _memory_of(engine._process.pid))
    except EngineFailed as error:
        return VoiceTrial(fault=(explain_failure(error)[1], _CHOOSE_ESPEAK))
    except TimeoutError:
        return VoiceTrial(fault=(f"loading and speaking took more than {limit:g} s", _CHOOSE_ESPEAK))


def _speak(engine: PrivateEngine, voice: str, text: str) -> tuple[protocol.Ended, float | None]:
    """Speak a text to its end. Return the `Ended` event and the seconds taken to load the voice.

    The time is None if the voice was already loaded.
    """
    load_s = None
    # Set `voice_only`, because otherwise espeak would speak if the voice isn't loaded.
    engine.speak(protocol.Speak(text, text, SENTENCE_RATE_WPM, 1.0, voice, 50, voice_only=True))
    while True:
        event = next(engine.events)
        if isinstance(event, protocol.VoiceLoaded):
            load_s = event.seconds
        elif isinstance(event, protocol.Ended):
            return event, load_s


def _memory_of(pid: int) -> int | None:
    """Return the resident memory of a process in bytes. Return None if it is unknown."""
    statm = read_proc_file(f"/proc/{pid}/statm")  # the second number is the count of resident pages
    return int(statm.split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm else None


def judge_server_voices(voices: dict[str, Any]) -> list[Finding]:
    """Check whether the server can speak with its neural voices. Return the findings.

    `voices` is the server's description of its neural voices.
    """
    for voice, each in voices.items():
        if each.get("state") == "failed":
            step = f"try to load the voice again: talk set --voice {voice}"
            return [warning(_NEURAL_CHECK, f"the server cannot speak with the voice {voice}: {each.get('why')}", step)]
    return [ok(_NEURAL_CHECK, f"the server's neural voices: {join_names(list(voices))}")] if voices else []


def judge_trial(voice: str, trial: VoiceTrial, server_voices: dict[str, Any] | None) -> Finding:
    """Check how a neural voice performed in a trial. Return the finding.

    The other arguments are those of `check_neural`.
    """
    broken = failure if server_voices is None else warning
    words = f"{voice} is in use: "
    if trial.speed is None:
        message, step = trial.fault
        return broken(_NEURAL_CHECK, words + message, step)
    for found in judge_server_voices(server_voices or {}):
        if found.state == WARNING:
            return found  # the doctor could load the voice, but the server couldn't
    facts = [] if trial.load_s is None else [f"loaded in {trial.load_s:.1f} s"]
    facts.append(f"speaks {trial.speed:.1f} times as fast as real time")
    facts += [] if trial.memory_bytes is None else [f"uses {trial.memory_bytes / 1e6:.0f} MB of memory"]
    words += ", ".join(facts)
    if trial.speed < _MIN_REAL_TIME_FACTOR:
        step = "choose a voice with the quality low or x_low, or an espeak voice: talk set --voice en"
        return warning(_NEURAL_CHECK, f"{words}; this machine is too slow or too busy for this voice", step)
    return ok(_NEURAL_CHECK, words)
