"""The order of goals by examples: priority, what preempts whom, flush, and who gives way in a full queue."""

from __future__ import annotations

import pytest

from talkcli.frozen import replace
from talkcli.goals.goal import By
from talkcli.goals.options import Cancel, Say
from talkcli.goals.scheduler import Changed
from talkcli.goals.states import State
from tests.unit.robot import ARM, DOOR, Robot, ending

# Priority


def test_higher_priorities_go_first_and_equals_in_the_order_in_which_they_came() -> None:
    robot = Robot()
    robot.says("a sentence")
    for priority, text in ((0, "zero"), (5, "five"), (1, "one"), (5, "five again"), (-3, "minus three")):
        robot.says(text, priority=priority)
    assert robot.waiting() == [3, 5, 4, 2, 6]
    assert robot.speaks_the_rest() == ["five", "five again", "one", "zero", "minus three"]


def test_a_higher_priority_alone_interrupts_nothing() -> None:
    robot = Robot()
    active = robot.says()
    robot.says(priority=1_000)
    assert active.state is State.ACTIVE


def test_priority_is_told() -> None:
    assert Robot().says(priority=-7).snapshot().priority == -7


# Preempt


@pytest.mark.parametrize(("priority", "stopped"), [(0, False), (4, False), (5, True), (6, True)])
def test_preempt_stops_the_active_goal_unless_its_priority_is_higher(priority: int, *, stopped: bool) -> None:
    robot = Robot()
    active = robot.says(priority=5)
    robot.says(preempt=True, priority=priority)
    assert active.state is (State.PREEMPTING if stopped else State.ACTIVE)


def test_preempt_with_a_lower_priority_than_the_active_goal_is_first_among_its_own_and_recalls_nothing_higher() -> None:
    robot = Robot()
    active = robot.says("urgent", priority=5)
    robot.says("low", priority=1)
    robot.says("high", priority=3)
    urgent = robot.says("higher and preempting", preempt=True, priority=3)
    newcomer = robot.says("newcomer", preempt=True, priority=1)
    assert active.state is State.ACTIVE
    assert urgent.state is State.PENDING
    assert robot.waiting() == [urgent.number, 3, newcomer.number, 2]


def test_preempt_recalls_those_of_a_lower_priority_that_were_sent_to_preempt() -> None:
    robot = Robot()
    robot.says()
    lower = robot.says(preempt=True, priority=-1)
    plain = robot.says(priority=-1)
    newer = robot.says(preempt=True)
    assert ending(lower) == (State.RECALLED, "preempted", By(goal=newer.id))
    assert robot.waiting() == [newer.number, plain.number]


def test_a_higher_goal_that_waits_still_goes_before_the_one_that_preempts() -> None:
    robot = Robot()
    active = robot.says()
    robot.says("high", priority=2)
    newcomer = robot.says("newcomer", preempt=True)
    robot.tells("stopped", active.id)
    assert ending(active) == (State.PREEMPTED, "preempted", By(goal=newcomer.id))
    assert robot.speaks_the_rest() == ["newcomer"]


def test_the_servers_default_may_change_and_goals_that_wait_keep_what_they_were_sent_with() -> None:
    robot = Robot(preempt=True)
    robot.says("active")
    preempting = robot.says("preempting")
    robot.scheduler.settings = replace(robot.scheduler.settings, preempt=False)
    robot.says("plain")
    newcomer = robot.says("newcomer", preempt=True)
    assert ending(preempting) == (State.RECALLED, "preempted", By(goal=newcomer.id))
    assert robot.waiting() == [newcomer.number, 3]


# Flush


def test_flush_preempts_and_recalls_all_that_waits_with_the_same_or_a_lower_priority() -> None:
    robot = Robot()
    active = robot.says()
    gone = [robot.says(), robot.says(priority=-1), robot.says(preempt=False)]
    higher = robot.says(priority=1)
    newcomer = robot.asks(Say("newcomer", flush=True))
    assert [ending(each) for each in gone] == [(State.RECALLED, "preempted", By(goal=newcomer.id))] * 3
    assert (active.state, active.by) == (State.PREEMPTING, By(goal=newcomer.id))
    assert robot.waiting() == [higher.number, newcomer.number]


def test_flush_does_not_stop_a_goal_of_a_higher_priority() -> None:
    robot = Robot()
    active, waiting = robot.says(priority=1), robot.says()
    newcomer = robot.asks(Say("newcomer", flush=True))
    assert (active.state, waiting.state) == (State.ACTIVE, State.RECALLED)
    assert robot.waiting() == [newcomer.number]


def test_flush_counts_as_preempting_for_the_next_one() -> None:
    robot = Robot()
    robot.says()
    flushing = robot.asks(Say("flushing", flush=True))
    newer = robot.says(preempt=True)
    assert ending(flushing) == (State.RECALLED, "preempted", By(goal=newer.id))


def test_flush_when_nothing_is_said_starts_at_once() -> None:
    robot = Robot()
    robot.asks(Say("hi", flush=True))
    assert robot.seen == ["1 PENDING", "1 ACTIVE", "1 Start"]


def test_what_a_goal_ends_is_told_after_its_own_acceptance_and_before_it_starts() -> None:
    robot = Robot(max_queue=1)
    robot.pauses()
    robot.says()
    robot.asks(Say("newcomer", flush=True))
    robot.resumes()
    assert robot.seen == ["1 PENDING", "2 PENDING", "1 RECALLED", "2 ACTIVE", "2 Start"]


# A full queue


def test_in_a_full_queue_the_newest_of_the_lowest_priority_gives_way_to_a_higher_one() -> None:
    robot = Robot(max_queue=4)
    robot.says()
    waiting = [robot.says(priority=each) for each in (0, 1, 0, 2)]
    newcomer = robot.says("urgent", priority=5)
    assert ending(waiting[2]) == (State.RECALLED, "displaced", By(goal=newcomer.id))
    assert str(waiting[2].message).startswith("Talk recalled: ")
    assert robot.waiting() == [newcomer.number, 5, 3, 2]
    assert robot.seen[-2:] == ["6 PENDING", "4 RECALLED"]


@pytest.mark.parametrize("priority", [0, -1])
def test_in_a_full_queue_nothing_gives_way_to_an_equal_or_a_lower_one(priority: int) -> None:
    robot = Robot(max_queue=2)
    robot.says()
    robot.says()
    robot.says(priority=1)
    assert ending(robot.says(priority=priority)) == (State.REJECTED, "queue_full", None)
    assert robot.waiting() == [3, 2]


@pytest.mark.parametrize(
    ("priorities", "say", "displaced"),
    [
        ([0, 0], Say("fire", preempt=True), 2),
        ([0, 0], Say("fire", preempt=True, key="fire"), 2),
        ([2, 1, 1, 2], Say("fire", preempt=True, priority=2), 3),
        ([1, 1], Say("fire", preempt=True), None),
        ([0, 0], Say("fire"), None),
        ([0, 0], Say("fire", preempt=False), None),
        ([1, 1], Say("fire", flush=True), None),
    ],
    ids=str,
)
@pytest.mark.parametrize("paused", [False, True])
@pytest.mark.parametrize("preempt", [False, True])
def test_only_a_goal_that_brings_preempt_displaces_its_own_priority(
    priorities: list[int], say: Say, displaced: int | None, paused: bool, preempt: bool
) -> None:
    robot = Robot(preempt=preempt, max_queue=len(priorities))
    active = robot.says("a long story", priority=2, preempt=False)
    waiting = [robot.says("log", priority=each, preempt=False) for each in priorities]
    if paused:
        robot.pauses()
    goal = robot.asks(say)
    ended = [each for each in waiting if each.state is State.RECALLED]
    if displaced is None:
        assert (ending(goal), ended) == ((State.REJECTED, "queue_full", None), [])
    else:
        assert ended == [waiting[displaced - 1]]
        assert ending(ended[0]) == (State.RECALLED, "displaced", By(goal=goal.id))
        stopped = active.priority <= say.priority
        assert (active.state is State.PREEMPTING) is stopped


def test_a_goal_may_give_way_that_is_first_in_the_queue_for_it_is_the_newest() -> None:
    robot = Robot(max_queue=2)
    robot.says()
    robot.says("older")
    robot.says("newer", preempt=True)
    robot.says("urgent", priority=1)
    assert robot.waiting() == [4, 2]


def test_a_goal_in_anothers_place_is_as_new_as_it_is() -> None:
    robot = Robot(max_queue=3)
    robot.says("active")
    robot.asks(Say("face", key="face"))
    robot.says("plain")
    robot.says("plain")
    newest = robot.asks(Say("face again", key="face"))
    assert robot.waiting() == [newest.number, 3, 4]
    newcomer = robot.says("urgent", priority=1)
    assert ending(newest) == (State.RECALLED, "displaced", By(goal=newcomer.id))


@pytest.mark.parametrize("options", [Say("x", flush=True), Say("x", key="face"), Say("x", preempt=True)])
def test_room_is_counted_after_what_a_goal_recalls_and_nothing_more_gives_way(options: Say) -> None:
    robot = Robot(max_queue=2)
    robot.says("active")
    robot.says("plain", priority=-1, preempt=False)
    going = robot.asks(Say("face", key="face", preempt=True))
    newcomer = robot.asks(options)
    assert newcomer.state is State.PENDING
    assert going.reason == ("replaced" if options.key else "preempted")
    assert robot.seen.count("2 RECALLED") == (1 if options.flush else 0)
    assert robot.scheduler.pending_count == (1 if options.flush else 2)


def test_a_goal_that_is_rejected_replaces_flushes_and_interrupts_nothing() -> None:
    robot = Robot(max_queue=2)
    robot.says("active", priority=1)
    robot.says("high", priority=1)
    robot.asks(Say("higher", priority=2, preempt=True))
    before = list(robot.seen)
    rejected = robot.asks(Say("x", flush=True))
    assert rejected.reason == "queue_full"
    assert robot.seen == [*before, "4 REJECTED"]


def test_a_goal_that_could_wait_for_room_is_known() -> None:
    robot = Robot(max_queue=1)
    assert not robot.lacks_room(Say("x"))
    robot.says()
    assert not robot.lacks_room(Say("x"))
    waiting = robot.asks(Say("y", key="face", id="mine"))
    assert robot.lacks_room(Say("x"))
    assert robot.lacks_room(Say("x", preempt=True, priority=-1))
    for fits in (Say("x", priority=1), Say("x", flush=True), Say("x", preempt=True), Say("x", key="face")):
        assert not robot.lacks_room(fits)
    for would_not_help in (Say(""), Say("x", rate=1), Say("y", id="mine"), Say("z", id="mine")):
        assert not robot.lacks_room(would_not_help)
    assert not robot.lacks_room(Say("x"), ("unknown_voice", "no such voice"))
    robot.cancels("early")
    assert not robot.lacks_room(Say("x", id="early")), "it is RECALLED at once"
    robot.cancels(waiting.id)
    assert not robot.lacks_room(Say("x"))


def test_a_goal_that_waits_for_room_goes_on_when_it_has_it_or_never_will() -> None:
    robot = Robot(max_queue=1)
    robot.says()
    robot.says()
    assert not robot.scheduler.has_room(Say("x"))
    assert robot.scheduler.has_room(Say("x", priority=1))
    robot.shuts_down()
    assert robot.asks(Say("x")).reason == "shutdown"
    assert robot.scheduler.has_room(Say("x"))


@pytest.mark.parametrize(
    "say", [Say("x"), Say("x", flush=True), Say("door open", throttle=60)], ids=lambda each: each.text
)
def test_a_goal_cancelled_while_it_waited_for_room_is_recalled_and_stops_nothing(say: Say) -> None:
    robot = Robot(max_queue=1)
    spoken, waiting = robot.says(), robot.says()
    by = By(client=DOOR)
    done = robot.scheduler.submit(say, ARM, robot.now, None, by)
    assert ending(done.record) == (State.RECALLED, "canceled", by)
    assert [each.state for each in done.effects if isinstance(each, Changed)] == [State.PENDING, State.RECALLED]
    assert (spoken.state, waiting.state) == (State.ACTIVE, State.PENDING)


@pytest.mark.parametrize(
    ("selection", "chosen"),
    [
        (Cancel(), [0, 1, 2, 3]),
        (Cancel(ids=()), []),
        (Cancel(ids=("b", "7", "c")), [1, 2]),
        (Cancel(key="k"), [0, 1]),
        (Cancel(current=True), []),
        (Cancel(before="b"), [0, 1]),
        (Cancel(before="nobody's"), []),
        (Cancel(ids=("c",), before="b", current=True), [0, 1, 2]),
    ],
    ids=str,
)
def test_which_of_those_that_wait_for_room_a_cancel_selects(selection: Cancel, chosen: list[int]) -> None:
    waiting = [Say("1", key="k"), Say("2", id="b", key="k"), Say("3", id="c"), Say("4")]
    assert selection.of_waiting(waiting) == chosen
