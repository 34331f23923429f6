"""What is always true of the scheduler, whatever clients ask and whatever the engine says.

A hypothesis state machine does random steps and checks each effect. The examples in `test_scheduler_*.py` say which
goal goes first and which reason it ends with.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from talkcli.frozen import replace
from talkcli.goals.options import INITIAL, Cancel, Say
from talkcli.goals.scheduler import SILENCE_LIMIT, Changed, Now, Order, Scheduler
from talkcli.goals.states import TRANSITIONS, IllegalTransition, State
from tests.unit.robot import ARM

if TYPE_CHECKING:
    from collections.abc import Iterable

    from talkcli.goals.goal import Goal
    from talkcli.goals.record import Record
    from talkcli.goals.scheduler import Effect

#: Few values of each, so that goals meet. Times are multiples of the clock's steps, so that they fall together.
SAYS = st.fixed_dictionaries(
    {"text": st.sampled_from(["door open", "battery low", "é日🤖"])},
    optional={
        "preempt": st.booleans(),
        "flush": st.just(value=True),
        "priority": st.sampled_from([1, 5, -1]),
        "key": st.sampled_from(["battery", "door"]),
        "ttl": st.sampled_from([0.5, 0.0, 3.0]),
        "throttle": st.sampled_from([10.0, 1.5]),
        "id": st.sampled_from(["mine", "arm.1"]),
        "voice": st.sampled_from(["piper/joe", "piper/amy#2"]),
        "voice_only": st.just(value=True),
    },
)
IDS = st.sampled_from(["mine", "arm.1", "4k7f-900", *(f"4k7f-{number}" for number in range(1, 9))])
STEPS_S = st.sampled_from([0.0, 0.5, 1.0, 2.0, 10.0])
BUSY = {State.ACTIVE, State.PREEMPTING}


class SchedulerMachine(RuleBasedStateMachine):
    """Random requests, engine events and time."""

    @initialize(
        preempt=st.sampled_from([False, False, True]), max_queue=st.integers(1, 5), ttl=st.sampled_from([0.0, 2.0])
    )
    def open(self, *, preempt: bool, max_queue: int, ttl: float) -> None:
        initial = replace(INITIAL, preempt=preempt, ttl=ttl)
        self.scheduler = Scheduler("4k7f", max_queue=max_queue, settings=initial)
        self.now = Now(1_000.0, 1.7e9)
        self.records: dict[str, Record] = {}
        self.states: dict[str, list[State]] = defaultdict(list)
        self.ended: dict[str, Goal] = {}
        self.started: list[str] = []
        #: what the engine does: the goal that it has, and what it was told to do with that
        self.engine: Record | None = None
        self.orders: list[Order] = []

    # -- what clients and the clock do

    @rule(fields=SAYS, waited=st.sampled_from([0.0, 0.0, 2.0]))
    def say(self, fields: dict[str, Any], waited: float) -> None:
        before = self.scheduler.unfinished()
        full = self.scheduler.lacks_room(Say(**fields), self.now)
        done = self.scheduler.submit(Say(**fields), ARM, self.now, waited=waited)
        if done.attached:
            assert done.effects == []
            return
        assert done.record.id not in self.records, "an id was given twice"
        self.records[done.record.id] = done.record
        self.see(done.effects)
        if done.record.state.terminal:
            assert self.scheduler.unfinished() == before, "a goal that was not queued has done something"
        assert full or done.record.reason != "queue_full", "refused for want of room that there was"

    @rule(says=st.lists(SAYS, min_size=2, max_size=5))
    def say_some(self, says: list[dict[str, Any]]) -> None:
        """Fill the queue: most rules for the order need several goals that wait."""
        for fields in says:
            self.say(fields, 0.0)

    @rule(ids=st.lists(IDS, max_size=2), current=st.booleans(), before=st.none() | IDS, key=st.none() | st.just("door"))
    def cancel(self, ids: list[str], current: bool, before: str | None, key: str | None) -> None:
        selection = Cancel(tuple(ids) or None, current, before, key)
        done = self.scheduler.cancel(selection, ARM, self.now)
        self.see(done.effects)
        assert all(each.state is State.RECALLED for each in done.recalled)
        assert done.stopping is None or done.stopping.state is State.PREEMPTING
        if selection.everything:
            assert self.scheduler.pending_count == 0

    @rule(step=STEPS_S, jump=st.sampled_from([0.0, 3_600.0, -3_600.0]), seen=st.booleans())
    def wait(self, step: float, jump: float, seen: bool) -> None:
        """Let time pass. The wall clock jumps as it likes, and nothing may depend on it."""
        self.now = Now(self.now.monotonic + step, self.now.wall + step + jump)
        if seen:
            self.see(self.scheduler.tick(self.now))
            deadline = self.scheduler.deadline()
            assert deadline is None or deadline > self.now.monotonic, "what was due has not been done"

    @rule(preempt=st.booleans(), ttl=st.sampled_from([0.0, 1.0]), voice=st.sampled_from([None, "piper/joe"]))
    def change_settings(self, **chosen: Any) -> None:
        self.scheduler.settings = replace(self.scheduler.settings, **chosen)

    @rule(pause=st.booleans())
    def pause_or_resume(self, pause: bool) -> None:
        self.see(self.scheduler.pause() if pause else self.scheduler.resume(self.now))

    # -- what the engine says

    @precondition(lambda self: self.engine)
    @rule(what=st.sampled_from(["heard", "completed", "completed", "failed", "not_silent", "stopped"]))
    def hear_of_the_goal(self, what: str) -> None:
        assert self.engine
        if what in {"stopped", "not_silent"} and self.engine.state is not State.PREEMPTING:
            what = "heard"  # the engine has not been told to stop
        self.tell(what, self.engine.id)

    @rule(what=st.sampled_from(["heard", "completed", "failed", "stopped"]), goal_id=IDS)
    def hear_of_another_goal(self, what: str, goal_id: str) -> None:
        if self.engine is None or goal_id != self.engine.id:
            before = self.scheduler.unfinished()
            with pytest.raises(IllegalTransition):
                self.tell(what, goal_id)
            assert self.scheduler.unfinished() == before

    @rule(what=st.sampled_from(["lost", "ready", "missing"]))
    def hear_of_the_process(self, what: str) -> None:
        if what == "lost":
            self.scheduler.engine_lost()
        else:
            missing = what == "missing"
            told = self.scheduler.engine_missing("no memory", self.now) if missing else None
            self.see(self.scheduler.engine_ready(self.now) if told is None else told)

    @rule(voice=st.sampled_from(["piper/joe", "piper/amy"]), what=st.sampled_from(["wait_for", "begin", "end"]))
    def hear_of_a_voice(self, voice: str, what: str) -> None:
        if what == "begin":
            self.scheduler.loading.begin(voice, self.now.monotonic)
        else:
            getattr(self.scheduler.loading, what)(voice)
        self.see(self.scheduler.tick(self.now))

    def tell(self, what: str, goal_id: str) -> None:
        effects: list[Effect] = []
        if what == "heard":
            self.scheduler.heard(goal_id, 4)
        elif what == "completed":
            effects = self.scheduler.completed(goal_id, 1.5, self.now)
        elif what == "stopped":
            effects = self.scheduler.stopped(goal_id, self.now)
        else:
            reason = "not_silent" if what == "not_silent" else "audio_lost"
            effects = self.scheduler.failed(goal_id, reason, "device is gone", 1.5, self.now)
        self.see(effects)

    # -- what is always true

    def see(self, effects: Iterable[Effect]) -> None:
        """Check effects in their order."""
        for effect in effects:
            record = effect.record
            if isinstance(effect, Changed):
                self.see_state(record, effect.state)
            else:
                self.see_order(record, effect.order)

    def see_state(self, record: Record, state: State) -> None:
        path = self.states[record.id]
        # RECALLING is not published.
        before = State.RECALLING if state is State.RECALLED else path[-1] if path else None
        allowed = TRANSITIONS[before] if before is not None else {State.PENDING, State.REJECTED}
        assert state in allowed, f"{record.id}: {path}, then {state}"
        assert not (path and path[-1].terminal), f"{record.id} ended twice"
        path.append(state)
        assert sum(each[-1] in BUSY for each in self.states.values()) <= 1, "two goals are spoken at once"
        if state.terminal:
            assert record.message
            assert state is State.SUCCEEDED or record.reason
            if self.engine is record:
                self.engine = None

    def see_order(self, record: Record, order: Order) -> None:
        if order is Order.START:
            assert self.engine is None, "a goal started before the last one had ended"
            assert record.id not in self.started, "a goal was spoken twice"
            assert self.scheduler.has_engine
            assert not self.scheduler.paused
            assert record.expires_at is None or self.now.monotonic < record.expires_at, "a goal started too late"
            self.engine, self.orders = record, []
            self.started.append(record.id)
        elif order is Order.GIVE_UP:
            assert self.engine is record
            assert self.orders[-1] is Order.STOP
            assert record.stop_since is not None
            assert self.now.monotonic >= record.stop_since + SILENCE_LIMIT
        else:
            assert self.engine is record, "an order for a goal that the engine does not have"
            assert Order.STOP not in self.orders, "an order for a goal that was told to stop"
            assert (order is Order.RESUME) == (order is not Order.STOP and self.orders[-1:] == [Order.HOLD])
            self.orders.append(order)

    @invariant()
    def order_of_the_queue(self) -> None:
        waiting = list(self.scheduler.pending())
        assert self.scheduler.pending_count == len(waiting) <= self.scheduler.max_queue
        assert [each.priority for each in waiting] == sorted((each.priority for each in waiting), reverse=True)
        plain = [(-each.priority, each.number) for each in waiting if each.key is None and not each.preempt]
        assert plain == sorted(plain), "equals are not first in, first out"
        keys = [each.key for each in waiting if each.key is not None]
        assert len(keys) == len(set(keys)), "two goals with one key wait"

    @invariant()
    def results_are_final(self) -> None:
        for goal_id, record in self.records.items():
            if record.state.terminal:
                assert self.ended.setdefault(goal_id, record.snapshot()) == record.snapshot()
            else:
                assert self.scheduler.find(goal_id) is record

    @invariant()
    def nothing_waits_without_a_reason(self) -> None:
        first = next(self.scheduler.pending(), None)
        if first and not (self.scheduler.active or self.scheduler.paused) and self.scheduler.has_engine:
            waits_for_voice = self.scheduler.loading.begins_at(first, self.scheduler.settings.voice) > 0
            deadline = self.scheduler.deadline()
            is_due = deadline is not None and deadline <= self.now.monotonic  # the next tick starts it
            assert waits_for_voice or is_due

    def teardown(self) -> None:
        """End everything: each goal has exactly one result."""
        if hasattr(self, "scheduler"):
            self.see(self.scheduler.shutdown(self.now))
            if self.scheduler.active:
                self.see(self.scheduler.stopped(self.scheduler.active.id, self.now))
            assert self.states.keys() == self.records.keys()
            assert all(path[-1].terminal for path in self.states.values())


TestScheduler = SchedulerMachine.TestCase
TestScheduler.settings = settings(
    max_examples=5 * settings().max_examples,  # what goes wrong only where three options meet is rare
    stateful_step_count=40,
    suppress_health_check=[HealthCheck.too_slow],  # a busy machine is no fault of it
)
