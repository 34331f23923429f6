"""The scheduler against the slow model: any sequence of requests, engine events and time, compared after each step.

What is compared: each goal's states in their order, what the engine is told, who waits and in which order, reasons,
`by`, times, what was spoken, what a cancel answers. `Witness` holds what must be true of any sequence of effects,
whatever the model says.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, precondition, rule

from talkcli.messages import Sender
from talkcli.requests import Cancel, Say
from talkcli.scheduler import Changed, Effect, GiveUp, Now, Scheduler, Start, Stop
from talkcli.states import IllegalTransition
from tests.unit.slow_model import ENDS, FIRST, TABLE, Refused, Selection, SlowModel

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hypothesis.stateful import MultipleResults

    from talkcli.messages import By, Goal
    from talkcli.record import Record

BOOT = "k3fz"
MAX_TEXT = 20

good_texts = st.sampled_from(["door open", "battery low", "é日🤖"])
#: Goals that are refused whatever else is so, and why.
bad_says = st.sampled_from(
    [
        (Say("", preempt=True), "invalid_text"),
        (Say(" \n"), "invalid_text"),
        (Say("a\0b", preempt=True), "invalid_text"),
        (Say("\ud800", preempt=True), "invalid_text"),
        (Say("a" * (MAX_TEXT + 1), preempt=True), "text_too_long"),
        (Say("hi", preempt=True, format="ssml"), "bad_option"),
    ]
)
clients = st.sampled_from(["arm", "base", "door"]).map(lambda name: Sender(pid=len(name), uid=1000, name=name))
unknown_ids = st.sampled_from([f"{BOOT}-900", "zzzz-1", "mine"])
steps = st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, 10.0])
durations = st.none() | st.sampled_from([0.0, 1.25])
reasons = st.sampled_from(["audio_device", "audio_lost", "engine_crashed", "nothing_to_say"])


class Witness:
    """Sees the effects alone, and holds what is true of every sequence of them."""

    def __init__(self) -> None:
        self.paths: dict[str, list[str]] = defaultdict(list)
        self.speaking: str | None = None
        self.told_to_stop: set[str] = set()
        self.started: list[str] = []

    def see(self, effects: Iterable[Effect]) -> None:
        for effect in effects:
            goal_id = effect.record.id
            match effect:
                case Changed(state=state):
                    self._changed(goal_id, state.name)
                case Start():
                    assert self.speaking is None, "a goal started before the old one had ended"
                    assert goal_id not in self.started, "a goal started twice"
                    self.speaking = goal_id
                    self.started.append(goal_id)
                case Stop():
                    assert goal_id == self.speaking, "a stop for a goal that the engine doesn't have"
                    assert goal_id not in self.told_to_stop, "a goal was told to stop twice"
                    self.told_to_stop.add(goal_id)
                case GiveUp():
                    assert goal_id in self.told_to_stop, "an engine was given up that nobody told to stop"
                    assert self.started[-1] == goal_id, "an engine was given up that has the next goal already"

    def _changed(self, goal_id: str, state: str) -> None:
        path = self.paths[goal_id]
        assert state in (TABLE.get(path[-1], set()) if path else FIRST), f"{goal_id}: {path} then {state}"
        path.append(state)
        busy = [each for each, states in self.paths.items() if states[-1] in {"ACTIVE", "PREEMPTING"}]
        assert len(busy) <= 1, f"{busy} at once"
        if state in ENDS and goal_id == self.speaking:
            self.speaking = None


class SchedulerMachine(RuleBasedStateMachine):
    """Does the same to the scheduler and to the model, and compares."""

    goals = Bundle("goals")

    @initialize(preempt=st.booleans(), max_queue=st.integers(1, 6))
    def open(self, *, preempt: bool, max_queue: int) -> None:
        self.real = Scheduler(BOOT, preempt=preempt, max_queue=max_queue, max_text=MAX_TEXT)
        self.model = SlowModel(preempt=preempt, max_queue=max_queue)
        self.witness = Witness()
        self.records: dict[str, Record] = {}
        self.finished: dict[str, Goal] = {}
        self.now = Now(1_000.0, 1.7e9)

    # Time. The wall clock jumps as it likes, and nothing may depend on it.

    @rule(step=steps, jump=st.sampled_from([0.0, 3_600.0, -3_600.0]))
    def time_goes_on(self, step: float, jump: float) -> None:
        self.now = Now(self.now.monotonic + step, self.now.wall + step + jump)
        self.begin()
        self.model.tick()
        self.compare(self.real.tick(self.now))

    # Requests

    @rule(target=goals, text=good_texts, preempt=st.sampled_from([None, None, True, False]), sender=clients)
    def say(self, text: str, *, preempt: bool | None, sender: Sender) -> str:
        return self.submit(Say(text, preempt=preempt), None, sender)

    @rule(target=goals, preempts=st.lists(st.sampled_from([None, False]), min_size=2, max_size=4), sender=clients)
    def say_some(self, preempts: list[bool | None], sender: Sender) -> MultipleResults[str]:
        return multiple(*[self.submit(Say("one of some", preempt=each), None, sender) for each in preempts])

    @rule(target=goals, say=bad_says, sender=clients)
    def say_what_is_refused(self, say: tuple[Say, str], sender: Sender) -> str:
        return self.submit(*say, sender)

    def submit(self, say: Say, fault: str | None, sender: Sender) -> str:
        self.begin()
        refusals = self.model.refusals(fault, preempt=say.preempt)
        before = list(self.real.pending()), self.real.unfinished()
        record, effects = self.real.submit(say, sender, self.now)
        assert record.id not in self.records
        assert record.id.startswith(f"{BOOT}-")
        assert record.id.removeprefix(f"{BOOT}-").isdecimal()
        self.records[record.id] = record
        refused = record.reason if record.state.name == "REJECTED" else None
        assert (refused is not None) == bool(refusals), f"{refused}, but there is {refusals or 'no reason'}"
        if refused is not None:
            assert refused in refusals
            assert (list(self.real.pending()), self.real.unfinished()) == before
        self.model.submit(record.id, say.text, preempt=say.preempt, refused=refused)
        assert isinstance(effects[0], Changed), "a goal's first event comes before all that it causes"
        assert effects[0].record is record
        assert record.snapshot().client == sender
        self.compare(effects)
        return record.id

    @rule(
        ids=st.none() | st.lists(goals | unknown_ids, max_size=3),
        current=st.booleans(),
        before=goals | st.none() | unknown_ids,
        sender=clients,
    )
    def cancel(self, ids: list[str] | None, *, current: bool, before: str | None, sender: Sender) -> None:
        self.begin()
        expected = self.model.cancel(Selection(ids, current, before), str(sender.name))
        done = self.real.cancel(Cancel(None if ids is None else tuple(ids), current, before), sender, self.now)
        self.compare(done.effects)
        assert sorted(each.id for each in done.recalled) == sorted(expected.recalled)
        assert (None if done.stopping is None else done.stopping.id) == expected.stopping
        assert {each.id for each in done.ended} - {before} == set(expected.ended) - {before}
        assert set(done.unknown) == set(expected.unknown)

    @rule(goal=goals, sender=clients)
    def cancel_one(self, goal: str, sender: Sender) -> None:
        self.cancel([goal], current=False, before=None, sender=sender)

    @precondition(lambda self: len(self.records) > 8)
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

    @rule(event=st.sampled_from(["heard", "completed", "failed", "stopped"]), goal=goals | unknown_ids)
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

    def compare(self, effects: list[Effect]) -> None:
        """Compare what a step did with what the model did in it."""
        self.witness.see(effects)
        real = [(each.record.id, each.state.name) for each in effects if isinstance(each, Changed)]
        assert by_goal(real) == by_goal(self.model.events)
        names: dict[type[Effect], str] = {Start: "start", Stop: "stop", GiveUp: "give up"}
        orders = [(names[type(each)], each.record.id) for each in effects if not isinstance(each, Changed)]
        assert orders == self.model.orders

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
            assert (goal.state.name, goal.text) == (expected.state, expected.text)
            assert goal.queued_at == expected.times["queued"]
            assert goal.started_at == expected.times.get("started")
            assert goal.ended_at == expected.times.get("ended")
            assert goal.spoken == (expected.text[: expected.spoken] if "started" in expected.times else None)
            if expected.state in ENDS:
                assert (goal.reason, told(goal.by), goal.duration) == (expected.reason, expected.by, expected.duration)
                assert goal.message
                self.finished[goal.id] = goal

    @invariant()
    def a_goal_that_ended_stays_as_it_is(self) -> None:
        for goal_id, goal in self.finished.items():
            assert self.records[goal_id].snapshot() == goal

    @invariant()
    def there_is_a_deadline_while_silence_is_awaited(self) -> None:
        waited = [each.stopped_at for each in self.model.voice if each.stopped_at is not None]
        deadline = self.real.deadline()
        if not waited:
            assert deadline is None
        else:
            assert deadline is not None
            assert waited[0] < deadline <= waited[0] + 2.0

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


TestScheduler = SchedulerMachine.TestCase
