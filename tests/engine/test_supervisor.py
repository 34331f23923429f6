"""The engine thread holds goals, watches its process and passes on what it says, with the scripted engine as that."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.engine import protocol, supervisor
from talkcli.engine.supervisor import LINES, EngineDied, EngineMissing, EngineSaid
from tests.engine.threads import Thread, answering

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


def _pauses(thread: Thread) -> int:
    """Return how many pauses were confirmed."""
    return sum(isinstance(each, protocol.Paused) for each in thread.seen)


def _hold(thread: Thread, text: str) -> None:
    """Begin a goal and ask for a pause in its first word."""
    thread.say(text)
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)


# -- pauses


def test_a_goal_is_held_beyond_any_limit_and_goes_on_where_it_was(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "HANG_AFTER", 0.7)
    monkeypatch.setattr(supervisor, "PAUSE_LIMIT", 0.7)
    thread = start()
    began = time.monotonic()
    _hold(thread, "length=0.4 slow-pause=0.1 two three four")
    assert thread.until(protocol.Paused).id == "g1"
    assert thread.next(1.0) is None
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert time.monotonic() - began >= 0.4 + 1.0
    assert [each.number for each in thread.seen if isinstance(each, protocol.Word)] == [1, 2, 3, 4, 5]


def test_a_pause_has_no_limit_once_the_goal_goes_on(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "PAUSE_LIMIT", 0.2)
    thread = start()
    _hold(thread, "length=0.5 ignore-pause")
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert not _pauses(thread)


def test_a_pause_that_is_not_confirmed_ends_the_process(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "PAUSE_LIMIT", 0.3)
    thread = start()
    asked = time.monotonic()
    _hold(thread, "never-ends ignore-pause")
    ended = thread.until(protocol.Ended)
    assert time.monotonic() - asked >= 0.3
    assert (ended.reason, ended.message) == ("engine_hung", "the engine did not confirm a pause within 0.3 s")
    assert thread.spoken("yes", "g2").outcome == protocol.COMPLETED


def test_paused_is_posted_when_the_process_is_silent_and_not_after_a_resume(start: Callable[[], Thread]) -> None:
    thread = start()
    asked = time.monotonic()
    _hold(thread, "length=0.7 slow-pause=0.3")
    thread.until(protocol.Paused)
    assert time.monotonic() - asked >= 0.3
    thread.engine.resume("g1")
    thread.engine.pause("g1", 2)
    thread.engine.resume("g1")
    thread.until(protocol.Ended)
    assert _pauses(thread) == 1


def test_an_answer_to_an_earlier_pause_is_no_answer_to_this_one(start: Callable[[], Thread]) -> None:
    thread = start()
    _hold(thread, "length=0.6 stale-pause slow-pause=0.2")
    thread.engine.resume("g1")
    thread.engine.pause("g1", 2)
    assert thread.until(protocol.Paused) == protocol.Paused("g1", 2)
    thread.engine.resume("g1")
    thread.until(protocol.Ended)
    assert _pauses(thread) == 1


def test_a_goal_that_waits_for_a_process_is_held_by_the_thread(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCRIPTED_START", "slow=0.4")
    thread = start()
    thread.say("two words")
    thread.engine.pause("g1", 1)
    assert thread.next() == protocol.Paused("g1", 1)
    thread.until(protocol.Voices)
    assert thread.next(0.4) is None
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
    assert thread.spoken("the next is not held", "g2") == protocol.Ended("g2", protocol.COMPLETED, duration=0.1)


@pytest.mark.parametrize("on_stop", ["", "on-stop=crash"])
def test_a_paused_goal_is_stopped(start: Callable[[], Thread], on_stop: str) -> None:
    thread = start()
    _hold(thread, f"never-ends {on_stop}")
    thread.until(protocol.Paused)
    thread.engine.stop("g1")
    thread.engine.pause("g1", 1)
    assert thread.until(protocol.Ended).outcome == protocol.STOPPED
    assert _pauses(thread) == 1


def test_a_crash_before_the_pause_is_confirmed_ends_the_goal(start: Callable[[], Thread]) -> None:
    thread = start()
    _hold(thread, "length=0.2 at=0.9 crash slow-pause=5")
    ended = thread.until(protocol.Ended)
    assert (ended.outcome, ended.reason) == (protocol.FAILED, "engine_crashed")
    thread.engine.resume("g1")
    assert thread.spoken("yes", "g2").outcome == protocol.COMPLETED


def test_a_pause_or_resume_of_another_goal_changes_nothing(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.engine.pause("g1", 1)
    thread.say("length=0.2")
    thread.engine.pause("g0", 1)
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED
    assert not _pauses(thread)


# -- the process


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


def test_the_voices_are_listed_by_the_first_process_alone(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.spoken("crash")
    assert thread.spoken("yes", "g2").outcome == protocol.COMPLETED
    assert sum(isinstance(each, protocol.Ready) for each in thread.seen) == 2
    assert sum(isinstance(each, protocol.Voices) for each in thread.seen) == 1


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
    words = "the engine was not ready after 0.3 s"
    assert thread.spoken("battery low") == protocol.Ended("g1", protocol.FAILED, "engine_failed", words)
    assert time.monotonic() - began >= 3 * 0.3, "only a start that began after the time of patience costs a goal"
    assert thread.until(EngineMissing) == EngineMissing(words), "no goal is in hand: who hands them in has to end one"
    thread.say("coming home", "g2")
    behaviour.write_text("")
    monkeypatch.setattr(supervisor, "START_LIMIT", 10.0)
    assert thread.until(protocol.Ended).outcome == protocol.COMPLETED


#: Complains about each goal, and ends in its middle if it is told to.
COMPLAINS = """
for word in command.text.split():
    if word == "raise":
        raise ValueError("no tongue")
    sys.stderr.write(word + "\\n")
sys.stderr.write("half a line")
sys.stderr.flush()
tell(protocol.Ended(command.id, protocol.COMPLETED))
"""


@pytest.fixture
def complaining(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Thread]:
    monkeypatch.setattr("talkcli.engine.process.engine_command", lambda: answering(tmp_path, COMPLAINS))
    thread = Thread()
    yield thread
    thread.close()


def _said(thread: Thread) -> list[str]:
    return [each.words for each in thread.seen if isinstance(each, EngineSaid)]


def test_standard_error_of_the_process_is_posted_and_its_traceback_before_the_crash(complaining: Thread) -> None:
    complaining.say("one two")
    while len(_said(complaining)) < 2:
        assert complaining.next() is not None
    assert _said(complaining) == ["one", "two"]
    complaining.until(protocol.Ended)
    complaining.say("three raise", "g2")
    died = complaining.until(EngineDied)
    assert died.words == "the engine crashed: it exited with status 1 (ValueError: no tongue)"
    said = _said(complaining)[2:]
    assert said[:2] == ["half a linethree", "Traceback (most recent call last):"]
    assert said[-1] == "ValueError: no tongue"


def test_a_flood_of_complaints_is_cut_off(complaining: Thread) -> None:
    complaining.spoken("x " * 5000)
    complaining.say("raise", "g2")
    complaining.until(EngineDied)
    assert _said(complaining) == ["x"] * LINES
