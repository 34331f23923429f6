"""The scheduler by examples: order, preempt, admission, cancel, shutdown, and what a goal's end says of it."""

from __future__ import annotations

import pytest

from talkcli.goals.goal import By
from talkcli.goals.options import Say
from talkcli.goals.scheduler import Cancelled, Changed, Now
from talkcli.goals.states import State
from tests.unit.robot import ARM, DOOR, Robot, ending, numbers


def test_goals_are_spoken_first_in_first_out() -> None:
    robot = Robot()
    goals = [robot.says(text) for text in ("a", "b", "c")]
    for goal in goals:
        robot.tells("completed", goal.id)
    assert robot.seen == [
        *("1 PENDING", "1 ACTIVE", "1 Start", "2 PENDING", "3 PENDING"),
        *("1 SUCCEEDED", "2 ACTIVE", "2 Start", "2 SUCCEEDED", "3 ACTIVE", "3 Start", "3 SUCCEEDED"),
    ]


def test_a_goal_that_succeeded_says_so() -> None:
    robot = Robot()
    goal = robot.says("door open")
    robot.seconds += 3
    robot.tells("completed", goal.id)
    told = goal.snapshot()
    assert (told.state, told.message, told.reason) == (State.SUCCEEDED, "Talk completed successfully", None)
    assert (told.by, told.client, told.duration, told.spoken) == (None, ARM, 1.5, "door open")
    assert told.queued_at == told.started_at == 1.7e9 + 100
    assert told.ended_at == 1.7e9 + 103


@pytest.mark.parametrize(("gaps", "words"), [(1, "1 gap of 2.0 s in all"), (3, "3 gaps of 2.0 s in all")])
def test_a_goal_with_gaps_succeeded_and_says_so(gaps: int, words: str) -> None:
    robot = Robot()
    goal = robot.says("door open")
    robot.see(robot.scheduler.completed(goal.id, 1.5, robot.now, gaps, 2.04))
    told = goal.snapshot()
    message = f"Talk completed successfully, but with {words}: this machine is too slow for the voice"
    assert (told.state, told.message) == (State.SUCCEEDED, message)


def test_a_goal_that_failed_says_why_and_how_far_it_came_and_the_next_one_starts() -> None:
    robot = Robot()
    goal = robot.says("door open")
    robot.says()
    robot.tells("heard", goal.id)
    robot.tells("failed", goal.id)
    told = goal.snapshot()
    assert (told.state, told.reason, told.message) == (State.ABORTED, "audio_lost", "Talk aborted: device is gone")
    assert (told.spoken, told.by) == ("door", None)
    assert robot.seen[-3:] == ["1 ABORTED", "2 ACTIVE", "2 Start"]


def test_what_was_heard_only_moves_forward() -> None:
    robot = Robot()
    goal = robot.says("door open")
    assert goal.snapshot().spoken == ""
    for end, spoken in ((4, "door"), (2, "door"), (0, "door"), (9, "door open"), (4, "door open")):
        assert robot.scheduler.heard(goal.id, end) is goal
        assert goal.snapshot().spoken == spoken


def test_a_goal_that_waits_has_nothing_spoken_and_no_end() -> None:
    robot = Robot()
    robot.says()
    told = robot.says().snapshot()
    assert (told.spoken, told.started_at, told.ended_at, told.message, told.reason) == (None, None, None, None, None)


def test_data_and_format_travel_with_the_goal() -> None:
    record = Robot().scheduler.submit(Say("hi", data={"page": 3}), ARM, Now(0, 0)).record
    assert (record.snapshot().data, record.snapshot().format) == ({"page": 3}, "text")


# Preempt


def test_preempt_stops_the_active_goal_and_goes_first_when_it_is_silent() -> None:
    robot = Robot()
    first = robot.says()
    robot.says()
    robot.says()
    newcomer = robot.says(preempt=True)
    assert robot.waiting() == [4, 2, 3]
    robot.tells("stopped", first.id)
    assert ending(first) == (State.PREEMPTED, "preempted", By(goal=newcomer.id))
    assert newcomer.state is State.ACTIVE
    assert robot.waiting() == [2, 3]


def test_the_newest_of_those_that_preempt_wins_and_the_rest_of_the_queue_stays() -> None:
    robot = Robot()
    robot.says()
    robot.says()
    older = robot.says(preempt=True)
    newer = robot.says(preempt=True)
    assert ending(older) == (State.RECALLED, "preempted", By(goal=newer.id))
    assert str(older.message).startswith("Talk recalled: ")
    assert robot.waiting() == [4, 2]
    assert robot.seen[-2:] == ["4 PENDING", "3 RECALLED"]


def test_preempt_with_nothing_spoken_starts_at_once() -> None:
    robot = Robot()
    robot.says(preempt=True)
    assert robot.seen == ["1 PENDING", "1 ACTIVE", "1 Start"]


def test_preempt_may_be_the_servers_default_and_a_goal_may_opt_out() -> None:
    robot = Robot(preempt=True)
    robot.says(preempt=False)
    robot.says(preempt=False)
    assert robot.seen[-1] == "2 PENDING"
    robot.says()
    assert robot.waiting() == [3, 2]
    robot.says(preempt=False)
    assert robot.waiting() == [3, 2, 4]


def test_of_a_thousand_preempting_goals_the_last_is_spoken_whole() -> None:
    robot = Robot()
    goals = [robot.says(f"goal {number}", preempt=True) for number in range(1_000)]
    robot.tells("stopped", goals[0].id)
    robot.tells("completed", goals[-1].id)
    assert [each.state for each in goals] == [State.PREEMPTED, *[State.RECALLED] * 998, State.SUCCEEDED]
    ends = [each for each in robot.seen if each.split()[1] in {"PREEMPTED", "RECALLED", "SUCCEEDED"}]
    assert len(ends) == len(set(ends)) == 1_000
    assert robot.scheduler.unfinished() == []


# Admission


@pytest.mark.parametrize(
    ("say", "reason"),
    [
        (Say("", preempt=True), "invalid_text"),
        (Say("\u200b", preempt=True), "invalid_text"),
        (Say("a\0", preempt=True), "invalid_text"),
        (Say("\ud800", preempt=True), "invalid_text"),
        (Say("a" * 100_000, preempt=True), "text_too_long"),
        (Say("hi", preempt=True, format="ssml"), "bad_option"),
    ],
)
def test_a_rejected_goal_has_its_reason_and_interrupts_nothing(say: Say, reason: str) -> None:
    robot = Robot()
    active, pending = robot.says(), robot.says(preempt=False)
    before = active.snapshot(), pending.snapshot(), robot.waiting()
    done = robot.submits(say)
    record = done.record
    assert done.effects == [Changed(record, State.REJECTED)]
    assert (record.reason, record.started_at, record.ended_at) == (reason, None, robot.now.wall)
    assert str(record.message).startswith("Talk rejected: ")
    assert (active.snapshot(), pending.snapshot(), robot.waiting()) == before
    assert robot.scheduler.find(record.id) is record


def test_a_full_queue_rejects_the_newcomer() -> None:
    robot = Robot(max_queue=2)
    goals = [robot.says() for _ in range(4)]
    assert ending(goals[3]) == (State.REJECTED, "queue_full", None)
    assert robot.waiting() == [2, 3]
    assert goals[0].state is State.ACTIVE


def test_room_is_counted_after_those_that_give_way() -> None:
    robot = Robot(max_queue=1)
    robot.says()
    older = robot.says(preempt=True)
    newer = robot.says(preempt=True)
    assert (older.state, newer.state) == (State.RECALLED, State.PENDING)
    assert robot.says(preempt=False).reason == "queue_full"
    assert newer.state is State.PENDING


def test_no_id_is_used_twice_and_each_is_the_boots() -> None:
    robot = Robot(max_queue=1)
    ids = [robot.says(text).id for text in ("a", "b", "c", "", "d")]
    assert len(set(ids)) == 5
    assert all(each.startswith("4k7f-") for each in ids)


# Cancel


def test_cancel_without_a_selector_ends_everything() -> None:
    robot = Robot()
    goals = [robot.says() for _ in range(4)]
    done = robot.cancels()
    assert (numbers(done.recalled), done.stopping) == ([2, 3, 4], goals[0])
    for goal in goals[1:]:
        assert ending(goal) == (State.RECALLED, "canceled", By(client=DOOR))
        assert str(goal.message).startswith("Talk recalled: ")
    robot.tells("stopped", goals[0].id)
    assert robot.scheduler.unfinished() == []
    assert sum(each.endswith(("RECALLED", "PREEMPTED")) for each in robot.seen) == 4


def test_cancel_with_nothing_to_cancel_does_nothing() -> None:
    robot = Robot()
    assert robot.cancels() == Cancelled()
    assert robot.cancels(current=True) == Cancelled()


def test_cancel_of_one_of_three_pending_keeps_the_order_of_the_rest() -> None:
    robot = Robot()
    goals = [robot.says() for _ in range(4)]
    assert numbers(robot.cancels(goals[2].id).recalled) == [3]
    assert robot.waiting() == [2, 4]
    assert goals[0].state is State.ACTIVE


def test_cancel_before_an_id_ends_that_goal_and_all_accepted_before_it() -> None:
    robot = Robot()
    goals = [robot.says() for _ in range(9)]
    newest = robot.says(preempt=True)
    done = robot.cancels(before=goals[6].id)
    assert numbers(done.recalled) == [2, 3, 4, 5, 6, 7]
    assert done.stopping is goals[0]
    assert robot.waiting() == [newest.number, 8, 9]


def test_cancel_of_ended_and_unknown_ids_says_so_and_does_the_rest() -> None:
    robot = Robot()
    ended = robot.says()
    robot.tells("completed", ended.id)
    before = ended.snapshot()
    robot.says()
    pending = robot.says()
    done = robot.cancels(ended.id, "4k7f-99", pending.id, pending.id, before="mine")
    assert (done.ended, sorted(done.unknown), done.recalled, done.stopping) == (
        [ended], ["4k7f-99", "mine"], [pending], None
    )  # fmt: skip
    assert ended.snapshot() == before


def test_selectors_of_a_cancel_add_up() -> None:
    robot = Robot()
    goals = [robot.says() for _ in range(5)]
    done = robot.cancels(goals[4].id, current=True, before=goals[1].id)
    assert (numbers(done.recalled), done.stopping) == ([2, 5], goals[0])
    assert robot.waiting() == [3, 4]


# The end


def test_shutdown_ends_everything_for_its_own_reason_and_takes_no_goal_any_more() -> None:
    robot = Robot()
    goals = [robot.says() for _ in range(4)]
    robot.shuts_down()
    robot.shuts_down()
    assert [ending(each) for each in goals[1:]] == [(State.RECALLED, "shutdown", None)] * 3
    late = robot.says()
    assert ending(late) == (State.REJECTED, "shutdown", None)
    robot.tells("stopped", goals[0].id)
    assert ending(goals[0]) == (State.PREEMPTED, "shutdown", None)
    assert robot.seen.count("1 Stop") == 1
    assert robot.scheduler.unfinished() == []


def test_results_are_found_after_the_end() -> None:
    robot = Robot()
    goals = [robot.says() for _ in range(3)]
    robot.cancels()
    robot.tells("stopped", goals[0].id)
    assert [robot.scheduler.find(each.id) for each in goals] == list(goals)
    assert robot.scheduler.find("4k7f-4") is None
