"""The effects of a suspend, or of a change of the wall clock, on waiting goals.

The tests can't suspend the machine, so they use a clock of their own that jumps ahead.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.frozen import replace
from talkcli.goals.goal import Sender
from talkcli.goals.options import INITIAL, Say
from talkcli.goals.scheduler import Scheduler
from talkcli.goals.states import State
from talkcli.server import speech
from talkcli.server.speech import Speech
from tests.support.loop import in_loop

if TYPE_CHECKING:
    from talkcli.engine import protocol


class _BusyEngine:
    """An engine that accepts every goal and reports nothing."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, goal: protocol.Say) -> None:
        self.said.append(goal.text)

    def follow(self, goal_id: str, followed: bool, by_neural: bool) -> None:
        """Do nothing."""


class _Clock:
    def __init__(self) -> None:
        self.ahead = 0.0

    def __call__(self) -> float:
        return time.monotonic() + self.ahead


async def _queued_behind_another(ttl: float) -> Speech:
    served = Speech(Scheduler("4k7f", max_queue=1, settings=replace(INITIAL, ttl=ttl)))
    served.engine = _BusyEngine()  # type: ignore[assignment]
    served.scheduler.engine_ready(served.now())
    for text in ("a long sentence", "the door is open"):
        served.apply(served.scheduler.submit(Say(text), Sender(), served.now()).effects)
    return served


async def _until(served: Speech, goal_id: str, state: State, limit: float) -> float:
    """Return the seconds until the goal is in this state."""
    began = time.monotonic()
    record = served.scheduler.find(goal_id)
    assert record is not None
    while record.state is not state:
        assert time.monotonic() - began < limit, f"{goal_id} is {record.state.name} after {limit} s"
        await asyncio.sleep(0.005)
    return time.monotonic() - began


@in_loop
async def test_a_goal_whose_time_ended_in_a_suspend_is_recalled_when_the_machine_wakes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slept = _Clock()
    monkeypatch.setattr(speech, "elapsed", slept)
    served = await _queued_behind_another(ttl=600)
    await asyncio.sleep(0)  # the loop has set its timer for the ten minutes
    slept.ahead += 3_600
    await _until(served, "4k7f-2", State.RECALLED, speech.LOOK_EVERY + 1)


@in_loop
async def test_no_request_after_a_suspend_finds_a_goal_whose_time_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    slept = _Clock()
    monkeypatch.setattr(speech, "elapsed", slept)
    served = await _queued_behind_another(ttl=600)
    slept.ahead += 3_600
    served.now()  # every request begins with this
    assert served.scheduler.pending_count == 0


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="this system has no clock that counts a suspend")
def test_the_clock_is_the_one_that_counts_a_suspend() -> None:
    before = time.clock_gettime(time.CLOCK_BOOTTIME)
    assert before <= speech.elapsed() <= time.clock_gettime(time.CLOCK_BOOTTIME)
