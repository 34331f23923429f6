"""Voices that are being loaded, by examples: who waits for one, for how long, and who does not."""

from __future__ import annotations

import pytest

from talkcli.frozen import replace
from talkcli.goals.options import Say
from talkcli.goals.states import State
from tests.unit.robot import Robot, ending

JOE = "piper/joe"


def loads(robot: Robot, voice: str = JOE) -> None:
    robot.scheduler.loading.begin(voice, robot.seconds)


def has_loaded(robot: Robot, voice: str = JOE) -> None:
    robot.scheduler.loading.end(voice)
    robot.waits(0)


@pytest.mark.parametrize("voice", [JOE, f"{JOE}#3"])
def test_a_goal_waits_for_its_voice_and_those_behind_it_wait_too(voice: str) -> None:
    robot = Robot()
    loads(robot)
    first, second = robot.asks(Say("battery low", voice=voice)), robot.says()
    assert (first.state, second.state) == (State.PENDING, State.PENDING)
    robot.waits(9.9)
    has_loaded(robot, "piper/another")
    assert first.state.name == "PENDING"
    has_loaded(robot)
    assert robot.seen == ["1 PENDING", "2 PENDING", "1 ACTIVE", "1 Start"]
    assert robot.speaks_the_rest() == ["door open"]


def test_a_goal_without_a_voice_waits_for_the_servers() -> None:
    robot = Robot()
    loads(robot)
    robot.scheduler.settings = replace(robot.scheduler.settings, voice=JOE)
    mine, other = robot.says(), robot.asks(Say("turn left", voice="en"))
    assert (mine.state, other.state) == (State.PENDING, State.PENDING)
    robot.scheduler.settings = replace(robot.scheduler.settings, voice=None)
    assert robot.scheduler.deadline() == 0
    robot.waits(0)
    assert mine.state is State.ACTIVE


def test_a_goal_waits_ten_seconds_from_when_its_voice_was_begun_with() -> None:
    robot = Robot()
    loads(robot)
    robot.waits(4)
    goal = robot.asks(Say("battery low", voice=JOE))
    assert robot.scheduler.deadline() == 110
    robot.waits(5.9)
    assert goal.state.name == "PENDING"
    robot.waits(0.1)
    assert goal.state is State.ACTIVE


def test_for_a_voice_that_is_not_begun_with_a_goal_waits_ten_seconds_from_its_turn() -> None:
    robot = Robot()
    first = robot.says()
    robot.scheduler.loading.wait_for(JOE)
    goal = robot.asks(Say("battery low", voice=JOE))
    robot.waits(60)
    robot.tells("completed", first.id)
    assert robot.scheduler.deadline() == 170
    robot.waits(4)
    loads(robot)
    assert robot.scheduler.deadline() == 174, "it will be there soon"
    robot.waits(9.9)
    assert goal.state.name == "PENDING"
    robot.waits(0.1)
    assert goal.state is State.ACTIVE


def test_a_goal_whose_turn_it_is_by_a_cancel_waits_from_then_on() -> None:
    robot = Robot()
    loads(robot)
    robot.scheduler.loading.wait_for("piper/amy")
    first, second = robot.asks(Say("x", voice=JOE)), robot.asks(Say("y", voice="piper/amy"))
    robot.waits(3)
    robot.cancels(first.id)
    assert robot.scheduler.deadline() == 0, "it is to be looked at"
    robot.waits(0)
    assert robot.scheduler.deadline() == 113
    robot.waits(10)
    assert second.state is State.ACTIVE


@pytest.mark.parametrize("urgent", [{"preempt": True}, {"flush": True}, {"priority": 1}])
def test_who_is_urgent_waits_for_no_voice(urgent: dict[str, object]) -> None:
    robot = Robot()
    loads(robot)
    waiting = robot.asks(Say("battery low", voice=JOE))
    goal = robot.asks(Say("stop", voice=JOE, **urgent))  # type: ignore[arg-type]
    assert goal.state is State.ACTIVE
    assert waiting.state is (State.RECALLED if "flush" in urgent else State.PENDING)


def test_a_lower_priority_is_not_urgent() -> None:
    robot = Robot()
    loads(robot)
    assert robot.asks(Say("battery low", voice=JOE, priority=-1)).state is State.PENDING


def test_a_goal_begins_while_half_a_second_of_its_time_is_left() -> None:
    robot = Robot()
    loads(robot)
    goal = robot.asks(Say("battery low", voice=JOE, ttl=2))
    assert robot.scheduler.deadline() == 101.5
    robot.waits(1.5)
    assert goal.state is State.ACTIVE
    robot = Robot()
    loads(robot)
    assert robot.asks(Say("battery low", voice=JOE, ttl=0.5)).state is State.ACTIVE


@pytest.mark.parametrize("urgent", [{}, {"preempt": True}, {"priority": 5}])
def test_who_insists_on_a_voice_waits_until_it_is_there(urgent: dict[str, object]) -> None:
    robot = Robot()
    loads(robot)
    goal = robot.asks(Say("battery low", voice=JOE, voice_only=True, **urgent))  # type: ignore[arg-type]
    assert robot.scheduler.deadline() is None
    robot.waits(60)
    assert goal.state.name == "PENDING"
    has_loaded(robot)
    assert goal.state is State.ACTIVE


def test_who_insists_on_a_voice_expires_as_any() -> None:
    robot = Robot()
    loads(robot)
    goal, behind = robot.asks(Say("battery low", voice=JOE, voice_only=True, ttl=3)), robot.says()
    assert robot.scheduler.deadline() == 103
    robot.waits(3)
    assert ending(goal) == (State.RECALLED, "expired", None)
    assert behind.state is State.ACTIVE


def test_what_waited_behind_a_goal_that_was_cancelled_begins() -> None:
    robot = Robot()
    loads(robot)
    goal, behind = robot.asks(Say("battery low", voice=JOE)), robot.says()
    robot.cancels(goal.id)
    robot.waits(0)
    assert behind.state is State.ACTIVE


def test_nothing_begins_for_a_voice_while_speech_is_paused_or_another_goal_is_spoken() -> None:
    robot = Robot()
    first = robot.says()
    loads(robot)
    goal = robot.asks(Say("battery low", voice=JOE))
    assert robot.scheduler.deadline() is None
    has_loaded(robot)
    assert goal.state.name == "PENDING"
    robot.pauses()
    robot.tells("completed", first.id)
    assert robot.scheduler.deadline() is None
    robot.resumes()
    assert goal.state is State.ACTIVE


def test_an_engine_that_is_lost_loads_nothing_any_more() -> None:
    robot = Robot()
    loads(robot)
    goal = robot.asks(Say("battery low", voice=JOE))
    robot.scheduler.engine_lost()
    robot.waits(20)
    assert goal.state.name == "PENDING"
    robot.see(robot.scheduler.engine_ready(robot.now))
    assert goal.state is State.ACTIVE


def test_a_goal_tells_by_which_voice_it_is_heard_from_then_on() -> None:
    robot = Robot()
    goal = robot.asks(Say("battery low", voice=JOE))
    assert goal.snapshot().voice is None
    robot.scheduler.spoken_by(goal.id, "gmw/en-US")
    assert goal.snapshot().voice == "gmw/en-US"
    assert goal.snapshot(State.PENDING).voice is None
    robot.tells("completed", goal.id)
    assert goal.snapshot().to_json()["voice"] == "gmw/en-US"
