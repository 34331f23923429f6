"""Thousands of sentences in a row, with stops, pauses and preempts at random: what is late, lost or left behind.

    python -m tests.bench.marathon [--sentences 10000] [--seed N]

Several servers, each at a sound server of its own, share them: most of the time is waiting. It prints the onsets, each
that is late with what was done before it, gaps within a sentence that nothing explains, and what a server has at the
end and had at the beginning; of every random choice the seed tells.
"""

from __future__ import annotations

import argparse
import random
import statistics
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tests.bench.arithmetic import percentile, silences
from tests.bench.ear import VOICED, fine_blocks
from tests.support import census
from tests.support.espeak import RATE
from tests.support.processes import Talk
from tests.support.sink import Sink

if TYPE_CHECKING:
    from tests.support.connection import Wire

#: Servers side by side.
SERVERS = 6
#: Seconds from which on an onset is told of.
LATE = 0.1
#: Samples of digital silence within a sentence that are a gap: as fast as this it has up to 8 ms of its own.
_GAP = RATE * 12 // 1000
#: Seconds without a sound after which a sentence is over.
_QUIET = 0.03
#: What is done to a sentence, each as often as it stands here.
_ACTS = ("stop", "stop", "stop", "preempt", "pause", "whole")


@dataclass(slots=True)
class Found:
    """What was found in the sentences of one server."""

    onsets: list[float] = field(default_factory=list)
    acts: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    #: what there is to be explained, in words
    told: list[str] = field(default_factory=list)
    gaps: int = 0
    before: census.Census | None = None
    after: census.Census | None = None


def run(sentences: int, seed: int) -> Found:
    """Speak so many sentences to one server."""
    chance, found = random.Random(seed), Found()
    with Sink() as sink, fine_blocks(sink):
        talk = Talk(("--rate", "450"), sink=sink, watched=False)
        try:
            with talk.connect() as wire:
                assert wire.request("voices")["ok"]  # the engine is ready
                for number in range(sentences):
                    if number == sentences // 20:  # all that grows by being used once has grown
                        found.before = census.count(talk.pid)
                    _sentence(sink, wire, chance, found, number)
                found.after = census.settled(talk.pid, lambda _: False)
            talk.stop()
        finally:
            talk.close()
    return found


def _sentence(sink: Sink, wire: Wire, chance: random.Random, found: Found, number: int) -> None:
    act = chance.choice(_ACTS)
    found.acts[act] += 1
    time.sleep(chance.random() * 0.02)
    with sink.record() as recording:
        began = time.monotonic()
        goal = wire.request("say", text=VOICED, wait=True)["goal"]["id"]
        recording.wait_for_sound(10)
        first = recording.first_sound()
        assert first is not None
        onset = first - began
        found.onsets.append(onset)
        if onset > LATE:
            found.told.append(f"sentence {number} began after {onset * 1000:.0f} ms; {act}")
        if act != "whole":
            time.sleep(chance.random() * 0.15)
        if act == "preempt":
            newcomer = wire.request("say", text=VOICED, wait=True, preempt=True)["goal"]["id"]
            found.ends[wire.receive_event("result", timeout=10)["goal"]["state"]] += 1
            goal = newcomer
            time.sleep(0.05 + chance.random() * 0.1)
        if act == "pause":
            assert wire.request("pause")["ok"]
            time.sleep(chance.random() * 0.1)
            assert wire.request("resume")["ok"]
            time.sleep(chance.random() * 0.1)
        if act != "whole":
            assert wire.request("cancel")["ok"]
        ended = wire.receive_event("result", timeout=10)["goal"]
        assert ended["id"] == goal, ended
        found.ends[ended["state"]] += 1
        recording.wait_until_quiet(_QUIET)
        if act in ("stop", "whole"):
            for quiet_from, until in silences(recording.samples, _GAP, 0):
                found.gaps += 1
                where, how_long = quiet_from / RATE, (until - quiet_from) / RATE
                found.told.append(f"sentence {number} was silent for {how_long * 1000:.0f} ms at {where:.2f} s; {act}")


def main() -> None:
    """Run it as the command line says, and print what was found."""
    parser = argparse.ArgumentParser(
        description="Thousands of sentences in a row, at random stopped, paused, preempted."
    )
    parser.add_argument("--sentences", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    began = time.monotonic()
    with ThreadPoolExecutor(SERVERS) as pool:
        all_found = list(pool.map(lambda each: run(options.sentences // SERVERS, options.seed + each), range(SERVERS)))
    onsets = [each for found in all_found for each in found.onsets]
    acts: Counter[str] = sum((each.acts for each in all_found), Counter())
    ends: Counter[str] = sum((each.ends for each in all_found), Counter())
    print(f"seed {options.seed}, {time.monotonic() - began:.0f} s, {len(onsets)} sentences: {dict(acts)}, {dict(ends)}")
    figures = (statistics.median(onsets), percentile(onsets, 99), percentile(onsets, 99.9), max(onsets))
    print("onset, median, 99th, 99.9th, longest: " + ", ".join(f"{each * 1000:.1f} ms" for each in figures))
    print(f"gaps within a sentence: {sum(each.gaps for each in all_found)}")
    for number, found in enumerate(all_found):
        print(f"server {number}, before: {found.before}\n          after:  {found.after}")
        for each in found.told:
            print(f"server {number}: {each}")


if __name__ == "__main__":
    main()
