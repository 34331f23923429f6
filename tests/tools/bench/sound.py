"""Rows about sound: the times until it is heard, stops, pauses or is replaced, and the gaps between sentences."""

from __future__ import annotations

import contextlib
import subprocess
import time
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from talkcli import Client, State
from tests.support.compare import extent
from tests.support.espeak import RATE
from tests.support.recording import LOUD
from tests.support.reference import render
from tests.tools.bench.harness import PYTHON, SHORT, TALK, VOICED, serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from tests.support.recording import Samples
    from tests.tools.bench.harness import Action, Harness

#: Text for `onset`. Its first 11 ms are quiet.
TEXT = "battery low"
_PYTTSX3 = f"import pyttsx3; engine = pyttsx3.init(); engine.say({TEXT!r}); engine.runAndWait()"
#: Factor for a cancel on an open connection, because its 99th percentile has a limit.
_MORE_ROUNDS = 7
#: Sentences without pauses as long as those between sentences.
_QUEUED = ("battery low", "coming home", "all is well", "moving along")
#: Shortest pause between sentences. espeak-ng's pauses take 235 ms.
_PAUSE_SAMPLES = RATE * 150 // 1000
LONG_TEXT = ("I am ready to go. We are leaving now. Please follow me. " * 200)[:10_000]
#: The first words of the long text.
_TEN = "I am ready"


def onset(harness: Harness) -> list[Row]:
    """Measure all ways to speak a text."""
    with _lines(harness) as line:
        subjects: dict[str, Action] = {
            "talk say -w": harness.command(TALK, "say", "-w", "--", TEXT),
            "Client.say": partial(_say_whole, harness.client, TEXT),
            "--lines": line,
        }
        if harness.has_peers:
            subjects["spd-say -w"] = harness.command("spd-say", "-w", TEXT)
            subjects["pyttsx3 script"] = harness.command(PYTHON, "-c", _PYTTSX3)
            subjects["espeak-ng"] = harness.command("espeak-ng", "-s", "200", TEXT)
        times = harness.in_turn({name: partial(harness.until_sound, action) for name, action in subjects.items()})

    def row(name: str, subject: str, peer: str, *limits: Limit) -> Row:
        return Row(f"{name} → first sample", "ms", times[subject], peer, times.get(peer, ()), limits)

    return [
        row("start of `talk say -w`", "talk say -w", "spd-say -w", Limit("ratio", 1.25)),
        row("start of `talk say -w`", "talk say -w", "pyttsx3 script", Limit("ratio", 0.6)),
        row("start of `talk say -w`", "talk say -w", "espeak-ng"),
        row("line into a running `talk say --lines`", "--lines", "spd-say -w", Limit("ratio", 0.6)),
        row("`Client.say()`", "Client.say", "spd-say -w", Limit("ratio", 0.25), Limit("median", 5)),
    ]


def at_once(harness: Harness) -> list[Row]:
    """Measure a text that starts with sound, and the start of an interpreter for comparison."""
    subjects: dict[str, Action] = {
        "talk say -w": harness.command(TALK, "say", "-w", "--", SHORT),
        "Client.say": partial(_say_whole, harness.client, SHORT),
    }
    if harness.has_peers:
        subjects["spd-say -w"] = harness.command("spd-say", "-w", SHORT)
    silent = {"python": partial(harness.until_end, [PYTHON, "-c", "pass"])}
    times = harness.in_turn({name: partial(harness.until_sound, action) for name, action in subjects.items()} | silent)
    spd = times.get("spd-say -w", ())
    whole, library = f"start of `talk say -w {SHORT}`", f'`Client.say("{SHORT}")`'
    above, ratio = Limit("above", 8), Limit("ratio", 0.45)
    return [
        Row(f"{whole} → first sample", "ms", times["talk say -w"], "python -c pass", times["python"], (above,)),
        Row(f"{library} → first sample", "ms", times["Client.say"], "spd-say -w", spd, (ratio,)),
    ]


def cancel(harness: Harness) -> list[Row]:
    say, spd = partial(_say, harness.client), "spd-say"
    subjects = {"talk": partial(harness.until_silence, say, harness.command(TALK, "cancel"))}
    if harness.has_peers:
        hush = harness.command(spd, "-S")
        subjects[spd] = partial(harness.until_silence, harness.command(spd, VOICED), hush)
    times = harness.in_turn(subjects)
    name = "start of `talk cancel` → silence"
    return [Row(name, "ms", times["talk"], "spd-say -S", times.get(spd, ()), (Limit("ratio", 0.9),))]


def connection(harness: Harness) -> list[Row]:
    """Measure a cancel on an open connection, also while the sound server is stopped."""

    def stop() -> Callable[[], object]:
        harness.client.cancel()
        return int

    silent = partial(harness.until_silence, partial(_say, harness.client), stop)
    times = harness.in_turn({"silent": silent}, harness.options.rounds * _MORE_ROUNDS)
    times |= harness.in_turn({state: partial(_cancel_returns, harness, state) for state in ("running", "stopped")})
    limits = Limit("median", 2), Limit("p99", 20)
    name = "`Client.cancel()` → return, while the sound server is stopped"
    return [
        Row("cancel on an open connection → silence", "ms", times["silent"], limits=limits),
        Row(name, "ms", times["stopped"], "running", times["running"], (Limit("above", 5),)),
    ]


def pause(harness: Harness) -> list[Row]:

    def start_pause() -> Callable[[], object]:
        harness.client.pause()
        return end_pause

    def end_pause() -> None:
        harness.client.cancel()
        harness.client.resume()

    times = harness.in_turn({"pause": partial(harness.until_silence, partial(_say, harness.client), start_pause)})
    return [Row("pause on an open connection → silence", "ms", times["pause"], limits=(Limit("p99", 60),))]


def preempt(harness: Harness) -> list[Row]:
    """Measure a preempting goal on an open connection."""
    times = harness.in_turn({"preempt": harness.until_preempted}, harness.options.rounds * 2)
    name = "request of a preempting goal → first sound of its sentence"
    return [Row(name, "ms", times["preempt"], limits=(Limit("median", 10),))]


def gap(harness: Harness) -> list[Row]:
    """Measure the pauses between queued sentences, without espeak-ng's own pauses."""
    rounds = max(1, harness.options.rounds // 3)  # each has three pauses
    pauses: list[float] = []
    peer_pauses: list[float] = []
    # espeak-ng renders a sentence differently each time, so the reference must contain all sentences of this server.
    references = render([*_QUEUED] * (rounds + 1))
    with serving(sink=harness.sink) as talk, Client(talk.socket) as client:
        for number in range(rounds + 1):
            expected = references[number * len(_QUEUED) :][: len(_QUEUED)]
            harness.jitter()
            measured = _pauses(harness, expected, partial(client.say, follow=False))
            # With the priority "message", sentences queue. With the default, "text", each replaces the previous one.
            spd = lambda text: harness.until_end(["spd-say", "-P", "message", text])  # noqa: E731
            peer = _pauses(harness, expected, spd) if harness.has_peers else []
            if number:  # the first round only warms up
                pauses += measured
                peer_pauses += peer
    name = "end of a sentence → start of the next one, without espeak-ng's own pause"
    limits = Limit("median", 5), Limit("median", -5, at_least=True), Limit("least", -10, at_least=True)
    return [Row(name, "ms", pauses, "spd-say", peer_pauses, limits)]


def long_text(harness: Harness) -> list[Row]:
    """Measure the onset of a long text, compared with a short text."""
    subjects = {text: partial(_say_and_cancel, harness.client, text) for text in (_TEN, LONG_TEXT)}
    times = harness.in_turn({text: partial(harness.until_sound, action) for text, action in subjects.items()})
    name = "`Client.say()` of 10,000 characters → first sample"
    return [Row(name, "ms", times[LONG_TEXT], "10 characters", times[_TEN], (Limit("ratio", 1.3),))]


def silences(samples: Samples, shortest: int) -> list[tuple[int, int]]:
    """Return the start and end of each silence between two sounds that has more than `shortest` samples."""
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    return [(int(loud[index]) + 1, int(loud[index + 1])) for index in np.flatnonzero(np.diff(loud) > shortest)]


def _say(client: Client) -> Callable[[], object]:
    return partial(client.say(VOICED).wait, 10)


def _say_whole(client: Client, text: str) -> Callable[[], object]:
    goal = client.say(text)

    def end() -> None:
        assert goal.wait(10).state is State.SUCCEEDED

    return end


def _say_and_cancel(client: Client, text: str) -> Callable[[], object]:
    return client.say(text).cancel


def _cancel_returns(harness: Harness, sound_server: str) -> float:
    with harness.sink.record() as recording:
        harness.client.say(VOICED)
        recording.wait_for_sound()
        if sound_server == "stopped":
            harness.sink.freeze()
        started_at = time.monotonic()
        try:
            harness.client.cancel()
            return time.monotonic() - started_at
        finally:
            harness.sink.thaw()
            recording.wait_until_quiet(0.3)


def _pauses(harness: Harness, expected: Sequence[Samples], say: Callable[[str], object]) -> list[float]:
    """Return the milliseconds by which each pause between queued sentences is longer than in the references."""
    with harness.sink.record() as recording:
        for text in _QUEUED:
            say(text)
        recording.wait_for_sound()
        recording.wait_until_quiet(0.6)
    pauses = silences(recording.samples, _PAUSE_SAMPLES)
    assert len(pauses) == len(_QUEUED) - 1, f"{len(pauses) + 1} sentences were heard"
    sounds = [extent(samples) or (0, 0) for samples in expected]
    lengths = [len(samples) for samples in expected]
    own = [length - end + start for length, ((_, end), (start, _)) in zip(lengths, pairwise(sounds), strict=False)]
    return [1000 * (end - start - quiet) / RATE for (start, end), quiet in zip(pauses, own, strict=True)]


@contextlib.contextmanager
def _lines(harness: Harness) -> Iterator[Action]:
    """Run `talk say --lines`, and yield the action that writes a line to its input."""
    with subprocess.Popen(
        [TALK, "say", "--lines"], env=harness.env, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, bufsize=0
    ) as process:
        assert process.stdin
        pipe = process.stdin

        def line() -> Callable[[], object]:
            pipe.write(f"{TEXT}\n".encode())
            return wait

        def wait() -> None:
            for goal in harness.client.follow():  # the quiet end of the sentence
                goal.wait(10)

        try:
            yield line
        finally:
            process.kill()
