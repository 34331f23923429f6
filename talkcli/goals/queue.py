"""The queue: the pending goals, in the order in which they will be spoken.

Pure: it keeps the goals and knows which one a full queue would displace. The scheduler decides whether one is. Higher
priorities go first. Goals of the same priority keep the order of acceptance, except that a goal may be put at the front
of its priority, or into the place of another goal.

At most ten thousand goals wait (`--max-queue`). Methods that are called for each goal use binary search, except where
their docstring says otherwise.
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
        #: in the order of the queue: negative priority and position
        self._goals: list[_Entry] = []
        #: the goals that preempt, in the same order
        self._preempting: list[_Entry] = []
        #: in the order in which a full queue displaces goals, the first one last: negative priority and number
        self._displaceable: list[_Entry] = []
        #: the goals with a time to live: when it ends, and their number
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
        """Return the goal with this key. There is one at most, because a new one replaces it."""
        return None if key is None else self._by_key.get(key)

    def with_text(self, text: str) -> Record | None:
        """Return the first goal with this text. Slow, because it looks at all goals."""
        return next((each for each in self if each.text == text), None)

    def goals_up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and of lower ones."""
        return list(map(_record_of, self._goals[bisect_left(self._goals, (-priority,)) :]))

    def preempting_goals_up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and of lower ones that preempt."""
        return list(map(_record_of, self._preempting[bisect_left(self._preempting, (-priority,)) :]))

    def displaceable_goal(self) -> Record | None:
        """Return the goal that a full queue displaces: the newest one of the lowest priority."""
        return self._displaceable[-1][2] if self._displaceable else None

    def add(self, record: Record, replaced: Record | None = None) -> None:
        """Put a goal at the end of its priority, or at the front if it preempts.

        Args:
            record: the goal.
            replaced: a goal of the same priority that has left the queue, and whose place the new goal takes.
        """
        usual = -record.number if record.preempt else record.number
        record.position = replaced.position if replaced else usual
        for goals, entry in self._entries(record):
            insort(goals, entry)
        if record.key is not None:
            self._by_key[record.key] = record

    def remove(self, record: Record) -> None:
        """Take a goal out of the queue."""
        for goals, entry in self._entries(record):
            del goals[bisect_left(goals, entry)]
        if record.key is not None:
            del self._by_key[record.key]

    def next_expiry(self) -> float | None:
        """Return when the first goal expires (monotonic)."""
        return self._expiries[0][0] if self._expiries else None

    def expired(self, now: float) -> list[Record]:
        """Return the goals that have expired, in the order in which they did."""
        return list(map(_record_of, self._expiries[: bisect_left(self._expiries, (now, inf))]))

    def _entries(self, record: Record) -> Iterator[tuple[list[_Entry], _Entry]]:
        """Return the lists that a goal is in, each with its entry there."""
        entry = by_number = -record.priority, record.position, record
        if record.position != record.number:
            by_number = -record.priority, record.number, record
        yield self._goals, entry
        yield self._displaceable, by_number
        if record.preempt:
            yield self._preempting, entry
        if record.expires_at is not None:
            yield self._expiries, (record.expires_at, record.number, record)
