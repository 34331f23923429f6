"""What a step costs with ten thousand goals waiting, against a hundred: counted, so that no machine matters.

Counted are the interpreter's own steps. What it does within one of them, such as moving the end of a list, it does at a
speed at which ten thousand make little difference; `test_scheduler_cost` measures it.
"""

from __future__ import annotations

import sys
import tracemalloc
from itertools import count, islice
from typing import TYPE_CHECKING

import pytest

from talkcli.goals.options import Say
from talkcli.goals.queue import Queue
from talkcli.goals.record import Record
from talkcli.protocol import events
from talkcli.protocol.lines import encode
from tests.unit.robot import ARM, Robot

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType
    from typing import Any

FEW, MANY = 100, 10_000
#: The most that the hundredfold may cost: a search in what is sorted takes seven steps more, of some ten.
AT_MOST = 1.5
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


class Comparisons(float):
    """A moment that counts how often moments are compared."""

    made = 0

    def __lt__(self, other: float) -> bool:
        Comparisons.made += 1
        return float(self) < float(other)

    def __eq__(self, other: object) -> bool:
        return self is other

    __hash__ = float.__hash__


class Crowd(Robot):
    """A robot that says something while so many goals wait: of five priorities, some with a key or a time to live."""

    def __init__(self, size: int) -> None:
        super().__init__(max_queue=size + 100)
        self.numbers = count()
        self.says("active", priority=9)
        for _ in range(size):
            self.enqueue()
        assert self.scheduler.pending_count == size

    def say(self, **options: Any) -> Say:
        number = next(self.numbers)
        usual: dict[str, Any] = {"priority": number % 5, "id": f"goal:{number}"}
        usual["ttl"] = None if number % 3 else 1_000.0 + number
        usual["key"] = f"key {number}" if number % 2 else None
        return Say("battery low", **{**usual, **options})

    def enqueue(self, **options: Any) -> str:
        say = self.say(**options)
        self.scheduler.submit(say, ARM, self.now)
        assert say.id
        return say.id


@pytest.fixture(scope="module")
def crowds() -> tuple[Crowd, Crowd]:
    return Crowd(FEW), Crowd(MANY)


def enqueue(crowd: Crowd) -> int:
    return steps(crowd.enqueue)


def enqueue_with_a_time_to_live(crowd: Crowd) -> int:
    return steps(lambda: crowd.enqueue(ttl=500.0))


def replace_one_by_its_key(crowd: Crowd) -> int:
    crowd.enqueue(key="battery")
    return steps(lambda: crowd.enqueue(key="battery"))


def enqueue_a_preempting_one(crowd: Crowd) -> int:
    return steps(lambda: crowd.enqueue(preempt=True))


def cancel_in_the_middle(crowd: Crowd) -> int:
    middle = crowd.scheduler.pending_count // 2
    ids = [each.id for each in islice(crowd.scheduler.pending(), middle, middle + 5)]
    taken = sum(steps(lambda each=each: crowd.cancels(each)) for each in ids)  # type: ignore[misc]
    for _ in ids:
        crowd.enqueue()
    return taken


def start_the_next(crowd: Crowd) -> int:
    assert crowd.scheduler.active
    goal_id = crowd.scheduler.active.id
    taken = steps(lambda: crowd.tells("completed", goal_id))
    crowd.enqueue()
    return taken


def a_status_line(crowd: Crowd) -> int:
    goals = crowd.scheduler.pending()
    next(goals)
    return steps(lambda: encode(events.item(7, pending=next(goals).snapshot().to_json())))


def look_at_the_clock(crowd: Crowd) -> int:
    return steps(crowd.scheduler.deadline)


STEPS = [
    *(enqueue, enqueue_with_a_time_to_live, enqueue_a_preempting_one, replace_one_by_its_key),
    *(cancel_in_the_middle, start_the_next, a_status_line, look_at_the_clock),
]


@pytest.mark.parametrize("step", STEPS)
def test_a_step_takes_no_more_because_a_hundred_times_as_many_wait(
    crowds: tuple[Crowd, Crowd], step: Callable[[Crowd], int]
) -> None:
    few, many = (sorted(step(crowd) for _ in range(9)) for crowd in crowds)
    # The median: what one goal brings, another doesn't.
    assert 0 < many[4] <= AT_MOST * few[4], f"{many[4]} steps of the interpreter, {few[4]} with {FEW:,} goals"


def test_a_full_queue_gives_way_in_as_many_steps_however_much_has_left_it() -> None:
    robot = Robot(max_queue=FEW)
    robot.says("active", priority=9)
    for _ in range(FEW):
        robot.says()
    taken = [steps(lambda: robot.says("urgent", priority=1)) for _ in range(FEW)]
    assert robot.scheduler.pending_count == FEW
    assert max(taken[1:-1]) <= AT_MOST * min(taken[1:-1])


def test_priorities_that_are_all_different_make_no_search_longer() -> None:
    taken = []
    for size in (FEW // 10, FEW * 10):
        robot = Robot(max_queue=size + 100)
        robot.says("active", priority=10 * size)
        for number in range(size):
            robot.says(priority=number)
        taken.append(steps(lambda: robot.says("urgent", priority=size // 2, preempt=True)))  # noqa: B023
    assert taken[1] <= AT_MOST * taken[0]


def test_a_time_to_live_finds_its_place_in_few_comparisons() -> None:
    made = []
    for size in (FEW, MANY // 4):
        queue = Queue()
        for number in range(size + 1):
            record = Record(f"4k7f-{number}", number, Say("battery low"), ARM, 1.0)
            # The last one is over first, so that it has the longest way.
            record.expires_at = Comparisons(size + number * 7 % size if number < size else 0.0)
            Comparisons.made = 0
            queue.add(record)
        made.append(Comparisons.made)
    assert 0 < made[1] <= made[0] + 10, made


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
