"""The scheduler's records of ended goals, past speech and early cancel requests.

Each store has a maximum size and drops its oldest entries. Methods receive the time as an argument, in monotonic
seconds. Ended goals are kept so that another process can still ask for the result, for example with `talk wait ID`. An
early cancel is one that arrives before its goal.
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

#: Number of spoken goals to keep. A robot that speaks ten times a minute speaks this many goals in 100 minutes.
MAX_SPOKEN_GOALS = 1_000
#: Number of rejected goals to keep. Without a separate limit, one client's rejected goals could displace the results of
#: other clients.
MAX_REJECTED_GOALS = 200
#: Number of recalled goals to keep. One cancel can recall 1,000 waiting goals of a connection, and each result must
#: stay available.
MAX_RECALLED_GOALS = 1_000
#: Maximum total size of the texts of ended goals. Without a limit, they could use 40 MB of memory.
MAX_KEPT_TEXT_BYTES = 8 * 1024 * 1024
#: Maximum number of keys and texts whose last start time is kept.
MAX_SPEECH_TIMES = 20_000
#: How long to remember a cancel request for an unknown id. Another program may send the goal a moment later.
EARLY_CANCEL_S = 60.0
#: Maximum number of cancel requests for unknown ids to remember.
MAX_EARLY_CANCELS = 1_000


class RecentGoals:
    """The records of recently ended goals, oldest first.

    The number of goals and the size of their texts are limited.
    """

    def __init__(self) -> None:
        self._all: dict[str, Record] = {}
        #: goal ids by state, oldest first. All spoken goals are listed under SUCCEEDED.
        self._ids: defaultdict[State, deque[str]] = defaultdict(deque)
        self._text_bytes = 0

    def add(self, record: Record) -> None:
        """Add an ended goal. If there are too many goals or texts, drop the oldest."""
        limits = {State.REJECTED: MAX_REJECTED_GOALS, State.RECALLED: MAX_RECALLED_GOALS}
        ids = self._ids[record.state if record.state in limits else State.SUCCEEDED]
        ids.append(record.id)
        self._all[record.id] = record
        self._text_bytes += record.text_bytes
        if len(ids) > limits.get(record.state, MAX_SPOKEN_GOALS):
            self._text_bytes -= self._all.pop(ids.popleft()).text_bytes
        while self._text_bytes > MAX_KEPT_TEXT_BYTES:
            oldest = next(each for each in self._all.values() if each.text_hash is None)
            self._text_bytes -= oldest.text_bytes
            oldest.drop_text()

    def find(self, goal_id: str) -> Record | None:
        """Return the ended goal with this id, or None if it is unknown."""
        return self._all.get(goal_id)

    def latest(self, count: int, *, include_rejected: bool) -> list[Record]:
        """Return the most recently ended goals, oldest first.

        Args:
            count: the maximum number of goals.
            include_rejected: whether to include rejected goals.
        """
        newest = (each for each in reversed(self._all.values()) if include_rejected or each.state is not State.REJECTED)
        return list(islice(newest, count))[::-1]


class SpeechTimes:
    """The start times of the last goals that were spoken, by key and by text."""

    def __init__(self) -> None:
        #: start time and id of the last goal, by its key and by the hash of its text
        self._starts: OrderedDict[str | bytes, tuple[float, str]] = OrderedDict()

    def add(self, record: Record) -> None:
        """Record the start time of a goal under its key and its text.

        The goal must have been heard, at least in part.
        """
        for each in (record.say.key, _digest(record.say.content)):
            if each is not None:
                _set_newest(self._starts, each, (record.began_at, record.id), MAX_SPEECH_TIMES)

    def last_goal_id(self, since: float, key: str | None, content: str) -> str | None:
        """Return the id of the last goal after `since` with this key. If `key` is None, compare the content.

        Return None if no such goal has started. Times are monotonic.
        """
        last = self._starts.get(_digest(content) if key is None else key)
        return last[1] if last is not None and last[0] > since else None


class EarlyCancels:
    """Cancel requests that arrived before their goals."""

    def __init__(self) -> None:
        #: expiry time and sender of each cancel request, by goal id
        self._cancels: OrderedDict[str | None, tuple[float, By]] = OrderedDict()

    def add(self, goal_id: str, by: By, now: float) -> None:
        """Remember a request to cancel a goal that hasn't arrived yet."""
        _set_newest(self._cancels, goal_id, (now + EARLY_CANCEL_S, by), MAX_EARLY_CANCELS)

    def find(self, goal_id: str | None, now: float) -> By | None:
        """Return the client that recently cancelled the goal with this id, if any."""
        lapses_at, by = self._cancels.get(goal_id, (now, None))
        return by if now < lapses_at else None


def _set_newest(entries: OrderedDict[_Key, _Value], key: _Key, value: _Value, limit: int) -> None:
    """Store an entry as the newest one. If there are too many entries, drop the oldest."""
    entries[key] = value
    entries.move_to_end(key)
    if len(entries) > limit:
        entries.popitem(last=False)


def _digest(text: str) -> bytes:
    """Return a hash of a text.

    Keeping ten thousand texts instead could use 400 MB of memory.
    """
    return hashlib.blake2b(text.encode(errors="surrogatepass"), digest_size=16).digest()
