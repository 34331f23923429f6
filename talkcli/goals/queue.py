"""The goals that wait, in the order in which they will be spoken.

Pure, and no rule of admission: it keeps what it is given. Higher priority goes first, first in first out among equals,
but for what is put at the front of its priority or in the place of another. Every operation takes about the same time
whether ten goals wait or a hundred thousand: what looks for one looks at no other.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left, insort
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.record import Record

#: Goals with a time to live that have left before it was over stay in the heap; past this many beside those that still
#: wait, it is made anew.
_HEAP_SLACK = 64


class _Level:
    """The pending goals of one priority: two chains through the records themselves.

    A record names its neighbours, so that it can be taken out of the middle at once. Dictionaries in their order would
    do that too, but take 150 bytes a goal more, and keep a place for what has left: the end of one from which much was
    taken is found the later, the more that was.
    """

    __slots__ = ("first", "last", "newest")

    def __init__(self) -> None:
        #: the chain in which they will be spoken: from a record to the one `behind` it, and to the one `ahead`
        self.first: Record | None = None
        self.last: Record | None = None
        #: the chain in which they were accepted: from a record to the next `older` one, and to the next `newer`
        self.newest: Record | None = None

    def __iter__(self) -> Iterator[Record]:
        record = self.first
        while record:
            yield record
            record = record.behind

    def insert(self, record: Record, ahead: Record | None, behind: Record | None) -> None:
        """Put a record, the newest, between these two neighbours; None where it is to be the first or the last."""
        record.older = self.newest
        if self.newest:
            self.newest.newer = record
        self.newest = record
        record.ahead, record.behind = ahead, behind
        if ahead:
            ahead.behind = record
        else:
            self.first = record
        if behind:
            behind.ahead = record
        else:
            self.last = record

    def remove(self, record: Record) -> None:
        """Take a record out of both chains."""
        if record.ahead:
            record.ahead.behind = record.behind
        else:
            self.first = record.behind
        if record.behind:
            record.behind.ahead = record.ahead
        else:
            self.last = record.ahead
        if record.older:
            record.older.newer = record.newer
        if record.newer:
            record.newer.older = record.older
        else:
            self.newest = record.older
        record.ahead = record.behind = record.older = record.newer = None


class Queue:
    """The queue."""

    def __init__(self) -> None:
        self._levels: dict[int, _Level] = {}
        #: the priorities there are, negated: the highest first
        self._ranks: list[int] = []
        #: those that were sent to preempt, as (rank, number): few, or each of another priority
        self._preempting: list[tuple[int, int, Record]] = []
        self._by_key: dict[str, Record] = {}
        self._count = 0
        self._expiries: list[tuple[float, int, Record]] = []
        self._mortal = 0

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Record]:
        for rank in self._ranks:
            yield from self._levels[-rank]

    def first(self) -> Record | None:
        """Return the goal to be spoken next."""
        return self._levels[-self._ranks[0]].first if self._ranks else None

    def with_key(self, key: str | None) -> Record | None:
        """Return the goal with this key: there is one at most, as the next one replaces it."""
        return None if key is None else self._by_key.get(key)

    def with_text(self, text: str) -> Record | None:
        """Return the first goal with this text. Looks at all of them: only a throttle without a key asks for it."""
        return next((each for each in self if each.text == text), None)

    def up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and lower ones, in their order."""
        lower = self._ranks[bisect_left(self._ranks, -priority) :]
        return [each for rank in lower for each in self._levels[-rank]]

    def preempting_up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and lower ones that were sent to preempt."""
        return [each for *_, each in self._preempting[bisect_left(self._preempting, (-priority,)) :]]

    def newest_of_lowest(self) -> Record | None:
        """Return the goal that gives way first: of the lowest priority, the one accepted last."""
        return self._levels[-self._ranks[-1]].newest if self._ranks else None

    def add(self, record: Record) -> None:
        """Put a goal at the end of its priority, or at the front where it preempts."""
        level = self._levels.get(record.priority)
        if level is None:
            level = self._levels[record.priority] = _Level()
            insort(self._ranks, -record.priority)
        if record.preempt:
            level.insert(record, None, level.first)
        else:
            level.insert(record, level.last, None)
        self._note(record)

    def replace(self, old: Record, new: Record) -> None:
        """Put a goal into the place of one of the same priority, which leaves."""
        self._levels[old.priority].insert(new, old, old.behind)
        self.remove(old)
        self._note(new)

    def remove(self, record: Record) -> None:
        """Take a goal out."""
        level = self._levels[record.priority]
        level.remove(record)
        if level.first is None:
            del self._levels[record.priority]
            del self._ranks[bisect_left(self._ranks, -record.priority)]
        if record.preempt:
            del self._preempting[bisect_left(self._preempting, (-record.priority, record.number))]
        if record.key is not None:
            del self._by_key[record.key]
        self._count -= 1
        self._mortal -= record.expires_at is not None
        record.waits = False

    def next_expiry(self) -> float | None:
        """Return the monotonic time at which the first goal's time to live is over."""
        while self._expiries and not self._expiries[0][2].waits:
            heapq.heappop(self._expiries)
        return self._expiries[0][0] if self._expiries else None

    def expired(self, now: float) -> Iterator[Record]:
        """Return the goals whose time is over, one after the other; each has to be taken out."""
        while (due := self.next_expiry()) is not None and due <= now:
            yield heapq.heappop(self._expiries)[2]

    def _note(self, record: Record) -> None:
        """Note what else is asked about a goal that came in."""
        record.waits = True
        self._count += 1
        if record.preempt:
            insort(self._preempting, (-record.priority, record.number, record))
        if record.key is not None:
            self._by_key[record.key] = record
        if record.expires_at is not None:
            self._mortal += 1
            self._await_expiry(record)

    def _await_expiry(self, record: Record) -> None:
        assert record.expires_at is not None
        if len(self._expiries) > 2 * self._mortal + _HEAP_SLACK:
            self._expiries = [each for each in self._expiries if each[2].waits]
            heapq.heapify(self._expiries)
        heapq.heappush(self._expiries, (record.expires_at, record.number, record))
