"""A slow model of the scheduler: the documents' rules for goals, order and cancel, told again with plain lists.

Rules for this file: it imports nothing of `talkcli` and is written from the rules, never from the scheduler's code: two
tellings that agree are worth something, two copies are not. Speed is no aim. A new option is a field of `Wish` and of
`SlowGoal`, a line in `SlowModel.refusals` or `SlowModel.given_up_for`, and a place in `SlowModel.insert`.
"""

from __future__ import annotations

import re

from tests.unit.slow_goal import ENDS, Outcome, Selection, SlowGoal, Wish

#: Seconds after the first stop by which silence is confirmed or given up.
SILENCE = 2.0
#: Seconds for which a goal waits for a voice that is being loaded, and of its time to live that it keeps for itself.
PATIENCE, SPARE = 10.0, 0.5
#: Seconds for which a cancel of an id that nobody knows yet is remembered.
EARLY_CANCEL = 60.0


class Refused(Exception):
    """The model's own word for an event that doesn't fit the state of its goal."""


def own_form(goal_id: str) -> bool:
    """Whether a client may have made this id: neither all digits nor of the server's form."""
    return not goal_id.isdecimal() and not re.fullmatch(r"[a-z0-9]{4}-[0-9]+", goal_id)


class SlowModel:
    """All goals of one server, in lists. Each step appends what it did to `events` and `orders`."""

    def __init__(self, *, preempt: bool, max_queue: int, ttl: float = 0.0) -> None:
        self.preempt = preempt
        self.max_queue = max_queue
        self.ttl = ttl
        self.usual_voice: str | None = None
        self.loading: dict[str, float | None] = {}  # voices, without their speakers, and since when; None: not yet
        self.all: list[SlowGoal] = []  # in order of arrival
        self.queue: list[SlowGoal] = []  # in the order in which they will be spoken
        self.voice: list[SlowGoal] = []  # being spoken: none or one
        self.early: dict[str, tuple[float, str]] = {}  # cancels of ids to come: when, by whom
        self.paused = False
        self.engine = True  # whether there is one that takes goals
        self.closed = False
        self.monotonic = 0.0
        self.wall = 0.0
        self.events: list[tuple[str, str]] = []  # (id, state), in order within one goal
        self.orders: list[tuple[str, str]] = []  # what the engine is told: (start, stop, hold, …; id)

    def begin(self, monotonic: float, wall: float) -> None:
        """Begin a step at this time."""
        self.monotonic, self.wall = monotonic, wall
        self.events, self.orders = [], []

    # Requests

    def first_of(self, wish: Wish) -> SlowGoal | None:
        """Return the goal that used this id up. A REJECTED one doesn't; it never even has the id."""
        return next((each for each in self.all if each.id == wish.id), None)

    def refusals(self, wish: Wish, fault: str | None = None) -> dict[str, set[str | None]]:
        """Return every reason for which a goal would be REJECTED now, with what `by` may be then.

        `fault` is its text's or its options'. Where there are several, it is left open which one is told.
        """
        reasons: dict[str, set[str | None]] = {} if fault is None else {fault: {None}}
        if self.closed:
            reasons["shutdown"] = {None}
        first = self.first_of(wish)
        if first is not None and first.text != wish.text:
            reasons["id_conflict"] = {None}
        throttling = self.throttling(wish)
        if throttling:
            reasons["throttled"] = {f"goal {each.id}" for each in throttling}
        if self.cancelled_early(wish) is None and self.full_for(wish) and self.displaced_by(wish) is None:
            reasons["queue_full"] = {None}
        return reasons

    def throttling(self, wish: Wish) -> list[SlowGoal]:
        """Return the goals for which this one would be said too often."""
        if wish.throttle is None:
            return []
        alike = [each for each in self.all if each.state != "REJECTED"]
        if wish.key is not None:
            alike = [each for each in alike if each.key == wish.key]
        else:
            alike = [each for each in alike if each.text == wish.text]
        spoken = [each for each in alike if each in self.voice]
        waiting = [each for each in self.queue if each in alike][:1] if wish.key is None else []
        recent = [
            each
            for each in alike
            if each.state in {"SUCCEEDED", "PREEMPTED"}
            and each.spoken > 0
            and each.began_at is not None
            and self.monotonic - each.began_at < wish.throttle
        ]
        return spoken + waiting + recent

    def given_up_for(self, wish: Wish) -> dict[str, str]:
        """Return the pending goals that this one recalls for its own options, id to reason."""
        doomed = {}
        for each in self.queue:
            if wish.key is not None and each.key == wish.key:
                doomed[each.id] = "replaced"
            elif self.preempts(wish) and each.priority <= wish.priority and (wish.flush or each.preempt):
                doomed[each.id] = "preempted"
        return doomed

    def staying(self, wish: Wish) -> list[SlowGoal]:
        return [each for each in self.queue if each.id not in self.given_up_for(wish)]

    def full_for(self, wish: Wish) -> bool:
        return len(self.staying(wish)) >= self.max_queue

    def displaced_by(self, wish: Wish) -> SlowGoal | None:
        """Return the newest pending goal of the lowest priority, if this goal may displace it.

        Its priority must be lower. If this goal brings `preempt`, the same priority will do for a goal without it.
        """
        lower = [each for each in self.staying(wish) if each.priority < wish.priority]
        same = [each for each in self.staying(wish) if each.priority == wish.priority and not each.preempt]
        weaker = lower + same if wish.preempt else lower
        lowest = min((each.priority for each in weaker), default=0)
        return next((each for each in reversed(self.all) if each in weaker and each.priority == lowest), None)

    def cancelled_early(self, wish: Wish) -> str | None:
        """Return who cancelled this id before it was there, a short while ago."""
        when, client = self.early.get(wish.id or "", (0.0, None))
        return client if self.monotonic - when < EARLY_CANCEL else None

    def submit(self, goal_id: str, wish: Wish, refused: tuple[str, str | None] | None = None) -> None:
        """Take a goal, or refuse it for a reason and its `by`, which are among the `refusals`."""
        goal = SlowGoal(goal_id, wish.text, self.preempts(wish), wish.priority, wish.key)
        goal.ttl = (self.ttl if wish.ttl is None else wish.ttl) or None
        goal.voice, goal.voice_only = wish.voice, wish.voice_only
        goal.accepted_at, goal.times["queued"] = self.monotonic, self.wall
        self.all.append(goal)
        if refused is not None:
            self.end(goal, "REJECTED", *refused)
            return
        self.change(goal, "PENDING")
        client = self.cancelled_early(wish)
        if client is not None:
            self.recall(goal, "canceled", client)
            return
        self.make_way(goal, wish)
        self.speak_next()

    def make_way(self, goal: SlowGoal, wish: Wish) -> None:
        by = f"goal {goal.id}"
        doomed = self.given_up_for(wish)
        victim = self.displaced_by(wish) if self.full_for(wish) else None
        old_queue = self.queue
        for each in old_queue:
            if each.id in doomed:
                self.recall(each, doomed[each.id], by)
            elif each is victim:
                self.recall(each, "displaced", by)
        for active in self.voice:
            if goal.preempt and active.priority <= goal.priority:
                self.stop(active, "preempted", by)
        same_place = [
            each for each in old_queue if doomed.get(each.id) == "replaced" and each.priority == goal.priority
        ]
        if same_place and not goal.preempt:
            self.queue = [goal if each is same_place[0] else each for each in old_queue]
        else:
            self.insert(goal)

    def preempts(self, wish: Wish) -> bool:
        return wish.flush or (self.preempt if wish.preempt is None else wish.preempt)

    def insert(self, goal: SlowGoal) -> None:
        """Put a goal among the pending: before or behind those of its priority, for higher ones go before lower."""
        higher = [each for each in self.queue if each.priority > goal.priority]
        equal = [each for each in self.queue if each.priority == goal.priority]
        lower = [each for each in self.queue if each.priority < goal.priority]
        self.queue = higher + ([goal, *equal] if goal.preempt else [*equal, goal]) + lower

    def cancel(self, selection: Selection, client: str) -> Outcome:
        outcome = Outcome()
        chosen = self.selected(selection, outcome)
        by = f"client {client}"
        for goal in [each for each in self.queue if each in chosen]:
            self.recall(goal, "canceled", by)
            outcome.recalled.append(goal.id)
        for goal in [each for each in self.voice if each in chosen]:
            self.stop(goal, "canceled", by)
            outcome.stopping = goal.id
        self.early.update({each: (self.monotonic, by) for each in outcome.unknown if own_form(each)})
        return outcome

    def selected(self, selection: Selection, outcome: Outcome) -> list[SlowGoal]:
        """Return the goals that have not ended among those selected; note in `outcome` what else was named."""
        living = self.voice + self.queue
        if selection == Selection():
            return living
        ids = selection.ids or []
        named = list(ids) if selection.before is None else [*ids, selection.before]
        known = {each.id: each for each in self.all}
        outcome.unknown = [each for each in named if each not in known]
        outcome.ended = [each for each in ids if each in known and known[each].state in ENDS]
        chosen = [known[each] for each in named if each in known]
        if selection.current:
            chosen += self.voice
        if selection.before in known:
            chosen += self.all[: self.all.index(known[selection.before]) + 1]
        if selection.key is not None:
            chosen += [each for each in living if each.key == selection.key]
        return [each for each in living if each in chosen]

    def pause(self) -> None:
        if not self.paused:
            self.paused = True
            for goal in [each for each in self.voice if each.state == "ACTIVE"]:
                goal.paused = True
                self.orders.append(("hold", goal.id))

    def resume(self) -> None:
        self.paused = False
        for goal in [each for each in self.voice if each.paused]:
            goal.paused = False
            self.orders.append(("resume", goal.id))
        self.speak_next()

    def shutdown(self) -> None:
        self.closed = True
        for goal in list(self.queue):
            self.recall(goal, "shutdown", None)
        for goal in list(self.voice):
            self.stop(goal, "shutdown", None)

    # The engine

    def engine_lost(self) -> None:
        self.engine = False
        self.loading = {}

    def is_to_load(self, voice: str) -> None:
        if voice not in self.loading:
            self.loading[voice] = None

    def begins_to_load(self, voice: str) -> None:
        self.loading[voice] = self.monotonic

    def has_loaded(self, voice: str) -> None:
        self.loading = {name: since for name, since in self.loading.items() if name != voice}
        self.tick()

    def engine_ready(self) -> None:
        self.engine = True
        self.speak_next()

    def engine_missing(self) -> None:
        """It costs the goal whose turn it would be, and no other."""
        if self.engine:
            return
        self.loading = {}
        if self.voice or self.paused:
            return
        self.recall_what_is_too_late()
        if self.queue:
            self.begin_with_the_first()
            self.end(self.voice[0], "ABORTED", "engine_failed", None)

    def heard(self, goal_id: str, end: int) -> None:
        goal = self.spoken(goal_id)
        goal.spoken = max(goal.spoken, end)

    def completed(self, goal_id: str, duration: float | None) -> None:
        goal = self.spoken(goal_id)
        goal.duration = duration
        goal.spoken = len(goal.text)  # all of it was played
        self.end(goal, "SUCCEEDED", None, None)
        self.speak_next()

    def failed(self, goal_id: str, reason: str, duration: float | None) -> None:
        goal = self.spoken(goal_id)
        goal.duration = duration
        if goal.state == "PREEMPTING" and reason != "not_silent":
            self.end(goal, "PREEMPTED", goal.reason, goal.by)
        else:
            self.end(goal, "ABORTED", reason, goal.by)
        self.speak_next()

    def stopped(self, goal_id: str) -> None:
        goal = self.spoken(goal_id)
        if goal.state != "PREEMPTING":
            raise Refused(f"nobody told {goal_id} to stop")
        self.end(goal, "PREEMPTED", goal.reason, goal.by)
        self.speak_next()

    def spoken(self, goal_id: str) -> SlowGoal:
        for goal in self.voice:
            if goal.id == goal_id:
                return goal
        raise Refused(f"{goal_id} is not being spoken")

    # Time

    def tick(self) -> None:
        for goal in list(self.voice):
            if goal.stopped_at is not None and self.monotonic - goal.stopped_at >= SILENCE:
                self.end(goal, "ABORTED", "not_silent", goal.by)
                self.orders.append(("give up", goal.id))
                self.speak_next()
        for goal in self.unbegun():
            if self.monotonic - goal.accepted_at >= (goal.ttl or 0):
                self.stop(goal, "expired", None)
        self.recall_what_is_too_late()
        self.speak_next()

    def unbegun(self) -> list[SlowGoal]:
        """Return the goal that has a time to live and lost its engine before any of it was heard: it may begin anew."""
        return [
            each for each in self.voice if each.ttl and not self.engine and each.state == "ACTIVE" and not each.spoken
        ]

    def recall_what_is_too_late(self) -> None:
        for goal in self.queue:
            if goal.ttl is not None and self.monotonic - goal.accepted_at >= goal.ttl:
                self.recall(goal, "expired", None)

    # The steps that all of these share

    def speak_next(self) -> None:
        """Begin with the first that is not too late."""
        if self.voice or self.paused or not self.engine:
            return
        self.recall_what_is_too_late()
        if self.queue and not self.waits_for_its_voice(self.queue[0]):
            self.begin_with_the_first()
            self.orders.append(("start", self.voice[0].id))

    def waits_for_its_voice(self, goal: SlowGoal) -> bool:
        if goal.turn_at is None:
            goal.turn_at = self.monotonic
        waits_until = self.waits_until(goal)
        return waits_until is not None and self.monotonic < waits_until

    def waits_until(self, goal: SlowGoal) -> float | None:
        """Return until when it waits for its voice; None for not at all."""
        name = (goal.voice or self.usual_voice or "").split("#")[0]
        if name not in self.loading:
            return None
        if goal.voice_only:
            return float("inf")
        if goal.preempt or goal.priority > 0:
            return None
        since = self.loading[name]
        if since is None:
            since = goal.turn_at
        limits = [] if since is None else [since + PATIENCE]
        if goal.ttl is not None:
            limits.append(goal.accepted_at + goal.ttl - SPARE)
        return min(limits)

    def may_begin_at(self) -> list[float]:
        """Return when the first of the queue begins if nothing else happens; nothing where something else must."""
        if self.voice or self.paused or not self.engine or not self.queue:
            return []
        if self.queue[0].turn_at is None:
            return [0.0]  # nobody has looked at it yet
        until = self.waits_until(self.queue[0])
        return [] if until == float("inf") else [0.0 if until is None else until]

    def begin_with_the_first(self) -> None:
        goal, *self.queue = self.queue
        self.voice = [goal]
        goal.began_at, goal.times["started"] = self.monotonic, self.wall
        self.change(goal, "ACTIVE")

    def recall(self, goal: SlowGoal, reason: str, by: str | None) -> None:
        self.end(goal, "RECALLED", reason, by)

    def stop(self, goal: SlowGoal, reason: str, by: str | None) -> None:
        """Tell the engine to stop; a later stop joins the first, which gives reason and `by`."""
        if goal.state == "PREEMPTING":
            return
        goal.reason, goal.by, goal.stopped_at, goal.paused = reason, by, self.monotonic, False
        self.change(goal, "PREEMPTING")
        self.orders.append(("stop", goal.id))

    def end(self, goal: SlowGoal, state: str, reason: str | None, by: str | None) -> None:
        goal.reason, goal.by, goal.paused = reason, by, False
        goal.times["ended"] = self.wall
        self.change(goal, state)
        self.queue = [each for each in self.queue if each is not goal]
        self.voice = [each for each in self.voice if each is not goal]

    def change(self, goal: SlowGoal, state: str) -> None:
        goal.state = state
        self.events.append((goal.id, state))
