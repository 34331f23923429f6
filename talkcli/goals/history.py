"""What the scheduler remembers: goals that have ended, what was said when, cancels that came before their goal.

Pure: it keeps what it is given and drops the oldest by fixed limits; the time comes in as an argument (monotonic
seconds). Goals are kept so that `talk wait ID` works after the fact and from another process, what was said so as not
to say it again.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.goal import By
    from talkcli.goals.record import Record

_Name = TypeVar("_Name")
_Fact = TypeVar("_Fact")

#: Results kept of goals that were spoken: a robot that speaks ten times a minute has 100 minutes to ask.
MAX_SPOKEN = 1_000
#: REJECTED goals have a ring of their own: a client that is refused all the time drives out no result.
MAX_REJECTED = 200
#: RECALLED goals have one, too, so that a flood that is recalled drives out no result of a goal that was spoken. One
#: cancel may recall the 1,000 goals that a connection may have waiting for room: each can still be asked for.
MAX_RECALLED = 1_000
#: Bytes of all the texts kept together: the limits above times the longest text would be 40 MB.
MAX_TEXT_BYTES = 8 * 1024 * 1024
#: Keys whose last beginning is remembered, and as many texts.
MAX_SAID = 10_000
#: Seconds for which the cancel of an id that no goal has yet is remembered: the goal and its cancel are sent by two
#: programs, which start one after the other.
EARLY_CANCEL = 60.0
#: Such ids.
MAX_EARLY_CANCELS = 1_000


class History:
    """The last goals that ended, oldest first."""

    def __init__(self) -> None:
        self._all: OrderedDict[str, Record] = OrderedDict()
        #: the goals of `_all` by how they ended: REJECTED, RECALLED, or after they had begun
        self._rejected: OrderedDict[str, Record] = OrderedDict()
        self._recalled: OrderedDict[str, Record] = OrderedDict()
        self._spoken: OrderedDict[str, Record] = OrderedDict()
        self._text_bytes = 0

    def add(self, record: Record) -> None:
        """Keep a goal that has ended; the oldest give way."""
        kept, limit = self._spoken, MAX_SPOKEN
        if record.state is State.REJECTED:
            kept, limit = self._rejected, MAX_REJECTED
        elif record.state is State.RECALLED:
            kept, limit = self._recalled, MAX_RECALLED
        self._all[record.id] = kept[record.id] = record
        self._text_bytes += record.text_bytes
        if len(kept) > limit:
            oldest = kept.popitem(last=False)[1]
            del self._all[oldest.id]
            self._text_bytes -= oldest.text_bytes
        while self._text_bytes > MAX_TEXT_BYTES:
            oldest = next(each for each in self._all.values() if each.text is not None)
            self._text_bytes -= oldest.text_bytes
            oldest.drop_text()

    def find(self, goal_id: str) -> Record | None:
        return self._all.get(goal_id)

    def latest(self, count: int) -> Iterator[Record]:
        """Return the last goals that ended, REJECTED ones aside, the newest first."""
        return islice((each for each in reversed(self._all.values()) if each.state is not State.REJECTED), count)

    def log(self, count: int) -> Iterator[Record]:
        """Return the last goals that ended, REJECTED ones too, the newest first."""
        return islice(reversed(self._all.values()), count)


class Said:
    """When a goal of a key, or of a text, last began to be spoken."""

    def __init__(self) -> None:
        self._by_key: OrderedDict[str, tuple[float, str]] = OrderedDict()
        self._by_text: OrderedDict[bytes, tuple[float, str]] = OrderedDict()

    def note(self, record: Record) -> None:
        """Remember a goal of which something was heard."""
        began = (record.began, record.id)
        if record.key is not None:
            _keep(self._by_key, record.key, began, MAX_SAID)
        _keep(self._by_text, _digest(record.text or ""), began, MAX_SAID)

    def within(self, seconds: float, key: str | None, text: str, now: float) -> str | None:
        """Return the id of the last goal of this key, or without one of this text, if it began since."""
        last = self._by_text.get(_digest(text)) if key is None else self._by_key.get(key)
        return last[1] if last is not None and now - last[0] < seconds else None


class EarlyCancels:
    """Ids of which a cancel came before the goal did, and by whom."""

    def __init__(self) -> None:
        self._until: OrderedDict[str | None, tuple[float, By]] = OrderedDict()

    def note(self, goal_id: str, by: By, now: float) -> None:
        """Remember the cancel of an id."""
        _keep(self._until, goal_id, (now + EARLY_CANCEL, by), MAX_EARLY_CANCELS)

    def find(self, goal_id: str | None, now: float) -> By | None:
        """Return who cancelled this id."""
        until, by = self._until.get(goal_id, (now, None))
        return by if now < until else None


def _keep(names: OrderedDict[_Name, _Fact], name: _Name, fact: _Fact, most: int) -> None:
    """Remember something of a name as the latest; the oldest gives way."""
    names[name] = fact
    names.move_to_end(name)
    if len(names) > most:
        names.popitem(last=False)


def _digest(text: str) -> bytes:
    """Return what stands for a text: ten thousand of the longest would be 400 MB."""
    return hashlib.blake2b(text.encode(errors="surrogatepass"), digest_size=16).digest()
