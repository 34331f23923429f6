"""What the scheduler remembers: ended goals, times of speech, and cancels that arrived before their goal.

Pure: each store drops its oldest entries at a fixed limit. Times are arguments, in monotonic seconds. Ended goals are
kept so that another process can ask for the result later, as `talk wait ID` does.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict, defaultdict, deque
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from talkcli.goals.states import State

if TYPE_CHECKING:
    from talkcli.goals.goal import By
    from talkcli.goals.record import Record

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")

#: Spoken goals that are kept. They cover the last 100 minutes of a robot that speaks ten times a minute.
MAX_SPOKEN_GOALS = 1_000
#: REJECTED goals that are kept. They have their own limit, so that one client's rejected goals can't displace the
#: results of other clients.
MAX_REJECTED_GOALS = 200
#: RECALLED goals that are kept. One cancel can recall the 1,000 goals of a connection that wait for room, and the
#: result of each one must stay available.
MAX_RECALLED_GOALS = 1_000
#: Total size of the texts of ended goals. Without this limit, they could take 40 MB.
MAX_KEPT_TEXT_BYTES = 8 * 1024 * 1024
#: Keys whose last start is remembered. The limit for texts is the same.
MAX_SPEECH_TIMES = 10_000
#: How long the cancel of an unknown id is remembered. If two programs started one after the other send a goal and its
#: cancel, the cancel may arrive first.
EARLY_CANCEL_S = 60.0
#: Cancels of unknown ids that are remembered.
MAX_EARLY_CANCELS = 1_000


class History:
    """The goals that have ended, oldest first."""

    def __init__(self) -> None:
        self._all: dict[str, Record] = {}
        #: the ids of the goals that share a limit, oldest first; all spoken goals are under SUCCEEDED
        self._ids: defaultdict[State, deque[str]] = defaultdict(deque)
        self._text_bytes = 0

    def add(self, record: Record) -> None:
        """Keep a goal that has ended, and drop the oldest goals and texts above the limits."""
        limits = {State.REJECTED: MAX_REJECTED_GOALS, State.RECALLED: MAX_RECALLED_GOALS}
        ids = self._ids[record.state if record.state in limits else State.SUCCEEDED]
        ids.append(record.id)
        self._all[record.id] = record
        self._text_bytes += record.text_bytes
        if len(ids) > limits.get(record.state, MAX_SPOKEN_GOALS):
            self._text_bytes -= self._all.pop(ids.popleft()).text_bytes
        while self._text_bytes > MAX_KEPT_TEXT_BYTES:
            oldest = next(each for each in self._all.values() if each.text is not None)
            self._text_bytes -= oldest.text_bytes
            oldest.drop_text()

    def find(self, goal_id: str) -> Record | None:
        """Return the goal with this id."""
        return self._all.get(goal_id)

    def latest(self, count: int, *, rejected: bool) -> list[Record]:
        """Return the goals that ended last, oldest first. `rejected` includes REJECTED goals."""
        newest = (each for each in reversed(self._all.values()) if rejected or each.state is not State.REJECTED)
        return list(islice(newest, count))[::-1]


class SpeechTimes:
    """The last time that a goal with each key and each text was spoken."""

    def __init__(self) -> None:
        #: start time and id of the last goal with each key
        self._by_key: OrderedDict[str, tuple[float, str]] = OrderedDict()
        #: start time and id of the last goal with each text, by a hash of the text
        self._by_text: OrderedDict[bytes, tuple[float, str]] = OrderedDict()

    def add(self, record: Record) -> None:
        """Remember the start of a goal that was at least partly heard."""
        start = (record.began_at, record.id)
        if record.key is not None:
            _set_newest(self._by_key, record.key, start, MAX_SPEECH_TIMES)
        _set_newest(self._by_text, _digest(record.text or ""), start, MAX_SPEECH_TIMES)

    def find(self, since: float, key: str | None, text: str) -> str | None:
        """Return the id of the last goal with this key that started after `since`. Without a key, compare the text."""
        last = self._by_text.get(_digest(text)) if key is None else self._by_key.get(key)
        return last[1] if last is not None and last[0] > since else None


class EarlyCancels:
    """Cancels of ids that no goal had yet."""

    def __init__(self) -> None:
        #: by goal id: the time at which the cancel lapses, and the client that sent it
        self._cancels: OrderedDict[str | None, tuple[float, By]] = OrderedDict()

    def add(self, goal_id: str, by: By, now: float) -> None:
        """Remember that this id was cancelled."""
        _set_newest(self._cancels, goal_id, (now + EARLY_CANCEL_S, by), MAX_EARLY_CANCELS)

    def find(self, goal_id: str | None, now: float) -> By | None:
        """Return the client that cancelled this id, or None if the id was not cancelled."""
        lapses_at, by = self._cancels.get(goal_id, (now, None))
        return by if now < lapses_at else None


def _set_newest(entries: OrderedDict[_Key, _Value], key: _Key, value: _Value, limit: int) -> None:
    """Set an entry as the newest one, and drop the oldest one above the limit."""
    entries[key] = value
    entries.move_to_end(key)
    if len(entries) > limit:
        entries.popitem(last=False)


def _digest(text: str) -> bytes:
    """Return a hash of a text. Ten thousand texts themselves could take 400 MB."""
    return hashlib.blake2b(text.encode(errors="surrogatepass"), digest_size=16).digest()
