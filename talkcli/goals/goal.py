"""A goal and its sender as values, and their form in JSON.

Only the form is here. The scheduler decides whether a goal is accepted. A field may be added, but never renamed or
given another meaning. Unknown fields are ignored. That would be wrong in requests, which are in `options` and
`protocol.requests`.
"""

from __future__ import annotations

from talkcli.errors import Unreadable
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.states import EXIT_CODES, State

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

JsonObject = dict[str, object]

#: some thirty million years, more than any calendar can show
_MAX_TIME_S = 1e15


@frozen
class Sender:
    """The program at the other end of a connection. A field is None if the system doesn't tell."""

    pid: int | None = None
    uid: int | None = None
    command: str | None = None
    #: the command line of the program that started it, which is usually a script
    parent: str | None = None
    #: the name that the sender gives itself, which may be wrong
    name: str | None = None

    def to_json(self) -> JsonObject:
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Sender:
        return cls(**read_fields(cls, value if isinstance(value, dict) else {}))


@frozen
class By:
    """The cause of a goal's end: another goal, or the request of a client. Neither is set if it was the server."""

    goal: str | None = None
    client: Sender | None = None

    def to_json(self) -> JsonObject | None:
        if self.goal is not None:
            return {"goal": self.goal}
        return None if self.client is None else {"client": self.client.to_json()}

    @classmethod
    def from_json(cls, value: object) -> By | None:
        return cls(**read_fields(cls, value)) if isinstance(value, dict) else None


@frozen
class Output:
    """The audio output of a goal, as the sound server reports it."""

    player: str
    #: the sound server's name for the device
    device: str
    #: 0 to 1, where 1 is 100 % of the device
    volume: float
    #: whether it was muted, or its volume 0, at any time while the goal was spoken
    muted: bool

    def to_json(self) -> JsonObject:
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Output | None:
        found = read_fields(cls, value) if isinstance(value, dict) else {}
        return cls(**found) if len(found) == len(cls.__annotations__) else None


@frozen
class Goal:
    """A goal at one moment. In JSON it always has all keys, with null for unknown values.

    Times are seconds since 1970 UTC. `duration` is in seconds of audio.
    """

    id: str
    state: State
    text: str | None = None
    #: why it ended, for programs: a `Reason`, or another string from a newer server
    reason: str | None = None
    by: By | None = None
    #: how it ended, for people
    message: str | None = None
    format: str = "text"
    #: the text up to the last word that was heard
    spoken: str | None = None
    priority: int = 0
    key: str | None = None
    ttl: float | None = None
    data: JsonObject | None = None
    client: Sender | None = None
    paused: bool = False
    queued_at: float | None = None
    started_at: float | None = None
    ended_at: float | None = None
    duration: float | None = None
    #: id of the voice that speaks it, which may differ from the requested voice; None until it is ACTIVE
    voice: str | None = None
    #: None if unknown
    output: Output | None = None

    @property
    def exit_code(self) -> int | None:
        """The exit code of a command with this goal; None until the goal has ended."""
        # The sender has asked for throttling, so this is no failure.
        return 0 if self.reason == "throttled" else EXIT_CODES.get(self.state)

    def to_json(self) -> JsonObject:
        # Written out for speed, because a busy server does little else.
        return {
            "id": self.id,
            "state": self.state.name,
            "status": int(self.state),
            "reason": self.reason,
            "by": None if self.by is None else self.by.to_json(),
            "message": self.message,
            "text": self.text,
            "format": self.format,
            "spoken": self.spoken,
            "priority": self.priority,
            "key": self.key,
            "ttl": self.ttl,
            "data": self.data,
            "client": None if self.client is None else self.client.to_json(),
            "paused": self.paused,
            "queued_at": self.queued_at,
            "started_at": self.started_at,
            "ended_at": self.ended_at,
            "duration": self.duration,
            "voice": self.voice,
            "output": None if self.output is None else self.output.to_json(),
        }

    @classmethod
    def from_json(cls, value: object) -> Goal:
        """Return the goal in a message of a server; raise Unreadable if the message has none."""
        found = read_fields(cls, value if isinstance(value, dict) else {})
        if not str(found.get("id", "\n")).isprintable() or "state" not in found:  # ids are shown unescaped
            raise Unreadable("what the server sent for a goal has no id that can be one, or an unknown state")
        return cls(**found)


def read_fields(cls: type, message: JsonObject) -> dict[str, Any]:
    """Return the values in a JSON object for the fields of a class; leave out those of the wrong type."""
    found = {}
    for name, annotation in cls.__annotations__.items():
        value = message.get(name)
        if value is not None and (read := _READ[annotation.partition(" ")[0]](value)) is not None:
            found[name] = read
    return found


def _of_type(kind: type) -> Callable[[object], object]:
    return lambda value: value if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)) else None


def read_seconds(value: object) -> float | None:
    """Return a time or a length of time from a message; None if it is no number or too large to be shown."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and abs(value) <= _MAX_TIME_S else None  # type: ignore[arg-type]


#: the functions that read a field, by its annotation; they return None for a value of the wrong type
_READ: dict[str, Callable[[object], object]] = {
    "str": _of_type(str),
    "int": _of_type(int),
    "float": read_seconds,
    "bool": _of_type(bool),
    "JsonObject": _of_type(dict),
    "State": lambda value: State.__members__.get(value) if isinstance(value, str) else None,
    "By": By.from_json,
    "Sender": Sender.from_json,
    "Output": Output.from_json,
    "Goal": Goal.from_json,
}
