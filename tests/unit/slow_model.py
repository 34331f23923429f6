"""A slow model of the scheduler: the README's rules for goals, order and cancel, told again with plain lists.

Rules for this file: it imports nothing of `talkcli` and is written from the rules, never from the scheduler's code: two
tellings that agree are worth something, two copies are not. Speed is no aim. A new option is a field of `SlowGoal`, a
line in `SlowModel.refusals` or `SlowModel.submit`, and a place in `SlowModel.insert`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

#: The table of states, as a watcher sees it: what may follow what. RECALLING is transient and never published.
TABLE: dict[str, set[str]] = {
    "PENDING": {"ACTIVE", "RECALLED"},
    "ACTIVE": {"PREEMPTING", "SUCCEEDED", "ABORTED"},
    "PREEMPTING": {"PREEMPTED", "SUCCEEDED", "ABORTED"},
}
#: What a goal that just arrived may be.
FIRST = {"PENDING", "REJECTED"}
ENDS = {"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED"}

#: Seconds after the first stop by which silence is confirmed or given up.
SILENCE = 2.0


class Refused(Exception):
    """The model's own word for an event that doesn't fit the state of its goal."""


@dataclass
class SlowGoal:
    """One goal. `by` is "goal ID", "client NAME", or None where the server or nobody ended it."""

    id: str
    text: str
    preempt: bool
    state: str = "PENDING"
    reason: str | None = None
    by: str | None = None
    spoken: int = 0
    duration: float | None = None
    #: when it was told to stop first, and what for
    stopped_at: float | None = None
    times: dict[str, float] = field(default_factory=dict)


@dataclass
class Selection:
    """What a cancel names; nothing named is everything, but a list of no ids names none."""

    ids: list[str] | None = None
    current: bool = False
    before: str | None = None


@dataclass
class Outcome:
    """What a cancel answers, by id. Whether `before` is noted where that goal has ended is left open."""

    recalled: list[str] = field(default_factory=list)
    stopping: str | None = None
    ended: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)


class SlowModel:
    """All goals of one server, in lists. Each step appends what it did to `events` and `orders`."""

    def __init__(self, *, preempt: bool, max_queue: int) -> None:
        self.preempt = preempt
        self.max_queue = max_queue
        self.all: list[SlowGoal] = []  # in order of arrival
        self.queue: list[SlowGoal] = []  # in the order in which they will be spoken
        self.voice: list[SlowGoal] = []  # being spoken: none or one
        self.closed = False
        self.monotonic = 0.0
        self.wall = 0.0
        self.events: list[tuple[str, str]] = []  # (id, state), in order within one goal
        self.orders: list[tuple[str, str]] = []  # what the engine is told: (start, stop or give up; id)

    def begin(self, monotonic: float, wall: float) -> None:
        """Begin a step at this time."""
        self.monotonic, self.wall = monotonic, wall
        self.events, self.orders = [], []

    # Requests

    def refusals(self, fault: str | None, *, preempt: bool | None) -> set[str]:
        """Return every reason for which a goal would be REJECTED now; `fault` is its text's or its options'."""
        reasons = set() if fault is None else {fault}
        if self.closed:
            reasons.add("shutdown")
        stays = [each for each in self.queue if not (self.wants_preempt(preempt) and each.preempt)]
        if self.voice and len(stays) >= self.max_queue:
            reasons.add("queue_full")
        return reasons

    def submit(self, goal_id: str, text: str, *, preempt: bool | None, refused: str | None) -> None:
        """Take a goal, or refuse it for the reason `refused`, which is one of `refusals`."""
        goal = SlowGoal(goal_id, text, self.wants_preempt(preempt), times={"queued": self.wall})
        self.all.append(goal)
        if refused is not None:
            self.end(goal, "REJECTED", refused, None)
            return
        self.change(goal, "PENDING")
        if goal.preempt:
            for older in [each for each in self.queue if each.preempt]:
                self.recall(older, "preempted", f"goal {goal.id}")
            for active in self.voice:
                self.stop(active, "preempted", f"goal {goal.id}")
        self.insert(goal)
        self.speak_next()

    def wants_preempt(self, preempt: bool | None) -> bool:
        return self.preempt if preempt is None else preempt

    def insert(self, goal: SlowGoal) -> None:
        """Put a goal in its place: at the end, or first where it preempts."""
        if goal.preempt:
            self.queue = [goal, *self.queue]
        else:
            self.queue = [*self.queue, goal]

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
        return outcome

    def selected(self, selection: Selection, outcome: Outcome) -> list[SlowGoal]:
        """Return the goals that have not ended among those selected; note in `outcome` what else was named."""
        living = self.voice + self.queue
        if selection.ids is None and not selection.current and selection.before is None:
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
        return [each for each in living if each in chosen]

    def shutdown(self) -> None:
        self.closed = True
        for goal in list(self.queue):
            self.recall(goal, "shutdown", None)
        for goal in list(self.voice):
            self.stop(goal, "shutdown", None)

    # The engine

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

    def tick(self) -> None:
        for goal in list(self.voice):
            if goal.stopped_at is not None and self.monotonic - goal.stopped_at >= SILENCE:
                self.end(goal, "ABORTED", "not_silent", goal.by)
                self.orders.append(("give up", goal.id))
                self.speak_next()

    def spoken(self, goal_id: str) -> SlowGoal:
        for goal in self.voice:
            if goal.id == goal_id:
                return goal
        raise Refused(f"{goal_id} is not being spoken")

    # The steps that all of these share

    def speak_next(self) -> None:
        if self.voice or not self.queue:
            return
        goal, *self.queue = self.queue
        self.voice = [goal]
        goal.times["started"] = self.wall
        self.change(goal, "ACTIVE")
        self.orders.append(("start", goal.id))

    def recall(self, goal: SlowGoal, reason: str, by: str | None) -> None:
        self.end(goal, "RECALLED", reason, by)

    def stop(self, goal: SlowGoal, reason: str, by: str | None) -> None:
        """Tell the engine to stop; a later stop joins the first, which gives reason and `by`."""
        if goal.state == "PREEMPTING":
            return
        goal.reason, goal.by, goal.stopped_at = reason, by, self.monotonic
        self.change(goal, "PREEMPTING")
        self.orders.append(("stop", goal.id))

    def end(self, goal: SlowGoal, state: str, reason: str | None, by: str | None) -> None:
        goal.reason, goal.by = reason, by
        goal.times["ended"] = self.wall
        self.change(goal, state)
        self.queue = [each for each in self.queue if each is not goal]
        self.voice = [each for each in self.voice if each is not goal]

    def change(self, goal: SlowGoal, state: str) -> None:
        goal.state = state
        self.events.append((goal.id, state))
