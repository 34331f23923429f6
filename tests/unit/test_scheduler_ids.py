"""Ids of the sender's own, by examples: attached, in conflict, cancelled before they arrive."""

from __future__ import annotations

import pytest

from talkcli.goals.goal import By
from talkcli.goals.history import EARLY_CANCEL, MAX_EARLY_CANCELS
from talkcli.goals.options import Say
from talkcli.goals.states import State
from tests.unit.robot import DOOR, Robot, ending, numbers


def test_the_same_id_again_attaches_to_the_first_and_is_spoken_once() -> None:
    robot = Robot()
    say = Say("door open", id="mine")
    first = robot.submits(say)
    assert (first.record.id, first.attached) == ("mine", False)
    again = robot.submits(say)
    assert (again.record, again.effects, again.attached) == (first.record, [], True)
    robot.tells("completed", "mine")
    late = robot.submits(say)
    assert (late.record, late.effects, late.attached) == (first.record, [], True)
    assert late.record.state is State.SUCCEEDED
    assert robot.seen.count("1 Start") == 1


def test_the_same_id_with_another_text_is_rejected_before_and_after_the_end() -> None:
    robot = Robot()
    robot.asks(Say("door open", id="mine"))
    other = Say("door shut", id="mine", flush=True)
    assert ending(robot.asks(other))[:2] == (State.REJECTED, "id_conflict")
    robot.tells("completed", "mine")
    rejected = robot.asks(other)
    assert ending(rejected)[:2] == (State.REJECTED, "id_conflict")
    assert rejected.id == "4k7f-3"
    assert robot.scheduler.find("mine") is not rejected


def test_a_goal_that_is_rejected_does_not_use_its_id_up_and_has_one_of_the_servers() -> None:
    robot = Robot()
    rejected = robot.asks(Say("", id="mine"))
    assert (rejected.id, rejected.state) == ("4k7f-1", State.REJECTED)
    accepted = robot.asks(Say("door open", id="mine"))
    assert (accepted.id, accepted.state) == ("mine", State.ACTIVE)


def test_attaching_asks_for_no_room_and_is_not_throttled_and_does_nothing_to_others() -> None:
    robot = Robot(max_queue=1)
    robot.says("active")
    first = robot.asks(Say("door open", id="mine", throttle=60))
    assert robot.submits(Say("door open", id="mine", throttle=60, flush=True, key="x")).attached
    assert robot.submits(Say("door open", id="mine", throttle=60)).record is first
    robot.shuts_down()
    assert robot.submits(Say("door open", id="mine")).attached


def test_attaching_uses_no_number_up() -> None:
    robot = Robot()
    for _ in range(3):
        robot.asks(Say("door open", id="mine"))
    assert robot.says().id == "4k7f-2"


def test_an_id_is_known_after_its_text_was_forgotten_and_another_text_is_still_a_conflict() -> None:
    robot = Robot()
    first = robot.asks(Say("door open", id="mine"))
    robot.tells("completed", "mine")
    first.drop_text()
    assert robot.submits(Say("door open", id="mine")).attached
    assert robot.asks(Say("door shut", id="mine")).reason == "id_conflict"


def test_a_goal_with_an_id_of_its_senders_is_cancelled_by_it_and_told_before_others() -> None:
    robot = Robot()
    robot.says()
    mine = robot.asks(Say("door open", id="mine"))
    robot.says()
    assert numbers(robot.cancels(before="mine").recalled) == [mine.number]
    assert robot.waiting() == [3]


# Cancelled before they arrived


def test_a_goal_whose_id_was_cancelled_before_it_arrived_is_recalled_and_never_spoken() -> None:
    robot = Robot()
    assert robot.cancels("mine").unknown == ["mine"]
    goal = robot.asks(Say("door open", id="mine"))
    assert ending(goal) == (State.RECALLED, "canceled", By(client=DOOR))
    assert str(goal.message).startswith("Talk recalled: ")
    assert robot.seen == ["1 PENDING", "1 RECALLED"]
    assert robot.submits(Say("door open", id="mine")).attached


def test_such_a_goal_needs_no_room_and_does_nothing_to_others() -> None:
    robot = Robot(max_queue=1)
    robot.says()
    robot.asks(Say("battery", key="battery"))
    robot.cancels("mine")
    goal = robot.asks(Say("door open", id="mine", key="battery", flush=True))
    assert goal.state is State.RECALLED
    assert robot.seen[-2:] == ["3 PENDING", "3 RECALLED"]
    assert robot.waiting() == [2]


def test_such_a_goal_is_rejected_all_the_same_where_it_would_be_and_stays_cancelled() -> None:
    robot = Robot()
    robot.cancels("mine")
    assert robot.asks(Say("", id="mine")).reason == "invalid_text"
    assert robot.asks(Say("door open", id="mine")).reason == "canceled"


def test_a_cancel_is_remembered_for_a_minute() -> None:
    assert EARLY_CANCEL == 60
    robot = Robot()
    robot.cancels("mine", "yours")
    robot.seconds += 59.9
    assert robot.asks(Say("door open", id="mine")).state is State.RECALLED
    robot.seconds += 0.2
    assert robot.asks(Say("door open", id="yours")).state is State.ACTIVE


def test_a_thousand_cancels_are_remembered_and_the_oldest_goes_first() -> None:
    assert MAX_EARLY_CANCELS == 1_000
    robot = Robot()
    robot.cancels(*(f"goal:{number}" for number in range(1_000)))
    robot.cancels("goal:0", "goal:1000")
    assert robot.asks(Say("door open", id="goal:0")).state is State.RECALLED
    assert robot.asks(Say("door open", id="goal:2")).state is State.RECALLED
    assert robot.asks(Say("door open", id="goal:1")).state is State.ACTIVE


def test_cancels_of_ids_that_no_client_can_choose_drive_out_nothing() -> None:
    robot = Robot()
    robot.cancels("mine")
    robot.cancels(*(f"9z9z-{number}" for number in range(1_000)))
    assert robot.asks(Say("door open", id="mine")).state is State.RECALLED


@pytest.mark.parametrize("goal_id", ["4k7f-1", "9z9z-7", "17", "-x", "a b", ""])
def test_a_cancel_of_an_id_that_no_client_can_choose_cancels_nothing_to_come(goal_id: str) -> None:
    robot = Robot()
    assert robot.cancels(goal_id).unknown == [goal_id]
    goal = robot.says()
    assert (goal.id, goal.state) == ("4k7f-1", State.ACTIVE)


def test_an_id_cancelled_as_the_last_of_those_before_it_is_remembered_too() -> None:
    robot = Robot()
    assert robot.cancels(before="mine").unknown == ["mine"]
    assert robot.asks(Say("door open", id="mine")).state is State.RECALLED
