"""Rows of what is heard: when a sentence begins, stops, is held or replaced, and the pause between two of them."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import time
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from talkcli import Client, State
from tests.support.compare import extent
from tests.support.espeak import RATE
from tests.support.neural_server import await_voice
from tests.support.real_voice import REAL_VOICE
from tests.support.recording import LOUD
from tests.support.reference import render
from tests.support.surroundings import short_directory
from tests.support.usage import descendants
from tests.tools.bench.machine import megabytes
from tests.tools.bench.stage import PYTHON, SHORT, TALK, VOICED, finish, serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from tests.support.recording import Samples
    from tests.tools.bench.stage import Action, Stage

#: The text of the rows of `onset`: its first 11 ms are quiet.
TEXT = "battery low"
_PYTTSX3 = f"import pyttsx3; engine = pyttsx3.init(); engine.say({TEXT!r}); engine.runAndWait()"
#: Seconds of the tone that is killed.
_TONE_S = 0.6
#: A cancel on an open connection is short, and its 99th percentile counts, so that it has more rounds.
_MORE_ROUNDS = 7
#: Sentences without a pause that is as long as the one between two of them.
_QUEUED = ("battery low", "coming home", "all is well", "moving along")
#: Samples of quiet that are a pause between sentences; that of espeak-ng is 235 ms long.
_PAUSE_SAMPLES = RATE * 150 // 1000
LONG_TEXT = ("I am ready to go. We are leaving now. Please follow me. " * 200)[:10_000]
#: Begins with the same words as the long text.
_TEN = "I am ready"
_THIRTY = (
    "I have found the small red box on the table in the kitchen and will bring it to you now, "
    "please keep the door open and wait for me there"
)
#: Milliseconds by which a neural voice may begin later than espeak-ng's.
_NEURAL_LATER_MS = {TEXT: 110, _THIRTY: 260}
#: By its id: in a server that has a neural voice for it, "en" is that voice.
_ESPEAK = "gmw/en"
#: Megabytes of the engine process: with the neural voice loaded, and after long texts.
_LOADED_MB, _AFTER_TEXTS_MB = 260, 340
_TEXTS, _LONG_PATIENCE_S = 10, 600.0


def recorder(stage: Stage) -> list[Row]:
    """Measure what the recorder adds: the sound of a player that is killed ends within a millisecond."""
    tone = 9000 * np.sin(np.arange(int(_TONE_S * RATE)) * (2 * np.pi * 441 / RATE))
    command = _player(stage, "tone", tone)
    playing: list[subprocess.Popen[bytes]] = []

    def play() -> Callable[[], object]:
        playing[:] = [stage.start(command)]
        return partial(finish, playing[0], -signal.SIGKILL)

    def kill() -> Callable[[], object]:
        playing[0].kill()
        return int

    times = stage.in_turn({"killed": partial(stage.until_silence, play, kill)})
    return [Row("SIGKILL of `aplay`, which plays a tone → silence", "ms", times["killed"])]


def onset(stage: Stage) -> list[Row]:
    """Measure each way to say a text."""
    with _lines(stage) as line:
        subjects: dict[str, Action] = {
            "talk say -w": stage.command(TALK, "say", "-w", "--", TEXT),
            "Client.say": partial(_say_whole, stage.client, TEXT),
            "--lines": line,
            "aplay": stage.command(*_player(stage, "rendering", render([TEXT])[0])),
        }
        if stage.has_peers:
            subjects["spd-say -w"] = stage.command("spd-say", "-w", TEXT)
            subjects["pyttsx3 script"] = stage.command(PYTHON, "-c", _PYTTSX3)
            subjects["espeak-ng"] = stage.command("espeak-ng", "-s", "200", TEXT)
        times = stage.in_turn({name: partial(stage.until_sound, each) for name, each in subjects.items()})

    def row(name: str, subject: str, peer: str, *limits: Limit) -> Row:
        return Row(f"{name} → first sample", "ms", times[subject], peer, times.get(peer, ()), limits)

    return [
        row("start of `talk say -w`", "talk say -w", "spd-say -w", Limit("ratio", 1.25)),
        row("start of `talk say -w`", "talk say -w", "pyttsx3 script", Limit("ratio", 0.6)),
        row("start of `talk say -w`", "talk say -w", "espeak-ng"),
        row("line into a running `talk say --lines`", "--lines", "spd-say -w", Limit("ratio", 0.6)),
        row("`Client.say()`", "Client.say", "spd-say -w", Limit("ratio", 0.25), Limit("median", 5)),
        row("start of `aplay` with a finished file", "aplay", "spd-say -w"),
    ]


def at_once(stage: Stage) -> list[Row]:
    """Measure a text that begins with sound, beside the start of an interpreter."""
    subjects: dict[str, Action] = {
        "talk say -w": stage.command(TALK, "say", "-w", "--", SHORT),
        "Client.say": partial(_say_whole, stage.client, SHORT),
    }
    if stage.has_peers:
        subjects["spd-say -w"] = stage.command("spd-say", "-w", SHORT)
    silent = {"python": partial(stage.until_end, [PYTHON, "-c", "pass"])}
    times = stage.in_turn({name: partial(stage.until_sound, each) for name, each in subjects.items()} | silent)
    spd = times.get("spd-say -w", ())
    whole, library = f"start of `talk say -w {SHORT}`", f'`Client.say("{SHORT}")`'
    above, ratio = Limit("above", 8), Limit("ratio", 0.45)
    return [
        Row(f"{whole} → first sample", "ms", times["talk say -w"], "python -c pass", times["python"], (above,)),
        Row(f"{library} → first sample", "ms", times["Client.say"], "spd-say -w", spd, (ratio,)),
    ]


def cancel(stage: Stage) -> list[Row]:
    """Measure the commands that stop a sentence."""
    say, spd = partial(_say, stage.client), "spd-say"
    subjects = {"talk": partial(stage.until_silence, say, stage.command(TALK, "cancel"))}
    if stage.has_peers:
        hush = stage.command(spd, "-S")
        subjects[spd] = partial(stage.until_silence, stage.command(spd, VOICED), hush)
    times = stage.in_turn(subjects)
    name = "start of `talk cancel` → silence"
    return [Row(name, "ms", times["talk"], "spd-say -S", times.get(spd, ()), (Limit("ratio", 0.9),))]


def connection(stage: Stage) -> list[Row]:
    """Measure a cancel on an open connection, and its return if the sound server is stopped."""

    def stop() -> Callable[[], object]:
        stage.client.cancel()
        return int

    silent = partial(stage.until_silence, partial(_say, stage.client), stop)
    times = stage.in_turn({"silent": silent}, stage.options.rounds * _MORE_ROUNDS)
    times |= stage.in_turn({each: partial(_cancel_returns, stage, each) for each in ("running", "stopped")})
    limits = Limit("median", 2), Limit("p99", 20)
    name = "`Client.cancel()` → return, while the sound server is stopped"
    return [
        Row("cancel on an open connection → silence", "ms", times["silent"], limits=limits),
        Row(name, "ms", times["stopped"], "running", times["running"], (Limit("above", 5),)),
    ]


def pause(stage: Stage) -> list[Row]:
    """Measure a pause on an open connection."""

    def hold() -> Callable[[], object]:
        stage.client.pause()
        return go_on

    def go_on() -> None:
        stage.client.cancel()
        stage.client.resume()

    times = stage.in_turn({"pause": partial(stage.until_silence, partial(_say, stage.client), hold)})
    return [Row("pause on an open connection → silence", "ms", times["pause"], limits=(Limit("p99", 60),))]


def preempt(stage: Stage) -> list[Row]:
    """Measure a goal that preempts, on an open connection."""
    times = stage.in_turn({"preempt": stage.until_preempted}, stage.options.rounds * 2)
    name = "request of a preempting goal → first sound of its sentence"
    return [Row(name, "ms", times["preempt"], limits=(Limit("median", 10),))]


def gap(stage: Stage) -> list[Row]:
    """Measure the pauses between queued sentences, above those of espeak-ng."""
    rounds = max(1, stage.options.rounds // 3)  # each has three pauses
    ours: list[float] = []
    theirs: list[float] = []
    # espeak-ng says no sentence twice alike in one process: the reference is all that this server says.
    references = render([*_QUEUED] * (rounds + 1))
    with serving(sink=stage.sink) as talk, Client(talk.socket) as client:
        for number in range(rounds + 1):
            expected = references[number * len(_QUEUED) :][: len(_QUEUED)]
            stage.jitter()
            found = _pauses(stage, expected, partial(client.say, follow=False))
            # By its priority "message" they queue; by the usual one, "text", each replaces the one before it.
            spd = lambda text: stage.until_end(["spd-say", "-P", "message", text])  # noqa: E731
            peer = _pauses(stage, expected, spd) if stage.has_peers else []
            if number:  # the first warms up
                ours += found
                theirs += peer
    name = "end of a sentence → start of the next one, without espeak-ng's own pause"
    limits = Limit("median", 5), Limit("median", -5, at_least=True), Limit("least", -10, at_least=True)
    return [Row(name, "ms", ours, "spd-say", theirs, limits)]


def long_text(stage: Stage) -> list[Row]:
    """Measure the onset of a long text beside that of a short one."""
    subjects = {each: partial(_say_and_cancel, stage.client, each, None) for each in (_TEN, LONG_TEXT)}
    times = stage.in_turn({text: partial(stage.until_sound, each) for text, each in subjects.items()})
    name = "`Client.say()` of 10,000 characters → first sample"
    return [Row(name, "ms", times[LONG_TEXT], "10 characters", times[_TEN], (Limit("ratio", 1.3),))]


def neural(stage: Stage) -> list[Row]:
    """Measure a neural voice beside espeak-ng's: the onset, and the memory of the engine process."""
    rows = []
    with serving("--voice", REAL_VOICE, sink=stage.sink) as talk, Client(talk.socket) as client:
        await_voice(talk.socket, REAL_VOICE)
        for text, later in _NEURAL_LATER_MS.items():
            say = {each: partial(_say_and_cancel, client, text, each) for each in (REAL_VOICE, _ESPEAK)}
            times = stage.in_turn({voice: partial(stage.until_sound, each) for voice, each in say.items()})
            name = f"`Client.say()` of {len(text.split())} words → first sample, joe"
            rows.append(Row(name, "ms", times[REAL_VOICE], "espeak", times[_ESPEAK], (Limit("above", later),)))
    with short_directory() as place, serving("--voice", REAL_VOICE, "--player", f"file:{place}/x.wav") as talk:
        await_voice(talk.socket, REAL_VOICE)
        (engine,) = descendants(talk.pid)
        name, limit = "memory of the engine process with joe (Pss)", Limit("median", _LOADED_MB)
        rows.append(Row(name, "MB", [megabytes(engine, "Pss")], limits=(limit,)))
        with Client(talk.socket) as client:
            for _ in range(_TEXTS):
                assert client.say(LONG_TEXT).wait(_LONG_PATIENCE_S).state is State.SUCCEEDED
        name, limit = f"… after {_TEXTS} texts of {len(LONG_TEXT):,} characters", Limit("median", _AFTER_TEXTS_MB)
        rows.append(Row(name, "MB", [megabytes(engine, "Pss")], limits=(limit,)))
    return rows


def silences(samples: Samples, shortest: int, level: int = LOUD) -> list[tuple[int, int]]:
    """Return where each silence between two sounds begins and ends, if it has so many samples."""
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > level)
    return [(int(loud[each]) + 1, int(loud[each + 1])) for each in np.flatnonzero(np.diff(loud) > shortest)]


def _say(client: Client) -> Callable[[], object]:
    return partial(client.say(VOICED).wait, 10)


def _say_whole(client: Client, text: str) -> Callable[[], object]:
    goal = client.say(text)

    def end() -> None:
        assert goal.wait(10).state is State.SUCCEEDED

    return end


def _say_and_cancel(client: Client, text: str, voice: str | None) -> Callable[[], object]:
    goal = client.say(text, voice=voice)

    def end() -> None:
        spoken = goal.cancel().voice
        assert voice in (None, spoken), f"{spoken} was heard instead of {voice}"

    return end


def _cancel_returns(stage: Stage, sound_server: str) -> float:
    with stage.sink.record() as recording:
        stage.client.say(VOICED)
        recording.wait_for_sound()
        if sound_server == "stopped":
            stage.sink.freeze()
        began = time.monotonic()
        try:
            stage.client.cancel()
            return time.monotonic() - began
        finally:
            stage.sink.thaw()
            recording.wait_until_quiet(0.3)


def _pauses(stage: Stage, expected: Sequence[Samples], say: Callable[[str], object]) -> list[float]:
    """Return the milliseconds by which each pause between queued sentences is longer than the sentences' own."""
    with stage.sink.record() as recording:
        for each in _QUEUED:
            say(each)
        recording.wait_for_sound()
        recording.wait_until_quiet(0.6)
    found = silences(recording.samples, _PAUSE_SAMPLES)
    assert len(found) == len(_QUEUED) - 1, f"{len(found) + 1} sentences are heard"
    sounds = [extent(each) or (0, 0) for each in expected]
    lengths = [len(each) for each in expected]
    own = [length - end + start for length, ((_, end), (start, _)) in zip(lengths, pairwise(sounds), strict=False)]
    return [1000 * (end - start - quiet) / RATE for (start, end), quiet in zip(found, own, strict=True)]


def _player(stage: Stage, name: str, samples: Samples) -> list[str]:
    """Return the command that plays samples from a file of this name."""
    path = f"{stage.sink.directory}/{name}"
    with open(path, "wb") as file:
        file.write(samples.astype("<i2").tobytes())
    return ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", str(RATE), "-c", "1", path]


@contextlib.contextmanager
def _lines(stage: Stage) -> Iterator[Action]:
    """Run `talk say --lines`, and yield the action that writes a line to it."""
    with subprocess.Popen(
        [TALK, "say", "--lines"], env=stage.env, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, bufsize=0
    ) as process:
        assert process.stdin
        pipe = process.stdin

        def line() -> Callable[[], object]:
            pipe.write(f"{TEXT}\n".encode())
            return ended

        def ended() -> None:
            for each in stage.client.follow():  # its quiet end is played after its last sound
                each.wait(10)

        try:
            yield line
        finally:
            process.kill()
