"""What the engine says on its way to the clients: in its order, a few at a time, and what is for the engine first."""

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

if TYPE_CHECKING:
    import pytest

    from talkcli.goals.record import Record
    from talkcli.goals.states import State

COUNT = 5 * AT_ONCE + 1


class _Written:
    """An engine that writes down what it is told, where others write down what clients are told."""

    def __init__(self, written: list[str]) -> None:
        self.written = written

    def say(self, goal: protocol.Say) -> None:
        self.written.append(f"say {goal.text}")

    def stop(self, _: str) -> None:
        self.written.append("stop")

    def follow(self, _: str, followed: bool, by_neural: bool) -> None:
        """Take note of what is no news for this test."""


def test_words_that_come_all_at_once_leave_the_clients_their_turns() -> None:
    async def play() -> None:
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

    asyncio.run(play())


def test_report_that_meets_a_bug_takes_no_other_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    async def play() -> None:
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

    asyncio.run(play())


def test_the_engine_gets_to_work_before_clients_are_told() -> None:
    async def play() -> None:
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

    asyncio.run(play())
