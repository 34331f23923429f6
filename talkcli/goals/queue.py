"""The queue: the pending goals in the order in which they will be spoken.

Higher priorities come first. Goals of the same priority keep the order in which they were accepted, except that a goal
may be put at the front of its priority or take the place of another goal. If the queue is full, the queue returns the
goal to displace, and the scheduler decides whether to do so.

At most ten thousand goals wait (`--max-queue`). Methods called for each goal use binary search unless their docstring
says otherwise.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from math import inf
from operator import itemgetter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.record import Record

    #: an entry of a sorted list: a unique sort key, and the goal
    _Entry = tuple[float, int, Record]

_record_of = itemgetter(2)


class Queue:
    """The pending goals."""

    def __init__(self) -> None:
        #: all goals in the order of speech, sorted by negative priority and position
        self._goals: list[_Entry] = []
        #: the goals that preempt, sorted by negative priority and position
        self._preempting: list[_Entry] = []
        #: all goals, sorted by negative priority and number; the last one is the first to be displaced
        self._displaceable: list[_Entry] = []
        #: the goals with a time to live, sorted by expiry time and number
        self._expiries: list[_Entry] = []
        self._by_key: dict[str, Record] = {}

    def __len__(self) -> int:
        return len(self._goals)

    def __iter__(self) -> Iterator[Record]:
        return map(_record_of, self._goals)

    def first(self) -> Record | None:
        """Return the next goal."""
        return self._goals[0][2] if self._goals else None

    def with_key(self, key: str | None) -> Record | None:
        """Return the goal with this key. There is never more than one, because a new one replaces the old one."""
        return None if key is None else self._by_key.get(key)

    def with_text(self, text: str) -> Record | None:
        """Return the first goal with this text. This is slow because it searches all goals."""
        return next((each for each in self if each.text == text), None)

    def goals_up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and of all lower priorities."""
        return list(map(_record_of, self._goals[bisect_left(self._goals, (-priority,)) :]))

    def preempting_goals_up_to(self, priority: int) -> list[Record]:
        """Return the preempting goals of this priority and of all lower priorities."""
        return list(map(_record_of, self._preempting[bisect_left(self._preempting, (-priority,)) :]))

    def displaceable_goal(self) -> Record | None:
        """Return the goal to displace if the queue is full: the newest goal of the lowest priority."""
        return self._displaceable[-1][2] if self._displaceable else None

    def add(self, record: Record, replaced: Record | None = None) -> None:
        """Add a goal at the end of its priority, or at the front if it preempts.

        Args:
            record: the goal to add.
            replaced: a removed goal of the same priority. The new goal takes its place.
        """
        usual = -record.number if record.preempt else record.number
        record.position = replaced.position if replaced else usual
        for goals, entry in self._entries(record):
            insort(goals, entry)
        if record.key is not None:
            self._by_key[record.key] = record

    def remove(self, record: Record) -> None:
        """Remove a goal."""
        for goals, entry in self._entries(record):
            del goals[bisect_left(goals, entry)]
        if record.key is not None:
            del self._by_key[record.key]

    def next_expiry(self) -> float | None:
        """Return the time at which the next goal expires (monotonic), or None if no goal has a time to live."""
        return self._expiries[0][0] if self._expiries else None

    def expired(self, now: float) -> list[Record]:
        """Return the expired goals in the order of their expiry."""
        return list(map(_record_of, self._expiries[: bisect_left(self._expiries, (now, inf))]))

    def _entries(self, record: Record) -> Iterator[tuple[list[_Entry], _Entry]]:
        """Yield each sorted list that contains a goal, with the goal's entry in that list."""
        entry = -record.priority, record.position, record
        yield self._goals, entry
        yield self._displaceable, (-record.priority, record.number, record)
        if record.preempt:
            yield self._preempting, entry
        if record.expires_at is not None:
            yield self._expiries, (record.expires_at, record.number, record)
