"""What a step costs while ten thousand goals wait, the most that there can be: about as much as while a hundred do.

Compared with each other on the same machine, never with a number of seconds. Whatever looks at every goal that waits
would take a hundred times as long; what is asserted leaves room for caches and for others who use the machine.
"""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING

import pytest

from talkcli.goals.options import Say
from tests.unit.robot import Robot
from tests.unit.stopwatch import least_seconds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

FEW, MANY = 100, 10_000
#: Of the hundred times that there would be.
AT_MOST = 5


def crowd(size: int) -> Robot:
    """Return a robot that is saying something while this many goals wait, of several priorities, some with a time."""
    robot = Robot(max_queue=size)
    robot.says("active", priority=9)
    for number in range(size):
        ttl = 1_000.0 + number if number % 2 else None
        robot.asks(Say("waiting", priority=number % 5, ttl=ttl, key=f"key {number}", id=f"goal:{number}"))
    assert robot.scheduler.pending_count == size
    robot.seen.clear()
    return robot


@pytest.fixture(scope="module")
def crowds() -> Iterator[tuple[Robot, Robot]]:
    gc.disable()  # else a collection that looks at all of them falls into what is measured
    yield crowd(FEW), crowd(MANY)
    gc.enable()


def speak_the_next(robot: Robot) -> None:
    assert robot.scheduler.active
    robot.tells("completed", robot.scheduler.active.id)
    robot.says("one more")


def displace(robot: Robot) -> None:
    assert robot.says("urgent", priority=8).state.name == "PENDING"


def be_refused(robot: Robot) -> None:
    assert robot.says("one too many", priority=-1).reason == "queue_full"


def replace(robot: Robot) -> None:
    assert robot.asks(Say("newer", key="battery", priority=8, ttl=50)).state.name == "PENDING"


def preempt(robot: Robot) -> None:
    robot.asks(Say("preempting", preempt=True, priority=8))


def cancel_and_say(robot: Robot) -> None:
    robot.cancels(robot.says("urgent", priority=8).id)
    robot.says("one more", priority=0)


def cancel_a_key(robot: Robot) -> None:
    robot.asks(Say("newer", key="door", priority=8))
    robot.cancels(key="door")
    robot.says("one more", priority=0)


def look_at_the_clock(robot: Robot) -> None:
    assert robot.scheduler.deadline() is not None
    robot.waits(0)


def attach(robot: Robot) -> None:
    assert robot.submits(Say("waiting", id="goal:99")).record.text == "waiting"


def throttle(robot: Robot) -> None:
    assert robot.asks(Say("newer", key="face", throttle=60, priority=8)).state.name == "PENDING"


def ask_for_room(robot: Robot) -> None:
    assert robot.scheduler.has_room(Say("patient", preempt=True, priority=8))
    assert not robot.scheduler.has_room(Say("patient", preempt=True, priority=-1))


STEPS = [
    *(speak_the_next, be_refused, replace, look_at_the_clock, attach, throttle, displace, preempt),
    *(cancel_and_say, cancel_a_key, ask_for_room),
]


@pytest.mark.parametrize("step", STEPS)
def test_a_step_costs_no_more_because_many_wait(crowds: tuple[Robot, Robot], step: Callable[[Robot], None]) -> None:
    few, many = (least_seconds(lambda robot=robot: step(robot)) for robot in crowds)  # type: ignore[misc]
    assert many < AT_MOST * few, f"{many / few:.0f} times as long with {MANY // FEW} times as many goals"
