"""Rows of thousands of sentences in a row, stopped, paused and preempted at random, for a quarter of an hour."""

from __future__ import annotations

import random
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from tests.support.espeak import RATE
from tests.support.sink import Sink
from tests.tools.bench.heard import silences
from tests.tools.bench.stage import VOICED, fine_blocks, serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from tests.support.connection import Wire
    from tests.tools.bench.stage import Stage

#: Servers side by side, each with a sound server of its own: most of the time is waiting.
SERVERS = 6
#: Samples of digital silence within a sentence that are a gap: at this rate it has up to 8 ms of its own.
_GAP_SAMPLES = RATE * 12 // 1000
_QUIET_S = 0.03
#: What is done to a sentence. Each is chosen as often as it stands here.
_ACTS = ("stop", "stop", "stop", "preempt", "pause", "whole")


def marathon(stage: Stage) -> list[Row]:
    """Measure the onset of every sentence, and count the silences within sentences."""
    seed = random.randrange(1_000_000)
    print(f"seed {seed}", file=sys.stderr)
    with ThreadPoolExecutor(SERVERS) as pool:
        found = pool.map(_run, [max(1, stage.options.sentences // SERVERS)] * SERVERS, range(seed, seed + SERVERS))
        onsets, gaps = zip(*(each for server in found for each in server), strict=True)
    return [
        Row("a sentence of the marathon → first sample", "ms", onsets),
        Row("… longest", "ms", [max(onsets)]),
        Row("silences within a sentence of the marathon", "", [sum(gaps)], limits=(Limit("median", 0),)),
    ]


def _run(sentences: int, seed: int) -> list[tuple[float, int]]:
    """Return the milliseconds to each sentence's first sample, and its gaps."""
    with Sink() as sink, fine_blocks(sink), serving("--rate", "450", sink=sink) as talk, talk.connect() as wire:
        chance = random.Random(seed)
        return [_sentence(sink, wire, chance) for _ in range(sentences)]


def _sentence(sink: Sink, wire: Wire, chance: random.Random) -> tuple[float, int]:
    act = chance.choice(_ACTS)
    time.sleep(chance.random() * 0.02)
    with sink.record() as recording:
        began = time.monotonic()
        goal = wire.request("say", text=VOICED, wait=True)["goal"]["id"]
        recording.wait_for_sound(10)
        first = recording.first_sound()
        assert first is not None
        if act != "whole":
            time.sleep(chance.random() * 0.15)
        if act == "preempt":
            goal = wire.request("say", text=VOICED, wait=True, preempt=True)["goal"]["id"]
            wire.receive_event("result", timeout=10)
            time.sleep(0.05 + chance.random() * 0.1)
        if act == "pause":
            for request in ("pause", "resume"):
                assert wire.request(request)["ok"]
                time.sleep(chance.random() * 0.1)
        if act != "whole":
            assert wire.request("cancel")["ok"]
        ended = wire.receive_event("result", timeout=10)["goal"]
        assert ended["id"] == goal, ended
        recording.wait_until_quiet(_QUIET_S)
        gaps = silences(recording.samples, _GAP_SAMPLES, 0) if act in ("stop", "whole") else []
    return (first - began) * 1000, len(gaps)
