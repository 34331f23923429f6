"""The goals that wait, in the order in which they will be spoken: one sorted list.

Pure: it keeps what it is given, and knows which goal would be displaced; whether one is, the scheduler decides. Higher
priority goes first, first in first out among equals, but for what is put at the front of its priority or in the place
of another.

Ten thousand wait at most (`--max-queue`): a place among them is found in fourteen comparisons, and what stands behind
it moves up in a microsecond. What is asked at each goal looks at no other; what looks at all of them says so: thousands
of goals that wait for room ask, too, each time that something leaves.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from math import inf
from operator import itemgetter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.record import Record

    #: a goal in a list: by what it is sorted, and itself, which is never compared: no two have the same place
    _Entry = tuple[float, int, Record]

_goal = itemgetter(2)


class Queue:
    """The queue. A record's `turn` is the queue's alone: its place among those of its priority, the lowest first."""

    def __init__(self) -> None:
        #: in their order: priority, negated, and turn; no two are equal
        self._goals: list[_Entry] = []
        #: those that were sent to preempt, in the same order
        self._preempting: list[_Entry] = []
        #: in the order in which a full queue displaces them, the last first: priority, negated, and number
        self._displaceable: list[_Entry] = []
        #: those with a time to live: its end, and their number
        self._expiries: list[_Entry] = []
        self._by_key: dict[str, Record] = {}

    def __len__(self) -> int:
        return len(self._goals)

    def __iter__(self) -> Iterator[Record]:
        return map(_goal, self._goals)

    def first(self) -> Record | None:
        """Return the goal to be spoken next."""
        return self._goals[0][2] if self._goals else None

    def with_key(self, key: str | None) -> Record | None:
        """Return the goal with this key: there is one at most, as the next one replaces it."""
        return None if key is None else self._by_key.get(key)

    def with_text(self, text: str) -> Record | None:
        """Return the first goal with this text. Looks at all of them: only a throttle without a key asks for it."""
        return next((each for each in self if each.text == text), None)

    def up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and lower ones, in their order."""
        return list(map(_goal, self._goals[bisect_left(self._goals, (-priority,)) :]))

    def preempting_up_to(self, priority: int) -> list[Record]:
        """Return the goals of this priority and lower ones that were sent to preempt."""
        return list(map(_goal, self._preempting[bisect_left(self._preempting, (-priority,)) :]))

    def newest_of_lowest(self) -> Record | None:
        """Return the goal that a full queue displaces: of the lowest priority, the goal accepted last."""
        return self._displaceable[-1][2] if self._displaceable else None

    def add(self, record: Record, instead: Record | None = None) -> None:
        """Put a goal at the end of its priority, or at the front where it preempts.

        `instead`: into the place of this one, of the same priority, which has left.
        """
        usual = -record.number if record.preempt else record.number
        record.turn = instead.turn if instead else usual
        for goals, entry in self._entries(record):
            insort(goals, entry)
        if record.key is not None:
            self._by_key[record.key] = record

    def remove(self, record: Record) -> None:
        """Take a goal out."""
        for goals, entry in self._entries(record):
            del goals[bisect_left(goals, entry)]
        if record.key is not None:
            del self._by_key[record.key]

    def next_expiry(self) -> float | None:
        """Return the monotonic time at which the first goal's time to live is over."""
        return self._expiries[0][0] if self._expiries else None

    def expired(self, now: float) -> list[Record]:
        """Return the goals whose time is over, the first to be so first."""
        return list(map(_goal, self._expiries[: bisect_left(self._expiries, (now, inf))]))

    def _entries(self, record: Record) -> Iterator[tuple[list[_Entry], _Entry]]:
        """Return the lists that a goal is in, and what it is in each; the same where it stands by its number."""
        entry = -record.priority, record.turn, record
        yield self._goals, entry
        yield self._displaceable, entry if record.turn == record.number else (-record.priority, record.number, record)
        if record.preempt:
            yield self._preempting, entry
        if record.expires_at is not None:
            yield self._expiries, (record.expires_at, record.number, record)
