"""The requests of a client, as frozen values, and how they are read from JSON.

Rules for this file: form only; whether a goal is admitted is the scheduler's business. A request is one class and
one table of its fields. A field may be added, never renamed or given another meaning. A field that is not in the table
is an error: an option that this server doesn't know is refused, never dropped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

from talkcli.errors import BadRequest
from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from typing import ClassVar

    from talkcli.goals.goal import JsonObject

#: An id is at most this long; a longer one names no goal that could exist.
MAX_ID = 64
#: `data` that travels with a goal, in bytes of JSON: a label for programs, not something that the server has to store.
MAX_DATA = 1024
#: What a sender calls itself is shown on one line of a terminal.
MAX_NAME = 64
#: Ids in one request; more would not fit into a line anyway.
MAX_IDS = 4096
#: Goals that one request for the log asks for: as many as are kept.
MAX_LOG = 1_200

Check = Callable[[object], object]


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise ValueError("must be a string")
    return value


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise ValueError("must be true or false")
    return value


def _integer(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError("must be an integer")
    return value


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("must be a number")
    return value


def _count(value: object) -> int:
    if not 0 < _integer(value) <= MAX_LOG:
        raise ValueError(f"must be 1 to {MAX_LOG}")
    return _integer(value)


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
        if isinstance(value, dict) and len(json.dumps(value)) <= MAX_DATA:
            return value
    except RecursionError:
        pass
    raise ValueError(f"must be an object of at most {MAX_DATA} bytes")


def _optional(check: Check) -> Check:
    return lambda value: None if value is None else check(value)


@frozen
class Hello:
    """The first request of a client: it says who it is, and that it is alive."""

    kind: ClassVar[str] = "hello"
    fields: ClassVar[Mapping[str, Check]] = {"name": _optional(_name), "urgent": _flag}
    name: str | None = None
    #: only `status` and `cancel` will follow: a full server keeps some places for these
    urgent: bool = False


@frozen
class Say:
    """A goal: speak this. Values out of their range make it REJECTED, bad_option; see `admission`."""

    kind: ClassVar[str] = "say"
    fields: ClassVar[Mapping[str, Check]] = {
        "text": _text,
        "wait": _flag,
        "feedback": _flag,
        "patient": _flag,
        "preempt": _optional(_flag),
        "flush": _flag,
        "priority": _integer,
        "ttl": _optional(_number),
        "key": _optional(_text),
        "throttle": _optional(_number),
        "id": _optional(_text),
        "rate": _optional(_integer),
        "volume": _optional(_number),
        "voice": _optional(_text),
        "pitch": _optional(_integer),
        "data": _optional(_data),
        "format": _text,
    }
    text: str
    #: send this connection the goal's states, and its result
    wait: bool = False
    #: … and each word as it is heard; implies `wait`
    feedback: bool = False
    #: where the queue is full, answer when there is room, instead of REJECTED, queue_full
    patient: bool = False
    #: stop what is being spoken and go first; None leaves it to the server's default
    preempt: bool | None = None
    #: as `preempt`, and recall everything pending of the same or a lower priority
    flush: bool = False
    #: higher goes first
    priority: int = 0
    #: seconds from acceptance in which it must begin; 0 for no limit, None leaves it to the server's default
    ttl: float | None = None
    #: replaces the pending goal with the same key
    key: str | None = None
    #: seconds in which no other goal of this key, or else of this text, may have begun to be spoken
    throttle: float | None = None
    #: the sender's own id; the same id again attaches to the first goal
    id: str | None = None
    rate: int | None = None  # words per minute
    volume: float | None = None  # 0 to 1
    voice: str | None = None  # id, name or language
    pitch: int | None = None  # 0 to 100
    data: JsonObject | None = None
    format: str = "text"


@frozen
class Wait:
    """Send the results of these goals; where `ids` is not given, of all that are active or pending now."""

    kind: ClassVar[str] = "wait"
    fields: ClassVar[Mapping[str, Check]] = {"ids": _optional(_goal_ids), "feedback": _flag}
    ids: tuple[str, ...] | None = None
    #: each word as it is heard, too
    feedback: bool = False


@frozen
class Cancel:
    """End what these select; where no selector is given, everything. An empty list of ids selects nothing."""

    kind: ClassVar[str] = "cancel"
    fields: ClassVar[Mapping[str, Check]] = {
        "ids": _optional(_goal_ids),
        "current": _flag,
        "before": _optional(_goal_id),
        "key": _optional(_text),
    }
    ids: tuple[str, ...] | None = None
    #: the goal being spoken
    current: bool = False
    #: this goal and all accepted before it
    before: str | None = None
    #: goals with this key, pending or active
    key: str | None = None

    @property
    def everything(self) -> bool:
        return self.ids is None and not self.current and self.before is None and self.key is None


@frozen
class Status:
    """How the server is, what it says, what it will say, what it said; or one goal."""

    kind: ClassVar[str] = "status"
    fields: ClassVar[Mapping[str, Check]] = {"id": _optional(_goal_id)}
    id: str | None = None


@frozen
class Voices:
    """The voices of the server's engine."""

    kind: ClassVar[str] = "voices"
    fields: ClassVar[Mapping[str, Check]] = {}


@frozen
class Watch:
    """All goals as they are now, and then everything that happens to any goal."""

    kind: ClassVar[str] = "watch"
    fields: ClassVar[Mapping[str, Check]] = {}


@frozen
class Log:
    """The last `count` goals that ended, REJECTED ones too, oldest first."""

    kind: ClassVar[str] = "log"
    fields: ClassVar[Mapping[str, Check]] = {"count": _count}
    count: int = 20


@frozen
class Set:
    """Change the running server's settings; those not given stay. Answered with all of them."""

    kind: ClassVar[str] = "set"
    fields: ClassVar[Mapping[str, Check]] = {
        "rate": _optional(_integer),
        "volume": _optional(_number),
        "voice": _optional(_text),
        "pitch": _optional(_integer),
        "preempt": _optional(_flag),
        "ttl": _optional(_number),
    }
    rate: int | None = None  # words per minute
    volume: float | None = None  # 0 to 1
    voice: str | None = None  # id, name or language; "default" for the driver's own
    pitch: int | None = None  # 0 to 100
    preempt: bool | None = None
    ttl: float | None = None  # seconds, 0 for no limit


@frozen
class Pause:
    """Hold speech where it is; answered when it is silent."""

    kind: ClassVar[str] = "pause"
    fields: ClassVar[Mapping[str, Check]] = {}


@frozen
class Resume:
    """Go on where speech was held."""

    kind: ClassVar[str] = "resume"
    fields: ClassVar[Mapping[str, Check]] = {}


Request = Hello | Say | Wait | Cancel | Status | Voices | Watch | Log | Set | Pause | Resume

KINDS: dict[str, type[Request]] = {
    each.kind: each for each in (Hello, Say, Wait, Cancel, Status, Voices, Watch, Log, Set, Pause, Resume)
}


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
