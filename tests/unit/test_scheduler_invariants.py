"""Invariants of the scheduler, which hold for all requests from clients and all reports from the engine.

The tests play random scripts for `tests.unit.robot`, and check each effect. The tables in `test_scheduler_*.py` define
the order of goals, and the reasons with which goals end.
"""

from __future__ import annotations

import random
from collections import defaultdict
from string import ascii_letters
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from talkcli.errors import RequestRefused
from talkcli.goals.scheduler import (
    CONFIRM_SILENCE_S,
    MAX_INTERRUPTED,
    EngineOrder,
    Interruption,
    Now,
    Order,
    StateChange,
)
from talkcli.goals.states import TRANSITIONS, IllegalTransition, State
from talkcli.goals.voices import VoiceLoadOrder
from tests.unit.robot import Robot

if TYPE_CHECKING:
    from talkcli.goals.goal import Goal
    from talkcli.goals.options import Say
    from talkcli.goals.record import Record
    from talkcli.goals.scheduler import Cancellation, Effect

#: Few values for each option, so that goals collide. Times are multiples of the clock's steps, so that they coincide.
OPTIONS = [
    ["text=door", "text=battery", "text=é日🤖"],
    ["", "", "", "preempt", "preempt", "queue", "flush", "interject", "interject", "interject"],
    ["", "", "1", "5", "-1"],
    ["", "", "key=battery", "key=door"],
    ["", "", "ttl=0.5", "ttl=0.0", "ttl=3.0"],
    ["", "", "", "throttle=10.0", "throttle=1.5"],
    ["", "", "", "id=mine", "id=arm.1"],
    ["", "", "", "voice=piper/joe", "voice=piper/amy#2"],
    ["", "", "", "voice_only"],
    ["", "", "", "waited=2.0"],
    ["", "", "more", "more stall=2"],
]
IDS = ["mine", "arm.1", "4k7f-900", *(f"4k7f-{number}" for number in range(1, 9))]
ENGINE = [
    "interrupted",
    "interrupted",
    "heard",
    "completed",
    "completed",
    "failed",
    "deaf",
    "stopped",
    "starved",
    "starved",
    "fed",
]
STEPS_S = ["0", "0.5", "1", "2", "10"]
BUSY = {State.ACTIVE, State.PREEMPTING}


def script(seed: int, length: int = 40) -> list[str]:
    """Return random steps. A step for the active goal refers to it by "*"."""
    chance = random.Random(seed)
    pick = chance.choice
    names = iter(ascii_letters)

    def cancel() -> str:
        ids = chance.sample(IDS, pick([0, 1, 2]))
        return " ".join(
            ["cancel", *ids, pick(["", "current"]), pick(["", f"before={pick(IDS)}"]), pick(["", "key=door"])]
        )

    kinds = [
        *[lambda: f"{next(names)} {' '.join(map(pick, OPTIONS))}"] * 8,
        *[lambda: f"{pick(ENGINE)} *"] * 4,
        *[lambda: f"{pick(['wait', 'wait', 'pass'])} {pick(STEPS_S)}"] * 2,
        *[lambda: pick(["pause", "resume", "resume", "lost", "ready", "ready", "missing"])] * 2,
        lambda: pick(["pause seconds=1", "pause connection=x", "pause connection=y seconds=2", "gone x", "gone y"]),
        lambda: f"{pick(['heard', 'completed', 'failed', 'stopped', 'interrupted'])} {pick(IDS)}",
        lambda: f"append {pick(IDS)} text={pick('ab')} {pick(['', '', 'end', 'broken'])}",
        lambda: f"left {pick(IDS)}",
        lambda: f"set preempt={pick(['yes', 'no'])} ttl={pick(['0.0', '1.0'])} voice={pick(['en', 'piper/joe'])}",
        lambda: (
            f"{pick(['loaded', 'loaded', 'unloadable', 'unloaded', 'measured'])} {pick(['joe', 'amy'])} {pick('29')}"
        ),
        cancel,
    ]
    first = f"set preempt={pick(['no', 'no', 'yes'])} ttl={pick(['0.0', '2.0'])}"
    return [f"room {chance.randint(1, 5)}", first, *(pick(kinds)() for _ in range(length))]


class Checked(Robot):
    """A robot that checks each effect, and the scheduler after each step."""

    def __init__(self) -> None:
        super().__init__(seconds=1_000.0)
        self.records: dict[str, Record] = {}
        self.states: dict[str, list[State]] = defaultdict(list)
        self.ended: dict[str, Goal] = {}
        self.started: set[str] = set()
        self.busy: set[str] = set()
        #: the interrupted goals
        self.silent: set[str] = set()
        #: the state of the engine: its current goal, and its last order for this goal
        self.engine: Record | None = None
        self.orders: list[Order] = []

    @property
    def now(self) -> Now:
        """The current time. The wall clock jumps, because nothing may depend on it."""
        return Now(self.seconds, 1.7e9 + self.seconds * 7_919 % 7_200)

    def submit(self, say: Say, name: str = "", **known: Any) -> Record:
        before = self.scheduler.unfinished()
        full = self.scheduler.only_lacks_room(say, self.now)
        record = super().submit(say, name, **known)
        if self.records.get(record.id) is record:
            return record  # the goal was sent before
        assert record.id not in self.records, "an id was used twice"
        self.records[record.id] = record
        if record.state.terminal:
            assert self.scheduler.unfinished() == before, "a goal that was not queued has changed other goals"
        assert full or record.reason != "queue_full", "a goal was rejected although there was room"
        return record

    def cancel(self, *ids: str, waiting: tuple[str, ...] = (), **selection: Any) -> Cancellation:
        done = super().cancel(*ids, waiting=waiting, **selection)
        assert all(record.state in {State.RECALLED, State.PREEMPTED} for record in done.ended_at_once)
        assert done.stopping is None or done.stopping.state is State.PREEMPTING
        if not ids and selection in ({}, {"current": False}):
            assert len(self.scheduler.pending) == 0
        return done

    def append(self, goal_id: str, **addition: Any) -> None:
        record = self.scheduler.find(goal_id)
        before = record.snapshot() if record else None
        try:
            if record:
                super().append(goal_id, **addition)
        except RequestRefused:
            assert record
            assert record.snapshot() == before, "an addition that was refused has changed the goal"

    def leave(self, goal_id: str) -> None:
        if self.scheduler.find(goal_id):
            super().leave(goal_id)

    def wait(self, seconds: float) -> None:
        super().wait(seconds)
        deadline = self.scheduler.deadline()
        assert deadline > self.seconds, "a deadline has passed"

    def report(self, event: str, goal_id: str) -> None:
        if goal_id == "*":
            return  # no goal is active
        if self.engine and goal_id == self.engine.id:
            stopping = self.engine.state is State.PREEMPTING
            if event == "interrupted" and Order.INTERRUPT not in self.orders:
                return
            super().report(event if stopping or event not in {"deaf", "stopped"} else "heard", goal_id)
        else:
            before = self.scheduler.unfinished()
            with pytest.raises(IllegalTransition):
                super().report(event, goal_id)
            assert self.scheduler.unfinished() == before

    # -- the invariants

    def collect(self, effects: list[Effect]) -> list[Effect]:
        for effect in effects:
            if isinstance(effect, StateChange):
                self._check_state(effect.record, effect.state)
            elif isinstance(effect, EngineOrder):
                self._check_order(effect.record, effect.order)
            elif isinstance(effect, Interruption):
                self._check_interruption(effect.record, effect.interrupted_by)
            elif isinstance(effect, VoiceLoadOrder):
                assert self.scheduler.has_engine
                assert effect.voice not in effect.dropped, "the voice to load was dropped"
                loading = str(self.scheduler.voices.to_json()).count("'loading'")
                assert loading <= 1, "two voices are loaded at once"
        return effects

    def _check_state(self, record: Record, state: State) -> None:
        path = self.states[record.id]
        # RECALLING is not published.
        before = State.RECALLING if state is State.RECALLED else path[-1] if path else None
        allowed = TRANSITIONS[before] if before is not None else {State.PENDING, State.REJECTED}
        if record.id in self.silent and state is State.ACTIVE:
            self.silent.remove(record.id)  # the goal continues
            allowed = {State.ACTIVE}
        assert state in allowed, f"{record.id}: {path}, then {state}"
        assert not (path and path[-1].terminal), f"{record.id} ended twice"
        path.append(state)
        (self.busy.add if state in BUSY and record.id not in self.silent else self.busy.discard)(record.id)
        assert len(self.busy) <= 1, "two goals are spoken at once"
        if state.terminal:
            assert record.message
            assert state is State.SUCCEEDED or record.reason
            self.ended[record.id] = record.snapshot()
            if self.engine is record:
                self.engine = None

    def _check_interruption(self, record: Record, interrupted_by: str) -> None:
        assert self.states[record.id][-1] is State.ACTIVE
        assert self.scheduler.find(interrupted_by)
        if self.engine is record:
            assert Order.INTERRUPT in self.orders
            self.engine = None
        self.silent.add(record.id)
        self.busy.discard(record.id)

    def _check_order(self, record: Record, order: Order) -> None:
        if order is Order.START:
            assert self.engine is None, "a goal started before the last one had ended"
            assert record.id not in self.started or record.rest, "a goal was spoken twice"
            assert self.scheduler.has_engine
            assert not self.scheduler.paused
            assert self.seconds < record.expires_at or record.rest, "a goal started too late"
            self.engine, self.orders = record, []
            self.started.add(record.id)
        elif order is Order.APPEND:
            assert self.engine is record, "text for a goal that the engine does not have"
            assert Order.STOP not in self.orders, "text for a goal that is being stopped"
        elif order is Order.GIVE_UP:
            assert self.engine is record
            assert self.orders[-1] is Order.STOP
            assert record.stop_requested_at is not None
            assert self.seconds >= record.stop_requested_at + CONFIRM_SILENCE_S
        elif order is Order.INTERRUPT:
            assert self.engine is record
            assert not {Order.INTERRUPT, Order.STOP}.intersection(self.orders), "a goal is interrupted twice"
            assert self.orders[-1:] != [Order.HOLD], "a goal is interrupted in a pause"
            self.orders.append(order)
        else:
            assert self.engine is record, "an order for a goal that the engine does not have"
            assert Order.STOP not in self.orders, "an order for a goal that is being stopped"
            assert order is Order.STOP or (order is Order.RESUME) == (self.orders[-1:] == [Order.HOLD])
            self.orders.append(order)

    def check(self) -> None:
        scheduler = self.scheduler
        waiting = list(scheduler.pending)
        assert len(scheduler.pending) == len(waiting) <= scheduler.max_queue
        priorities = [goal.say.priority for goal in waiting]
        assert priorities == sorted(priorities, reverse=True)
        for interject in (True, False):
            kind = [goal for goal in waiting if goal.say.interject is interject and not goal.preempt]
            plain = [(-goal.say.priority, goal.number) for goal in kind if goal.say.key is None]
            assert plain == sorted(plain), "goals of the same priority are not first in, first out"
        held = scheduler.interrupted
        assert len(held) <= MAX_INTERRUPTED
        assert all((each.state, each.paused) == (State.ACTIVE, True) for each in held)
        assert all(each.interrupted_by in self.records for each in held)
        keys = [record.say.key for record in waiting if record.say.key is not None]
        assert len(keys) == len(set(keys)), "two pending goals have the same key"
        assert all(scheduler.find(record.id) is record for record in scheduler.unfinished())
        following = scheduler.next_goal()
        if following and not (scheduler.active or scheduler.paused) and scheduler.has_engine:
            waits_for_voice = scheduler._patience_end(following) > self.seconds
            deadline = scheduler.deadline()
            is_due = deadline <= self.seconds  # the next tick starts the goal
            assert waits_for_voice or is_due, "a goal waits without a reason"

    def end(self) -> None:
        """End all goals, and check that each goal has exactly one result, which never changed."""
        self.play("shutdown")
        if self.scheduler.active:
            self.play("stopped *")
        assert self.states.keys() == self.records.keys() == self.ended.keys()
        assert {goal_id: record.snapshot() for goal_id, record in self.records.items()} == self.ended


def first_error(steps: list[str]) -> BaseException | None:
    """Play these steps, and return the first error."""
    robot = Checked()
    try:
        for step in steps:
            robot.play(step)
            robot.check()
        robot.end()
    except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001
        return error
    return None


@settings(
    max_examples=24 * settings().max_examples,  # errors that need a combination of three options are rare
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow],  # a busy machine must not fail the test
)
@given(st.integers(0, 2**32))
def test_the_invariants_hold_for_random_scripts(seed: int) -> None:
    steps = script(seed)
    if first_error(steps) is None:
        return
    for place in reversed(range(len(steps))):
        shorter = steps[:place] + steps[place + 1 :]
        steps = shorter if first_error(shorter) else steps
    raise AssertionError("; ".join(steps)) from first_error(steps)
