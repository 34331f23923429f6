"""The engine thread holds goals, watches its process and passes on what it says, with the scripted engine as that."""

from __future__ import annotations

import os
import sys
import time
from typing import TYPE_CHECKING, Any

import pytest

import talkcli
from talkcli.engine import protocol, supervisor
from talkcli.engine.supervisor import LINES, EngineDied, EngineMissing, EngineSaid
from tests.engine.threads import Thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


def test_a_goal_is_held_and_goes_on_where_it_was(start: Callable[[], Thread]) -> None:
    thread = start()
    began = time.monotonic()
    thread.say("length=0.4 two three four")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    assert thread.until(protocol.Paused).id == "g1"
    assert thread.next(0.6) is None
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert time.monotonic() - began >= 0.4 + 0.6
    assert [each.number for each in thread.seen if isinstance(each, protocol.Word)] == [1, 2, 3, 4]


def test_a_pause_may_last_longer_than_any_limit(start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "HANG_AFTER", 1.0)
    monkeypatch.setattr(supervisor, "PAUSE_LIMIT", 1.0)
    thread = start()
    thread.say("length=0.3")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    thread.until(protocol.Paused)
    assert thread.next(1.5) is None
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


def test_a_thread_that_stood_still_hears_the_engine_before_it_judges_it(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a machine that was suspended, or a server that was stopped, between two lines of it."""
    monkeypatch.setattr(supervisor, "HANG_AFTER", 0.5)
    standing = [0.7]

    class Clock:
        def __getattr__(self, name: str) -> Any:
            return getattr(time, name)

        def monotonic(self) -> float:
            if words and standing and sys._getframe(1).f_code.co_name == "_run":  # the loop, between two rounds
                time.sleep(standing.pop())
            return time.monotonic()

    words: list[protocol.Word] = []
    thread = start()
    monkeypatch.setattr(supervisor, "time", Clock())
    thread.say("length=1.1 b c d e f g h i j k")
    words.append(thread.until(protocol.Word))
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert not standing


def test_paused_is_posted_when_the_process_is_silent_and_not_after_a_resume(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("length=0.9 slow-pause=0.3")
    thread.until(protocol.Word)
    asked = time.monotonic()
    thread.engine.pause("g1", 1)
    thread.until(protocol.Paused)
    assert time.monotonic() - asked >= 0.3
    thread.engine.resume("g1")
    thread.engine.pause("g1", 2)
    thread.engine.resume("g1")
    thread.until(protocol.Ended)
    assert sum(isinstance(each, protocol.Paused) for each in thread.seen) == 1


def test_an_answer_to_an_earlier_pause_is_no_answer_to_this_one(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("length=0.7 stale-pause slow-pause=0.2")
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


def test_a_pause_that_is_not_confirmed_ends_the_process(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "PAUSE_LIMIT", 0.3)
    thread = start()
    thread.say("never-ends ignore-pause")
    thread.until(protocol.Word)
    asked = time.monotonic()
    thread.engine.pause("g1", 1)
    ended = thread.until(protocol.Ended)
    assert time.monotonic() - asked >= 0.3
    assert (ended.reason, ended.message) == ("engine_hung", "the engine did not confirm a pause within 0.3 s")
    thread.say("yes", "g2")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


@pytest.mark.parametrize("words", ["slow-pause=0.1", "ignore-pause"], ids=["confirmed", "resumed before"])
def test_a_pause_has_no_limit_once_it_is_confirmed_or_over(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.setattr(supervisor, "PAUSE_LIMIT", 0.3)
    thread = start()
    thread.say(f"length=0.5 {words}")
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)
    if words == "ignore-pause":
        thread.engine.resume("g1")
    else:
        thread.until(protocol.Paused)
        assert thread.next(0.6) is None
        thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


def test_a_start_that_hangs_is_tried_again_and_fails_a_goal_each_time_after_a_while(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    behaviour = tmp_path / "start"
    behaviour.write_text("hang")
    monkeypatch.setenv("SCRIPTED_START_FILE", str(behaviour))
    monkeypatch.setattr(supervisor, "START_LIMIT", 0.3)
    monkeypatch.setattr(supervisor, "PATIENCE", 0.5)
    monkeypatch.setattr(supervisor, "BACK_OFF", (0.0,))
    thread = start()
    began = time.monotonic()
    thread.say("battery low")
    words = "the engine was not ready after 0.3 s"
    assert thread.until(protocol.Ended) == protocol.Ended("g1", protocol.FAILED, "engine_failed", words)
    assert time.monotonic() - began >= 3 * 0.3, "only a start that began after the time of patience costs a goal"
    assert thread.until(EngineMissing) == EngineMissing(words), "no goal is in hand: who hands them in has to end one"
    thread.say("coming home", "g2")
    behaviour.write_text("")
    monkeypatch.setattr(supervisor, "START_LIMIT", 10.0)
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


#: An engine process that complains about each goal, and ends in its middle where it is told to.
COMPLAINS = """
import os, sys
sys.path.insert(0, {root!r})
from talkcli.engine import protocol
for line in os.fdopen(0, "rb"):
    command = protocol.decode(line, protocol.COMMANDS)
    if isinstance(command, protocol.Configure):
        os.write(0, protocol.encode(protocol.Ready("complaining", None, None)))
    elif isinstance(command, protocol.Say):
        for word in command.text.split():
            if word == "raise":
                raise ValueError("no tongue")
            sys.stderr.write(word + "\\n")
        sys.stderr.write("half a line")
        sys.stderr.flush()
        os.write(0, protocol.encode(protocol.Ended(command.id, protocol.COMPLETED)))
"""


@pytest.fixture
def complaining(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Thread]:
    program = tmp_path / "engine.py"
    program.write_text(COMPLAINS.format(root=os.path.dirname(os.path.dirname(talkcli.__file__))))
    monkeypatch.setattr("talkcli.engine.process.engine_command", lambda: [sys.executable, str(program)])
    thread = Thread()
    yield thread
    thread.close()


def _said(thread: Thread) -> list[str]:
    return [each.words for each in thread.seen if isinstance(each, EngineSaid)]


def test_what_a_living_process_writes_to_standard_error_is_posted(complaining: Thread) -> None:
    complaining.say("one two")
    while len(_said(complaining)) < 2:
        assert complaining.next() is not None
    assert _said(complaining) == ["one", "two"]


def test_the_traceback_of_a_crash_is_posted_before_the_crash(complaining: Thread) -> None:
    complaining.say("one raise")
    died = complaining.until(EngineDied)
    assert died.words == "the engine crashed: it exited with status 1 (ValueError: no tongue)"
    said = _said(complaining)
    assert said[:2] == ["one", "Traceback (most recent call last):"]
    assert said[-1] == "ValueError: no tongue"


def test_a_flood_of_complaints_is_cut_off(complaining: Thread) -> None:
    complaining.say("x " * 5000)
    complaining.until(protocol.Ended)
    complaining.say("raise", "g2")
    complaining.until(EngineDied)
    assert _said(complaining) == ["x"] * LINES
