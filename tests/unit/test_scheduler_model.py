"""The scheduler against a slow model of its own: any requests, engine events and time, compared after each step.

What is compared: each goal's states in their order, what the engine is told, who waits and in which order, reasons,
`by`, times, what was spoken, what a cancel answers. `witness` holds what must be true of any sequence of effects,
whatever the model says.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, precondition, rule

from talkcli.effects import Changed, Effect, GiveUp, Hold, Now, Resume, Start, Stop
from talkcli.messages import Sender
from talkcli.requests import Cancel, Say
from talkcli.scheduler import Scheduler
from talkcli.states import IllegalTransition, State
from tests.unit.random_goals import BAD_SAYS, BOOT, MAX_TEXT, OPTIONS, OWN_IDS, TEXTS, says_with
from tests.unit.slow_goal import ENDS, Selection, Wish
from tests.unit.slow_model import Refused, SlowModel
from tests.unit.witness import Witness

if TYPE_CHECKING:
    from hypothesis.stateful import MultipleResults

    from talkcli.effects import Submitted
    from talkcli.messages import By, Goal
    from talkcli.record import Record
    from tests.unit.random_goals import Fields

ORDERS: dict[type[Effect], str] = {
    Start: "start",
    Stop: "stop",
    GiveUp: "give up",
    Hold: "hold",
    Resume: "resume",
}

NOBODYS_IDS = [f"{BOOT}-900", "zzzz-1", "17"]

clients = st.sampled_from(["arm", "base", "door"]).map(lambda name: Sender(pid=len(name), uid=1000, name=name))
keys = st.sampled_from(["battery", "door"])
any_ids = st.sampled_from([*NOBODYS_IDS, *OWN_IDS])
steps = st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, 10.0, 59.5])
jumps = st.sampled_from([0.0, 3_600.0, -3_600.0])
durations = st.none() | st.sampled_from([0.0, 1.25])
reasons = st.sampled_from(["audio_device", "audio_lost", "engine_crashed", "nothing_to_say"])


class SchedulerMachine(RuleBasedStateMachine):
    """Does the same to the scheduler and to the model, and compares."""

    goals = Bundle("goals")

    @initialize(preempt=st.booleans(), max_queue=st.sampled_from([2, 3, 1, 5, 8]), ttl=st.sampled_from([0.0, 0.0, 2.0]))
    def open(self, *, preempt: bool, max_queue: int, ttl: float) -> None:
        self.real = Scheduler(BOOT, preempt=preempt, max_queue=max_queue, max_text=MAX_TEXT, ttl=ttl)
        self.model = SlowModel(preempt=preempt, max_queue=max_queue, ttl=ttl)
        self.witness = Witness()
        self.records: dict[str, Record] = {}
        self.finished: dict[str, Goal] = {}
        self.now = Now(1_000.0, 1.7e9)

    # Time. The wall clock jumps as it likes, and nothing may depend on it.

    @rule(step=steps, jump=jumps)
    def time_goes_on(self, step: float, jump: float) -> None:
        self.time_goes_on_unseen(step, jump)
        self.begin()
        self.model.tick()
        self.compare(self.real.tick(self.now))

    @rule(step=steps, jump=jumps)
    def time_goes_on_unseen(self, step: float, jump: float) -> None:
        """Other things may come before the tick that is due."""
        self.now = Now(self.now.monotonic + step, self.now.wall + step + jump)

    # Requests

    @rule(target=goals, say=says_with("preempt"), sender=clients)
    def say(self, say: Fields, sender: Sender) -> str:
        return self.submit(Say(**say), sender)

    @rule(target=goals, say=says_with(*OPTIONS), sender=clients)
    def say_with_options(self, say: Fields, sender: Sender) -> str:
        return self.submit(Say(**say), sender)

    @rule(target=goals, say=says_with("priority", "preempt", "flush", "key"), sender=clients)
    def say_in_some_order(self, say: Fields, sender: Sender) -> str:
        return self.submit(Say(**say), sender)

    @rule(target=goals, goal=goals, keyed=st.booleans(), throttle=st.sampled_from(OPTIONS["throttle"]), sender=clients)
    def say_again(self, goal: str, *, keyed: bool, throttle: float, sender: Sender) -> str:
        """Say what was said before, but not too often."""
        earlier = self.records[goal]
        text = earlier.text if earlier.text in TEXTS else TEXTS[0]
        return self.submit(Say(text, key=earlier.key if keyed else None, throttle=throttle), sender)

    @precondition(lambda self: self.model.early)
    @rule(target=goals, say=says_with("priority", "flush", "key", "throttle"), data=st.data(), sender=clients)
    def say_what_was_cancelled_before(self, say: Fields, data: st.DataObject, sender: Sender) -> str:
        goal_id = data.draw(st.sampled_from(sorted(self.model.early)))
        return self.submit(Say(**say, id=goal_id), sender)

    @rule(target=goals, priorities=st.lists(st.sampled_from([0, 1]), min_size=2, max_size=4), sender=clients)
    def say_some(self, priorities: list[int], sender: Sender) -> MultipleResults[str]:
        return multiple(*[self.submit(Say("one of some", priority=each), sender) for each in priorities])

    @rule(target=goals, say=st.sampled_from(BAD_SAYS), sender=clients)
    def say_what_is_refused(self, say: tuple[Fields, str], sender: Sender) -> str:
        return self.submit(Say(**say[0]), sender, fault=say[1])

    def submit(self, say: Say, sender: Sender, fault: str | None = None) -> str:
        self.begin()
        wish = Wish(say.text, say.preempt, say.flush, say.priority, say.ttl, say.key, say.throttle, say.id)
        first = self.model.first_of(wish)
        refusals = self.model.refusals(wish, fault)
        before = list(self.real.pending()), self.real.unfinished()
        could_wait = self.real.lacks_room(say)
        outside = ("unknown_voice", "no such voice") if fault == "unknown_voice" else None
        done = self.real.submit(say, sender, self.now, outside)
        if done.attached:
            assert not could_wait
            assert first is not None
            assert first.text == say.text
            assert (done.record, done.effects) == (self.records[first.id], [])
            self.compare(done.effects)
            return first.id
        assert fault or first is None or first.text != say.text, "an id was used twice"
        self.compare_answer(say, sender, done, refusals)
        record = done.record
        if record.reason == "queue_full":
            assert could_wait
        if record.state.name == "REJECTED":
            assert (list(self.real.pending()), self.real.unfinished()) == before
            self.model.submit(record.id, wish, (str(record.reason), told(record.by)))
        else:
            self.model.submit(record.id, wish)
        self.compare(done.effects)
        return record.id

    def compare_answer(self, say: Say, sender: Sender, done: Submitted, refusals: dict[str, set[str | None]]) -> None:
        record = done.record
        assert record.number == len(self.records) + 1
        assert record.id not in self.records
        self.records[record.id] = record
        ttl = self.model.ttl if say.ttl is None else say.ttl
        if ttl:
            self.witness.over[record.id] = self.now.monotonic + ttl
        assert record.snapshot().client == sender
        refused = record.state.name == "REJECTED"
        assert refused == bool(refusals), f"{record.state.name}, but there is {refusals or 'no reason'}"
        assert record.id == (f"{BOOT}-{record.number}" if refused or say.id is None else say.id)
        if refused:
            assert told(record.by) in refusals.get(str(record.reason), set()), record.reason
            assert done.effects == [Changed(record, State.REJECTED)]
            return
        assert done.effects[0] == Changed(record, State.PENDING), "it comes before all that it causes"
        begun = [each for each in done.effects if isinstance(each, Start)]
        if begun:
            assert done.effects[-2:] == [Changed(begun[0].record, State.ACTIVE), *begun], "it waits for others' ends"

    @rule(
        ids=st.none() | st.lists(goals | any_ids, max_size=3),
        current=st.booleans(),
        before=goals | st.none() | any_ids,
        key=st.none() | keys,
        sender=clients,
    )
    def cancel(
        self, ids: list[str] | None, *, current: bool, before: str | None, key: str | None, sender: Sender
    ) -> None:
        self.begin()
        expected = self.model.cancel(Selection(ids, current, before, key), str(sender.name))
        chosen = Cancel(None if ids is None else tuple(ids), current, before, key)
        done = self.real.cancel(chosen, sender, self.now)
        self.compare(done.effects)
        assert sorted(each.id for each in done.recalled) == sorted(expected.recalled)
        assert (None if done.stopping is None else done.stopping.id) == expected.stopping
        assert {each.id for each in done.ended} - {before} == set(expected.ended) - {before}
        assert set(done.unknown) == set(expected.unknown)

    @rule(goal=goals | any_ids, sender=clients)
    def cancel_one(self, goal: str, sender: Sender) -> None:
        self.cancel([goal], current=False, before=None, key=None, sender=sender)

    @rule(key=keys, sender=clients)
    def cancel_a_key(self, key: str, sender: Sender) -> None:
        self.cancel(None, current=False, before=None, key=key, sender=sender)

    @rule(preempt=st.booleans())
    def set_preempt(self, *, preempt: bool) -> None:
        self.real.preempt = self.model.preempt = preempt

    @rule(ttl=st.sampled_from([0.0, 1.0, 3.0]))
    def set_ttl(self, ttl: float) -> None:
        self.real.ttl = self.model.ttl = ttl

    @rule()
    def pause(self) -> None:
        self.begin()
        self.witness.paused = True
        self.model.pause()
        self.compare(self.real.pause())

    @rule()
    def resume(self) -> None:
        self.begin()
        self.witness.paused = False
        self.model.resume()
        self.compare(self.real.resume(self.now))

    @precondition(lambda self: len(self.records) > 25)
    @rule()
    def shut_down(self) -> None:
        self.begin()
        self.model.shutdown()
        self.compare(self.real.shutdown(self.now))

    # The engine, with what it may truly say

    @precondition(lambda self: self.model.voice)
    @rule(end=st.integers(0, 12))
    def hears(self, end: int) -> None:
        self.engine_says("heard", self.model.voice[0].id, end=end)

    @precondition(lambda self: self.model.voice)
    @rule(duration=durations)
    def completes(self, duration: float | None) -> None:
        self.engine_says("completed", self.model.voice[0].id, duration=duration)

    @precondition(lambda self: self.model.voice)
    @rule(count=st.integers(1, 4), step=st.sampled_from([0.0, 0.5, 1.0]))
    def speaks_some(self, count: int, step: float) -> None:
        for _ in range(count):
            self.time_goes_on(step, 0.0)
            if self.model.voice:
                self.completes(1.0)

    @precondition(lambda self: self.model.voice)
    @rule(reason=reasons, duration=durations)
    def fails(self, reason: str, duration: float | None) -> None:
        self.engine_says("failed", self.model.voice[0].id, reason=reason, duration=duration)

    @precondition(lambda self: self.model.voice and self.model.voice[0].state == "PREEMPTING")
    @rule()
    def stops(self) -> None:
        self.engine_says("stopped", self.model.voice[0].id)

    @precondition(lambda self: self.model.voice and self.model.voice[0].state == "PREEMPTING")
    @rule()
    def cannot_confirm_silence(self) -> None:
        self.engine_says("failed", self.model.voice[0].id, reason="not_silent")

    @rule(event=st.sampled_from(["heard", "completed", "failed", "stopped"]), goal=goals | any_ids)
    def says_anything(self, event: str, goal: str) -> None:
        """An event of any goal: one that waits, one that ended, one that never was, or by chance the right one."""
        self.engine_says(event, goal, reason="engine_crashed")

    def engine_says(self, event: str, goal: str, end: int = 1, reason: str = "", duration: float | None = None) -> None:
        self.begin()
        try:
            match event:
                case "heard":
                    self.model.heard(goal, end)
                case "completed":
                    self.model.completed(goal, duration)
                case "failed":
                    self.model.failed(goal, reason, duration)
                case "stopped":
                    self.model.stopped(goal)
        except Refused:
            with pytest.raises(IllegalTransition):
                self.tell(event, goal, end, reason, duration)
            self.compare([])
        else:
            self.compare(self.tell(event, goal, end, reason, duration))

    def tell(self, event: str, goal: str, end: int, reason: str, duration: float | None) -> list[Effect]:
        match event:
            case "heard":
                assert self.real.heard(goal, end) is self.records[goal]
                return []
            case "completed":
                return self.real.completed(goal, duration, self.now)
            case "failed":
                return self.real.failed(goal, reason, "underrun at last", duration, self.now)
            case _:
                return self.real.stopped(goal, self.now)

    # Comparing

    def begin(self) -> None:
        self.model.begin(self.now.monotonic, self.now.wall)
        self.witness.now = self.now.monotonic

    def compare(self, effects: list[Effect]) -> None:
        """Compare what a step did with what the model did in it."""
        self.witness.see(effects)
        real = [(each.record.id, each.state.name) for each in effects if isinstance(each, Changed)]
        assert by_goal(real) == by_goal(self.model.events)
        orders = [(ORDERS[type(each)], each.record.id) for each in effects if not isinstance(each, Changed)]
        assert orders == self.model.orders

    @invariant()
    def it_is_paused_as_the_model_is(self) -> None:
        assert self.real.paused == self.model.paused

    @invariant()
    def the_same_goals_wait_in_the_same_order(self) -> None:
        assert [each.id for each in self.real.pending()] == [each.id for each in self.model.queue]
        assert self.real.pending_count == len(self.model.queue)
        assert {each.id for each in self.real.unfinished()} == {each.id for each in self.model.voice + self.model.queue}

    @invariant()
    def every_goal_is_as_in_the_model(self) -> None:
        for expected in self.model.all:
            if expected.id in self.finished:
                continue
            record = self.records[expected.id]
            assert self.real.find(expected.id) is record
            goal = record.snapshot()
            assert (goal.state.name, goal.text, goal.paused) == (expected.state, expected.text, expected.paused)
            assert (goal.priority, goal.key, goal.ttl) == (expected.priority, expected.key, expected.ttl)
            assert goal.queued_at == expected.times["queued"]
            assert goal.started_at == expected.times.get("started")
            assert goal.ended_at == expected.times.get("ended")
            assert goal.spoken == (expected.text[: expected.spoken] if "started" in expected.times else None)
            if expected.state in ENDS:
                assert (goal.reason, told(goal.by), goal.duration) == (expected.reason, expected.by, expected.duration)
                assert goal.message
                self.finished[goal.id] = goal

    @invariant()
    def higher_priorities_go_first_and_equals_in_the_order_in_which_they_came(self) -> None:
        waiting = list(self.real.pending())
        assert [each.priority for each in waiting] == sorted((each.priority for each in waiting), reverse=True)
        plain = [(-each.priority, each.number) for each in waiting if each.key is None and not each.preempt]
        assert plain == sorted(plain)
        keys = [each.key for each in waiting if each.key is not None]
        assert len(keys) == len(set(keys)), "two goals with one key wait"

    @invariant()
    def there_is_a_deadline_for_silence_and_for_what_waits(self) -> None:
        over = [each.accepted_at + each.ttl for each in self.model.queue if each.ttl is not None]
        stopped = [each.stopped_at for each in self.model.voice if each.stopped_at is not None]
        deadline = self.real.deadline()
        if deadline is None:
            assert not over
            assert not stopped
        else:
            in_silence = bool(stopped) and stopped[0] < deadline <= stopped[0] + 2.0
            assert deadline in over or in_silence
            assert deadline <= min([*over, *(each + 2.0 for each in stopped)])

    def teardown(self) -> None:
        """After the last step everything is ended, and each goal has one terminal event."""
        if not hasattr(self, "model"):
            return
        self.shut_down()
        if self.model.voice:
            self.stops()
        for path in self.witness.paths.values():
            assert [state for state in path if state in ENDS] == path[-1:]
        assert self.witness.paths.keys() == self.records.keys()
        for goal_id, goal in self.finished.items():
            assert self.records[goal_id].snapshot() == goal, "a goal that had ended was changed"
        assert self.witness.speaking is None


def by_goal(events: list[tuple[str, str]]) -> dict[str, list[str]]:
    paths = defaultdict(list)
    for goal_id, state in events:
        paths[goal_id].append(state)
    return dict(paths)


def told(by: By | None) -> str | None:
    """Return `by` as the model has it."""
    if by is None:
        return None
    return f"goal {by.goal}" if by.goal is not None else f"client {by.client.name if by.client else None}"


#: Where it fails, it takes its time to find the shortest sequence.
TestScheduler = pytest.mark.timeout(900)(SchedulerMachine.TestCase)
#: More than other tests have: what goes wrong only where three options meet is rare.
TestScheduler.settings = settings(
    max_examples=3 * settings().max_examples,
    stateful_step_count=60,
    suppress_health_check=[HealthCheck.too_slow],  # a busy machine is no fault of it
)
