"""What a client hears, as frozen values, and their form in JSON: events, results, and the snapshot of a watch.

Rules for this file: form only, no I/O. `to_json` gives what the commands print, which is what the wire has; a server
writes its events by hand, in `server.subscribers`, as it sends thousands of them. A field may be added, never renamed
or given another meaning; a reader ignores what it doesn't know.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.goal import By, Goal, known
from talkcli.protocol.replies import ServerStatus

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.states import State


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
        message = {**_counted("state", self), "state": self.state.name}
        del message["goal"]
        return message if self.goal is None else {**message, "goal": self.goal.to_json()}


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
        return _counted("word", self)


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
        return {**_counted("paused", self), "by": None if self.by is None else self.by.to_json()}


@frozen
class Result:
    """A goal has ended; this is how."""

    goal: Goal

    def to_json(self) -> JsonObject:
        return {"event": "result", "goal": self.goal.to_json()}


@frozen
class Snapshot:
    """How everything is as watching begins."""

    status: ServerStatus

    def to_json(self) -> JsonObject:
        return {"event": "snapshot", **self.status.to_json()}


Event = StateChanged | WordHeard | PausedChanged | Result | Snapshot

_KINDS: dict[str, type[StateChanged | WordHeard | PausedChanged | Result]] = {
    "state": StateChanged,
    "word": WordHeard,
    "paused": PausedChanged,
    "result": Result,
}


def from_json(message: JsonObject) -> Event | None:
    """Return the event in a message; None for a kind that is not known here; ValueError where its fields are wrong."""
    kind = str(message.get("event"))
    if kind == "snapshot":
        return Snapshot(ServerStatus.from_json(message))
    event = _KINDS.get(kind)
    if event is None:
        return None
    found = known(event, message)
    for name, annotation in event.__annotations__.items():
        value = message.get(name)
        if name not in found and (value is not None or not annotation.endswith(" | None")):
            raise ValueError(f"the {name!r} of a {kind!a} event is {value!a}")
    return event(**found)


def _counted(kind: str, event: StateChanged | WordHeard | PausedChanged) -> JsonObject:
    """Return an event as an object: the kind first, the server's count and the time last."""
    own = fields(event)
    at, n = own.pop("at"), own.pop("n")
    return {"event": kind, **own, "n": n, "at": at}
