"""Invalid reports from the engine about a goal are refused and change nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.goals.states import IllegalTransition
from tests.unit.robot import play

if TYPE_CHECKING:
    from tests.unit.robot import Robot

EVENTS = ["heard", "completed", "failed", "deaf", "stopped", "voice_chosen", "output_changed"]
#: A script after which only g is active. The stop of e was never confirmed.
SCRIPT = "a; completed a; b; failed b; c text=; d; cancel d; stopped d; e; f; cancel f; g; cancel e; pass 2; wait 0; h"
OUTCOME = "g ACTIVE; h PENDING; a SUCCEEDED; b ABORTED audio_lost; c REJECTED invalid_text; "
OUTCOME += "d PREEMPTED canceled by door; e ABORTED not_silent by door; f RECALLED canceled by door"


def report(robot: Robot, event: str, goal_id: str) -> None:
    if event == "voice_chosen":
        robot.scheduler.voice_chosen(goal_id, "en", robot.now)
    elif event == "output_changed":
        robot.scheduler.output_changed(goal_id, None)
    else:
        robot.report(event, goal_id)


@pytest.mark.parametrize("event", EVENTS)
def test_an_event_of_a_goal_that_is_not_being_spoken_is_refused(event: str) -> None:
    robot = play(SCRIPT)
    assert robot.outcome() == OUTCOME
    before = [record.snapshot() for record in robot.goals.values()], list(robot.seen), robot.scheduler.deadline()
    for goal_id in [*(robot.goals[name].id for name in "abcdefh"), "4k7f-99"]:
        with pytest.raises(IllegalTransition, match=f"{goal_id} is not being spoken"):
            report(robot, event, goal_id)
    assert ([record.snapshot() for record in robot.goals.values()], robot.seen, robot.scheduler.deadline()) == before


def test_a_report_of_a_stop_without_an_order_to_stop_is_refused() -> None:
    robot = play("a")
    before = robot.goals["a"].snapshot()
    with pytest.raises(IllegalTransition):
        robot.play("stopped a")
    assert robot.goals["a"].snapshot() == before
    assert robot.play("completed a").outcome() == "a SUCCEEDED"
