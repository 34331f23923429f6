"""The queue of pending goals, in the order in which they will be spoken.

Higher priorities come first. Goals of the same priority keep the order in which they were accepted, except that a goal
may take the place of another goal, and that preempting goals come first, followed by interjections. If the queue is
full, it can name a goal to displace, and the scheduler decides whether to do so.

The queue may contain ten thousand goals (`--max-queue`). Methods called for each goal use binary search unless their
docstring says otherwise.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from math import inf
from operator import itemgetter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.record import Record

    #: entry of a sorted list: two numbers to sort by, and the goal
    _Entry = tuple[float, int, Record]

_record_of = itemgetter(2)
#: Offset that puts preempting goals before interjections, and both before other goals. No goal has a number this high.
_POSITIONS = 2**40


class Queue:
    """The pending goals of a scheduler."""

    def __init__(self) -> None:
        #: all goals in speaking order, sorted by descending priority and then by position
        self._goals: list[_Entry] = []
        #: preempting goals, sorted by descending priority and then by position
        self._preempting: list[_Entry] = []
        #: interjections, sorted by descending priority and then by position
        self._interjections: list[_Entry] = []
        #: all goals, sorted by descending priority and then by age; the last goal is displaced first
        self._displaceable: list[_Entry] = []
        #: goals with a time to live, sorted by expiry time
        self._expiries: list[_Entry] = []
        self._by_key: dict[str, Record] = {}

    def __len__(self) -> int:
        return len(self._goals)

    def __iter__(self) -> Iterator[Record]:
        return map(_record_of, self._goals)

    def first(self) -> Record | None:
        """Return the next goal to speak, or None if the queue is empty."""
        return self._goals[0][2] if self._goals else None

    def interjections(self) -> Iterator[Record]:
        """Return an iterator over the pending interjections in speaking order."""
        return map(_record_of, self._interjections)

    def with_key(self, key: str | None) -> Record | None:
        """Return the pending goal with this key, if any.

        Two pending goals never have the same key.
        """
        return None if key is None else self._by_key.get(key)

    def with_content(self, content: str) -> Record | None:
        """Return the first pending goal with this text or sound, if any.

        This is slow, because it checks every goal.
        """
        return next((each for each in self if each.say.content == content), None)

    def goals_up_to(self, priority: int, *, only_preempting: bool) -> list[Record]:
        """Return the goals of this or a lower priority. Optionally leave out goals that don't preempt."""
        goals = self._preempting if only_preempting else self._goals
        return list(map(_record_of, goals[bisect_left(goals, (-priority,)) :]))

    def displaceable_goal(self) -> Record | None:
        """Return the goal to drop first from a full queue: the newest one of the lowest priority.

        Return None if the queue is empty.
        """
        return self._displaceable[-1][2] if self._displaceable else None

    def add(self, record: Record, replaced: Record | None = None) -> None:
        """Add a goal to the queue. If it replaces a goal that was removed, it takes that goal's place.

        Otherwise, its place is after the other goals of its kind and priority, or before them if it preempts.

        Args:
            record: the new goal.
            replaced: a goal of the same priority that was removed. The new goal takes its place in the queue.
        """
        usual = record.number - _POSITIONS * record.say.interject
        if record.preempt:
            usual = -2 * _POSITIONS - record.number
        record.position = replaced.position if replaced else usual
        for goals, entry in self._entries(record):
            insort(goals, entry)
        if record.say.key is not None:
            self._by_key[record.say.key] = record

    def remove(self, record: Record) -> None:
        """Remove a goal from the queue."""
        for goals, entry in self._entries(record):
            del goals[bisect_left(goals, entry)]
        if record.say.key is not None:
            del self._by_key[record.say.key]

    def next_expiry(self) -> float:
        """Return the monotonic time at which the next goal expires, or inf if no goal expires."""
        return self._expiries[0][0] if self._expiries else inf

    def expired(self, now: float) -> list[Record]:
        """Return the expired goals, earliest first. They stay in the queue."""
        return list(map(_record_of, self._expiries[: bisect_left(self._expiries, (now, inf))]))

    def _entries(self, record: Record) -> Iterator[tuple[list[_Entry], _Entry]]:
        """Yield each sorted list that contains a goal while it is queued, with the goal's entry in the list."""
        entry = -record.say.priority, record.position, record
        yield self._goals, entry
        yield self._displaceable, (-record.say.priority, record.number, record)
        if record.preempt:
            yield self._preempting, entry
        if record.say.interject:
            yield self._interjections, entry
        if record.expires_at < inf:
            yield self._expiries, (record.expires_at, record.number, record)
