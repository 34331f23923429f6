"""Keys and throttles, by examples: what is not said twice."""

from __future__ import annotations

import pytest

from talkcli.goals.goal import By
from talkcli.goals.history import MAX_SAID
from talkcli.goals.options import Say
from talkcli.goals.states import State
from tests.unit.robot import ARM, DOOR, Robot, ending, numbers

# Key


def test_of_three_goals_of_a_key_only_the_newest_is_spoken_in_the_firsts_place() -> None:
    robot = Robot()
    robot.says("a long sentence")
    first = robot.asks(Say("battery 12 %", key="battery"))
    robot.says("door open")
    second = robot.asks(Say("battery 11 %", key="battery"))
    third = robot.asks(Say("battery 10 %", key="battery"))
    assert ending(first) == (State.RECALLED, "replaced", By(goal=second.id))
    assert ending(second) == (State.RECALLED, "replaced", By(goal=third.id))
    assert robot.speaks_the_rest() == ["battery 10 %", "door open"]


def test_a_key_never_replaces_the_goal_being_spoken() -> None:
    robot = Robot()
    active = robot.asks(Say("battery 12 %", key="battery"))
    robot.asks(Say("battery 11 %", key="battery"))
    assert active.state is State.ACTIVE
    assert robot.waiting() == [2]


def test_goals_of_another_key_or_of_none_stay() -> None:
    robot = Robot()
    robot.says()
    for key in ("battery", "door", None, "battery"):
        robot.asks(Say("x", key=key))
    assert robot.waiting() == [5, 3, 4]


def test_a_goal_of_another_priority_is_queued_by_its_own_rules() -> None:
    robot = Robot()
    robot.says()
    robot.asks(Say("battery", key="battery"))
    robot.says()
    robot.asks(Say("battery", key="battery", priority=-1))
    assert robot.waiting() == [3, 4]
    robot.asks(Say("battery", key="battery", priority=1))
    assert robot.waiting() == [5, 3]


def test_a_key_replaces_a_goal_of_a_higher_priority_too() -> None:
    robot = Robot()
    robot.says()
    higher = robot.asks(Say("battery", key="battery", priority=9))
    newer = robot.asks(Say("battery", key="battery"))
    assert ending(higher) == (State.RECALLED, "replaced", By(goal=newer.id))


def test_a_goal_that_preempts_goes_first_and_not_into_the_place_of_the_one_it_replaces() -> None:
    robot = Robot()
    active = robot.says()
    robot.says()
    robot.asks(Say("battery", key="battery"))
    robot.asks(Say("battery", key="battery", preempt=True))
    assert robot.waiting() == [4, 2]
    assert active.state is State.PREEMPTING


@pytest.mark.parametrize("flush", [False, True])
def test_a_goal_that_would_be_preempted_and_replaced_is_replaced(*, flush: bool) -> None:
    robot = Robot()
    robot.says()
    older = robot.asks(Say("battery", key="battery", preempt=True))
    newer = robot.asks(Say("battery", key="battery", flush=flush, preempt=True))
    assert ending(older) == (State.RECALLED, "replaced", By(goal=newer.id))


def test_one_in_the_place_of_a_preempting_goal_is_not_recalled_as_if_it_preempted() -> None:
    robot = Robot()
    robot.says()
    robot.asks(Say("battery", key="battery", preempt=True))
    plain = robot.asks(Say("battery", key="battery"))
    newer = robot.says(preempt=True)
    assert plain.state is State.PENDING
    assert robot.waiting() == [newer.number, plain.number]


def test_cancel_of_a_key_ends_the_goals_that_have_it_pending_and_active() -> None:
    robot = Robot()
    active = robot.asks(Say("battery", key="battery"))
    robot.asks(Say("door", key="door"))
    pending = robot.asks(Say("battery", key="battery"))
    done = robot.cancels(key="battery")
    assert (done.recalled, done.stopping) == ([pending], active)
    assert ending(pending) == (State.RECALLED, "canceled", By(client=DOOR))
    assert robot.waiting() == [2]


def test_cancel_of_a_key_that_nobody_has_is_success_and_adds_up_with_the_rest() -> None:
    robot = Robot()
    robot.asks(Say("door", key="door"))
    pending = robot.says()
    assert robot.cancels(key="battery").effects == []
    done = robot.cancels(pending.id, key="battery")
    assert (numbers(done.recalled), done.stopping, done.unknown) == ([2], None, [])


# Throttle


def test_a_throttled_goal_is_rejected_while_its_key_is_being_spoken_and_for_the_time_after_it_began() -> None:
    robot = Robot()
    first = robot.asks(Say("battery 12 %", key="battery", throttle=60))
    say = Say("battery 11 %", key="battery", throttle=60)
    robot.seconds += 59
    assert ending(robot.asks(say)) == (State.REJECTED, "throttled", By(goal=first.id))
    robot.tells("completed", first.id)
    assert ending(robot.asks(say)) == (State.REJECTED, "throttled", By(goal=first.id))
    robot.seconds += 1
    assert robot.asks(say).state is State.ACTIVE


def test_a_goal_that_is_spoken_longer_than_the_throttle_lasts_throttles_to_its_end() -> None:
    robot = Robot()
    first = robot.asks(Say("a long story", throttle=1))
    robot.seconds += 100
    assert robot.asks(Say("a long story", throttle=1)).by == By(goal=first.id)
    robot.tells("completed", first.id)
    assert robot.asks(Say("a long story", throttle=1)).state is State.ACTIVE


def test_a_goal_without_a_throttle_is_not_throttled_but_throttles_others() -> None:
    robot = Robot()
    robot.says("door open")
    again = robot.says("door open")
    robot.speaks_the_rest()
    assert again.state is State.SUCCEEDED
    assert robot.asks(Say("door open", throttle=60)).by == By(goal=again.id)


@pytest.mark.parametrize("end", ["expired", "aborted", "canceled", "preempted unheard"])
def test_what_was_never_heard_or_was_aborted_does_not_throttle(end: str) -> None:
    robot = Robot()
    blocker = robot.says("a sentence", priority=1)
    first = robot.asks(Say("battery", key="battery", throttle=60, ttl=1 if end == "expired" else None))
    if end == "expired":
        robot.waits(1)
    elif end == "canceled":
        robot.cancels(first.id)
    robot.tells("completed", blocker.id)
    if end == "aborted":
        robot.tells("heard", first.id)
        robot.tells("failed", first.id)
    elif end == "preempted unheard":
        robot.cancels(first.id)
        robot.tells("stopped", first.id)
    assert first.state.terminal
    assert robot.asks(Say("battery", key="battery", throttle=60)).state is State.ACTIVE


def test_what_was_heard_in_part_before_it_was_stopped_throttles() -> None:
    robot = Robot()
    first = robot.says("door open")
    robot.tells("heard", first.id)
    robot.cancels(first.id)
    robot.tells("stopped", first.id)
    assert robot.asks(Say("door open", throttle=60)).by == By(goal=first.id)


def test_one_that_is_aborted_leaves_the_earlier_one_remembered() -> None:
    robot = Robot()
    first = robot.says("door open")
    robot.tells("completed", first.id)
    robot.seconds += 5
    second = robot.says("door open")
    robot.tells("failed", second.id)
    assert robot.asks(Say("door open", throttle=60)).by == By(goal=first.id)


def test_a_pending_goal_throttles_one_of_the_same_text_and_is_named() -> None:
    robot = Robot()
    robot.says("a sentence")
    first = robot.says("door open")
    robot.says("door open")
    assert ending(robot.asks(Say("door open", throttle=1))) == (State.REJECTED, "throttled", By(goal=first.id))
    urgent = robot.says("door open", priority=1)
    assert robot.asks(Say("door open", throttle=1)).by == By(goal=urgent.id)


def test_a_pending_goal_of_the_same_key_is_replaced_and_throttles_nothing() -> None:
    robot = Robot()
    robot.says("a sentence")
    first = robot.asks(Say("battery", key="battery", throttle=60))
    second = robot.asks(Say("battery", key="battery", throttle=60))
    assert ending(first) == (State.RECALLED, "replaced", By(goal=second.id))


def test_with_a_key_the_text_does_not_matter_and_without_one_the_key_does_not() -> None:
    robot = Robot()
    first = robot.asks(Say("battery low", key="battery"))
    robot.tells("completed", first.id)
    assert robot.asks(Say("battery low", throttle=60)).by == By(goal=first.id)
    other = robot.asks(Say("battery low", key="door", throttle=60))
    assert other.state is State.ACTIVE
    robot.tells("completed", other.id)
    assert robot.asks(Say("something else", key="battery", throttle=60)).by == By(goal=first.id)


def test_a_throttled_goal_replaces_flushes_and_interrupts_nothing() -> None:
    robot = Robot()
    robot.asks(Say("battery", key="battery"))
    robot.asks(Say("battery", key="battery"))
    before = list(robot.seen)
    assert robot.asks(Say("battery", key="battery", throttle=1, flush=True)).reason == "throttled"
    assert robot.seen == [*before, "3 REJECTED"]


def test_time_on_the_wall_does_not_matter_to_a_throttle() -> None:
    robot = Robot()
    first = robot.says()
    robot.tells("completed", first.id)
    done = robot.scheduler.submit(Say("door open", throttle=60), ARM, type(robot.now)(robot.seconds + 59, 9e9))
    assert done.record.reason == "throttled"


def test_ten_thousand_keys_are_remembered() -> None:
    assert MAX_SAID == 10_000
    robot = Robot()
    for number in range(MAX_SAID + 1):
        robot.tells("completed", robot.asks(Say(f"text {number}", key=f"key {number}")).id)
    assert robot.asks(Say("x", key="key 1", throttle=60)).reason == "throttled"
    assert robot.asks(Say("x", key=f"key {MAX_SAID}", throttle=60)).reason == "throttled"
    assert robot.asks(Say("text 1", throttle=60)).reason == "throttled"
    assert robot.asks(Say("x", key="key 0", throttle=60)).state is State.ACTIVE


def test_a_key_that_is_said_again_is_not_the_oldest_any_more() -> None:
    robot = Robot()
    for number in [*range(MAX_SAID), 0, MAX_SAID]:
        robot.tells("completed", robot.asks(Say(f"text {number}", key=f"key {number}")).id)
    assert robot.asks(Say("x", key="key 0", throttle=60)).reason == "throttled"
    assert robot.asks(Say("x", key="key 1", throttle=60)).state is State.ACTIVE
