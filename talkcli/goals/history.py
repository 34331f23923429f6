"""Goals that have ended, kept so that `talk wait ID` works after the fact and from another process.

Pure: it keeps what it is given and drops the oldest by fixed limits.
"""

from __future__ import annotations

from collections import OrderedDict
from heapq import merge
from itertools import islice
from typing import TYPE_CHECKING

from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.record import Record

#: Results kept: a robot that speaks ten times a minute has more than an hour and a half to ask.
MAX_ENDED = 1_000
#: REJECTED goals have a ring of their own, so that a client that is refused all the time drives out nobody's result.
MAX_REJECTED = 200
#: Bytes of all the texts kept together: the limits above times the longest text would be 40 MB.
MAX_TEXT_BYTES = 8 * 1024 * 1024


class History:
    """The last goals that ended, oldest first."""

    def __init__(self) -> None:
        self._ended: OrderedDict[str, Record] = OrderedDict()
        self._rejected: OrderedDict[str, Record] = OrderedDict()
        self._with_text: OrderedDict[str, Record] = OrderedDict()
        self._text_bytes = 0
        #: how many ended before each, so that both rings can be told in one order
        self._order: dict[str, int] = {}
        self._count = 0

    def add(self, record: Record) -> None:
        """Keep a goal that has ended; the oldest give way."""
        kept, limit = (self._rejected, MAX_REJECTED) if record.state is State.REJECTED else (self._ended, MAX_ENDED)
        kept[record.id] = record
        self._with_text[record.id] = record
        self._text_bytes += record.text_bytes
        self._count += 1
        self._order[record.id] = self._count
        if len(kept) > limit:
            oldest = kept.popitem(last=False)[1]
            del self._order[oldest.id]
            self._forget_text(oldest)
        while self._text_bytes > MAX_TEXT_BYTES:
            oldest = next(iter(self._with_text.values()))
            self._forget_text(oldest)
            oldest.drop_text()

    def find(self, goal_id: str) -> Record | None:
        return self._ended.get(goal_id) or self._rejected.get(goal_id)

    def latest(self, count: int) -> Iterator[Record]:
        """Return the last goals that ended, REJECTED ones aside, the newest first."""
        return islice(reversed(self._ended.values()), count)

    def log(self, count: int) -> Iterator[Record]:
        """Return the last goals that ended, REJECTED ones too, the newest first."""
        both = (reversed(self._ended.values()), reversed(self._rejected.values()))
        return islice(merge(*both, key=lambda each: self._order[each.id], reverse=True), count)

    def _forget_text(self, record: Record) -> None:
        if self._with_text.pop(record.id, None) is not None:
            self._text_bytes -= record.text_bytes
