"""A step of the scheduler costs about as much with ten thousand pending goals as with a hundred.

The tests count the bytecode instructions of a step, which don't depend on the machine. They also compare times on the
same machine, because a single instruction can do much work. A search of all pending goals would take a hundred times as
long.
"""

from __future__ import annotations

import gc
import sys
import timeit
import tracemalloc
from typing import TYPE_CHECKING

import pytest

from talkcli.goals.options import Say
from talkcli.protocol import events
from talkcli.protocol.lines import encode
from tests.unit.robot import ARM, Robot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType
    from typing import Any

FEW, MANY = 100, 10_000
#: Limit for the ratio of instructions. A binary search takes seven more steps in a queue of a hundred times the length.
MAX_STEPS_RATIO = 1.5
#: Limit for the ratio of times. It allows for caches and for other programs on the machine.
MAX_TIME_RATIO = 5
#: Memory of a pending goal with a short text, in bytes.
MAX_GOAL_BYTES = 1024


def instructions(action: Callable[[], object]) -> int:
    """Return the number of bytecode instructions that an action takes."""
    taken = 0

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal taken
        frame.f_trace_opcodes = True
        taken += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    finally:
        sys.settrace(before)
    return taken


def busy_robot(size: int) -> Robot:
    """Return a robot with an active goal, and pending goals of many priorities. Half of these have a ttl."""
    robot = Robot(max_queue=size)
    robot.say("active", priority=9)
    for number in range(size):
        ttl = 1_000.0 + number if number % 2 else None
        robot.submit(Say("waiting", priority=-(number % 1_000), ttl=ttl, key=f"key {number}", id=f"goal:{number}"))
    assert len(robot.scheduler.pending) == size
    robot.seen.clear()
    return robot


@pytest.fixture(scope="module")
def busy_robots() -> Iterator[tuple[Robot, Robot]]:
    gc.disable()  # otherwise, a garbage collection of all goals could distort the measurement
    yield busy_robot(FEW), busy_robot(MANY)
    gc.enable()


def check_for_room(robot: Robot) -> None:
    assert robot.scheduler.has_room(Say("patient", preempt=True, priority=8))
    assert not robot.scheduler.has_room(Say("patient", preempt=True, priority=-1_000))


def write_a_status_line(robot: Robot) -> None:
    encode(events.item(7, pending=next(iter(robot.scheduler.pending)).snapshot().to_json()))


#: The steps to measure: a function, or a script with an effect that it must have.
STEPS: dict[str, tuple[str, str] | Callable[[Robot], None]] = {
    "start the next goal": ("completed *; z", "z PENDING"),
    "reject": ("z -1000", "z REJECTED"),
    "replace": ("z 8 key=battery ttl=50", "z PENDING"),
    "attach": ("z text=waiting id=goal:99", ""),
    "throttle": ("z 8 key=face throttle=60", "z PENDING"),
    "displace": ("z 8", "z PENDING"),
    "preempt": ("z 8 preempt", "z PENDING"),
    "cancel one of many": ("z -20; cancel z; z -999", "z RECALLED"),
    "cancel a key": ("z 8 key=door; cancel key=door; z -999", "z RECALLED"),
    "tick": ("wait 0", ""),
    "check for room": check_for_room,
    "write a status line": write_a_status_line,
}


def run_step(robot: Robot, name: str) -> None:
    step = STEPS[name]
    if isinstance(step, tuple):
        script, news = step
        robot.seen.clear()
        robot.play(script)
        assert not news or news in robot.seen
    else:
        step(robot)


@pytest.mark.parametrize("name", STEPS)
def test_the_cost_of_a_step_does_not_depend_on_the_queue_length(busy_robots: tuple[Robot, Robot], name: str) -> None:
    def count(robot: Robot) -> int:
        # The median is used because some goals cause more work than others.
        return sorted(instructions(lambda: run_step(robot, name)) for _ in range(9))[4]

    def seconds(robot: Robot) -> float:
        return min(timeit.repeat(lambda: run_step(robot, name), repeat=7, number=8))

    few, many = map(count, busy_robots)
    assert 0 < many <= MAX_STEPS_RATIO * few, f"{many} instructions, {few} with {FEW:,} goals"
    few_s, many_s = map(seconds, busy_robots)
    assert many_s < MAX_TIME_RATIO * few_s, f"{many_s / few_s:.0f} times as long with {MANY // FEW} times as many goals"


def test_a_pending_goal_uses_less_than_a_kilobyte() -> None:
    robot = Robot(max_queue=5_000)
    robot.say("active")
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for number in range(5_000):
            robot.scheduler.submit(Say(f"battery low, the {number}th time"), ARM, robot.now)
        taken = (tracemalloc.get_traced_memory()[0] - before) / len(robot.scheduler.pending)
    finally:
        tracemalloc.stop()
    assert taken < MAX_GOAL_BYTES, f"{taken:.0f} bytes per goal"
