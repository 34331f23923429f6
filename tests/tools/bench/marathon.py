"""Rows about thousands of sentences that are stopped, paused and preempted at random, for a quarter of an hour."""

from __future__ import annotations

import random
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from tests.support.espeak import RATE
from tests.support.sink import Sink
from tests.tools.bench.harness import VOICED, fine_blocks, serving
from tests.tools.bench.sound import silences
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from tests.support.connection import Wire
    from tests.tools.bench.harness import Harness

#: Servers that run in parallel, each with its own sound server. They wait most of the time.
SERVERS = 6
#: Digital silence in a sentence that counts as a gap. At this rate, a sentence has up to 8 ms of its own.
_GAP_SAMPLES = RATE * 12 // 1000
_QUIET_S = 0.03
#: Actions on sentences, of which one is chosen at random.
_ACTIONS = ("stop", "stop", "stop", "preempt", "pause", "whole")


def marathon(harness: Harness) -> list[Row]:
    """Measure the onset of every sentence, and count the silences within sentences."""
    seed = random.randrange(1_000_000)
    print(f"seed {seed}", file=sys.stderr)
    with ThreadPoolExecutor(SERVERS) as pool:
        results = pool.map(_run, [max(1, harness.options.sentences // SERVERS)] * SERVERS, range(seed, seed + SERVERS))
        onsets, gaps = zip(*(sentence for server in results for sentence in server), strict=True)
    return [
        Row("a sentence of the marathon → first sample", "ms", onsets),
        Row("… longest", "ms", [max(onsets)]),
        Row("silences within a sentence of the marathon", "", [sum(gaps)], limits=(Limit("median", 0),)),
    ]


def _run(sentences: int, seed: int) -> list[tuple[float, int]]:
    """Return the onset in milliseconds and the number of gaps of each sentence."""
    with Sink() as sink, fine_blocks(sink), serving("--rate", "450", sink=sink) as talk, talk.connect() as wire:
        rng = random.Random(seed)
        return [_sentence(sink, wire, rng) for _ in range(sentences)]


def _sentence(sink: Sink, wire: Wire, rng: random.Random) -> tuple[float, int]:
    action = rng.choice(_ACTIONS)
    time.sleep(rng.random() * 0.02)
    with sink.record() as recording:
        sent_at = time.monotonic()
        goal = wire.request("say", text=VOICED, wait=True)["goal"]["id"]
        recording.wait_for_sound(10)
        first = recording.first_sound()
        assert first is not None
        if action != "whole":
            time.sleep(rng.random() * 0.15)
        if action == "preempt":
            goal = wire.request("say", text=VOICED, wait=True, preempt=True)["goal"]["id"]
            wire.receive_event("result", timeout=10)
            time.sleep(0.05 + rng.random() * 0.1)
        if action == "pause":
            for request in ("pause", "resume"):
                assert wire.request(request)["ok"]
                time.sleep(rng.random() * 0.1)
        if action != "whole":
            assert wire.request("cancel")["ok"]
        ended = wire.receive_event("result", timeout=10)["goal"]
        assert ended["id"] == goal, ended
        recording.wait_until_quiet(_QUIET_S)
        gaps = silences(recording.samples, _GAP_SAMPLES, 0) if action in ("stop", "whole") else []
    return (first - sent_at) * 1000, len(gaps)
