"""The goals that wait, in the order in which they will be spoken.

Pure, and no rule of admission: it keeps what it is given. Higher priority goes first, first in first out among equals,
but for what is put at the front of its priority or in the place of another. Every operation takes about the same time
whether ten goals wait or a hundred thousand.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left, insort
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.record import Record

#: Goals with a time to live that have left before it was over stay in the heap; past this many beside those that still
#: wait, it is made anew.
_HEAP_SLACK = 64


class _Level:
    """The pending goals of one priority."""

    __slots__ = ("newest", "order", "preempting")

    def __init__(self) -> None:
        #: by place, in the order in which they will be spoken
        self.order: OrderedDict[int, Record] = OrderedDict()
        #: by number, in the order in which they were accepted
        self.newest: dict[int, Record] = {}
        #: those that were sent to preempt
        self.preempting: dict[int, Record] = {}


class Pending:
    """The queue."""

    def __init__(self) -> None:
        self._levels: dict[int, _Level] = {}
        #: the priorities there are, negated: the highest first
        self._ranks: list[int] = []
        self._by_key: dict[str, Record] = {}
        self._count = 0
        self._front = self._back = 0
        self._expiries: list[tuple[float, int, Record]] = []
        self._mortal = 0

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Record]:
        for rank in self._ranks:
            yield from self._levels[-rank].order.values()

    def first(self) -> Record | None:
        """Return the goal to be spoken next."""
        return next(iter(self), None)

    def with_key(self, key: str | None) -> Record | None:
        """Return the goal with this key: there is one at most, as the next one replaces it."""
        return None if key is None else self._by_key.get(key)

    def with_text(self, text: str) -> Record | None:
        """Return the first goal with this text. Looks at all of them: only a throttle without a key asks for it."""
        return next((each for each in self if each.text == text), None)

    def up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and lower ones, in their order."""
        return [each for rank in self._ranks if -rank <= priority for each in self._levels[-rank].order.values()]

    def preempting_up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and lower ones that were sent to preempt."""
        return [each for rank in self._ranks if -rank <= priority for each in self._levels[-rank].preempting.values()]

    def newest_of_lowest(self) -> Record | None:
        """Return the goal that gives way first: of the lowest priority, the one accepted last."""
        if not self._ranks:
            return None
        return next(reversed(self._levels[-self._ranks[-1]].newest.values()))

    def add(self, record: Record) -> None:
        """Put a goal at the end of its priority, or at the front where it preempts."""
        if record.preempt:
            self._front -= 1
            record.place = self._front
        else:
            self._back += 1
            record.place = self._back
        level = self._insert(record)
        if record.preempt:
            level.order.move_to_end(record.place, last=False)

    def replace(self, old: Record, new: Record) -> None:
        """Put a goal into the place of one of the same priority, which leaves."""
        new.place = old.place
        level = self._levels[old.priority]
        self._forget(old, level)
        # Assigned, not deleted and added: so it stays where it is in the order.
        self._insert(new)

    def remove(self, record: Record) -> None:
        """Take a goal out."""
        level = self._levels[record.priority]
        del level.order[record.place]
        self._forget(record, level)
        if not level.order:
            del self._levels[record.priority]
            del self._ranks[bisect_left(self._ranks, -record.priority)]

    def next_expiry(self) -> float | None:
        """Return the monotonic time at which the first goal's time to live is over."""
        while self._expiries and not self._waits(self._expiries[0][2]):
            heapq.heappop(self._expiries)
        return self._expiries[0][0] if self._expiries else None

    def expired(self, now: float) -> Iterator[Record]:
        """Return the goals whose time is over, one after the other; each has to be taken out."""
        while (due := self.next_expiry()) is not None and due <= now:
            yield heapq.heappop(self._expiries)[2]

    def _insert(self, record: Record) -> _Level:
        level = self._levels.get(record.priority)
        if level is None:
            level = self._levels[record.priority] = _Level()
            insort(self._ranks, -record.priority)
        level.order[record.place] = record
        level.newest[record.number] = record
        if record.preempt:
            level.preempting[record.number] = record
        if record.key is not None:
            self._by_key[record.key] = record
        self._count += 1
        if record.expires_at is not None:
            self._mortal += 1
            self._await_expiry(record)
        return level

    def _forget(self, record: Record, level: _Level) -> None:
        del level.newest[record.number]
        level.preempting.pop(record.number, None)
        if record.key is not None:
            del self._by_key[record.key]
        self._count -= 1
        self._mortal -= record.expires_at is not None

    def _await_expiry(self, record: Record) -> None:
        assert record.expires_at is not None
        if len(self._expiries) > 2 * self._mortal + _HEAP_SLACK:
            self._expiries = [each for each in self._expiries if self._waits(each[2])]
            heapq.heapify(self._expiries)
        heapq.heappush(self._expiries, (record.expires_at, record.number, record))

    def _waits(self, record: Record) -> bool:
        level = self._levels.get(record.priority)
        return level is not None and record.number in level.newest
