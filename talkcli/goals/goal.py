"""Immutable snapshots of goals and their senders, and their JSON form.

This module only defines the format. The scheduler decides whether a goal is accepted. Fields may be added, but a field
never changes its name or meaning. Unknown fields are ignored. Requests, in contrast, are refused if they have unknown
fields. They are in `options` and `protocol.requests`.
"""

from __future__ import annotations

from talkcli.errors import Unreadable
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.states import EXIT_CODES, State

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

JsonObject = dict[str, object]

#: The largest time that is accepted: about thirty million years, more than any calendar can show.
_MAX_TIME_S = 1e15


@frozen
class Sender:
    """The program at the other end of a connection. A field is None if it is unknown."""

    pid: int | None = None
    uid: int | None = None
    command: str | None = None
    #: the command line of the parent process, which is usually a script
    parent: str | None = None
    #: the name that the sender gave itself in `hello`, which nobody verifies
    name: str | None = None

    def to_json(self) -> JsonObject:
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Sender:
        return cls(**read_fields(cls, value))


@frozen
class By:
    """The cause of a goal's end: another goal, or a client's request. Both are None if the server ended the goal."""

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
    """The audio output of a goal, as reported by the sound server."""

    player: str
    #: the sound server's name for the device
    device: str
    #: volume of the device, where 1 is 100 %
    volume: float
    #: whether the output was muted or at volume 0 at any time while the goal was spoken
    muted: bool

    def to_json(self) -> JsonObject:
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Output | None:
        found = read_fields(cls, value)
        return cls(**found) if len(found) == len(cls.__annotations__) else None


@frozen
class Goal:
    """A snapshot of a goal. Its JSON form always has all keys, with null for unknown values.

    Times are seconds since 1970 UTC. `duration` is the length of the audio in seconds.
    """

    id: str
    state: State
    text: str | None = None
    #: machine-readable reason for the end: a `Reason`, or an unknown string from a newer server
    reason: str | None = None
    by: By | None = None
    #: human-readable description of the end
    message: str | None = None
    format: str = "text"
    #: the text up to the end of the last word that was heard
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
    #: id of the voice that is used, which may differ from the requested voice; None until the goal is ACTIVE
    voice: str | None = None
    output: Output | None = None

    @property
    def exit_code(self) -> int | None:
        """The exit code of a command that waits for this goal, or None until the goal has ended."""
        # A throttled goal is not a failure, because its sender asked for throttling.
        return 0 if self.reason == "throttled" else EXIT_CODES.get(self.state)

    def to_json(self) -> JsonObject:
        # The keys are written out for speed, because a busy server spends most of its time here.
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
        """Return the goal in a server's message. Raises Unreadable if its id or state is missing or invalid."""
        found = read_fields(cls, value)
        if not str(found.get("id", "\n")).isprintable() or "state" not in found:  # ids are printed without escaping
            raise Unreadable("what the server sent for a goal has no id that can be one, or an unknown state")
        return cls(**found)


def read_fields(cls: type, message: object) -> dict[str, Any]:
    """Return the values that a JSON object has for the fields of a class. Values of the wrong type are left out."""
    found = {}
    values = message if isinstance(message, dict) else {}
    for name, annotation in cls.__annotations__.items():
        value = values.get(name)
        if value is not None and (read := _READERS[annotation.partition(" ")[0]](value)) is not None:
            found[name] = read
    return found


def _reader(kind: type) -> Callable[[object], object]:
    """Return a function that returns a value of exactly this type unchanged, and None for every other value."""
    return lambda value: value if type(value) is kind else None


def read_seconds(value: object) -> float | None:
    """Return a number of seconds from a message, or None if it is not a number or too large to be shown."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and abs(value) <= _MAX_TIME_S else None  # type: ignore[arg-type]


#: Functions that read a field, by the field's annotation. They return None for a value of the wrong type.
_READERS: dict[str, Callable[[object], object]] = {
    "str": _reader(str),
    "int": _reader(int),
    "float": read_seconds,
    "bool": _reader(bool),
    "JsonObject": _reader(dict),
    "State": lambda value: State.__members__.get(value) if isinstance(value, str) else None,
    "By": By.from_json,
    "Sender": Sender.from_json,
    "Output": Output.from_json,
    "Goal": Goal.from_json,
}
