"""What a step costs with ten thousand goals waiting, the most that there can be: about as much as with a hundred.

Counted are the interpreter's own steps, so that no machine matters. What the interpreter does within one of them is
timed, and compared on the same machine: a look at every goal that waits would take a hundred times as long.
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
#: The most that the hundredfold may cost in steps: a search in what is sorted takes seven steps more, of some ten.
AT_MOST = 1.5
#: The most in seconds, which leaves room for caches and for others who use the machine.
AT_MOST_TIME = 5
#: Bytes that a pending goal of a short text may take.
MEMORY = 1024


def steps(action: Callable[[], object]) -> int:
    """Return how many steps the interpreter takes for this."""
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


def crowd(size: int) -> Robot:
    """Return a robot that is saying something while this many goals wait, of many priorities, half with a time."""
    robot = Robot(max_queue=size)
    robot.says("active", priority=9)
    for number in range(size):
        ttl = 1_000.0 + number if number % 2 else None
        robot.asks(Say("waiting", priority=-(number % 1_000), ttl=ttl, key=f"key {number}", id=f"goal:{number}"))
    assert robot.scheduler.pending_count == size
    robot.seen.clear()
    return robot


@pytest.fixture(scope="module")
def crowds() -> Iterator[tuple[Robot, Robot]]:
    gc.disable()  # else a collection that looks at all of them falls into what is measured
    yield crowd(FEW), crowd(MANY)
    gc.enable()


def ask_for_room(robot: Robot) -> None:
    assert robot.scheduler.has_room(Say("patient", preempt=True, priority=8))
    assert not robot.scheduler.has_room(Say("patient", preempt=True, priority=-1_000))


def write_a_status_line(robot: Robot) -> None:
    encode(events.item(7, pending=next(robot.scheduler.pending()).snapshot().to_json()))


#: Each a script, with the news that it must bring, or a function.
STEPS: dict[str, tuple[str, str] | Callable[[Robot], None]] = {
    "speak the next": ("completed *; z", "z PENDING"),
    "reject": ("z -1000", "z REJECTED"),
    "replace": ("z 8 key=battery ttl=50", "z PENDING"),
    "attach": ("z text=waiting id=goal:99", ""),
    "throttle": ("z 8 key=face throttle=60", "z PENDING"),
    "displace": ("z 8", "z PENDING"),
    "preempt": ("z 8 preempt", "z PENDING"),
    "cancel among others": ("z -20; cancel z; z -999", "z RECALLED"),
    "cancel a key": ("z 8 key=door; cancel key=door; z -999", "z RECALLED"),
    "look at the clock": ("wait 0", ""),
    "ask for room": ask_for_room,
    "write a status line": write_a_status_line,
}


def take(robot: Robot, name: str) -> None:
    step = STEPS[name]
    if isinstance(step, tuple):
        script, news = step
        robot.seen.clear()
        robot.play(script)
        assert not news or news in robot.seen
    else:
        step(robot)


@pytest.mark.parametrize("name", STEPS)
def test_a_step_costs_no_more_because_many_wait(crowds: tuple[Robot, Robot], name: str) -> None:
    def count(robot: Robot) -> int:
        # The median: what one goal brings, another doesn't.
        return sorted(steps(lambda: take(robot, name)) for _ in range(9))[4]

    def seconds(robot: Robot) -> float:
        return min(timeit.repeat(lambda: take(robot, name), repeat=7, number=8))

    few, many = map(count, crowds)
    assert 0 < many <= AT_MOST * few, f"{many} steps of the interpreter, {few} with {FEW:,} goals"
    few_s, many_s = map(seconds, crowds)
    assert many_s < AT_MOST_TIME * few_s, f"{many_s / few_s:.0f} times as long with {MANY // FEW} times as many goals"


def test_a_pending_goal_takes_less_than_a_kilobyte() -> None:
    robot = Robot(max_queue=5_000)
    robot.says("active")
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for number in range(5_000):
            robot.scheduler.submit(Say(f"battery low, the {number}th time"), ARM, robot.now)
        taken = (tracemalloc.get_traced_memory()[0] - before) / robot.scheduler.pending_count
    finally:
        tracemalloc.stop()
    assert taken < MEMORY, f"{taken:.0f} bytes a goal"
