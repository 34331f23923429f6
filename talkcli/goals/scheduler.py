"""The scheduler: which goal is spoken, which waits, and how each ends.

Pure: a request, an engine event or the time goes in, effects come out; no thread, socket or clock inside. A method
either does all of its step or raises and has changed nothing. Effects are to be carried out in the order in which they
come: those for the engine in theirs, and the news for clients, `Changed`, in theirs.

What holds after every step: at most one goal is ACTIVE or PREEMPTING, and none starts before that one has ended, while
speech is paused, or while there is no engine; a goal ends once; the order in which goals wait is the queue's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import TYPE_CHECKING

from talkcli.frozen import frozen, replace
from talkcli.goals import text as texts
from talkcli.goals.goal import By
from talkcli.goals.history import EarlyCancels, History, Said
from talkcli.goals.loading import Loading
from talkcli.goals.option import figure, is_clients_id
from talkcli.goals.options import INITIAL, MAX_CHARACTERS, bad_option
from talkcli.goals.queue import Queue
from talkcli.goals.reasons import Reason, Refusal
from talkcli.goals.record import Record
from talkcli.goals.states import IllegalTransition, State

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from talkcli.goals.goal import Output, Sender
    from talkcli.goals.options import Cancel, Say, Set

#: Seconds after a stop in which silence must be confirmed: `cancel` is answered within 2 s whatever happens.
SILENCE_LIMIT = 1.9


@frozen
class Now:
    """One moment on both clocks, in seconds: monotonic, for limits, and since 1970 UTC, to be shown.

    The monotonic one counts the time in which the machine was suspended: what was true before is not news after it.
    """

    monotonic: float
    wall: float


@frozen
class Changed:
    """A goal is in a new state; to be published."""

    record: Record
    state: State


class Order(Enum):
    """What the engine shall do with a goal, as the log calls it."""

    START = "Start"
    #: the answer is `ended`
    STOP = "Stop"
    #: it didn't become silent in time: it must be replaced before it may be given another goal
    GIVE_UP = "GiveUp"
    #: be silent, and go on with it at `RESUME`
    HOLD = "Hold"
    RESUME = "Resume"


@frozen
class Ordered:
    """The engine shall do this with a goal."""

    record: Record
    order: Order


Effect = Changed | Ordered


@frozen
class Submitted:
    """What became of a goal that was sent: its record, or that of the first goal of its id, to which it is attached."""

    record: Record
    effects: list[Effect]
    attached: bool = False


@dataclass(slots=True)
class Cancelled:
    """What a cancel did: goals that ended at once, the one being stopped, those that had ended, ids nobody knows."""

    recalled: list[Record] = field(default_factory=list)
    stopping: Record | None = None
    ended: list[Record] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)


class Scheduler:
    """Goals of one server. `boot` makes their ids: four characters a server start."""

    def __init__(self, boot: str, *, max_queue: int, max_text: int = MAX_CHARACTERS, settings: Set = INITIAL) -> None:
        self.boot = boot
        #: what holds for goals that don't say; all of them are given
        self.settings = settings
        self.max_queue = max_queue
        self.max_text = max_text
        self.history = History()
        #: the goal that is ACTIVE or PREEMPTING
        self.active: Record | None = None
        #: whether nothing is to be spoken until `resume`
        self.paused = False
        #: whether there is an engine to start the next goal; without one they wait
        self.has_engine = True
        self.loading = Loading()
        #: whether it was told to end, and takes no goal any more
        self.closing = False
        self._queue = Queue()
        self._by_id: dict[str, Record] = {}
        self._said = Said()
        self._early = EarlyCancels()
        self._count = 0

    # -- what there is

    @property
    def pending_count(self) -> int:
        return len(self._queue)

    def pending(self) -> Iterator[Record]:
        """Return the pending goals in the order in which they will be spoken."""
        return iter(self._queue)

    def find(self, goal_id: str) -> Record | None:
        """Return a goal that is active, pending, or still remembered."""
        return self._by_id.get(goal_id) or self.history.find(goal_id)

    def lacks_room(self, say: Say, now: Now, fault: Refusal | None = None) -> bool:
        """Whether this goal would be REJECTED only because the queue is full; `fault` as in `submit`."""
        early = self._early.find(say.id, now.monotonic)
        return not (early or self.has_room(say)) and self._refuse(say, fault, None) is None

    def has_room(self, say: Say) -> bool:
        """Whether a goal that lacked nothing but room need wait no longer."""
        attaches = say.id is not None and self.find(say.id) is not None
        return attaches or self._way(say) is not None

    def unfinished(self) -> list[Record]:
        """Return the active goal and the pending ones."""
        return ([self.active] if self.active else []) + list(self._queue)

    # -- what clients ask for

    def submit(
        self,
        say: Say,
        sender: Sender,
        now: Now,
        fault: Refusal | None = None,
        canceled: By | None = None,
        waited: float = 0.0,
    ) -> Submitted:
        """Accept or reject a goal. Admission is one step: a goal that is REJECTED has done nothing to the others.

        Args:
            say: the goal.
            sender: its sender.
            now: the time.
            fault: reason and words, if something is wrong with it that can't be known here.
            canceled: who cancelled it while it waited for room; it is RECALLED at once, and does nothing to the others.
            waited: seconds for which it waited for room; if its ttl is over, it is RECALLED likewise.
        """
        first = self.find(say.id) if say.id is not None and is_clients_id(say.id) else None
        if first is not None and first.has_text(say.text):
            return Submitted(first, [], attached=True)
        self._count += 1
        ttl = (self.settings.ttl if say.ttl is None else say.ttl) or None
        expires_at = None if ttl is None else now.monotonic + ttl - waited
        number, asked = self._count, say if ttl == say.ttl else replace(say, ttl=ttl)
        record = Record(f"{self.boot}-{number}", number, asked, sender, now.wall, self._preempts(say), expires_at)
        by = canceled or self._early.find(say.id, now.monotonic)
        refused = self._refuse(say, fault, first) or (None if canceled else self._throttle(say, record, now))
        expired = expires_at is not None and expires_at <= now.monotonic
        way = self._way(say)
        if way is None and not (by or refused or expired):
            refused = Reason.QUEUE_FULL, f"{len(self._queue)} goals are waiting already (`talk serve --max-queue`)"
        if refused:
            record.reason, words = refused
            record.state, record.message, record.ended_at = State.REJECTED, f"Talk rejected: {words}", now.wall
            self.history.add(record)
            return Submitted(record, [Changed(record, State.REJECTED)])
        record.id = say.id or record.id
        self._by_id[record.id] = record
        effects: list[Effect] = [Changed(record, State.PENDING)]
        if by:
            words = "canceled before it was spoken" if canceled else "canceled before it arrived"
            return Submitted(record, effects + self._recalled(record, Reason.CANCELED, words, by, now))
        if expired:
            return Submitted(record, effects + self._recalled(record, Reason.EXPIRED, _expired(record), None, now))
        effects += self._make_way(record, way or [], now)
        return Submitted(record, effects + self._start_next(now))

    def cancel(
        self, selection: Cancel, sender: Sender | None, now: Now, waiting: Collection[str | None] = ()
    ) -> Cancelled:
        """End what is selected: pending goals at once, the active one as soon as the engine is silent.

        `waiting`: ids that it selects of goals that have not been submitted yet.
        """
        done = Cancelled()
        by = By(client=sender)
        chosen = self._select(selection, done, waiting)
        for goal_id in filter(is_clients_id, done.unknown):
            self._early.note(goal_id, by, now.monotonic)
        for record in chosen:
            if record.state is State.PENDING:
                done.effects += self._recall(record, Reason.CANCELED, "canceled before it was spoken", by, now)
                done.recalled.append(record)
            else:
                done.effects += self._stop(record, Reason.CANCELED, by, now)
                done.stopping = record
        return done

    def shutdown(self, now: Now) -> list[Effect]:
        """End everything, and take no goal any more."""
        self.closing = True
        effects: list[Effect] = []
        for record in list(self._queue):
            effects += self._recall(record, Reason.SHUTDOWN, "the server was stopped", None, now)
        if self.active:
            effects += self._stop(self.active, Reason.SHUTDOWN, None, now)
        return effects

    def pause(self) -> list[Effect]:
        """Hold the goal being spoken, and start none."""
        if self.paused:
            return []
        self.paused = True
        if self.active is None or self.active.state is not State.ACTIVE:
            return []
        self.active.paused = True
        self.active.holds += 1
        return [Ordered(self.active, Order.HOLD)]

    def resume(self, now: Now) -> list[Effect]:
        """Go on with the goal that is held, or else with the next."""
        if not self.paused:
            return []
        self.paused = False
        if not (self.active and self.active.paused):
            return self._start_next(now)  # nothing where one is being stopped
        self.active.paused = False
        return [Ordered(self.active, Order.RESUME)]

    # -- what the engine says

    def engine_lost(self) -> None:
        """Start no goal until there is an engine again, which has no voice loaded."""
        self.has_engine = False
        self.loading.clear()

    def engine_ready(self, now: Now) -> list[Effect]:
        """Go on: there is an engine that takes the next goal."""
        self.has_engine = True
        return self._start_next(now)

    def engine_missing(self, words: str, now: Now) -> list[Effect]:
        """End the goal whose turn it is: an engine was waited for long enough, and once more none came."""
        if self.has_engine:
            return []
        self.loading.clear()  # there is nothing that would load a voice
        record, effects = self._activate_next(now)
        return effects + self.failed(record.id, Reason.ENGINE_FAILED, words, None, now) if record else effects

    def heard(self, goal_id: str, end: int) -> Record:
        """Note that the word that ends at this offset of the text is being heard."""
        record = self._spoken(goal_id)
        record.spoken_end = max(record.spoken_end, end)
        return record

    def spoken_by(self, goal_id: str, voice: str) -> None:
        """Note by which voice the active goal is heard."""
        self._spoken(goal_id).voice = voice

    def goes_to(self, goal_id: str, output: Output | None) -> None:
        """Note where the active goal's sound goes, as far as that is known."""
        self._spoken(goal_id).output = output

    def completed(self, goal_id: str, duration: float | None, now: Now, gaps: int = 0, late: float = 0) -> list[Effect]:
        """End the active goal: all of it was played, with so many gaps, so many seconds `late` by them."""
        record = self._spoken(goal_id)
        record.duration = duration
        record.spoken_end = len(record.text or "")
        words = "Talk completed successfully"
        if record.output and record.output.muted:
            words += f", but the output was muted: {record.output.device}"
        if gaps:
            many = f"{gaps} gap{'s' if gaps > 1 else ''} of {late:.1f} s in all"
            words += f", but with {many}: this machine is too slow for the voice"
        # A stop that came too late ended nothing: its reason goes.
        return self._end(record, State.SUCCEEDED, None, words, None, now)

    def failed(self, goal_id: str, reason: Reason, words: str, duration: float | None, now: Now) -> list[Effect]:
        """End the active goal: engine or audio failed.

        One that was being stopped is silent now, so it is PREEMPTED, unless the silence is what failed (not_silent).
        """
        record = self._spoken(goal_id)
        record.duration = duration
        if record.state is State.PREEMPTING and reason is not Reason.NOT_SILENT:
            return self.stopped(goal_id, now)
        return self._end(record, State.ABORTED, reason, f"Talk aborted: {words}", record.by, now)

    def stopped(self, goal_id: str, now: Now) -> list[Effect]:
        """End the active goal, which was told to stop: it is silent."""
        record = self._spoken(goal_id)
        return self._end(record, State.PREEMPTED, record.reason, "Talk preempted", record.by, now)

    # -- time

    def deadline(self) -> float | None:
        """Return the monotonic time at which `tick` has something to do."""
        due = (self._active_deadline(), self._queue.next_expiry(), self._next_deadline())
        return min((each for each in due if each is not None), default=None)

    def tick(self, now: Now) -> list[Effect]:
        """Do what is due: recall what is too late, abort what isn't silent in time, start what has waited."""
        effects: list[Effect] = []
        record, deadline = self.active, self._active_deadline()
        if record is not None and deadline is not None and now.monotonic >= deadline:
            if record.stop_since is None:
                effects = self._stop(record, Reason.EXPIRED, None, now)
            else:
                words = f"Talk aborted: silence could not be confirmed within {SILENCE_LIMIT:g} s"
                effects = [Ordered(record, Order.GIVE_UP)]
                effects += self._end(record, State.ABORTED, Reason.NOT_SILENT, words, record.by, now)
        return effects + self._expire(now) + self._start_next(now)

    # -- inside

    def _select(self, selection: Cancel, done: Cancelled, waiting: Collection[str | None]) -> list[Record]:
        """Return the selected goals that have not ended; note in `done` what else was named."""
        chosen = self.unfinished() if selection.everything else []
        for goal_id in dict.fromkeys(selection.ids or ()):
            record = self.find(goal_id)
            if record and record.state.terminal:
                done.ended.append(record)
            elif record:
                chosen.append(record)
            elif goal_id not in waiting:
                done.unknown.append(goal_id)
        if self.active and (selection.current or self.active.key == selection.key is not None):
            chosen.append(self.active)
        if pending := self._queue.with_key(selection.key):
            chosen.append(pending)
        if selection.before is not None:
            last = self.find(selection.before)
            if last or selection.before in waiting:
                chosen += [each for each in self.unfinished() if last is None or each.number <= last.number]
            else:
                done.unknown.append(selection.before)
        once = {each.number: each for each in chosen}.values()
        # The active one last: another must not start, even for the length of this step, and be stopped again.
        return sorted(once, key=lambda each: (each is self.active, each.number))

    def _refuse(self, say: Say, fault: Refusal | None, first: Record | None) -> Refusal | None:
        """Return reason and words why a goal can't be had, whatever else is being said."""
        if self.closing:
            return Reason.SHUTDOWN, "the server is being stopped"
        if words := bad_option(say):
            return Reason.BAD_OPTION, words
        if first is not None:
            return Reason.ID_CONFLICT, f"the id {say.id} is that of another text already"
        return texts.fault(say.text, self.max_text) or fault

    def _throttle(self, say: Say, record: Record, now: Now) -> Refusal | None:
        """Return reason and words where the same is being said, waits, or was said just now; note which goal it is."""
        if say.throttle is None:
            return None
        active = self.active
        waiting = self._queue.with_text(say.text) if say.key is None else None
        if active and (active.text == say.text if say.key is None else active.key == say.key):
            first, words = active.id, "is being said"
        elif waiting:
            first, words = waiting.id, "is waiting already"
        else:
            last = self._said.within(say.throttle, say.key, say.text, now.monotonic)
            if last is None:
                return None
            first, words = last, f"was said less than {figure(say.throttle)} s ago"
        record.by = By(goal=first)
        return Reason.THROTTLED, f"the same {words}"

    def _way(self, say: Say) -> list[tuple[Record, Reason]] | None:
        """Return the pending goals that this one recalls, and the reason; None if it has no room even so."""
        replaced = self._queue.with_key(say.key)
        preempted: list[Record] = []
        if say.flush:
            preempted = self._queue.up_to(say.priority)
        elif self._preempts(say):
            preempted = self._queue.preempting_up_to(say.priority)
        way = [(replaced, Reason.REPLACED)] if replaced else []
        way += [(each, Reason.PREEMPTED) for each in preempted if each is not replaced]
        # There never are more goals in the queue than may be: one that will be recalled makes room enough.
        if way or len(self._queue) < self.max_queue:
            return way
        last = self._queue.newest_of_lowest()
        # A goal that brings `preempt` displaces its own priority, too. Any preempting goal there is in `way` already.
        limit = say.priority if say.preempt else say.priority - 1
        return [(last, Reason.DISPLACED)] if last and last.priority <= limit else None

    def _preempts(self, say: Say) -> bool:
        return say.flush or bool(self.settings.preempt if say.preempt is None else say.preempt)

    def _make_way(self, record: Record, ended: list[tuple[Record, Reason]], now: Now) -> list[Effect]:
        """Queue a goal that was accepted, and end what it replaces, preempts or displaces."""
        by = By(goal=record.id)
        effects: list[Effect] = []
        instead = None
        for each, reason in ended:
            if reason is Reason.REPLACED and each.priority == record.priority and not record.preempt:
                instead = each
            effects += self._recall(each, reason, f"{reason} by {record.id}", by, now)
        if record.preempt and self.active and self.active.priority <= record.priority:
            effects += self._stop(self.active, Reason.PREEMPTED, by, now)
        self._queue.add(record, instead)
        return effects

    def _expire(self, now: Now) -> list[Effect]:
        effects: list[Effect] = []
        for record in self._queue.expired(now.monotonic):
            effects += self._recall(record, Reason.EXPIRED, _expired(record), None, now)
        return effects

    def _active_deadline(self) -> float | None:
        """Return by when the active goal must be silent, if it was stopped, or else when it expires.

        It does so only where its engine was lost before it was heard, and it may have to begin anew.
        """
        goal = self.active
        if goal is None:
            return None
        if goal.stop_since is not None:
            return goal.stop_since + SILENCE_LIMIT
        return None if self.has_engine or goal.spoken_end else goal.expires_at

    def _next_deadline(self) -> float | None:
        """Return when the goal whose turn it is waits no longer for its voice."""
        record = None if self.active or self.paused or not self.has_engine else self._queue.first()
        if record is None:
            return None
        begins_at = 0.0 if record.turn_at == inf else self.loading.begins_at(record, self.settings.voice)
        return begins_at if begins_at < inf else None

    def _start_next(self, now: Now) -> list[Effect]:
        if not self.has_engine:
            return []
        record, effects = self._activate_next(now)
        return [*effects, Ordered(record, Order.START)] if record else effects

    def _activate_next(self, now: Now) -> tuple[Record | None, list[Effect]]:
        """Make the goal whose turn it is the active one, if there is one and nothing speaks against it."""
        if self.active or self.paused:
            return None, []
        effects = self._expire(now)
        record = self._queue.first()
        if record:
            record.turn_at = min(record.turn_at, now.monotonic)
        if record and self.loading.begins_at(record, self.settings.voice) <= now.monotonic:
            record.become(State.ACTIVE)
            self._queue.remove(record)
            record.started_at, record.began = now.wall, now.monotonic
            self.active = record
            return record, [*effects, Changed(record, State.ACTIVE)]
        return None, effects

    def _recall(self, record: Record, reason: Reason, words: str, by: By | None, now: Now) -> list[Effect]:
        self._queue.remove(record)
        return self._recalled(record, reason, words, by, now)

    def _recalled(self, record: Record, reason: Reason, words: str, by: By | None, now: Now) -> list[Effect]:
        record.become(State.RECALLING)
        return self._end(record, State.RECALLED, reason, f"Talk recalled: {words}", by, now)

    def _stop(self, record: Record, reason: Reason, by: By | None, now: Now) -> list[Effect]:
        if record.state is State.PREEMPTING:
            return []  # the first stop gives the reason, later ones join it
        record.become(State.PREEMPTING)
        record.reason, record.by, record.stop_since = reason, by, now.monotonic
        record.paused = False
        return [Changed(record, State.PREEMPTING), Ordered(record, Order.STOP)]

    def _spoken(self, goal_id: str) -> Record:
        if self.active is None or self.active.id != goal_id:
            raise IllegalTransition(f"{goal_id} is not being spoken")
        return self.active

    def _end(
        self, record: Record, state: State, reason: Reason | None, message: str, by: By | None, now: Now
    ) -> list[Effect]:
        """End a goal for ever, and start the next if it was the active one."""
        record.become(state)
        record.reason, record.message, record.by = reason, message, by
        record.ended_at, record.paused = now.wall, False
        if record.spoken_end and state is not State.ABORTED:
            self._said.note(record)
        self._by_id.pop(record.id)
        self.history.add(record)
        if record is not self.active:
            return [Changed(record, state)]
        self.active = None
        return [Changed(record, state), *self._start_next(now)]


def _expired(record: Record) -> str:
    return f"its time to live of {figure(record.say.ttl)} s was over before it was spoken"
