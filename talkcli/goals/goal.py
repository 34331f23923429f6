"""A goal and who sent it, as client and server tell each other of them: frozen values and their form in JSON.

Rules for this file: form only. Whether a goal is admitted is the scheduler's business, how a line is cut from a stream
is the wire's. A field may be added, never renamed or given another meaning. A reader ignores fields that it doesn't
know; requests, where that would drop what somebody asked for, are in `options` and `protocol.requests`.
"""

from __future__ import annotations

from talkcli.errors import Unreadable
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.states import EXIT_CODES, State

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

JsonObject = dict[str, object]

#: Seconds in some thirty million years: what is longer, no calendar can show.
_LONGEST = 1e15


@frozen
class Sender:
    """Who is at the other end of a connection. None where the system doesn't tell."""

    pid: int | None = None
    uid: int | None = None
    #: the program that connected
    command: str | None = None
    #: the command line of the program that started it: the script that one looks for
    parent: str | None = None
    #: what the sender calls itself; a claim, and shown as one
    name: str | None = None

    def to_json(self) -> JsonObject:
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Sender:
        return cls(**known(cls, value if isinstance(value, dict) else {}))


@frozen
class By:
    """What ended a goal: another goal, or a client's request. Neither where it was the server itself."""

    goal: str | None = None
    client: Sender | None = None

    def to_json(self) -> JsonObject | None:
        if self.goal is not None:
            return {"goal": self.goal}
        return None if self.client is None else {"client": self.client.to_json()}

    @classmethod
    def from_json(cls, value: object) -> By | None:
        return cls(**known(cls, value)) if isinstance(value, dict) else None


@frozen
class Output:
    """Where a goal's sound goes, and whether anybody can hear it, as far as the sound server tells."""

    #: the player's name
    player: str
    #: the device, by the sound server's name for it
    device: str
    #: 0 to 1; 1 is what the device calls 100 %
    volume: float
    #: whether it was muted, or its volume 0, at any time while the goal was spoken
    muted: bool

    def to_json(self) -> JsonObject:
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Output | None:
        found = known(cls, value) if isinstance(value, dict) else {}
        return cls(**found) if len(found) == len(cls.__annotations__) else None


@frozen
class Goal:
    """A goal as it is at one moment. In JSON it always has all its keys, null where unknown.

    Times are seconds since 1970 UTC, `duration` is seconds of audio.
    """

    id: str
    state: State
    text: str | None = None
    #: why it ended, for programs: one of the reasons in protocol/README.md
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
    #: id of the voice by which it is heard, which may be another than it asked for; None until it is ACTIVE
    voice: str | None = None
    #: None where it can't be known
    output: Output | None = None

    @property
    def exit_code(self) -> int | None:
        """What a command ends with whose goal this is; None until it has ended."""
        # That it is not said again is what the sender of a throttled one has asked for.
        return 0 if self.reason == "throttled" else EXIT_CODES.get(self.state)

    def to_json(self) -> JsonObject:
        # Written out: each goal is told of two or three times, and a busy server does little else.
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
        """Return the goal in a server's message; Unreadable where it is none. Fields not known here are ignored."""
        found = known(cls, value if isinstance(value, dict) else {})
        if not str(found.get("id", "\n")).isprintable() or "state" not in found:  # ids are shown as they are
            raise Unreadable("what the server sent for a goal has no id that can be one, or an unknown state")
        return cls(**found)


def known(cls: type, message: JsonObject) -> dict[str, Any]:
    """Return what an object has of the fields of a value, each as the value has it; none that is of another kind."""
    found = {}
    for name, annotation in cls.__annotations__.items():
        value = message.get(name)
        if value is not None and (read := _READ[annotation.partition(" ")[0]](value)) is not None:
            found[name] = read
    return found


def _of(kind: type) -> Callable[[object], object]:
    return lambda value: value if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)) else None


def seconds(value: object) -> float | None:
    """Return a time, or a length of time, that somebody else tells; None for what is none, or past all calendars."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and abs(value) <= _LONGEST else None  # type: ignore[arg-type]


#: What reads a field, by its annotation; None for what is of another kind.
_READ: dict[str, Callable[[object], object]] = {
    "str": _of(str),
    "int": _of(int),
    "float": seconds,
    "bool": _of(bool),
    "JsonObject": _of(dict),
    "State": lambda value: State.__members__.get(value) if isinstance(value, str) else None,
    "By": By.from_json,
    "Sender": Sender.from_json,
    "Output": Output.from_json,
    "Goal": Goal.from_json,
}
