"""The effects of a suspend on waiting goals.

The tests can't suspend the machine, so they use a clock that jumps ahead.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any, cast

import pytest

from talkcli.frozen import replace
from talkcli.goals.goal import Sender
from talkcli.goals.options import DEFAULTS, Say
from talkcli.goals.scheduler import Scheduler
from talkcli.goals.states import State
from talkcli.server import speech
from talkcli.server.speech import Speech
from tests.support.loop import in_loop
from tests.test_waiting import Engine


@pytest.fixture
def suspends(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The length of each suspend in seconds. The server's clock is ahead by their sum."""
    seconds: list[float] = []
    monkeypatch.setattr(speech, "monotonic_now", lambda: time.monotonic() + sum(seconds))
    return seconds


async def _speech_with_pending_goal(ttl: float) -> Speech:
    served = Speech(Scheduler("4k7f", max_queue=1, settings=replace(DEFAULTS, ttl=ttl)))
    served.engine = cast("Any", Engine())
    served.scheduler.engine_ready(served.advance_time())
    for text in ("a long sentence", "the door is open"):
        served.apply(served.scheduler.submit(Say(text), Sender(), served.advance_time())[1])
    return served


@in_loop
async def test_a_goal_that_expired_during_a_suspend_is_recalled_afterwards(suspends: list[float]) -> None:
    served = await _speech_with_pending_goal(ttl=600)
    await asyncio.sleep(0)  # the loop has started its timer for the ten minutes
    suspends.append(3_600)
    record, end = served.scheduler.find("4k7f-2"), time.monotonic() + speech.CLOCK_CHECK_S + 1
    assert record
    while record.state is not State.RECALLED:
        assert time.monotonic() < end, record.state
        await asyncio.sleep(0.005)


@in_loop
async def test_requests_after_a_suspend_find_no_expired_goals(suspends: list[float]) -> None:
    served = await _speech_with_pending_goal(ttl=600)
    suspends.append(3_600)
    served.advance_time()  # every request starts with this call
    assert len(served.scheduler.pending) == 0


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="this system has no clock that includes suspends")
def test_the_servers_clock_includes_suspends() -> None:
    before = time.clock_gettime(time.CLOCK_BOOTTIME)
    assert before <= speech.monotonic_now() <= time.clock_gettime(time.CLOCK_BOOTTIME)
