"""What the engine may say of a goal and when: all else is refused and changes nothing. Stops; silence that fails."""

from __future__ import annotations

import pytest

from talkcli.goals.goal import By
from talkcli.goals.options import Say
from talkcli.goals.scheduler import SILENCE_LIMIT, Now, Order, Ordered
from talkcli.goals.states import IllegalTransition, State
from tests.unit.robot import DOOR, Robot, ending

# What an engine may not say

EVENTS = ["heard", "completed", "failed", "stopped"]


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("which", ["pending", "succeeded", "aborted", "recalled", "rejected", "unknown"])
def test_engine_event_of_a_goal_that_is_not_spoken_is_refused_and_changes_nothing(event: str, which: str) -> None:
    robot = Robot()
    goals = {}
    goals["succeeded"] = robot.says().id
    robot.tells("completed", goals["succeeded"])
    goals["aborted"] = robot.says().id
    robot.tells("failed", goals["aborted"])
    robot.says()
    goals["recalled"] = robot.says().id
    robot.cancels(goals["recalled"])
    goals["rejected"] = robot.says("").id
    goals["pending"] = robot.says().id
    goals["unknown"] = "4k7f-99"
    known = [record for each in goals.values() if (record := robot.scheduler.find(each))]
    before = [each.snapshot() for each in known], robot.waiting(), list(robot.seen), robot.scheduler.deadline()
    with pytest.raises(IllegalTransition):
        robot.tells(event, goals[which])
    assert ([each.snapshot() for each in known], robot.waiting(), robot.seen, robot.scheduler.deadline()) == before


def test_a_goal_that_nobody_told_to_stop_cannot_have_stopped() -> None:
    robot = Robot()
    goal = robot.says()
    before = goal.snapshot()
    with pytest.raises(IllegalTransition):
        robot.tells("stopped", goal.id)
    assert goal.snapshot() == before
    robot.tells("completed", goal.id)
    assert goal.state is State.SUCCEEDED


@pytest.mark.parametrize("event", EVENTS)
def test_late_word_of_an_engine_that_was_given_up_is_refused(event: str) -> None:
    robot = Robot()
    goal, following = robot.says(), robot.says()
    robot.cancels(goal.id)
    robot.waits(2)
    with pytest.raises(IllegalTransition):
        robot.tells(event, goal.id)
    assert (goal.state, following.state) == (State.ABORTED, State.ACTIVE)


# Stopping


@pytest.mark.parametrize("event", ["stopped", "failed"])
def test_a_goal_that_is_silent_after_a_cancel_is_preempted_even_if_the_engine_died_of_it(event: str) -> None:
    robot = Robot()
    goal = robot.says()
    done = robot.cancels(goal.id)
    assert (done.recalled, done.stopping, goal.state) == ([], goal, State.PREEMPTING)
    robot.tells(event, goal.id)
    assert ending(goal) == (State.PREEMPTED, "canceled", By(client=DOOR))
    assert goal.message == "Talk preempted"
    assert robot.seen == ["1 PENDING", "1 ACTIVE", "1 Start", "1 PREEMPTING", "1 Stop", "1 PREEMPTED"]


def test_a_goal_that_ends_before_the_stop_arrives_succeeded_and_nothing_ended_it() -> None:
    robot = Robot()
    goal = robot.says()
    robot.cancels()
    robot.tells("completed", goal.id)
    assert ending(goal) == (State.SUCCEEDED, None, None)


def test_the_first_stop_gives_the_reason_and_later_ones_join_it() -> None:
    robot = Robot()
    goal = robot.says()
    robot.cancels(goal.id)
    robot.seconds += 1.5
    robot.says(preempt=True)
    assert robot.cancels(current=True).stopping is goal
    robot.shuts_down()
    assert robot.seen.count("1 Stop") == 1
    assert robot.scheduler.deadline() == 100 + SILENCE_LIMIT
    robot.tells("stopped", goal.id)
    assert ending(goal) == (State.PREEMPTED, "canceled", By(client=DOOR))


def test_silence_is_given_up_within_two_seconds_and_the_next_goal_starts() -> None:
    assert 1.5 < SILENCE_LIMIT <= 2
    robot = Robot()
    goal, _ = robot.says(), robot.says()
    assert robot.scheduler.deadline() is None
    robot.cancels(goal.id)
    robot.waits(SILENCE_LIMIT - 0.01)
    assert goal.state is State.PREEMPTING
    robot.waits(0.02)
    assert (goal.state, goal.reason) == (State.ABORTED, "not_silent")
    assert str(goal.message).startswith("Talk aborted: ")
    assert [each for each in robot.seen[-4:] if each != "1 ABORTED"] == ["1 GiveUp", "2 ACTIVE", "2 Start"]
    assert robot.scheduler.deadline() is None


def test_a_goal_that_is_spoken_undisturbed_has_no_limit() -> None:
    robot = Robot()
    goal = robot.says()
    robot.waits(1e6)
    assert goal.state is State.ACTIVE


def test_both_ways_to_find_no_silence_end_alike() -> None:
    by_time, by_engine = Robot(), Robot()
    goals = [robot.says() for robot in (by_time, by_engine)]
    for robot in (by_time, by_engine):
        robot.cancels()
    by_time.waits(2)
    by_engine.scheduler.failed(goals[1].id, "not_silent", "process 7 does not end", None, by_engine.now)
    assert ending(goals[0]) == ending(goals[1]) == (State.ABORTED, "not_silent", By(client=DOOR))


def test_effects_of_the_last_resort_come_before_the_next_start() -> None:
    robot = Robot()
    goal, following = robot.says(), robot.says()
    robot.cancels(goal.id)
    effects = robot.scheduler.tick(Now(robot.seconds + 2, 0))
    assert effects.index(Ordered(goal, Order.GIVE_UP)) < effects.index(Ordered(following, Order.START))
    assert Ordered(goal, Order.STOP) not in effects


# An engine that is not there


def test_without_an_engine_goals_wait_and_their_time_runs() -> None:
    robot = Robot()
    robot.scheduler.engine_lost()
    short, long = robot.asks(Say("door open", ttl=1.0)), robot.says()
    assert (short.state, long.state) == (State.PENDING, State.PENDING)
    robot.waits(1)
    assert (short.state, short.reason, long.state) == (State.RECALLED, "expired", State.PENDING)
    robot.see(robot.scheduler.engine_ready(robot.now))
    assert long.state is State.ACTIVE


def test_a_goal_that_lost_its_engine_before_it_was_heard_has_its_time() -> None:
    robot = Robot()
    goal, heard = robot.asks(Say("door open", ttl=1.0)), robot.asks(Say("battery low", ttl=9.0))
    robot.waits(2)
    assert goal.state is State.ACTIVE, "it has begun"
    robot.scheduler.engine_lost()
    robot.waits(0)
    assert (goal.state.name, goal.reason) == ("PREEMPTING", "expired")
    robot.tells("stopped", goal.id)
    robot.see(robot.scheduler.engine_ready(robot.now))
    robot.tells("heard", heard.id)
    robot.scheduler.engine_lost()
    robot.waits(20)
    assert heard.state is State.ACTIVE, "what was heard in part is not begun anew"


def test_a_goal_that_is_spoken_may_end_after_its_engine_was_lost_and_the_next_waits() -> None:
    robot = Robot()
    goal, following = robot.says(), robot.says()
    robot.scheduler.engine_lost()
    robot.tells("failed", goal.id)
    assert (goal.state, following.state) == (State.ABORTED, State.PENDING)


def test_an_engine_that_does_not_come_costs_one_goal_each_time() -> None:
    robot = Robot()
    robot.scheduler.engine_lost()
    goals = [robot.says() for _ in range(3)]
    robot.see(robot.scheduler.engine_missing("no memory", robot.now))
    assert [each.state for each in goals] == [State.ABORTED, State.PENDING, State.PENDING]
    assert (goals[0].reason, goals[0].message) == ("engine_failed", "Talk aborted: no memory")
    assert robot.seen[-2:] == ["1 ACTIVE", "1 ABORTED"], "nothing is started"
    robot.pauses()
    assert robot.scheduler.engine_missing("no memory", robot.now) == []
    robot.resumes()
    robot.see(robot.scheduler.engine_ready(robot.now))
    assert robot.scheduler.engine_missing("it came at last", robot.now) == []
    assert [each.state.name for each in goals] == ["ABORTED", "ACTIVE", "PENDING"]
