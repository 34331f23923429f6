"""The scheduler's memory: goals that have ended, what was spoken when, and cancels that arrived before their goal.

Pure: it drops the oldest entries at fixed limits, and takes the time as an argument (monotonic seconds). Ended goals
are kept so that another process can still ask for the result, as `talk wait ID` does.
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

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")

#: Goals that are kept after they were spoken. A robot that speaks ten times a minute has 100 minutes to ask for them.
MAX_SPOKEN_GOALS = 1_000
#: REJECTED goals have a limit of their own, so that a client that is always refused displaces no results.
MAX_REJECTED_GOALS = 200
#: RECALLED goals have a limit of their own, too. One cancel may recall the 1,000 goals of a connection that wait for
#: room, and each can still be asked for.
MAX_RECALLED_GOALS = 1_000
#: All texts of ended goals together. Without this limit they could take 40 MB.
MAX_KEPT_TEXT_BYTES = 8 * 1024 * 1024
#: Keys whose last start is remembered, and as many texts.
MAX_SPEECH_TIMES = 10_000
#: How long a cancel is remembered if no goal has the id yet. Two programs that start one after the other may send the
#: goal and its cancel.
EARLY_CANCEL_S = 60.0
#: Cancels that are remembered.
MAX_EARLY_CANCELS = 1_000


class History:
    """The goals that have ended, oldest first."""

    def __init__(self) -> None:
        self._all: OrderedDict[str, Record] = OrderedDict()
        #: the same goals by how they ended: REJECTED, RECALLED, or after they had begun
        self._rejected: OrderedDict[str, Record] = OrderedDict()
        self._recalled: OrderedDict[str, Record] = OrderedDict()
        self._spoken: OrderedDict[str, Record] = OrderedDict()
        self._text_bytes = 0

    def add(self, record: Record) -> None:
        """Keep a goal that has ended, and drop the oldest ones past the limits."""
        kept, limit = self._spoken, MAX_SPOKEN_GOALS
        if record.state is State.REJECTED:
            kept, limit = self._rejected, MAX_REJECTED_GOALS
        elif record.state is State.RECALLED:
            kept, limit = self._recalled, MAX_RECALLED_GOALS
        self._all[record.id] = kept[record.id] = record
        self._text_bytes += record.text_bytes
        if len(kept) > limit:
            oldest = kept.popitem(last=False)[1]
            del self._all[oldest.id]
            self._text_bytes -= oldest.text_bytes
        while self._text_bytes > MAX_KEPT_TEXT_BYTES:
            oldest = next(each for each in self._all.values() if each.text is not None)
            self._text_bytes -= oldest.text_bytes
            oldest.drop_text()

    def find(self, goal_id: str) -> Record | None:
        """Return the goal with this id."""
        return self._all.get(goal_id)

    def latest(self, count: int) -> Iterator[Record]:
        """Return the last goals that ended, newest first, without REJECTED ones."""
        return islice((each for each in reversed(self._all.values()) if each.state is not State.REJECTED), count)

    def log(self, count: int) -> Iterator[Record]:
        """Return the last goals that ended, newest first, with REJECTED ones."""
        return islice(reversed(self._all.values()), count)


class SpeechTimes:
    """When a goal with a key, or with a text, was last spoken."""

    def __init__(self) -> None:
        self._by_key: OrderedDict[str, tuple[float, str]] = OrderedDict()
        self._by_text: OrderedDict[bytes, tuple[float, str]] = OrderedDict()

    def note(self, record: Record) -> None:
        """Note a goal of which something was heard."""
        began = (record.began_at, record.id)
        if record.key is not None:
            _keep(self._by_key, record.key, began, MAX_SPEECH_TIMES)
        _keep(self._by_text, _digest(record.text or ""), began, MAX_SPEECH_TIMES)

    def find(self, since: float, key: str | None, text: str) -> str | None:
        """Return the id of the last goal that began after `since` with this key, or, without a key, with this text."""
        last = self._by_text.get(_digest(text)) if key is None else self._by_key.get(key)
        return last[1] if last is not None and last[0] > since else None


class EarlyCancels:
    """Cancels of ids that no goal had yet."""

    def __init__(self) -> None:
        #: by id: until when the cancel holds, and who sent it
        self._until: OrderedDict[str | None, tuple[float, By]] = OrderedDict()

    def note(self, goal_id: str, by: By, now: float) -> None:
        """Note that an id was cancelled."""
        _keep(self._until, goal_id, (now + EARLY_CANCEL_S, by), MAX_EARLY_CANCELS)

    def find(self, goal_id: str | None, now: float) -> By | None:
        """Return who has cancelled this id; None if nobody has."""
        until, by = self._until.get(goal_id, (now, None))
        return by if now < until else None


def _keep(entries: OrderedDict[_Key, _Value], key: _Key, value: _Value, limit: int) -> None:
    """Set the newest entry, and drop the oldest one past the limit."""
    entries[key] = value
    entries.move_to_end(key)
    if len(entries) > limit:
        entries.popitem(last=False)


def _digest(text: str) -> bytes:
    """Return a hash of a text, because ten thousand texts could take 400 MB."""
    return hashlib.blake2b(text.encode(errors="surrogatepass"), digest_size=16).digest()
