"""The scheduler: which goal is spoken, which waits, and how each ends.

Pure: a request, an engine event or the time goes in, effects come out; no thread, socket or clock inside. A method
either does all of its step or raises and has changed nothing. Effects are to be carried out in their order.

What holds after every step: at most one goal is ACTIVE or PREEMPTING, and none starts before that one has ended; a goal
ends once; the queue is first in first out but for what `--preempt` puts at its front.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from talkcli import text as texts
from talkcli.history import History
from talkcli.messages import By
from talkcli.record import Record
from talkcli.states import IllegalTransition, State

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from talkcli.messages import Sender
    from talkcli.requests import Cancel, Say

#: Seconds after a stop in which silence must be confirmed: `cancel` is answered within 2 s whatever happens.
SILENCE_LIMIT = 1.9

SUCCEEDED_MESSAGE = "Talk completed successfully"
PREEMPTED_MESSAGE = "Talk preempted"


@dataclass(frozen=True, slots=True)
class Now:
    """One moment on both clocks, in seconds: monotonic, for limits, and since 1970 UTC, to be shown."""

    monotonic: float
    wall: float


@dataclass(frozen=True, slots=True)
class Changed:
    """A goal is in a new state; to be published."""

    record: Record
    state: State


@dataclass(frozen=True, slots=True)
class Start:
    """The engine shall speak this goal."""

    record: Record


@dataclass(frozen=True, slots=True)
class Stop:
    """The engine shall stop this goal; the answer is `ended`."""

    record: Record


@dataclass(frozen=True, slots=True)
class GiveUp:
    """The engine didn't become silent in time: it must be replaced before it may be given another goal."""

    record: Record


Effect = Changed | Start | Stop | GiveUp


@dataclass(slots=True)
class Cancelled:
    """What a cancel did: goals that ended at once, the one being stopped, those that had ended, ids nobody knows."""

    recalled: list[Record] = field(default_factory=list)
    stopping: Record | None = None
    ended: list[Record] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)


class Scheduler:
    """Goals of one server. `boot` makes their ids: four random characters a server start."""

    def __init__(self, boot: str, *, preempt: bool, max_queue: int, max_text: int = texts.MAX_CHARACTERS) -> None:
        self.boot = boot
        #: whether goals that don't say preempt
        self.preempt = preempt
        self.max_queue = max_queue
        self.max_text = max_text
        self.history = History()
        #: the goal that is ACTIVE or PREEMPTING
        self.active: Record | None = None
        self._pending: OrderedDict[int, Record] = OrderedDict()
        self._by_id: dict[str, Record] = {}
        self._preempting: dict[int, Record] = {}
        self._count = 0
        self._front = self._back = 0
        self._closing = False

    # -- what there is

    @property
    def pending_count(self) -> int:
        return len(self._pending)

    def pending(self) -> Iterator[Record]:
        """Return the pending goals in the order in which they will be spoken."""
        return iter(self._pending.values())

    def find(self, goal_id: str) -> Record | None:
        """Return a goal that is active, pending, or still remembered."""
        return self._by_id.get(goal_id) or self.history.find(goal_id)

    def unfinished(self) -> list[Record]:
        """Return the active goal and the pending ones."""
        return ([self.active] if self.active else []) + list(self._pending.values())

    # -- what clients ask for

    def submit(self, say: Say, sender: Sender, now: Now) -> tuple[Record, list[Effect]]:
        """Accept or reject a goal. Admission is one step: a goal that is REJECTED has done nothing to the others."""
        self._count += 1
        record = Record(f"{self.boot}-{self._count}", self._count, say.text, sender, now.wall)
        record.preempt = self.preempt if say.preempt is None else say.preempt
        record.format, record.data = say.format, say.data
        refused = self._refuse(say, record)
        if refused:
            record.state = State.REJECTED
            record.reason, words = refused
            record.message = f"Talk rejected: {words}"
            record.ended_at = now.wall
            self.history.add(record)
            return record, [Changed(record, State.REJECTED)]
        effects: list[Effect] = [Changed(record, State.PENDING)]
        if record.preempt:
            effects += self._give_way(record, now)
        self._enqueue(record)
        return record, effects + self._start_next(now)

    def cancel(self, selection: Cancel, sender: Sender | None, now: Now) -> Cancelled:
        """End what is selected: pending goals at once, the active one as soon as the engine is silent."""
        done = Cancelled()
        by = By(client=sender)
        for record in self._select(selection, done):
            if record.state is State.PENDING:
                done.effects += self._recall(record, "canceled", "canceled before it was spoken", by, now)
                done.recalled.append(record)
            else:
                done.effects += self._stop(record, "canceled", by, now)
                done.stopping = record
        return done

    def shutdown(self, now: Now) -> list[Effect]:
        """End everything, and take no goal any more."""
        self._closing = True
        effects: list[Effect] = []
        for record in list(self._pending.values()):
            effects += self._recall(record, "shutdown", "the server was stopped", None, now)
        if self.active:
            effects += self._stop(self.active, "shutdown", None, now)
        return effects

    # -- what the engine says

    def heard(self, goal_id: str, end: int) -> Record:
        """Note that the word that ends at this offset of the text is being heard."""
        record = self._spoken(goal_id)
        record.spoken_end = max(record.spoken_end, end)
        return record

    def completed(self, goal_id: str, duration: float | None, now: Now) -> list[Effect]:
        """End the active goal: all of it was played."""
        record = self._spoken(goal_id)
        record.duration = duration
        record.spoken_end = len(record.text or "")
        # A stop that came too late ended nothing: its reason goes.
        return self._end(record, State.SUCCEEDED, None, SUCCEEDED_MESSAGE, None, now)

    def failed(self, goal_id: str, reason: str, words: str, duration: float | None, now: Now) -> list[Effect]:
        """End the active goal: engine or audio failed.

        One that was being stopped is silent now, so it is PREEMPTED, unless the silence is what failed (not_silent).
        """
        record = self._spoken(goal_id)
        record.duration = duration
        if record.state is State.PREEMPTING and reason != "not_silent":
            return self.stopped(goal_id, now)
        return self._end(record, State.ABORTED, reason, f"Talk aborted: {words}", record.by, now)

    def stopped(self, goal_id: str, now: Now) -> list[Effect]:
        """End the active goal, which was told to stop: it is silent."""
        record = self._spoken(goal_id)
        return self._end(record, State.PREEMPTED, record.reason, PREEMPTED_MESSAGE, record.by, now)

    # -- time

    def deadline(self) -> float | None:
        """Return the monotonic time at which `tick` has something to do."""
        if self.active is None or self.active.stop_since is None:
            return None
        return self.active.stop_since + SILENCE_LIMIT

    def tick(self, now: Now) -> list[Effect]:
        """Do what is due: a goal that was stopped and did not become silent in time is ABORTED."""
        deadline = self.deadline()
        if self.active is None or deadline is None or now.monotonic < deadline:
            return []
        record = self.active
        words = f"Talk aborted: silence could not be confirmed within {SILENCE_LIMIT:g} s"
        return [GiveUp(record), *self._end(record, State.ABORTED, "not_silent", words, record.by, now)]

    # -- inside

    def _refuse(self, say: Say, record: Record) -> tuple[str, str] | None:
        if self._closing:
            return "shutdown", "the server is being stopped"
        if say.format != "text":
            return "bad_option", f"the format {say.format[:64]!r} is not known, only 'text'"
        fault = texts.fault(say.text, self.max_text)
        if fault:
            return fault
        makes_room = len(self._preempting) if record.preempt else 0
        if len(self._pending) - makes_room >= self.max_queue:
            return "queue_full", f"{len(self._pending)} goals are waiting already (`talk serve --max-queue`)"
        return None

    def _give_way(self, record: Record, now: Now) -> list[Effect]:
        """Make room at the front for a goal that preempts: the newest of those wins, the others are recalled."""
        by = By(goal=record.id)
        effects: list[Effect] = []
        for earlier in list(self._preempting.values()):
            effects += self._recall(earlier, "preempted", f"preempted by {record.id}", by, now)
        if self.active:
            effects += self._stop(self.active, "preempted", by, now)
        return effects

    def _enqueue(self, record: Record) -> None:
        self._by_id[record.id] = record
        if record.preempt:
            self._front -= 1
            record.place = self._front
            self._preempting[record.place] = record
        else:
            self._back += 1
            record.place = self._back
        self._pending[record.place] = record
        if record.preempt:
            self._pending.move_to_end(record.place, last=False)

    def _start_next(self, now: Now) -> list[Effect]:
        if self.active or not self._pending:
            return []
        record = next(iter(self._pending.values()))
        record.become(State.ACTIVE)
        self._leave_queue(record)
        record.started_at = now.wall
        self.active = record
        return [Changed(record, State.ACTIVE), Start(record)]

    def _select(self, selection: Cancel, done: Cancelled) -> Iterable[Record]:
        """Return the selected goals that have not ended, pending ones first; note in `done` what else was named."""
        if selection.everything:
            chosen = {each.number: each for each in self.unfinished()}
        else:
            chosen = dict(self._named(selection.ids or (), done))
            if selection.current and self.active:
                chosen[self.active.number] = self.active
            if selection.before is not None:
                chosen.update(self._accepted_until(selection.before, done))
        # The active one last: another must not start, even for the length of this step, and be stopped again.
        return sorted(chosen.values(), key=lambda each: (each is self.active, each.number))

    def _named(self, ids: Iterable[str], done: Cancelled) -> Iterator[tuple[int, Record]]:
        for goal_id in dict.fromkeys(ids):
            record = self.find(goal_id)
            if record is None:
                done.unknown.append(goal_id)
            elif record.state.terminal:
                done.ended.append(record)
            else:
                yield record.number, record

    def _accepted_until(self, goal_id: str, done: Cancelled) -> dict[int, Record]:
        last = self.find(goal_id)
        if last is None:
            done.unknown.append(goal_id)
            return {}
        return {each.number: each for each in self.unfinished() if each.number <= last.number}

    def _recall(self, record: Record, reason: str, words: str, by: By | None, now: Now) -> list[Effect]:
        record.become(State.RECALLING)
        self._leave_queue(record)
        return self._close(record, State.RECALLED, reason, f"Talk recalled: {words}", by, now)

    def _stop(self, record: Record, reason: str, by: By | None, now: Now) -> list[Effect]:
        if record.state is State.PREEMPTING:
            return []  # the first stop gives the reason, later ones join it
        record.become(State.PREEMPTING)
        record.reason, record.by, record.stop_since = reason, by, now.monotonic
        return [Changed(record, State.PREEMPTING), Stop(record)]

    def _spoken(self, goal_id: str) -> Record:
        if self.active is None or self.active.id != goal_id:
            raise IllegalTransition(f"{goal_id} is not being spoken")
        return self.active

    def _end(
        self, record: Record, state: State, reason: str | None, message: str, by: By | None, now: Now
    ) -> list[Effect]:
        effects = self._close(record, state, reason, message, by, now)
        self.active = None
        return effects + self._start_next(now)

    def _close(
        self, record: Record, state: State, reason: str | None, message: str, by: By | None, now: Now
    ) -> list[Effect]:
        record.become(state)
        record.reason, record.message, record.by = reason, message, by
        record.ended_at = now.wall
        self._by_id.pop(record.id)
        self.history.add(record)
        return [Changed(record, state)]

    def _leave_queue(self, record: Record) -> None:
        del self._pending[record.place]
        self._preempting.pop(record.place, None)
