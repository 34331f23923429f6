"""What a client hears, as frozen values, and their form in JSON: events, results, and the snapshot of a watch.

Rules for this file: form only, no I/O. `to_json` gives what the commands print, which is what the wire has; a server
writes its events by hand, in `server.subscribers`, as it sends thousands of them. A field may be added, never renamed
or given another meaning; a reader ignores what it doesn't know.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import By, Goal
from talkcli.goals.states import State
from talkcli.protocol.replies import ServerStatus

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeVar

    from talkcli.goals.goal import JsonObject

    _T = TypeVar("_T")


@frozen
class StateChanged:
    """A goal is in another state now."""

    id: str
    state: State
    #: when, in seconds since 1970 UTC
    at: float | None = None
    #: the server's count of events: a gap in it shows feedback that was dropped, or was for others
    n: int | None = None
    #: the whole goal, where the server tells all goals: with the first state and the last
    goal: Goal | None = None

    def to_json(self) -> JsonObject:
        message: JsonObject = {"event": "state", "id": self.id, "state": self.state.name, "n": self.n, "at": self.at}
        return message if self.goal is None else {**message, "goal": self.goal.to_json()}

    @classmethod
    def from_json(cls, message: JsonObject) -> StateChanged:
        """Return the event in a message; ValueError where it is none."""
        name, goal = _field(message, "state", str), message.get("goal")
        if name not in State.__members__:
            raise ValueError(f"no goal can be {name!a}")
        return cls(
            _field(message, "id", str),
            State[name],
            _maybe(message, "at", float),
            _maybe(message, "n", int),
            None if goal is None else Goal.from_json(goal),
        )


@frozen
class WordHeard:
    """A word of a goal is being heard: it begins now."""

    id: str
    word: str
    #: where it stands in the goal's text: `text[start:end]`, in characters
    start: int
    end: int
    #: 1 for the first word that was heard
    number: int
    #: seconds into the sentence
    time: float
    #: when, in seconds since 1970 UTC
    at: float | None = None
    #: the server's count of events
    n: int | None = None

    def to_json(self) -> JsonObject:
        return {
            "event": "word",
            "id": self.id,
            "word": self.word,
            "start": self.start,
            "end": self.end,
            "number": self.number,
            "time": self.time,
            "n": self.n,
            "at": self.at,
        }

    @classmethod
    def from_json(cls, message: JsonObject) -> WordHeard:
        """Return the event in a message; ValueError where it is none."""
        return cls(
            _field(message, "id", str),
            _field(message, "word", str),
            _field(message, "start", int),
            _field(message, "end", int),
            _field(message, "number", int),
            _field(message, "time", float),
            _maybe(message, "at", float),
            _maybe(message, "n", int),
        )


@frozen
class PausedChanged:
    """Speech is held, or goes on."""

    paused: bool
    #: the goal that is held, or goes on; None where none was being spoken
    id: str | None = None
    #: who asked for it
    by: By | None = None
    #: when, in seconds since 1970 UTC
    at: float | None = None
    #: the server's count of events
    n: int | None = None

    def to_json(self) -> JsonObject:
        by = None if self.by is None else self.by.to_json()
        return {"event": "paused", "paused": self.paused, "id": self.id, "by": by, "n": self.n, "at": self.at}

    @classmethod
    def from_json(cls, message: JsonObject) -> PausedChanged:
        """Return the event in a message; ValueError where it is none."""
        return cls(
            _field(message, "paused", bool),
            _maybe(message, "id", str),
            By.from_json(message.get("by")),
            _maybe(message, "at", float),
            _maybe(message, "n", int),
        )


@frozen
class Result:
    """A goal has ended; this is how."""

    goal: Goal

    def to_json(self) -> JsonObject:
        return {"event": "result", "goal": self.goal.to_json()}

    @classmethod
    def from_json(cls, message: JsonObject) -> Result:
        """Return the event in a message; ValueError where it is none."""
        return cls(Goal.from_json(message.get("goal")))


@frozen
class Snapshot:
    """How everything is as watching begins."""

    status: ServerStatus

    def to_json(self) -> JsonObject:
        return {"event": "snapshot", **self.status.to_json()}

    @classmethod
    def from_json(cls, message: JsonObject) -> Snapshot:
        """Return the snapshot in a message; ValueError where one of its goals is none."""
        return cls(ServerStatus.from_json(message))


Event = StateChanged | WordHeard | PausedChanged | Result | Snapshot

_READERS: dict[str, Callable[[JsonObject], Event]] = {
    "state": StateChanged.from_json,
    "word": WordHeard.from_json,
    "paused": PausedChanged.from_json,
    "result": Result.from_json,
    "snapshot": Snapshot.from_json,
}


def from_json(message: JsonObject) -> Event | None:
    """Return the event in a message; None for a kind that is not known here; ValueError where its fields are wrong."""
    read = _READERS.get(str(message.get("event")))
    return None if read is None else read(message)


def _maybe(message: JsonObject, name: str, kind: type[_T]) -> _T | None:
    """Return a field; None where it is null, or not there."""
    return None if message.get(name) is None else _field(message, name, kind)


def _field(message: JsonObject, name: str, kind: type[_T]) -> _T:
    value = message.get(name)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)  # a JSON number without a fraction
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"the {name!r} of a {message.get('event')!a} event is {value!a}")
    return value
