"""Reports of the engine reach the clients in order, a few at a time, after the engine has its next task."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.engine import protocol
from talkcli.goals.goal import Sender
from talkcli.goals.options import Say
from talkcli.goals.scheduler import Scheduler
from talkcli.server.speech import AT_ONCE, Speech
from tests.support.loop import in_loop

if TYPE_CHECKING:
    import pytest

    from talkcli.goals.record import Record
    from talkcli.goals.states import State

COUNT = 5 * AT_ONCE + 1


class _Written:
    """An engine that writes its requests into the list in which the test writes the clients' events."""

    def __init__(self, written: list[str]) -> None:
        self.written = written

    def say(self, goal: protocol.Say) -> None:
        self.written.append(f"say {goal.text}")

    def stop(self, _: str) -> None:
        self.written.append("stop")

    def follow(self, _: str, followed: bool, by_neural: bool) -> None:
        """Do nothing."""


@in_loop
async def test_many_words_at_once_leave_the_clients_their_turns() -> None:
    loop = asyncio.get_running_loop()
    taken: list[object] = []
    wakes = []
    served = Speech(Scheduler("4k7f", max_queue=1))
    served._takes[protocol.Word] = taken.append
    call = loop.call_soon_threadsafe
    loop.call_soon_threadsafe = lambda *values: wakes.append(call(*values))  # type: ignore[assignment, method-assign]
    words = [protocol.Word("4k7f-1", 0, 1, number, 0.0) for number in range(COUNT)]

    def post_all() -> None:
        for each in words:
            served.report(each)

    thread = threading.Thread(target=post_all)
    thread.start()
    thread.join()
    assert len(wakes) == 1  # one for all of them
    turns = 0
    while len(taken) < COUNT:
        await asyncio.sleep(0)
        turns += 1
        assert len(taken) <= turns * AT_ONCE
    assert taken == words
    served.report(words[0])
    assert len(wakes) == 2


@in_loop
async def test_bug_in_a_report_harms_no_other_report(monkeypatch: pytest.MonkeyPatch) -> None:
    taken, failed = [], []

    def take(report: protocol.Event) -> None:
        taken.append(report)
        if len(taken) == 1:
            raise ZeroDivisionError("a bug")

    monkeypatch.setattr(log, "bug", lambda what, error: failed.append((what, type(error))))
    served = Speech(Scheduler("4k7f", max_queue=1))
    served._takes[protocol.Alive] = take
    for number in range(3):
        served.report(protocol.Alive(f"4k7f-{number}"))
    await asyncio.sleep(0)
    assert len(taken) == 3
    assert failed == [("a report of the engine", ZeroDivisionError)]


@in_loop
async def test_engine_gets_its_next_task_before_clients_get_events() -> None:
    written: list[str] = []
    served = Speech(Scheduler("4k7f", max_queue=1))
    served.engine = _Written(written)  # type: ignore[assignment]
    served.scheduler.engine_ready(served.now())

    def changed(record: Record, state: State, _: float) -> None:
        written.append(f"{state.name} {record.text}")

    served.subscribers.changed = changed  # type: ignore[assignment, method-assign]
    for text, preempt in (("first", False), ("second", True)):
        served.apply(served.scheduler.submit(Say(text, preempt=preempt), Sender(), served.now()).effects)
    served.report(protocol.Ended("4k7f-1", protocol.STOPPED))
    await asyncio.sleep(0)
    assert written == [
        *("say first", "PENDING first", "ACTIVE first"),
        *("stop", "PENDING second", "PREEMPTING first"),
        *("say second", "PREEMPTED first", "ACTIVE second"),
    ]
