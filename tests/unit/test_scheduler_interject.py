"""Interjections: which goals they interrupt, what is spoken next, and how interrupted goals end."""

from __future__ import annotations

import pytest

from talkcli.goals.goal import Output
from talkcli.goals.reasons import Reason
from talkcli.goals.scheduler import MAX_INTERRUPTED, Scheduler
from talkcli.goals.states import State
from tests.unit.robot import Robot, play, rules

RULES = """
# an interjection
is an ordinary goal if nothing is spoken
    a interject -> a ACTIVE
is spoken once the goal has reached the end of its word
    a; b; c interject; interrupted a -> c ACTIVE; a ACTIVE paused for c; b PENDING
interrupts a sound, too
    a format=sound; b interject format=sound; interrupted a -> b ACTIVE; a ACTIVE paused for b
is next if only the last word of the goal was left
    a; b; c interject; completed a -> c ACTIVE; b PENDING; a SUCCEEDED
lets the goal continue before the queue
    a; b 9; c interject; interrupted a; completed c -> a ACTIVE; b PENDING; c SUCCEEDED
interrupts no goal of a higher priority
    a 1; b; c interject; completed a -> c ACTIVE; b PENDING; a SUCCEEDED
goes first among waiting goals of its priority, but behind those that preempt
    a; pause; b; c interject; d interject; e 1; f preempt -> a PREEMPTING preempted by f; e f c d b PENDING
waits while an interruption is on its way
    a; b interject; c interject; interrupted a -> b ACTIVE; a ACTIVE paused for b; c PENDING
is spoken after one of a higher priority if both wait
    a; b interject; c 1 interject; interrupted a -> c ACTIVE; a ACTIVE paused for c; b PENDING
waits for another interjection
    a; b interject; interrupted a; c interject; completed b -> c ACTIVE; a ACTIVE paused for c; b SUCCEEDED
interrupts another interjection of a lower priority
    a; b interject; interrupted a; c 1 interject; interrupted b
        -> c ACTIVE; b ACTIVE paused for c; a ACTIVE paused for b
lets interrupted goals continue in the reverse order
    a; b interject; interrupted a; c 1 interject; interrupted b; completed c
        -> b ACTIVE; a ACTIVE paused for b; c SUCCEEDED
waits until an interrupted goal of a higher priority has ended
    a 1; b 1 interject; interrupted a; c interject; completed b -> a ACTIVE; c PENDING; b SUCCEEDED
may repeatedly interrupt a goal
    a; b interject; interrupted a; completed b; c interject; interrupted a
        -> c ACTIVE; a ACTIVE paused for c; b SUCCEEDED
takes the place of a waiting interjection with its key
    a 1; b interject key=k; c interject; d interject key=k -> a ACTIVE; d c PENDING; b RECALLED replaced by d
goes to its own place if it replaces another kind of goal
    a 1; b key=k; c interject; d interject key=k -> a ACTIVE; c d PENDING; b RECALLED replaced by d
can't end other goals
    a; b interject preempt; c interject flush -> a ACTIVE; b c REJECTED bad_option
ends no goal even if the server's setting is to preempt
    set preempt=yes; a; b interject -> a ACTIVE; b PENDING
waits for no voice
    loaded joe; unloaded joe; a; b interject voice=piper/joe; interrupted a -> b ACTIVE; a ACTIVE paused for b
interrupts only once its voice is there if it needs that voice
    a; b interject voice=piper/joe voice_only; heard a -> a ACTIVE; b PENDING
# an interruption that is not needed any more
lets the goal continue at once
    a; b; c interject; cancel c; interrupted a -> a ACTIVE; b PENDING; c RECALLED canceled by door
lets the goal continue at once if the interjection expires
    a; b interject ttl=1; wait 1; interrupted a -> a ACTIVE; b RECALLED expired
# a pause
delays an interjection
    a; pause; b interject -> a ACTIVE paused; b PENDING
is followed by the interruption
    a; pause; b interject; resume; interrupted a -> b ACTIVE; a ACTIVE paused for b
of an interjection resumes the interjection
    a; b interject; interrupted a; pause; resume -> b ACTIVE; a ACTIVE paused for b
before the end of the word holds both goals
    a; b interject; pause; interrupted a -> a ACTIVE paused for b; b PENDING
before the end of the word is followed by the interjection
    a; b interject; pause; interrupted a; resume -> b ACTIVE; a ACTIVE paused for b
before the end of the word may end before the word
    a; b interject; pause; resume; interrupted a -> b ACTIVE; a ACTIVE paused for b
# a cancel
ends interrupted goals at once
    a; b; c interject; interrupted a; cancel
        -> c PREEMPTING canceled by door; a PREEMPTED canceled by door; b RECALLED canceled by door
of an interrupted goal leaves the interjection alone
    a; b interject; interrupted a; cancel a -> b ACTIVE; a PREEMPTED canceled by door
of the current goal lets the interrupted one continue
    a; b interject; interrupted a; cancel current; stopped b -> a ACTIVE; b PREEMPTED canceled by door
of a key ends an interrupted goal
    a key=k; b interject; interrupted a; cancel key=k -> b ACTIVE; a PREEMPTED canceled by door
of older goals ends an interrupted goal
    a; b; c interject; interrupted a; cancel before=b
        -> c ACTIVE; a PREEMPTED canceled by door; b RECALLED canceled by door
of the goal that interrupts another one names the next one instead
    a; b interject; interrupted a; c 1 interject; interrupted b; cancel b
        -> c ACTIVE; a ACTIVE paused for c; b PREEMPTED canceled by door
that arrives before the end of the word ends the goal
    a; b interject; cancel a; interrupted a -> b ACTIVE; a PREEMPTED canceled by door
# a goal that preempts
ends the interjection and the interrupted goals before it is spoken
    a; b; c interject; interrupted a; d preempt -> c PREEMPTING preempted by d; d b PENDING; a PREEMPTED preempted by d
is spoken next
    a; b interject; interrupted a; c preempt; stopped b -> c ACTIVE; a b PREEMPTED preempted by c
or flushes does so, too
    a; b; c interject; interrupted a; d flush; stopped c
        -> d ACTIVE; a c PREEMPTED preempted by d; b RECALLED preempted by d
ends interrupted goals of its priority, but no interjection of a higher one
    a; b 1 interject; interrupted a; c preempt -> b ACTIVE; c PENDING; a PREEMPTED preempted by c
waits for interrupted goals of a higher priority
    a 1; b 1 interject; interrupted a; c preempt; completed b -> a ACTIVE; c PENDING; b SUCCEEDED
ends a goal that is being interrupted
    a; b interject; c preempt; stopped a -> c ACTIVE; b PENDING; a PREEMPTED preempted by c
is interrupted by a newer interjection
    a; b preempt; stopped a; c interject; interrupted b -> c ACTIVE; b ACTIVE paused for c; a PREEMPTED preempted by b
in a pause ends interrupted goals
    a; b interject; pause; interrupted a; c preempt -> c b PENDING; a PREEMPTED preempted by c
# an interrupted goal
does not expire
    a ttl=1; b interject; interrupted a; wait 2; completed b -> a ACTIVE; b SUCCEEDED
throttles its text
    a; b interject; interrupted a; c text=a throttle=9 -> b ACTIVE; a ACTIVE paused for b; c REJECTED throttled by a
is not replaced by a goal with its key
    a key=k; b interject; interrupted a; c key=k -> b ACTIVE; a ACTIVE paused for b; c PENDING
ends at a shutdown
    a; b interject; interrupted a; shutdown; stopped b -> a b PREEMPTED shutdown
is not affected if the interjection fails
    a; b interject; interrupted a; failed b -> a ACTIVE; b ABORTED audio_lost
continues with a new engine
    a; b interject; interrupted a; lost; failed b; ready -> a ACTIVE; b ABORTED audio_lost
waits for a new engine
    a; b interject; interrupted a; lost; completed b -> a ACTIVE paused for b; b SUCCEEDED
fails if no engine can be started
    a; b interject; interrupted a; lost; completed b; missing -> a ABORTED engine_failed; b SUCCEEDED
may end before it reaches the end of its word
    a; b interject; failed a -> b ACTIVE; a ABORTED audio_lost
# an interrupted growing text
grows
    a more; b interject; interrupted a; append a text=bc end; completed b; completed a -> a b SUCCEEDED
doesn't stall
    a more stall=2; starved a; b interject; interrupted a; wait 9; completed b; wait 9 -> a ACTIVE; b SUCCEEDED
stalls after it has continued
    a more stall=2; starved a; b interject; interrupted a; completed b; starved a; wait 2; stopped a
        -> a ABORTED text_stalled; b SUCCEEDED
breaks off after its last sentence
    a more; b interject; interrupted a; left a; completed b; completed a -> a ABORTED broken_off; b SUCCEEDED
ends at once if its sender gives up
    a more; b interject; interrupted a; append a broken -> b ACTIVE; a ABORTED broken_off
"""


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert play(script).outcome() == outcome


def test_the_effects_of_an_interruption_come_in_order() -> None:
    robot = play("a; b interject; interrupted a; completed b; completed a")
    before = ["a Interrupt", "a interrupted by 4k7f-2", "b ACTIVE", "b Start"]
    after = ["b SUCCEEDED", "a ACTIVE", "a Start", "a SUCCEEDED"]
    assert robot.seen[robot.seen.index("a Interrupt") :] == before + after


def test_interrupted_goals_end_before_an_urgent_goal_starts() -> None:
    for option, verb in (("preempt", "PREEMPTED"), ("flush", "PREEMPTED")):
        robot = play(f"a; b interject; interrupted a; c 1 interject; interrupted b; d 1 {option}; stopped c")
        assert [robot.seen.index(f"{name} {verb}") for name in "abc"] == sorted(
            robot.seen.index(f"{name} {verb}") for name in "abc"
        )
        assert robot.seen.index("c PREEMPTED") < robot.seen.index("d Start")


def test_a_goal_that_preempts_is_not_interrupted_by_an_older_interjection() -> None:
    assert "c Interrupt" not in play("a; b interject; c preempt; stopped a; d").seen


def test_at_most_eight_goals_are_interrupted_and_the_next_interjection_waits() -> None:
    robot = play("a")
    for priority, name in enumerate("bcdefghi", 1):
        robot.play(f"{name} {priority} interject; interrupted *")
    assert len(robot.scheduler.interrupted) == MAX_INTERRUPTED
    robot.play("j 9 interject")
    assert robot.seen[-1] == "j PENDING"
    assert robot.play("completed i").scheduler.active is robot.goals["j"]
    for _ in range(MAX_INTERRUPTED + 1):
        robot.play("completed *")
    assert robot.outcome() == "a b c d e f g h i j SUCCEEDED"


def test_nothing_is_interrupted_that_is_written_to_a_file() -> None:
    robot = Robot()
    robot.scheduler = Scheduler("4k7f", max_queue=9, can_interrupt=False)
    robot.scheduler.engine_ready(robot.now)
    assert robot.play("a; b; c interject; completed a").outcome() == "c ACTIVE; b PENDING; a SUCCEEDED"
    assert "a Interrupt" not in robot.seen


def test_a_goal_that_was_ever_muted_or_had_gaps_says_so_at_its_end() -> None:
    robot = play("a; b interject")
    goal_id, now = robot.goals["a"].id, robot.now
    robot.scheduler.output_changed(goal_id, Output("pulse", "card", 1.0, muted=True))
    robot.scheduler.interrupted_at(goal_id, 1, now, 2, 0.5)
    robot.play("completed b")
    for output in (None, Output("pulse", "usb", 1.0, muted=False)):
        robot.scheduler.output_changed(goal_id, output)
    robot.scheduler.completed(goal_id, 1.5, now, 1, 0.25)
    goal = robot.goals["a"].snapshot()
    assert goal.output == Output("pulse", "usb", 1.0, muted=True)
    assert goal.message == (
        "Talk completed successfully, but the output was muted: usb, "
        "but with 3 gaps (0.8 s in total): this machine is too slow for the voice"
    )


def test_the_rest_of_a_sound_does_not_expire_while_it_waits_for_an_engine() -> None:
    robot = play("a format=sound ttl=1")
    robot.scheduler.audio_heard(robot.goals["a"].id, 0.25)
    robot.play("b interject; interrupted a; completed b; lost; wait 2")
    assert robot.outcome() == "a ACTIVE; b SUCCEEDED"


def test_a_goal_of_which_nothing_is_left_to_say_has_succeeded() -> None:
    robot = play("a; heard a; b interject; interrupted a; completed b")
    robot.scheduler.failed(robot.goals["a"].id, Reason.NOTHING_TO_SAY, "nothing", None, robot.now)
    goal = robot.goals["a"].snapshot()
    assert (goal.state, goal.duration) == (State.SUCCEEDED, 0.25)


def test_an_interrupted_goal_shows_what_was_heard_and_keeps_its_voice_loaded() -> None:
    robot = play("a voice=piper/joe; loaded joe; chosen a joe; heard a; b interject; interrupted a; measured joe 99")
    goal = robot.goals["a"].snapshot()
    assert (goal.state, goal.paused, goal.interrupted_by) == (State.ACTIVE, True, robot.goals["b"].id)
    assert (goal.spoken, goal.heard, goal.voice) == ("a", 0.25, "piper/joe")
    assert "drop piper/joe" not in robot.seen
