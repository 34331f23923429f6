"""The engine thread holds a goal and lets it go on, with the scripted engine as its process."""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import time
from typing import TYPE_CHECKING, TypeVar

import pytest

from talkcli.engine import protocol, spawn
from talkcli.engine.thread import HANG_AFTER, EngineThread, Report
from tests.support import scripted_engine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_R = TypeVar("_R")

#: Seconds after which a report is late on the busiest machine.
PATIENCE = 20.0


class Thread:
    """A running engine thread and what it has posted."""

    def __init__(self) -> None:
        self.seen: list[Report] = []
        self._posted: queue.Queue[Report] = queue.Queue()
        self.engine = EngineThread(protocol.Configure(os.getpid(), None, None, None, None), self._posted.put)
        self.engine.start()

    def say(self, text: str, goal: str = "g1") -> None:
        self.engine.say(protocol.Say(goal, text, 200, 1.0, None, 50))

    def next(self, seconds: float = PATIENCE) -> Report | None:
        """Return the next report, None if there is none for so long."""
        with contextlib.suppress(queue.Empty):
            self.seen.append(self._posted.get(timeout=seconds))
            return self.seen[-1]
        return None

    def until(self, kind: type[_R]) -> _R:
        while (report := self.next()) is not None:
            if isinstance(report, kind):
                return report
        raise AssertionError(f"no {kind.__name__} in {self.seen}")

    def close(self) -> None:
        self.engine.close()
        self.engine.join(PATIENCE)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Thread]]:
    monkeypatch.setattr(spawn, "engine_command", lambda: [sys.executable, scripted_engine.__file__])
    with contextlib.ExitStack() as stack:

        def make() -> Thread:
            thread = Thread()
            stack.callback(thread.close)
            return thread

        yield make


def test_a_goal_is_held_and_goes_on_where_it_was(start: Callable[[], Thread]) -> None:
    thread = start()
    began = time.monotonic()
    thread.say("length=0.6 two three four")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    assert thread.until(protocol.Paused).id == "g1"
    assert thread.next(0.8) is None
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert time.monotonic() - began >= 0.6 + 0.8
    assert [each.number for each in thread.seen if isinstance(each, protocol.Word)] == [1, 2, 3, 4]


def test_a_pause_may_last_longer_than_any_limit(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("length=0.3")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    thread.until(protocol.Paused)
    assert thread.next(HANG_AFTER + 0.5) is None
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


def test_paused_is_posted_when_the_process_is_silent_and_not_after_a_resume(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("length=1.5 slow-pause=0.4")
    thread.until(protocol.Word)
    asked = time.monotonic()
    thread.engine.pause("g1", 1)
    thread.until(protocol.Paused)
    assert time.monotonic() - asked >= 0.4
    thread.engine.resume("g1")
    thread.engine.pause("g1", 2)
    thread.engine.resume("g1")
    thread.until(protocol.Ended)
    assert sum(isinstance(each, protocol.Paused) for each in thread.seen) == 1


def test_an_answer_to_an_earlier_pause_is_no_answer_to_this_one(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("length=1 stale-pause slow-pause=0.3")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    thread.engine.resume("g1")
    thread.engine.pause("g1", 2)
    assert thread.until(protocol.Paused) == protocol.Paused("g1", 2)
    thread.engine.resume("g1")
    thread.until(protocol.Ended)
    assert sum(isinstance(each, protocol.Paused) for each in thread.seen) == 1


def test_a_goal_that_waits_for_a_process_is_held_by_the_thread(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCRIPTED_START", "slow=0.5")
    thread = start()
    thread.say("two words")
    thread.engine.pause("g1", 1)
    assert thread.next() == protocol.Paused("g1", 1)
    thread.until(protocol.Voices)
    assert thread.next(0.5) is None
    thread.engine.resume("g1")
    assert isinstance(thread.next(), protocol.Word)
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


def test_a_goal_that_is_held_by_the_thread_is_stopped_at_once(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCRIPTED_START", "slow=0.5")
    thread = start()
    thread.say("two words")
    thread.engine.pause("g1", 1)
    thread.engine.stop("g1")
    assert [thread.next(), thread.next()] == [protocol.Paused("g1", 1), protocol.Ended("g1", protocol.STOPPED)]
    thread.say("the next is not held", "g2")
    assert thread.until(protocol.Ended) == protocol.Ended("g2", protocol.COMPLETED, duration=0.1)


@pytest.mark.parametrize(("word", "outcome"), [("", protocol.STOPPED), ("on-stop=crash", protocol.STOPPED)])
def test_a_paused_goal_is_stopped(start: Callable[[], Thread], word: str, outcome: str) -> None:
    thread = start()
    thread.say(f"never-ends {word}")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    thread.until(protocol.Paused)
    thread.engine.stop("g1")
    thread.engine.pause("g1", 1)
    assert thread.until(protocol.Ended).outcome == outcome
    assert sum(isinstance(each, protocol.Paused) for each in thread.seen) == 1


def test_a_crash_before_the_pause_is_confirmed_ends_the_goal(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("length=0.2 at=0.9 crash slow-pause=5")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    ended = thread.until(protocol.Ended)
    assert (ended.outcome, ended.reason) == (protocol.FAILED, "engine_crashed")
    thread.engine.resume("g1")
    thread.say("yes", "g2")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


def test_what_is_said_of_another_goal_changes_nothing(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.engine.pause("g1", 1)
    thread.say("length=0.3")
    thread.engine.pause("g0", 1)
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert not any(isinstance(each, protocol.Paused) for each in thread.seen)


def test_an_engine_that_ignores_a_pause_confirms_none(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("length=0.5 ignore-pause")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert not any(isinstance(each, protocol.Paused) for each in thread.seen)


def test_the_voices_are_listed_by_the_first_process_alone(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("crash")
    thread.until(protocol.Ended)
    thread.say("yes", "g2")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert sum(isinstance(each, protocol.Ready) for each in thread.seen) == 2
    assert sum(isinstance(each, protocol.Voices) for each in thread.seen) == 1
