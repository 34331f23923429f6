"""From a goal to its sound, from a stop or a pause to silence, and from one sentence to the next, by either voice."""

from __future__ import annotations

import time
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

from talkcli import Client
from tests.bench.arithmetic import first_sound, silences
from tests.bench.ear import VOICED, until_silence, until_sound
from tests.bench.failure import FailedError
from tests.bench.onset import milliseconds
from tests.bench.table import Limit, Row
from tests.bench.voices_stage import VOICES
from tests.support.espeak import RATE

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli import Goal
    from tests.bench.arithmetic import Samples
    from tests.bench.ear import Action
    from tests.bench.voices_stage import VoiceStage

SHORT = "battery low"
#: Thirty words, by which a robot says what it does.
THIRTY = (
    "I have found the small red box on the table in the kitchen and will bring it to you now, "
    "please keep the door open and wait for me there"
)
#: How much later than libespeak-ng's a neural voice may be heard, in milliseconds.
_LATER = {SHORT: 110, THIRTY: 260}
#: Samples above this are heard: a hundredth of full scale. The noise of a neural voice's own pauses is fainter.
HEARD = 327
#: Said one after the other, so that each voice follows each.
_CHAIN = ("joe", "joe", "espeak", "espeak", "joe")
_SENTENCES = (SHORT, "coming home", "all is well", "moving along", "I am ready")
#: Samples of quiet that may be a pause.
_QUIET = int(0.06 * RATE)
#: Seconds that a pause between two sentences has.
_SHORTEST, _LONGEST = 200, 350
#: Seconds of a sentence that are heard before it is held, and for which it is.
_BEFORE, _HELD = 0.3, 0.3


def onset(stage: VoiceStage) -> list[Row]:
    """Measure how soon a text is heard."""
    rows = []
    with stage.server() as talk, Client(talk.socket) as client:
        for text, later in _LATER.items():
            found = _in_turn(stage, partial(_until_sound, stage, client, text))
            name = f"`Client.say()` of {len(text.split())} words → first sample, joe"
            rows.append(_beside("onset", name, found, Limit("above", later)))
    return rows


def cancel(stage: VoiceStage) -> list[Row]:
    """Measure how soon a stop is silence."""
    with stage.server() as talk, Client(talk.socket) as client:

        def stop() -> Callable[[], object]:
            client.cancel()
            return int

        found = _in_turn(stage, lambda voice: _until_silence(stage, client, voice, stop))
    return [_beside("cancel", "cancel on an open connection → silence, joe", found, Limit("above", 2))]


def pause(stage: VoiceStage) -> list[Row]:
    """Measure how soon a pause is silence."""
    with stage.server() as talk, Client(talk.socket) as client:

        def hold() -> Callable[[], object]:
            client.pause()

            def go_on() -> None:
                client.cancel()
                client.resume()

            return go_on

        found = _in_turn(stage, lambda voice: _until_silence(stage, client, voice, hold))
    limits = Limit("above", 2), Limit("p99", 150)
    return [_beside("pause", "pause on an open connection → silence, joe", found, *limits)]


def resume(stage: VoiceStage) -> list[Row]:
    """Measure how soon a sentence that is held goes on."""
    with stage.server() as talk, Client(talk.socket) as client:
        found = _in_turn(stage, partial(_resumed, stage, client))
    return [_beside("resume", "resume on an open connection → sound, joe", found, Limit("above", 2))]


def between(stage: VoiceStage) -> list[Row]:
    """Measure the pauses between queued sentences, whichever voices they have."""
    pairs = list(pairwise(_CHAIN))
    found: dict[tuple[str, str], list[float]] = {each: [] for each in pairs}
    with stage.server() as talk, Client(talk.socket) as client:
        for number in range(stage.options.rounds + 1):
            time.sleep(stage.jitter())
            with stage.sink.record() as recording:
                texts = [_SENTENCES[(number + each) % len(_SENTENCES)] for each in range(len(_CHAIN))]
                goals = [client.say(text, voice=VOICES[each]) for text, each in zip(texts, _CHAIN, strict=True)]
                for each, voice in zip(goals, _CHAIN, strict=True):
                    _spoken_with(VOICES[voice], each.wait(20))
                recording.wait_until_quiet(0.3)
            for pair, (begin, end) in zip(pairs, pauses(recording.samples, len(pairs)), strict=True):
                if number:  # the first warmed up
                    found[pair].append((end - begin) / RATE)
    limits = Limit("least", _SHORTEST, at_least=True), Limit("p99", _LONGEST)
    return [
        Row("between", f"last sound of {first} → first of {second}, queued", "ms", milliseconds(each), limits=limits)
        for (first, second), each in found.items()
    ]


def pauses(samples: Samples, many: int) -> list[tuple[int, int]]:
    """Return so many pauses, in their order: where each begins, and where it is loud again. FailedError if fewer.

    A closure within a word is quiet, too, but not for as long as a pause: so they are the longest.
    """
    found = sorted(silences(samples, _QUIET, HEARD), key=lambda each: each[0] - each[1])[:many]
    if len(found) < many:
        raise FailedError(f"{len(found)} pauses are heard, not {many}")
    return sorted(found)


def _in_turn(stage: VoiceStage, measure: Callable[[str], float]) -> dict[str, tuple[float, ...]]:
    """Return the milliseconds of each voice's rounds, after one that warms both up."""
    found: dict[str, list[float]] = {each: [] for each in VOICES}
    for number in range(stage.options.rounds + 1):
        for name in stage.shuffled([*VOICES]):
            time.sleep(stage.jitter())
            seconds = measure(VOICES[name])
            if number:
                found[name].append(seconds)
    return {name: milliseconds(each) for name, each in found.items()}


def _beside(group: str, name: str, found: dict[str, tuple[float, ...]], *limits: Limit) -> Row:
    return Row(group, name, "ms", found["joe"], "espeak", found["espeak"], limits)


def _until_sound(stage: VoiceStage, client: Client, text: str, voice: str) -> float:
    """Say a text, and stop it when it is heard."""

    def begin() -> Callable[[], object]:
        goal = client.say(text, voice=voice)
        return lambda: _spoken_with(voice, goal.cancel())

    return until_sound(stage.sink, begin)


def _until_silence(stage: VoiceStage, client: Client, voice: str, stop: Action) -> float:
    def begin() -> Callable[[], object]:
        goal = client.say(VOICED, voice=voice)
        return lambda: _spoken_with(voice, goal.wait(10))

    return until_silence(stage.sink, begin, stop, stage.jitter())


def _resumed(stage: VoiceStage, client: Client, voice: str) -> float:
    with stage.sink.record() as recording:
        goal = client.say(VOICED, voice=voice)
        recording.wait_for_sound()
        time.sleep(_BEFORE + stage.jitter())
        client.pause()
        recording.wait_until_quiet(_HELD)
        held, asked = len(recording), time.monotonic()
        client.resume()
        recording.wait_for_sound()
        _spoken_with(voice, goal.cancel())
        recording.wait_until_quiet(_HELD)
        again = first_sound(recording.samples[held:])
        assert again is not None
        return recording.time_of(held + again) - asked


def _spoken_with(voice: str, ended: Goal) -> None:
    if ended.voice != voice:
        raise FailedError(f"{voice} was asked for, and {ended.voice} was heard")
