"""Invalid reports from the engine about a goal are refused and change nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.goals.states import IllegalTransition
from tests.unit.robot import play

if TYPE_CHECKING:
    from tests.unit.robot import Robot

EVENTS = ["heard", "completed", "failed", "deaf", "stopped", "voice_chosen", "output_changed"]
#: Goals that are not active. Another goal is active meanwhile. The last one was given up.
SCENE = "a; completed a; b; failed b; c text=; d; cancel d; stopped d; e; f; cancel f; g; cancel e; pass 2; wait 0; h"
SPOKEN = "g ACTIVE; h PENDING; a SUCCEEDED; b ABORTED audio_lost; c REJECTED invalid_text; "
SPOKEN += "d PREEMPTED canceled by door; e ABORTED not_silent by door; f RECALLED canceled by door"


def tell(robot: Robot, event: str, goal_id: str) -> None:
    if event == "voice_chosen":
        robot.scheduler.voice_chosen(goal_id, "en", robot.now)
    elif event == "output_changed":
        robot.scheduler.output_changed(goal_id, None)
    else:
        robot.tells(event, goal_id)


@pytest.mark.parametrize("event", EVENTS)
def test_an_event_of_a_goal_that_is_not_spoken_is_refused(event: str) -> None:
    robot = play(SCENE)
    assert robot.outcome() == SPOKEN
    before = [each.snapshot() for each in robot.goals.values()], list(robot.seen), robot.scheduler.deadline()
    for goal_id in [*(robot.goals[each].id for each in "abcdefh"), "4k7f-99"]:
        with pytest.raises(IllegalTransition, match=f"{goal_id} is not being spoken"):
            tell(robot, event, goal_id)
    assert ([each.snapshot() for each in robot.goals.values()], robot.seen, robot.scheduler.deadline()) == before


def test_a_goal_that_was_not_told_to_stop_cannot_have_stopped() -> None:
    robot = play("a")
    before = robot.goals["a"].snapshot()
    with pytest.raises(IllegalTransition):
        robot.play("stopped a")
    assert robot.goals["a"].snapshot() == before
    assert robot.play("completed a").outcome() == "a SUCCEEDED"
