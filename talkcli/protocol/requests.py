"""The requests that a client can send, and how they are read from JSON.

Rules for this file: it only defines the form of requests. The scheduler decides whether a goal is admitted. A request
is a class with a row for each of its fields. The classes of `say`, `append`, `cancel`, `log`, `set` and `pause` are in
`goals.options`. Fields may be added, but never renamed or given another meaning. A field without a row is refused and
never ignored, because a client must know that a server doesn't support it. `meaning` is shown in the protocol's
document.
"""

from __future__ import annotations

from talkcli.errors import BadRequest
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import (
    FLAG,
    ID,
    IDS,
    MAX_IDS,
    MAX_SENDER_NAME_CHARS,
    SENDER_NAME,
    Append,
    Cancel,
    Log,
    Option,
    Pause,
    Say,
    Set,
)

if TYPE_CHECKING:
    from typing import ClassVar

    from talkcli.goals.goal import JsonObject


@frozen
class Hello:
    """The first request of a client, which contains the client's name."""

    kind: ClassVar[str] = "hello"
    meaning: ClassVar[str] = "Identify the client. Send this first"
    options: ClassVar[tuple[Option, ...]] = (
        Option("name", SENDER_NAME, "the client's name, for the log", form=f"1 to {MAX_SENDER_NAME_CHARS} characters"),
        Option(
            "urgent",
            FLAG,
            "the client only sends `status` and `cancel`; a full server still accepts a few such clients",
            default=False,
        ),
    )
    name: str | None = None
    urgent: bool = False


@frozen
class Wait:
    """A request for the results of the named goals, or of all unfinished goals.

    Any client may have sent them.
    """

    kind: ClassVar[str] = "wait"
    meaning: ClassVar[str] = "Send the results of these goals, whoever sent them"
    options: ClassVar[tuple[Option, ...]] = (
        Option(
            "ids", IDS, "null for all goals that have not ended", form=f"of up to {MAX_IDS:,} ids", default_words="all"
        ),
        Option("feedback", FLAG, "also send each word when it is heard", default=False),
    )
    ids: tuple[str, ...] | None = None
    feedback: bool = False


@frozen
class Status:
    """A request for the state of the server and its goals, or of one goal."""

    kind: ClassVar[str] = "status"
    meaning: ClassVar[str] = "Return the state of the server and its goals, or of one goal"
    options: ClassVar[tuple[Option, ...]] = (Option("id", ID, "only this goal"),)
    id: str | None = None


@frozen
class Voices:
    """A request for the list of the engine's voices."""

    kind: ClassVar[str] = "voices"
    meaning: ClassVar[str] = "List the engine's voices"
    options: ClassVar[tuple[Option, ...]] = ()


@frozen
class Sounds:
    """A request for the names of all sounds."""

    kind: ClassVar[str] = "sounds"
    meaning: ClassVar[str] = "List the sounds that can be played by name"
    options: ClassVar[tuple[Option, ...]] = ()


@frozen
class Watch:
    """A request for the state of the server, and then for the events of all goals."""

    kind: ClassVar[str] = "watch"
    meaning: ClassVar[str] = "Return the current state, and then send the events of all goals"
    options: ClassVar[tuple[Option, ...]] = ()


@frozen
class Resume:
    """A request to resume speech after a pause."""

    kind: ClassVar[str] = "resume"
    meaning: ClassVar[str] = "Continue speech after a pause"
    options: ClassVar[tuple[Option, ...]] = ()


Request = Hello | Say | Append | Wait | Cancel | Status | Voices | Sounds | Watch | Log | Set | Pause | Resume

REQUEST_TYPES: dict[str, type[Request]] = {each.kind: each for each in Request.__args__}


def read_request(message: JsonObject) -> Request:
    """Read a request from a JSON object. Raise BadRequest if it is malformed.

    The caller must have removed `seq` from the object.
    """
    fields = dict(message)
    kind = fields.pop("request", None)
    if not isinstance(kind, str):
        raise BadRequest("the field 'request' is missing or not a string", "bad_request")
    request = REQUEST_TYPES.get(kind)
    if request is None:
        known = ", ".join(REQUEST_TYPES)
        raise BadRequest(
            f"unknown request {kind[:MAX_SENDER_NAME_CHARS]!r}; this server supports {known}", "unknown_request"
        )
    for name, value in fields.items():
        option = next((each for each in request.options if each.name == name), None)
        if option is None:
            raise BadRequest(
                f"{kind}: this server doesn't support the field {name[:MAX_SENDER_NAME_CHARS]!r}", "unknown_field"
            )
        fault = option.type_error(value)
        if fault:
            raise BadRequest(f"{kind}: {name!r} {fault}", "bad_field")
        if isinstance(value, list):
            fields[name] = tuple(value)
    for option in request.options:
        if option.default_words == "required" and option.name not in fields:
            raise BadRequest(f"{kind}: {option.name!r} is missing", "bad_field")
    return request(**fields)  # type: ignore[arg-type]
