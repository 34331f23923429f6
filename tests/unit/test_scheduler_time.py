"""Time and pause by examples: goals that come too late, speech that is held, and what goes on meanwhile."""

from __future__ import annotations

import pytest

from talkcli.frozen import replace
from talkcli.goals.goal import By
from talkcli.goals.options import Say
from talkcli.goals.scheduler import SILENCE_LIMIT, Now, Order, Ordered
from talkcli.goals.states import State
from tests.unit.robot import ARM, DOOR, Robot, ending

# Time to live


def test_a_goal_whose_time_is_over_before_it_began_is_recalled_and_never_spoken() -> None:
    robot = Robot()
    robot.says("a sentence of three seconds")
    late = robot.asks(Say("turn left", ttl=1))
    assert robot.scheduler.deadline() == 101
    robot.waits(0.9)
    assert late.state is State.PENDING
    robot.waits(0.1)
    assert ending(late) == (State.RECALLED, "expired", None)
    assert str(late.message).startswith("Talk recalled: ")
    assert late.ended_at == robot.now.wall
    assert robot.scheduler.deadline() is None
    assert robot.speaks_the_rest() == []


@pytest.mark.parametrize(
    ("say", "ttl"),
    [(Say("stop", ttl=1, preempt=True), 0.0), (Say("stop", ttl=1, flush=True), 0.0), (Say("stop", key="k"), 1.0)],
)
def test_a_goal_whose_time_is_over_while_it_waits_for_room_does_nothing_to_the_others(say: Say, ttl: float) -> None:
    robot = Robot(max_queue=1, ttl=ttl)
    robot.says()
    robot.asks(Say("left", ttl=0, key="k"))
    late = robot.scheduler.submit(say, ARM, robot.now, waited=1.0).record
    assert ending(late) == (State.RECALLED, "expired", None)
    assert late.message == "Talk recalled: its time to live of 1 s was over before it was spoken"
    assert [each.state.name for each in robot.scheduler.unfinished()] == ["ACTIVE", "PENDING"]


def test_a_goal_that_has_begun_may_take_its_time() -> None:
    robot = Robot()
    goal = robot.asks(Say("turn left", ttl=1))
    assert robot.scheduler.deadline() is None
    robot.waits(100)
    assert goal.state is State.ACTIVE


def test_a_goal_whose_time_is_over_is_not_started_even_if_nobody_looked_at_the_clock() -> None:
    robot = Robot()
    first = robot.says()
    late, alive = robot.asks(Say("left", ttl=1)), robot.asks(Say("right", ttl=2))
    robot.seconds += 1
    robot.tells("completed", first.id)
    assert (late.reason, alive.state) == ("expired", State.ACTIVE)
    assert robot.seen[-4:] == ["1 SUCCEEDED", "2 RECALLED", "3 ACTIVE", "3 Start"]


@pytest.mark.parametrize(
    ("server", "own", "effective"), [(0, None, None), (5, None, 5), (5, 0, None), (5, 2.5, 2.5), (0, 2.5, 2.5)]
)
def test_the_servers_time_to_live_holds_unless_the_goal_has_its_own(
    server: float, own: float | None, effective: float | None
) -> None:
    robot = Robot(ttl=server)
    robot.asks(Say("a sentence", ttl=0))
    goal = robot.asks(Say("turn left", ttl=own))
    assert goal.snapshot().ttl == effective
    assert robot.scheduler.deadline() == (None if effective is None else 100 + effective)


def test_the_servers_time_to_live_may_change_and_goals_that_wait_keep_theirs() -> None:
    robot = Robot(ttl=5)
    robot.says()
    robot.says()
    robot.scheduler.settings = replace(robot.scheduler.settings, ttl=1)
    robot.says()
    robot.waits(1)
    assert robot.waiting() == [2]
    robot.waits(4)
    assert robot.waiting() == []


def test_the_earliest_time_counts_whatever_the_order_and_goals_that_are_gone_do_not() -> None:
    robot = Robot()
    robot.says()
    late, early, middle = (robot.asks(Say("x", ttl=ttl)) for ttl in (9, 2, 4))
    assert robot.scheduler.deadline() == 102
    robot.cancels(early.id)
    assert robot.scheduler.deadline() == 104
    robot.waits(4)
    assert (middle.reason, late.state) == ("expired", State.PENDING)
    assert robot.scheduler.deadline() == 109


def test_the_deadline_is_that_of_silence_or_of_a_goal_whichever_is_first() -> None:
    robot = Robot()
    active = robot.says()
    robot.asks(Say("x", ttl=5))
    robot.cancels(active.id)
    assert robot.scheduler.deadline() == 100 + SILENCE_LIMIT
    robot.asks(Say("x", ttl=1))
    assert robot.scheduler.deadline() == 101


def test_what_is_too_late_when_silence_is_given_up_is_not_started() -> None:
    robot = Robot()
    active = robot.says()
    late = robot.asks(Say("x", ttl=1))
    robot.cancels(active.id)
    robot.waits(2)
    assert (active.reason, late.reason) == ("not_silent", "expired")
    assert robot.scheduler.active is None


def test_time_on_the_wall_does_not_matter() -> None:
    robot = Robot()
    robot.says()
    goal = robot.asks(Say("x", ttl=1))
    assert robot.scheduler.tick(Now(robot.seconds + 0.5, 9e9)) == []
    assert goal.state is State.PENDING


def test_many_goals_that_come_and_go_leave_no_deadline_behind() -> None:
    robot = Robot()
    robot.says()
    for number in range(1_000):
        robot.asks(Say(f"position {number}", key="position", ttl=1_000 + number))
    assert robot.scheduler.deadline() == 100 + 1_999
    robot.cancels(key="position")
    assert robot.scheduler.deadline() is None


# Pause


def test_pause_holds_the_goal_being_spoken_and_resume_goes_on_with_it() -> None:
    robot = Robot()
    goal = robot.says()
    assert robot.see(robot.scheduler.pause()) == [Ordered(goal, Order.HOLD)]
    assert (robot.scheduler.paused, goal.state, goal.snapshot().paused) == (True, State.ACTIVE, True)
    assert robot.see(robot.scheduler.resume(robot.now)) == [Ordered(goal, Order.RESUME)]
    assert (robot.scheduler.paused, goal.state, goal.snapshot().paused) == (False, State.ACTIVE, False)
    robot.tells("completed", goal.id)
    assert robot.seen == ["1 PENDING", "1 ACTIVE", "1 Start", "1 Hold", "1 Resume", "1 SUCCEEDED"]


def test_pause_and_resume_twice_do_nothing_the_second_time() -> None:
    robot = Robot()
    robot.says()
    robot.resumes()
    robot.pauses()
    robot.pauses()
    robot.resumes()
    robot.resumes()
    assert robot.seen[3:] == ["1 Hold", "1 Resume"]


def test_while_paused_goals_are_accepted_and_none_starts_until_resume() -> None:
    robot = Robot()
    robot.pauses()
    first, second = robot.says(), robot.says()
    assert (first.state, second.state) == (State.PENDING, State.PENDING)
    robot.resumes()
    assert (first.state, second.state) == (State.ACTIVE, State.PENDING)


def test_a_queue_that_is_full_while_paused_rejects() -> None:
    robot = Robot(max_queue=1)
    robot.pauses()
    robot.says()
    assert robot.says().reason == "queue_full"


def test_a_goal_that_was_ending_while_speech_was_paused_does_not_start_the_next() -> None:
    robot = Robot()
    goal, following = robot.says(), robot.says()
    robot.pauses()
    robot.tells("completed", goal.id)
    assert (goal.state, goal.snapshot().paused, following.state) == (State.SUCCEEDED, False, State.PENDING)
    robot.resumes()
    assert following.state is State.ACTIVE


def test_preempt_ends_the_held_goal_at_once_and_waits_itself() -> None:
    robot = Robot()
    held = robot.says()
    robot.pauses()
    newcomer = robot.says(preempt=True)
    assert (held.state, held.snapshot().paused) == (State.PREEMPTING, False)
    robot.tells("stopped", held.id)
    assert ending(held) == (State.PREEMPTED, "preempted", By(goal=newcomer.id))
    assert newcomer.state is State.PENDING
    robot.resumes()
    assert robot.seen[-2:] == ["2 ACTIVE", "2 Start"]


def test_a_goal_that_is_being_stopped_is_neither_held_nor_resumed() -> None:
    robot = Robot()
    goal, following = robot.says(), robot.says()
    robot.cancels(goal.id)
    robot.pauses()
    assert not goal.snapshot().paused
    robot.resumes()
    assert robot.seen[-2:] == ["1 PREEMPTING", "1 Stop"]
    robot.tells("stopped", goal.id)
    assert following.state is State.ACTIVE


def test_a_held_goal_that_was_stopped_before_resume_is_not_resumed() -> None:
    robot = Robot()
    goal = robot.says()
    robot.pauses()
    robot.cancels(goal.id)
    robot.resumes()
    assert robot.seen[-3:] == ["1 Hold", "1 PREEMPTING", "1 Stop"]


def test_cancel_ttl_and_the_limit_of_silence_go_on_while_paused() -> None:
    robot = Robot()
    held = robot.says()
    expiring, pending = robot.asks(Say("x", ttl=1)), robot.says()
    robot.pauses()
    robot.waits(1)
    assert ending(expiring) == (State.RECALLED, "expired", None)
    robot.cancels(pending.id)
    assert ending(pending) == (State.RECALLED, "canceled", By(client=DOOR))
    robot.cancels(held.id)
    robot.waits(2)
    assert ending(held) == (State.ABORTED, "not_silent", By(client=DOOR))


def test_a_goal_that_became_too_late_while_paused_is_not_started_by_resume() -> None:
    robot = Robot()
    robot.pauses()
    late, alive = robot.asks(Say("x", ttl=1)), robot.says()
    robot.seconds += 1
    robot.resumes()
    assert (late.reason, alive.state) == ("expired", State.ACTIVE)


def test_shutdown_ends_a_held_goal_too() -> None:
    robot = Robot()
    held, pending = robot.says(), robot.says()
    robot.pauses()
    robot.shuts_down()
    robot.tells("stopped", held.id)
    assert ending(held) == (State.PREEMPTED, "shutdown", None)
    assert ending(pending) == (State.RECALLED, "shutdown", None)
    robot.resumes()
    assert robot.scheduler.unfinished() == []


def test_a_goal_as_it_was_accepted_was_not_paused() -> None:
    robot = Robot()
    robot.pauses()
    goal = robot.scheduler.submit(Say("x"), ARM, robot.now).record
    robot.resumes()
    robot.pauses()
    assert goal.snapshot(State.PENDING).paused is False
    assert goal.snapshot().paused is True
