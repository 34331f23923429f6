"""Goals and their senders as immutable values, with conversion to and from JSON.

This module only defines the format. The scheduler decides whether a goal is accepted. Fields may be added, but a field
never changes its name or meaning. Unknown fields are ignored here, but a request with an unknown field is refused.
Requests are defined in `options` and `protocol.requests`.
"""

from __future__ import annotations

from talkcli.errors import Unreadable
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.states import EXIT_CODES, State

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

JsonObject = dict[str, object]

#: Largest accepted time, about 30 million years.
_MAX_TIME_S = 1e15
#: Prefixes of messages that only repeat the goal's state. The prefixes in the last line come from older servers.
_STATE_PREFIXES = (
    *("not spoken", "speech failed", "result unknown", "Talk preempted"),
    *("Talk rejected", "Talk recalled", "Talk aborted", "Talk lost"),
)


@frozen
class Sender:
    """The program that sent a request. Unknown fields are None."""

    pid: int | None = None
    uid: int | None = None
    command: str | None = None
    #: command line of the parent process, usually a script
    parent: str | None = None
    #: unverified name from the client's `hello` request
    name: str | None = None

    def to_json(self) -> JsonObject:
        """Return the sender as a JSON object for clients."""
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Sender:
        """Read a sender from a JSON object. Missing and malformed fields are None."""
        return cls(**read_fields(cls, value))


@frozen
class By:
    """The goal or client that ended a goal, paused speech or resumed it.

    Both fields are None if the server itself ended the goal.
    """

    goal: str | None = None
    client: Sender | None = None

    def to_json(self) -> JsonObject | None:
        """Return the goal or client as a JSON object. Return None for the server itself."""
        if self.goal is not None:
            return {"goal": self.goal}
        return None if self.client is None else {"client": self.client.to_json()}

    @classmethod
    def from_json(cls, value: object) -> By | None:
        """Read the goal or client from a JSON object. Return None for any other value."""
        return cls(**read_fields(cls, value)) if isinstance(value, dict) else None


@frozen
class Output:
    """The audio output that played a goal, as reported by the sound server."""

    player: str
    #: name of the device in the sound server
    device: str
    #: volume of the device, where 1.0 means 100 %
    volume: float
    #: whether the output was muted or at volume 0 at any time while the goal was spoken
    muted: bool

    def to_json(self) -> JsonObject:
        """Return the audio output as a JSON object for clients."""
        return fields(self)

    @classmethod
    def from_json(cls, value: object) -> Output | None:
        """Read an audio output from a JSON object. Return None if a field is missing or malformed."""
        found = read_fields(cls, value)
        return cls(**found) if len(found) == len(cls.__annotations__) else None


@frozen
class Goal:
    """An immutable snapshot of a goal: its text, its state and how it ended.

    Its JSON always contains all keys, with null for unknown values. Times are seconds since 1970 UTC. `duration` is the
    length of the audio in seconds.
    """

    id: str
    state: State
    text: str | None = None
    #: machine-readable reason why the goal ended; newer servers may use values that aren't in `Reason`
    reason: str | None = None
    by: By | None = None
    #: human-readable description of how the goal ended
    message: str | None = None
    format: str = "text"
    #: text as it is spoken, if it differs from `text`; only set in replies about a single goal and in goals from the
    #: history
    said: str | None = None
    #: text up to the end of the last word that has started
    spoken: str | None = None
    #: end of the last word that was heard completely, as an offset in the text
    spoken_end: int | None = None
    #: how many seconds of the audio were heard
    heard: float | None = None
    priority: int = 0
    key: str | None = None
    ttl: float | None = None
    data: JsonObject | None = None
    client: Sender | None = None
    paused: bool = False
    #: id of the goal that interrupts this one; afterwards, this goal continues
    interrupted_by: str | None = None
    #: whether the text may still grow
    more: bool = False
    #: whether the goal is silent because the next part of its text is missing
    waits: bool = False
    queued_at: float | None = None
    started_at: float | None = None
    ended_at: float | None = None
    duration: float | None = None
    #: id of the voice that speaks the goal, which may differ from the requested voice
    voice: str | None = None
    output: Output | None = None

    @property
    def exit_code(self) -> int | None:
        """The exit code of a command that waits for this goal. It is None until the goal ends."""
        # Throttling is not a failure, because the sender asked for it.
        return 0 if self.reason == "throttled" else EXIT_CODES.get(self.state)

    def to_json(self) -> JsonObject:
        """Return the goal as a JSON object for clients."""
        # A loop over the fields would be slower, and a busy server spends most of its time in this method.
        return {
            "id": self.id,
            "state": self.state.name,
            "status": int(self.state),
            "reason": self.reason,
            "by": None if self.by is None else self.by.to_json(),
            "message": self.message,
            "text": self.text,
            "format": self.format,
            "said": self.said,
            "spoken": self.spoken,
            "spoken_end": self.spoken_end,
            "heard": self.heard,
            "priority": self.priority,
            "key": self.key,
            "ttl": self.ttl,
            "data": self.data,
            "client": None if self.client is None else self.client.to_json(),
            "paused": self.paused,
            "interrupted_by": self.interrupted_by,
            "more": self.more,
            "waits": self.waits,
            "queued_at": self.queued_at,
            "started_at": self.started_at,
            "ended_at": self.ended_at,
            "duration": self.duration,
            "voice": self.voice,
            "output": None if self.output is None else self.output.to_json(),
        }

    @classmethod
    def from_json(cls, value: object) -> Goal:
        """Read a goal from a JSON object. Raise Unreadable if it is malformed.

        The id and the state are required. Other fields that are missing or malformed get their defaults.
        """
        found = read_fields(cls, value)
        if not str(found.get("id", "\n")).isprintable() or "state" not in found:  # ids are printed unescaped
            raise Unreadable("received a goal with an invalid id or an unknown state")
        return cls(**found)


def read_fields(data_class: type, message: object) -> dict[str, Any]:
    """Read the fields of a class from a JSON object. Return only the valid values."""
    found = {}
    values = message if isinstance(message, dict) else {}
    for name, annotation in data_class.__annotations__.items():
        value = values.get(name)
        if value is not None and (read := _READERS[annotation.partition(" ")[0]](value)) is not None:
            found[name] = read
    return found


def message_details(message: str | None) -> str:
    """Return a goal's message without a prefix such as "speech failed: "."""
    head, _, details = (message or "").partition(": ")
    return details if details and head in _STATE_PREFIXES else message or ""


def _create_reader(kind: type) -> Callable[[object], object]:
    """Return a function that returns values of this type unchanged, and None for other values."""
    return lambda value: value if type(value) is kind else None


def read_seconds(value: object) -> float | None:
    """Convert a value from a message to a time in seconds. Return None if it is not valid."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and abs(value) <= _MAX_TIME_S else None  # type: ignore[arg-type]


def _read_strings(value: object) -> tuple[str, ...] | None:
    """Return the strings in a list, or None if the value is not a list."""
    return tuple(each for each in value if isinstance(each, str)) if isinstance(value, list) else None


#: Functions that read a field's value, by the first word of its type. They return None if the value has the wrong type.
_READERS: dict[str, Callable[[object], object]] = {
    "str": _create_reader(str),
    "int": _create_reader(int),
    "float": read_seconds,
    "bool": _create_reader(bool),
    "tuple[str,": _read_strings,
    "JsonObject": _create_reader(dict),
    "State": lambda value: State.__members__.get(value) if isinstance(value, str) else None,
    "By": By.from_json,
    "Sender": Sender.from_json,
    "Output": Output.from_json,
    "Goal": Goal.from_json,
}
