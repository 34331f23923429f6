"""From the start of a command, or from a line or a call on an open connection, to the first sample that is heard.

What is compared takes turns, each round in another order, so that none always follows the same other one. All say the
same text at the same rate, so that its own quiet beginning (that of "battery low" is 11 ms long) is in all times alike.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from talkcli import State
from tests.bench.ear import SHORT, Command, until_silence, until_sound
from tests.bench.failure import FailedError
from tests.bench.table import Limit, Row
from tests.support.espeak import RATE
from tests.support.reference import render

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from talkcli import Client, GoalHandle
    from tests.bench.arithmetic import Samples
    from tests.bench.ear import Action
    from tests.bench.stage import Stage

_SCRIPT = "import pyttsx3; engine = pyttsx3.init(); engine.say({!r}); engine.runAndWait()"
#: Seconds of the tone that is killed.
_TONE = 0.6


def onset(stage: Stage) -> list[Row]:
    """Measure every way to say a word, in turn."""
    with stage.speaking.client() as client, _lines(stage, client) as line:
        times = in_turn(stage, {**_talk(stage, client, line), **(_peers(stage) if stage.options.peers else {})})

    def row(name: str, subject: str, peer: str, *limits: Limit) -> Row:
        return Row("onset", f"{name} → first sample", "ms", times[subject], peer, times.get(peer, ()), limits)

    return [
        row("start of `talk say -w`", "talk say -w", "spd-say -w", Limit("ratio", 1.25)),
        row("start of `talk say -w`", "talk say -w", "pyttsx3 script", Limit("ratio", 0.6)),
        row("start of `talk say -w`", "talk say -w", "espeak-ng"),
        row("line into a running `talk say --lines`", "--lines", "spd-say -w", Limit("ratio", 0.6)),
        row("`Client.say()`", "Client.say", "spd-say -w", Limit("ratio", 0.25), Limit("median", 5)),
        row("start of `aplay` of a ready file", "aplay", "spd-say -w"),
    ]


def at_once(stage: Stage) -> list[Row]:
    """Measure a text that begins with sound: nothing is in these times but what it takes to say it."""
    python: Action = lambda: Command([stage.installed.python, "-c", "pass"], stage.plain).finish  # noqa: E731
    with stage.speaking.client() as client:
        subjects = _ours(stage, client, SHORT)
        peers = {"spd-say -w": _spd(stage, SHORT)} if stage.options.peers else {}
        times = in_turn(stage, {**subjects, **peers}, {"python -c pass": python})

    def row(name: str, subject: str, peer: str, *limits: Limit) -> Row:
        return Row("at-once", f"{name} → first sample", "ms", times[subject], peer, times.get(peer, ()), limits)

    return [
        row(f"start of `talk say -w {SHORT}`", "talk say -w", "python -c pass", Limit("above", 8)),
        row(f'`Client.say("{SHORT}")`', "Client.say", "spd-say -w", Limit("ratio", 0.45)),
    ]


def recorder(stage: Stage) -> list[Row]:
    """Measure what the recorder adds: a sound that is ended by SIGKILL, which takes the system a millisecond."""
    tone = 9000 * np.sin(np.arange(int(_TONE * RATE)) * (2 * np.pi * 441 / RATE))
    command = _ready_made(stage, "tone", tone.astype(np.int16))
    playing: list[Command] = []

    def play() -> Callable[[], object]:
        playing[:] = [Command(command, stage.plain)]
        return partial(playing[0].finish, -signal.SIGKILL)

    def kill() -> Callable[[], object]:
        playing[0].kill()
        return int

    rounds = range(stage.options.rounds + 1)
    times = [until_silence(stage.sink, play, kill, stage.jitter()) for _ in rounds]
    name = "SIGKILL of an `aplay` of a tone → silence"
    return [Row("recorder", name, "ms", milliseconds(times[1:]))]  # the first warmed up


def in_turn(
    stage: Stage, subjects: Mapping[str, Action], silent: Mapping[str, Action] | None = None
) -> dict[str, tuple[float, ...]]:
    """Return the milliseconds of each subject's rounds, after one that warms all of them up.

    Those that are `silent` are timed to their end.
    """
    both = {**subjects, **(silent or {})}
    times: dict[str, list[float]] = {each: [] for each in both}
    names = list(both)
    for number in range(stage.options.rounds + 1):
        for name in stage.shuffled(names):
            seconds = (
                until_sound(stage.sink, both[name], stage.jitter()) if name in subjects else _until_end(both[name])
            )
            if number:
                times[name].append(seconds)
    return {name: milliseconds(each) for name, each in times.items()}


def milliseconds(seconds: list[float]) -> tuple[float, ...]:
    """Return seconds as milliseconds."""
    return tuple(each * 1000 for each in seconds)


def _talk(stage: Stage, client: Client, line: Action) -> dict[str, Action]:
    text = stage.options.text
    ready_made = _ready_made(stage, "rendering", render([text])[0])
    return {
        **_ours(stage, client, text),
        "--lines": line,
        # What a player takes that is started for each sentence: no talk can be sooner with it.
        "aplay": lambda: Command(ready_made, stage.plain).finish,
    }


def _ours(stage: Stage, client: Client, text: str) -> dict[str, Action]:
    command = [stage.installed.talk, "say", "-w", "--", text]
    return {
        "talk say -w": lambda: Command(command, stage.speaking.env).finish,
        "Client.say": lambda: partial(_succeed, client.say(text)),
    }


def _spd(stage: Stage, text: str) -> Action:
    return lambda: Command(["spd-say", "-w", text], stage.spd).finish


def _peers(stage: Stage) -> dict[str, Action]:
    plain, text = stage.plain, stage.options.text
    return {
        "spd-say -w": _spd(stage, text),
        "pyttsx3 script": lambda: Command([stage.installed.python, "-c", _SCRIPT.format(text)], plain).finish,
        "espeak-ng": lambda: Command(["espeak-ng", "-s", "200", text], plain).finish,
    }


def _until_end(begin: Action) -> float:
    began = time.monotonic()
    begin()()
    return time.monotonic() - began


def _succeed(goal: GoalHandle) -> None:
    ended = goal.wait(10)
    if ended.state is not State.SUCCEEDED:
        raise FailedError(f"{ended.id}: {ended.message}")


def _ready_made(stage: Stage, name: str, samples: Samples) -> list[str]:
    """Return the command that plays samples from a file of this name."""
    path = f"{stage.sink.directory}/{name}"
    with open(path, "wb") as file:
        file.write(samples.astype("<i2").tobytes())
    return ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", str(RATE), "-c", "1", path]


@contextlib.contextmanager
def _lines(stage: Stage, client: Client) -> Iterator[Action]:
    """Run `talk say --lines`; gives what writes a line to it."""
    process = subprocess.Popen(
        [stage.installed.talk, "say", "--lines"],
        env=stage.speaking.env,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        bufsize=0,
    )

    def line() -> Callable[[], object]:
        assert process.stdin
        process.stdin.write(f"{stage.options.text}\n".encode())
        return ended

    def ended() -> None:
        # It is not over when its sound is: its quiet end is played, too, and the next one would wait for that.
        for each in client.follow():
            each.wait(10)

    try:
        yield line
    finally:
        assert process.stdin
        process.stdin.close()
        process.kill()
        process.wait()
