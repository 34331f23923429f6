"""Growing texts in the scheduler: what may be added, and how goals end if the rest of the text never comes."""

from __future__ import annotations

import pytest

from talkcli.errors import RequestRefused
from talkcli.goals.options import GROWTH_FACTOR, MAX_TEXT_CHARS, Append
from talkcli.goals.reasons import Reason
from talkcli.goals.scheduler import CONFIRM_SILENCE_S
from tests.unit.robot import play, rules

RULES = """
# a text that is complete
may grow while the goal waits
    a; b more; append b text=c end; completed a; completed b -> a b SUCCEEDED
# a text that doesn't go on
ends after its limit
    a more stall=2; starved a; wait 1.9; wait 0.1; stopped a -> a ABORTED text_stalled
has its whole limit again after each addition
    a more stall=2; starved a; wait 1.9; append a text=b; wait 1.9 -> a ACTIVE
has its whole limit again after a pause
    a more stall=2; starved a; wait 1; pause; wait 9; resume; wait 1.9 -> a ACTIVE
stalls after a pause
    a more stall=2; starved a; pause; wait 9; resume; wait 2; stopped a -> a ABORTED text_stalled
has no limit while there is text to speak
    a more stall=2; starved a; fed a; wait 9 -> a ACTIVE
has no limit once it is complete
    a more stall=2; starved a; append a end; wait 9 -> a ACTIVE
has no limit once it breaks off
    a more stall=2; starved a; left a; wait 9 -> a ACTIVE
has no limit before it is spoken
    a; b more stall=1; wait 9; completed a -> b ACTIVE; a SUCCEEDED
is cancelled rather than stalled if both happen
    a more stall=1; starved a; cancel a; wait 1; stopped a -> a PREEMPTED canceled by door
is stopped by force if it doesn't become silent
    a more stall=1; starved a; wait 1; wait 2 -> a ABORTED not_silent
# a sender that leaves
breaks off a waiting goal at once
    a; b more; left b -> a ACTIVE; b RECALLED broken_off
ends the goal as broken off then
    a more; left a; completed a -> a ABORTED broken_off
changes nothing once the text is complete
    a more; append a end; left a; completed a -> a SUCCEEDED
may come back if it chose the id
    a more id=x stall=2; left a; wait 1.9; append a text=b end; wait 9; completed a -> a SUCCEEDED
may come back by sending the same goal
    a more id=x stall=2; left a; wait 1.9; b more id=x text=a; wait 9; append a end; completed a -> a SUCCEEDED; b is a
that chose the id breaks off the goal after the limit
    a more id=x stall=2; left a; wait 2; completed a -> a ABORTED broken_off
that chose the id breaks off a waiting goal after the limit
    a; b more id=x stall=2; left b; wait 1.9; wait 0.1 -> a ACTIVE; b RECALLED broken_off
can be cancelled meanwhile
    a; b more id=x stall=2; left b; cancel b; wait 9 -> a ACTIVE; b RECALLED canceled by door
# a sender that gives up
stops the goal at once
    a more; append a text=b end broken; stopped a -> a ABORTED broken_off
takes a waiting goal out of the queue
    a; b more; append b broken -> a ACTIVE; b RECALLED broken_off
doesn't bring back a goal that is cancelled first
    a more; cancel a; left a; stopped a -> a PREEMPTED canceled by door
# a failure
of the engine after a stall is not reported instead of it
    a more stall=1; starved a; wait 1; failed a -> a ABORTED text_stalled
"""


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert play(script).outcome() == outcome


@pytest.mark.parametrize(
    ("script", "addition", "code"),
    [
        ("a more; completed a", {"text": "b"}, "goal_ended"),
        ("a more; cancel a", {"text": "b"}, "goal_ended"),
        ("a more; left a", {"text": "b"}, "goal_ended"),
        ("a", {"text": "b"}, "text_ended"),
        ("a more; append a end", {"text": "b"}, "text_ended"),
        ("a more", {"text": "b", "at": 2}, "text_missing"),
        ("a more", {"text": "bc", "at": 0}, "text_conflict"),
        ("a more", {"text": "x" * MAX_TEXT_CHARS * GROWTH_FACTOR}, "text_too_long"),
        ("a more", {"text": "\0"}, "invalid_text"),
        ("a more", {"text": "\ud800"}, "invalid_text"),
    ],
)
def test_an_addition_that_does_not_fit_is_refused_and_changes_nothing(
    script: str, addition: dict[str, object], code: str
) -> None:
    robot = play(script)
    record = robot.goals["a"]
    before = record.snapshot(), list(robot.seen), robot.scheduler.deadline()
    with pytest.raises(RequestRefused) as refused:
        robot.scheduler.append(record, Append(record.id, **addition), robot.now)  # type: ignore[arg-type]
    assert refused.value.code == code
    assert (record.snapshot(), robot.seen, robot.scheduler.deadline()) == before


def test_an_addition_that_is_sent_again_is_added_once() -> None:
    robot = play("a more; append a text=bc at=1; append a text=bc at=1; append a text=bcd at=1; append a end at=4")
    robot.play("append a text=d at=3 end; completed a")
    assert robot.goals["a"].snapshot().text == "abcd"
    assert robot.seen.count("a Append") == 3  # bc, d and the end


def test_a_growing_goal_is_known_again_by_its_first_text_and_shows_whether_it_grows() -> None:
    robot = play("a more id=x; append a text=bc; starved a; b id=x text=a")
    assert robot.attached == ["b is a"]
    goal = robot.goals["a"].snapshot()
    assert (goal.text, goal.more, goal.waits) == ("abc", True, True)
    goal = robot.play("append a end; fed a; completed a").goals["a"].snapshot()
    assert (goal.spoken, goal.spoken_end, goal.more, goal.waits) == ("abc", 3, False, False)


def test_what_was_heard_of_a_broken_text_is_not_the_whole_text() -> None:
    robot = play("a more; append a text=bcdef; heard a; left a; completed a")
    goal = robot.goals["a"].snapshot()
    assert (goal.text, goal.spoken, goal.spoken_end) == ("abcdef", "abcd", 4)
    assert goal.message == "speech failed: the text broke off before its end"


def test_a_text_that_breaks_off_before_its_first_sentence_is_complete_is_broken_off() -> None:
    robot = play("a more; left a")
    robot.collect(robot.scheduler.failed(robot.goals["a"].id, Reason.NOTHING_TO_SAY, "nothing", None, robot.now))
    assert robot.outcome() == "a ABORTED broken_off"


def test_the_last_word_was_heard_to_its_end_if_text_is_missing() -> None:
    robot = play("a more; append a text=bcd; heard a")
    assert robot.goals["a"].snapshot().spoken_end == 0
    assert robot.play("starved a").goals["a"].snapshot().spoken_end == 4
    assert robot.play("cancel; stopped a").goals["a"].snapshot().spoken_end == 4


def test_a_stall_is_due_at_its_limit_and_then_silence_is_due() -> None:
    robot = play("a more stall=2; starved a")
    assert robot.scheduler.deadline() == robot.seconds + 2
    robot.play("wait 2")
    assert robot.scheduler.deadline() == robot.seconds + CONFIRM_SILENCE_S
    assert robot.play("stopped a").goals["a"].message == "speech failed: no more text arrived for 2 s"


def test_a_growing_text_is_throttled_only_by_its_key() -> None:
    assert play("a more throttle=1.0").outcome() == "a REJECTED bad_option"
    assert (
        play("a more throttle=1.0 key=k; b more throttle=1.0 key=k").outcome() == "a ACTIVE; b REJECTED throttled by a"
    )


def test_a_growing_text_may_begin_longer_than_others() -> None:
    assert play(f"a more text={'x' * (MAX_TEXT_CHARS + 1)}").outcome() == "a ACTIVE"
    assert play(f"a text={'x' * (MAX_TEXT_CHARS + 1)}").outcome() == "a REJECTED text_too_long"
