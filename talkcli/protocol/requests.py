"""The requests of a client, as frozen values, and how they are read from JSON.

Rules for this file: form only; whether a goal is admitted is the scheduler's business. A request is one class and the
rows of its fields; what a goal is and a server's settings are is in `goals.options`. A field may be added, never
renamed or given another meaning. A field that is not in the rows is an error: an option that this server doesn't know
is refused, never dropped. The first sentence of a request's docstring is its meaning in the wire's table.
"""

from __future__ import annotations

from talkcli.errors import BadRequest
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.option import FLAG, ID, IDS, MAX_IDS, MAX_LOG, MAX_NAME, Kind, Option
from talkcli.goals.options import Cancel, Say, Set

if TYPE_CHECKING:
    from typing import ClassVar

    from talkcli.goals.goal import JsonObject


def _bad_name(value: str) -> str | None:
    return None if 0 < len(value) <= MAX_NAME else f"must be 1 to {MAX_NAME} characters"


def _bad_count(value: int) -> str | None:
    return None if 0 < value <= MAX_LOG else f"must be 1 to {MAX_LOG}"


_NAME = Kind("string", (str,), "must be a string", fault=_bad_name)
_COUNT = Kind("integer", (int,), "must be an integer", fault=_bad_count)


@frozen
class Hello:
    """Who connects; send it at once, and the server knows that you are alive."""

    kind: ClassVar[str] = "hello"
    options: ClassVar[tuple[Option, ...]] = (
        Option("name", _NAME, "what the sender calls itself", form=f"1 to {MAX_NAME} characters"),
        Option(
            "urgent",
            FLAG,
            "only `status` and `cancel` will follow: a full server keeps places for these",
            default=False,
        ),
    )
    name: str | None = None
    urgent: bool = False


@frozen
class Wait:
    """Send the results of these goals, whoever sent them."""

    kind: ClassVar[str] = "wait"
    options: ClassVar[tuple[Option, ...]] = (
        Option("ids", IDS, "null: all that are active or pending now", form=f"of to {MAX_IDS:,} ids", absent="all"),
        Option("feedback", FLAG, "each word as it is heard, too", default=False),
    )
    ids: tuple[str, ...] | None = None
    feedback: bool = False


@frozen
class Status:
    """The server, and what it says, will say and said; or one goal."""

    kind: ClassVar[str] = "status"
    options: ClassVar[tuple[Option, ...]] = (Option("id", ID, "this goal alone"),)
    id: str | None = None


@frozen
class Voices:
    """The engine's voices."""

    kind: ClassVar[str] = "voices"
    options: ClassVar[tuple[Option, ...]] = ()


@frozen
class Watch:
    """Everything as it is now, and then all that happens to any goal."""

    kind: ClassVar[str] = "watch"
    options: ClassVar[tuple[Option, ...]] = ()


@frozen
class Log:
    """The last goals that ended, REJECTED ones too, oldest first."""

    kind: ClassVar[str] = "log"
    options: ClassVar[tuple[Option, ...]] = (Option("count", _COUNT, "so many", 20, form=f"1 to {MAX_LOG:,}"),)
    count: int = 20


@frozen
class Pause:
    """Hold speech where it is. Answered when it is silent."""

    kind: ClassVar[str] = "pause"
    options: ClassVar[tuple[Option, ...]] = ()


@frozen
class Resume:
    """Go on where speech was held."""

    kind: ClassVar[str] = "resume"
    options: ClassVar[tuple[Option, ...]] = ()


Request = Hello | Say | Wait | Cancel | Status | Voices | Watch | Log | Set | Pause | Resume

KINDS: dict[str, type[Request]] = {each.kind: each for each in Request.__args__}
_OPTIONS = {kind: {each.name: each for each in request.options} for kind, request in KINDS.items()}


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
    for name, value in fields.items():
        option = _OPTIONS[kind].get(name)
        if option is None:
            raise BadRequest(f"this server does not know the field {name[:MAX_NAME]!r} of {kind}", "unknown_field")
        fault = option.fault(value)
        if fault:
            raise BadRequest(f"{name!r} of {kind} {fault}", "bad_field")
        if isinstance(value, list):
            fields[name] = tuple(value)
    if request is Say and "text" not in fields:
        raise BadRequest("say needs a text", "bad_field")
    return request(**fields)  # type: ignore[arg-type]
