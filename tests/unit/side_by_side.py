"""The scheduler and its slow model, side by side: each step is done to both and compared.

What is compared: each goal's states in their order, what the engine is told, who waits and in which order, reasons,
`by`, times, what was spoken, what a cancel answers. `witness` holds what must be true of any sequence of effects,
whatever the model says.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import pytest

from talkcli.frozen import replace
from talkcli.goals.options import INITIAL, Cancel, Say
from talkcli.goals.scheduler import Changed, Now, Order, Ordered, Scheduler
from talkcli.goals.states import IllegalTransition, State
from tests.unit.random_goals import BOOT, MAX_TEXT
from tests.unit.slow_goal import ENDS, Selection, Wish
from tests.unit.slow_model import Refused, SlowModel
from tests.unit.witness import Witness

if TYPE_CHECKING:
    from typing import Any

    from talkcli.goals.goal import By, Goal, Sender
    from talkcli.goals.record import Record
    from talkcli.goals.scheduler import Effect, Submitted

ORDERS = {
    Order.START: "start",
    Order.STOP: "stop",
    Order.GIVE_UP: "give up",
    Order.HOLD: "hold",
    Order.RESUME: "resume",
}


class SideBySide:
    """Both, and the one clock that they share."""

    def __init__(self, *, preempt: bool, max_queue: int, ttl: float) -> None:
        settings = replace(INITIAL, preempt=preempt, ttl=ttl)
        self.real = Scheduler(BOOT, max_queue=max_queue, max_text=MAX_TEXT, settings=settings)
        self.model = SlowModel(preempt=preempt, max_queue=max_queue, ttl=ttl)
        self.witness = Witness()
        self.records: dict[str, Record] = {}
        self.finished: dict[str, Goal] = {}
        self.now = Now(1_000.0, 1.7e9)
        #: whether a step was begun that was not compared: then it failed, and what follows is of no use
        self.amidst = False

    # Requests

    def change(self, **settings: Any) -> None:
        self.real.settings = replace(self.real.settings, **settings)
        for name, value in settings.items():
            setattr(self.model, name, value)

    def submit(self, say: Say, sender: Sender, fault: str | None = None) -> str:
        self.begin()
        wish = Wish(
            say.text,
            say.preempt,
            say.flush,
            say.priority,
            say.ttl,
            say.key,
            say.throttle,
            say.id,
            say.voice,
            say.voice_only,
        )
        first = self.model.first_of(wish)
        refusals = self.model.refusals(wish, fault)
        before = list(self.real.pending()), self.real.unfinished()
        outside = ("unknown_voice", "no such voice") if fault == "unknown_voice" else None
        could_wait = self.real.lacks_room(say, self.now, outside)
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
        if record.state.name == "REJECTED":
            assert (list(self.real.pending()), self.real.unfinished()) == before
            assert could_wait or record.reason != "queue_full"
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
        begun = [each for each in done.effects if each == Ordered(each.record, Order.START)]
        if begun:
            assert done.effects[-2:] == [Changed(begun[0].record, State.ACTIVE), *begun], "it waits for others' ends"

    def cancel(
        self,
        ids: list[str] | None,
        sender: Sender,
        *,
        current: bool = False,
        before: str | None = None,
        key: str | None = None,
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

    def pause(self) -> None:
        self.begin()
        self.witness.paused = True
        self.model.pause()
        self.compare(self.real.pause())

    def resume(self) -> None:
        self.begin()
        self.witness.paused = False
        self.model.resume()
        self.compare(self.real.resume(self.now))

    def shut_down(self) -> None:
        self.begin()
        self.model.shutdown()
        self.compare(self.real.shutdown(self.now))

    # Time and the engine

    def tick(self) -> None:
        self.begin()
        self.model.tick()
        self.compare(self.real.tick(self.now))

    def engine_lost(self) -> None:
        self.begin()
        self.model.engine_lost()
        self.real.engine_lost()
        self.compare([])

    def is_to_load(self, voice: str) -> None:
        self.begin()
        self.model.is_to_load(voice)
        self.real.loading.wait_for(voice)
        self.compare([])

    def begins_to_load(self, voice: str) -> None:
        self.begin()
        self.model.begins_to_load(voice)
        self.real.loading.begin(voice, self.now.monotonic)
        self.compare([])

    def has_loaded(self, voice: str) -> None:
        self.begin()
        self.model.has_loaded(voice)
        self.real.loading.end(voice)
        self.compare(self.real.tick(self.now))

    def change_voice(self, voice: str | None) -> None:
        self.real.settings = replace(self.real.settings, voice=voice)
        self.model.usual_voice = voice

    def engine_ready(self) -> None:
        self.begin()
        self.model.engine_ready()
        self.compare(self.real.engine_ready(self.now))

    def engine_missing(self) -> None:
        self.begin()
        self.model.engine_missing()
        self.compare(self.real.engine_missing("no memory", self.now))

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
        self.amidst = True
        self.model.begin(self.now.monotonic, self.now.wall)
        self.witness.now = self.now.monotonic

    def compare(self, effects: list[Effect]) -> None:
        """Compare what a step did with what the model did in it."""
        self.witness.see(effects)
        real = [(each.record.id, each.state.name) for each in effects if isinstance(each, Changed)]
        assert by_goal(real) == by_goal(self.model.events)
        orders = [(ORDERS[each.order], each.record.id) for each in effects if isinstance(each, Ordered)]
        assert orders == self.model.orders
        self.amidst = False

    def compare_goals(self) -> None:
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

    def compare_deadline(self) -> None:
        mortal = self.model.queue + self.model.unbegun()
        over = [each.accepted_at + each.ttl for each in mortal if each.ttl is not None]
        stopped = [each.stopped_at for each in self.model.voice if each.stopped_at is not None]
        waiting = self.model.may_begin_at()
        deadline = self.real.deadline()
        if deadline is None:
            assert not over
            assert not stopped
            assert not waiting
        else:
            in_silence = bool(stopped) and stopped[0] < deadline <= stopped[0] + 2.0
            assert deadline in over or deadline in waiting or in_silence
            assert deadline <= min([*over, *waiting, *(each + 2.0 for each in stopped)])

    def all_has_ended_once(self) -> None:
        for path in self.witness.paths.values():
            assert [state for state in path if state in ENDS] == path[-1:]
        assert self.witness.paths.keys() == self.records.keys()
        assert self.witness.speaking is None
        for goal_id, goal in self.finished.items():
            assert self.records[goal_id].snapshot() == goal, "a goal that had ended was changed"


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
