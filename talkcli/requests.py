"""The requests of a client, as frozen dataclasses, and how they are read from JSON.

Rules for this file: form only; whether a goal is admitted is the scheduler's business. A request is one dataclass and
one table of its fields. A field may be added, never renamed or given another meaning. A field that is not in the table
is an error: an option that this server doesn't know is refused, never dropped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

from talkcli.errors import BadRequest

if TYPE_CHECKING:
    from talkcli.messages import JsonObject

#: An id is at most this long; a longer one names no goal that could exist.
MAX_ID = 64
#: `data` that travels with a goal, in bytes of JSON: a label for programs, not something that the server has to store.
MAX_DATA = 1024
#: What a sender calls itself is shown on one line of a terminal.
MAX_NAME = 64
#: Ids in one request; more would not fit into a line anyway.
MAX_IDS = 4096

Check = Callable[[object], object]


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise ValueError("must be a string")
    return value


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise ValueError("must be true or false")
    return value


def _goal_id(value: object) -> str:
    text = _text(value)
    if not 0 < len(text) <= MAX_ID:
        raise ValueError(f"must be an id of 1 to {MAX_ID} characters")
    return text


def _goal_ids(value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or len(value) > MAX_IDS:
        raise ValueError(f"must be a list of at most {MAX_IDS} ids")
    return tuple(_goal_id(each) for each in value)


def _name(value: object) -> str:
    text = _text(value)
    if not 0 < len(text) <= MAX_NAME:
        raise ValueError(f"must be 1 to {MAX_NAME} characters")
    return text


def _data(value: object) -> JsonObject:
    try:
        fits = isinstance(value, dict) and len(json.dumps(value)) <= MAX_DATA
    except RecursionError:
        fits = False
    if not fits:
        raise ValueError(f"must be an object of at most {MAX_DATA} bytes")
    return cast("JsonObject", value)


def _optional(check: Check) -> Check:
    return lambda value: None if value is None else check(value)


@dataclass(frozen=True, slots=True)
class Hello:
    """The first request of a client: it says who it is, and that it is alive."""

    kind: ClassVar[str] = "hello"
    fields: ClassVar[Mapping[str, Check]] = {"name": _optional(_name), "urgent": _flag}
    name: str | None = None
    #: only `status` and `cancel` will follow: a full server keeps some places for these
    urgent: bool = False


@dataclass(frozen=True, slots=True)
class Say:
    """A goal: speak this."""

    kind: ClassVar[str] = "say"
    fields: ClassVar[Mapping[str, Check]] = {
        "text": _text,
        "wait": _flag,
        "preempt": _optional(_flag),
        "data": _optional(_data),
        "format": _text,
    }
    text: str
    #: send this connection the goal's events, and its result
    wait: bool = False
    #: stop what is being spoken and go first; None leaves it to the server's default
    preempt: bool | None = None
    data: JsonObject | None = None
    format: str = "text"


@dataclass(frozen=True, slots=True)
class Wait:
    """Send the results of these goals; where `ids` is not given, of all that are active or pending now."""

    kind: ClassVar[str] = "wait"
    fields: ClassVar[Mapping[str, Check]] = {"ids": _optional(_goal_ids)}
    ids: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class Cancel:
    """End what these select; where no selector is given, everything. An empty list of ids selects nothing."""

    kind: ClassVar[str] = "cancel"
    fields: ClassVar[Mapping[str, Check]] = {
        "ids": _optional(_goal_ids),
        "current": _flag,
        "before": _optional(_goal_id),
    }
    ids: tuple[str, ...] | None = None
    #: the goal being spoken
    current: bool = False
    #: this goal and all accepted before it
    before: str | None = None

    @property
    def everything(self) -> bool:
        return self.ids is None and not self.current and self.before is None


@dataclass(frozen=True, slots=True)
class Status:
    """How the server is, what it says, what it will say, what it said; or one goal."""

    kind: ClassVar[str] = "status"
    fields: ClassVar[Mapping[str, Check]] = {"id": _optional(_goal_id)}
    id: str | None = None


@dataclass(frozen=True, slots=True)
class Voices:
    """The voices of the server's engine."""

    kind: ClassVar[str] = "voices"
    fields: ClassVar[Mapping[str, Check]] = {}


@dataclass(frozen=True, slots=True)
class Watch:
    """All goals as they are now, and then everything that happens to any goal."""

    kind: ClassVar[str] = "watch"
    fields: ClassVar[Mapping[str, Check]] = {}


Request = Hello | Say | Wait | Cancel | Status | Voices | Watch

KINDS: dict[str, type[Request]] = {each.kind: each for each in (Hello, Say, Wait, Cancel, Status, Voices, Watch)}


def read_request(message: JsonObject) -> Request:
    """Return the request in a decoded line, whose `seq` was taken out; BadRequest, with a code, where there is none."""
    fields = dict(message)
    kind = fields.pop("request", None)
    if not isinstance(kind, str):
        raise BadRequest('a request is an object with a "request"', "bad_request")
    request = KINDS.get(kind)
    if request is None:
        known = ", ".join(KINDS)
        raise BadRequest(f"this server does not know the request {kind[:MAX_NAME]!r}, but {known}", "unknown_request")
    values = {}
    for name, value in fields.items():
        check = request.fields.get(name)
        if check is None:
            raise BadRequest(f"this server does not know the field {name[:MAX_NAME]!r} of {kind}", "unknown_field")
        try:
            values[name] = check(value)
        except ValueError as error:
            raise BadRequest(f"{name!r} of {kind} {error}", "bad_field") from None
    if request is Say and "text" not in values:
        raise BadRequest("say needs a text", "bad_field")
    return request(**values)  # type: ignore[arg-type]


def write_request(request: Request) -> JsonObject:
    """Return a request as the object that goes over the wire; fields at their defaults are left out."""
    message: JsonObject = {"request": request.kind}
    default = type(request)("") if isinstance(request, Say) else type(request)()
    for name in request.fields:
        value = getattr(request, name)
        if value != getattr(default, name) or name == "text":
            message[name] = list(value) if isinstance(value, tuple) else value
    return message
