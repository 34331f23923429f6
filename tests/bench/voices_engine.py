"""The engine process of a neural voice: what it takes of the machine, and how soon it speaks after it was killed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from talkcli import Client, State
from tests.bench.arithmetic import first_sound
from tests.bench.failure import FailedError
from tests.bench.idle import megabytes, rest, settle, taken
from tests.bench.onset import milliseconds
from tests.bench.table import Limit, Row
from tests.bench.voices_heard import HEARD, pauses
from tests.bench.voices_stage import engine_of
from tests.conformance.hearing import await_word, send
from tests.conformance.voices import Joe
from tests.support.compare import compare
from tests.support.real_voice import REAL_VOICE, real_voice, silence_noise
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from tests.bench.voices_stage import VoiceStage
    from tests.support.processes import Talk
    from tests.support.recording import Recording
    from tests.support.reference import Samples

_LONG = "I am returning to the charging station in the kitchen now, please leave the door open and wait for me there"
#: What follows: as soon as it is known that the engine is dead, and behind that, in the voice that is loaded again.
_URGENT, _NEXT = "ready", "moving along"
#: What libespeak-ng speaks in the place of the voice, in its language.
_INSTEAD = "gmw/en-US"
#: Milliseconds from the kill until the urgent goal is heard, at worst; and until the voice is, in the median and so.
_SOON, _BACK, _BACK_AT_WORST = 400, 2500, 4000
LONG_TEXT = ("I am ready to go. We are leaving now. Please follow me. " * 200)[:10_000]
_PATIENCE = 600.0
#: Megabytes of the engine process once the voice is loaded, after long texts, and by which these may have it grow when
#: all that grows by being used once has grown.
_LOADED, _AFTER, _GROWN = 260, 340, 5


def killed(stage: VoiceStage) -> list[Row]:
    """Kill the engine in the midst of a neural sentence, each time at another word."""
    urgent, back = [], []
    with short_directory() as place:
        voices, cache = Path(place, "voices"), Path(place, "cache")
        for each in (voices, cache):
            each.mkdir(mode=0o755)
        silence_noise(real_voice(), voices)
        joe = Joe(str(voices), str(cache))
        (reference,) = joe.render([_NEXT], 200)
        with stage.server(env=joe.places) as talk:
            for number in range(stage.options.kills):
                found = _kill(stage, talk, 2 + number % 15, reference)
                urgent.append(found[0])
                back.append(found[1])
    limits = Limit("median", _BACK), Limit("p99", _BACK_AT_WORST)
    return [
        Row("killed", "engine killed → urgent goal heard", "ms", milliseconds(urgent), limits=(Limit("p99", _SOON),)),
        Row("killed", "engine killed → neural voice heard again", "ms", milliseconds(back), limits=limits),
    ]


def idle(stage: VoiceStage) -> list[Row]:
    """Measure an engine process that has spoken with a neural voice, and has nothing to do."""
    with stage.server("--player", "null", heard=False) as talk:
        with Client(talk.socket) as client:
            client.say("ready").wait(10)
        engines = [engine_of(talk)]
        settle(engines)
        before, began = taken(engines), time.monotonic()
        time.sleep(stage.options.idle)
        seconds = time.monotonic() - began
        found = taken(engines).since(before)
    return rest(f"idle for {seconds:.0f} s, joe loaded", "the engine", found, seconds)


def memory(stage: VoiceStage) -> list[Row]:
    """Measure the engine process once a voice is loaded, and after long texts."""
    rows = []
    with short_directory() as place, stage.server("--player", f"file:{place}/x.wav", heard=False) as talk:
        engine = engine_of(talk)
        rows += _memory("once joe is loaded", engine, _LOADED)
        after = []
        with Client(talk.socket) as client:
            for _ in range(stage.options.texts):
                ended = client.say(LONG_TEXT).wait(_PATIENCE)
                if ended.state is not State.SUCCEEDED:
                    raise FailedError(f"{ended.state}: {ended.message}")
                after.append(megabytes(engine, "Pss"))
        rows += _memory(f"after {len(after)} texts of 10,000 characters", engine, _AFTER)
    grown = after[-1] - after[len(after) // 2]
    name = "Pss of the engine: growth in the second half of these texts"
    return [*rows, Row("memory", name, "MB", (grown,), limits=(Limit("median", _GROWN),))]


def _kill(stage: VoiceStage, talk: Talk, word: int, reference: Samples) -> tuple[float, float]:
    """Return the seconds until an urgent goal was heard, and until the one that had waited was, as it should be."""
    goal, waiting = send(talk, _LONG), send(talk, _NEXT)
    await_word(talk, goal, word)
    time.sleep(stage.jitter(0.1))
    os.kill(engine_of(talk), signal.SIGKILL)
    hit = time.monotonic()
    state = talk.watcher.wait_for_terminal(goal)
    with stage.sink.record() as recording:
        urgent = send(talk, _URGENT, preempt=True)
        ends = [state, *(talk.watcher.wait_for_terminal(each, 30) for each in (urgent, waiting))]
    if ends != ["ABORTED", "SUCCEEDED", "SUCCEEDED"]:
        raise FailedError(f"the goal in hand, the urgent one and the next ended {', '.join(ends)}")
    spoken = [talk.goal(each)["voice"] for each in (goal, urgent, waiting)]
    if spoken != [REAL_VOICE, _INSTEAD, REAL_VOICE]:
        raise FailedError(f"the goal in hand, the urgent one and the next were spoken with {', '.join(spoken)}")
    return _heard(recording, hit, reference)


def _heard(recording: Recording, hit: float, reference: Samples) -> tuple[float, float]:
    samples = recording.samples
    first, ((quiet_from, again),) = first_sound(samples, HEARD), pauses(samples, 1)
    assert first is not None
    compared = compare(samples[(quiet_from + again) // 2 :], reference)
    if not compared.same:
        raise FailedError(f"what is heard again is not the neural voice: {compared}")
    return recording.time_of(first) - hit, recording.time_of(again) - hit


def _memory(when: str, engine: int, limit: float) -> list[Row]:
    return [
        Row(
            "memory",
            f"{kind} of the engine {when}",
            "MB",
            (megabytes(engine, kind),),
            limits=(Limit("median", limit),),
        )
        for kind in ("Pss", "Rss")
    ]
