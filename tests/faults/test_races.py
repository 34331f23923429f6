"""Cancel against the natural end of a goal, again and again: there is one end."""

from __future__ import annotations

import threading
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from tests.faults.soak_witness import Witness

if TYPE_CHECKING:
    from tests.conftest import MakeTalk

#: Goals on their way at once: fewer than the queue takes.
AHEAD = 50


@pytest.mark.parametrize("goals", [500, pytest.param(10_000, marks=pytest.mark.slow)])
def test_cancel_that_races_with_the_natural_end_10000_times(make_talk: MakeTalk, goals: int) -> None:
    talk = make_talk(scripted=True, watched=False)
    witness = Witness(talk.socket)
    over = threading.Event()
    canceled = Counter[bool]()

    def cancel() -> None:
        with talk.connect() as wire:
            while not over.is_set():
                reply = wire.request("cancel", current=True)
                assert reply["ok"]
                canceled[reply["count"] > 0] += 1

    thread = threading.Thread(target=cancel)
    thread.start()
    results: Counter[str] = Counter()
    try:
        with talk.connect() as wire:
            for number in range(goals + AHEAD):
                if number < goals:
                    # Without a word the goal may be over before it is known to have begun. Every other one takes about
                    # as long as a cancel, as that would nearly always be too late on busy cores.
                    text = f"length={0.001 * (number % 2)} words=0"
                    wire.send({"seq": number, "request": "say", "text": text, "wait": True})
                if number >= AHEAD:
                    results[wire.receive_event("result")["goal"]["state"]] += 1
    finally:
        over.set()
        thread.join()
    assert witness.wait_for(goals, timeout=10)
    talk.stop()
    witness.close()
    assert not witness.faults
    assert sum(results.values()) == goals
    assert results.keys() <= {"SUCCEEDED", "PREEMPTED"}
    assert {state: count for (state, _), count in witness.ends.items()} == dict(results)
    # Both must have come first often.
    assert min(results["SUCCEEDED"], results["PREEMPTED"]) > goals / 100, results
