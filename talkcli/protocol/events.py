"""The messages that a server sends, and their JSON form.

Rules for this file: it only defines the form of messages, without I/O. `to_json` returns the object for the wire, and
the commands print the same object. A field means the same in each event. Fields may be added, but never renamed or
given another meaning. Readers ignore fields that they don't know. A change that an older peer could not read needs
another PROTOCOL number. `{"request": "cancel"}` and `{"request": "status"}` stay the same in every protocol.
"""

from __future__ import annotations

from talkcli import __version__
from talkcli.errors import BadRequest, Busy, ProtocolMismatch, Unreadable
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.goal import By, Goal, read_fields
from talkcli.protocol.features import FEATURES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.goal import JsonObject
    from talkcli.goals.states import State


PROTOCOL = 1
#: The lists of goals in a server's status, in the order of the fields of `ServerStatus`.
_STATUS_LISTS = ("pending", "recent", "interrupted")


@frozen
class ServerStatus:
    """The state of a server and its goals."""

    #: the server's description of itself
    server: JsonObject
    #: the goal that is ACTIVE or PREEMPTING
    active: Goal | None
    #: the pending goals, in the order in which they will be spoken
    pending: tuple[Goal, ...]
    #: the most recently ended goals, oldest first
    recent: tuple[Goal, ...]
    #: the interrupted goals, in the order in which they will continue
    interrupted: tuple[Goal, ...] = ()

    def to_json(self) -> JsonObject:
        """Return the status as a JSON object for clients."""
        return {
            "server": self.server,
            "active": None if self.active is None else self.active.to_json(),
            "interrupted": [each.to_json() for each in self.interrupted],
            "pending": [each.to_json() for each in self.pending],
            "recent": [each.to_json() for each in self.recent],
        }

    @classmethod
    def from_json(cls, message: JsonObject) -> ServerStatus:
        """Read a status from its JSON object.

        Raises Unreadable if one of the goals is malformed.
        """
        server, lists = message.get("server"), [message.get(name) for name in _STATUS_LISTS]
        goals = [tuple(map(Goal.from_json, each)) if isinstance(each, list) else () for each in lists]
        return cls(server if isinstance(server, dict) else {}, goal_in(message, "active"), *goals)

    @classmethod
    def from_reply(cls, reply: JsonObject, items: list[JsonObject]) -> ServerStatus:
        """Read a status from a reply and the list items before it."""
        lists = {name: [each[name] for each in items if name in each] for name in _STATUS_LISTS}
        return cls.from_json({**reply, **lists})


def unfinished(status: ServerStatus) -> list[Goal]:
    """Return the active goal, followed by the interrupted and the pending goals in their order."""
    return [*([status.active] if status.active else []), *status.interrupted, *status.pending]


@frozen
class Canceled:
    """The goals that a request cancelled, and those of its goals that had already ended."""

    #: the goals that were cancelled
    canceled: tuple[Goal, ...]
    #: goals that were named in the request, but had already ended
    ended: tuple[Goal, ...]

    @classmethod
    def from_items(cls, items: list[JsonObject]) -> Canceled:
        """Read the goals from the list items in the server's answer to a cancel request."""
        return cls(tuple(goals(items, "canceled")), tuple(goals(items, "ended")))


@frozen
class StateChanged:
    """An event that is sent when a goal's state changes."""

    id: str
    state: State
    #: the time of the event, in seconds since 1970 UTC
    at: float | None = None
    #: the number of the event. A number is skipped if its event was for another client, or if a word was dropped
    #: because this client reads too slowly.
    n: int | None = None
    #: the whole goal. Only clients that watch all goals receive it, in the goal's first and last event.
    goal: Goal | None = None

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        message = {**_event_json("state", self), "state": self.state.name}
        return message if self.goal is None else {**message, "goal": self.goal.to_json()}


@frozen
class WordHeard:
    """An event that is sent when a word is heard."""

    id: str
    word: str
    #: position of the word in the goal's text: the word is `text[start:end]`
    start: int
    end: int
    #: the word's number, which is 1 for the first word that is heard
    number: int
    #: seconds since the beginning of the goal's sound
    time: float
    at: float | None = None
    n: int | None = None

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        return _event_json("word", self)


@frozen
class TextAdded:
    """An event that is sent to watching clients when a goal's text has grown."""

    id: str
    #: position of the new text in the goal's text
    start: int
    text: str
    at: float | None = None
    n: int | None = None

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        return _event_json("text", self)


@frozen
class TextMissing:
    """An event that is sent when a goal falls silent because text is missing, and when it continues."""

    id: str
    #: whether the goal waits for text
    waits: bool
    at: float | None = None
    n: int | None = None

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        return _event_json("waits", self)


@frozen
class GoalInterrupted:
    """An event that is sent when another goal interrupts a goal. Later, the goal may become ACTIVE again."""

    id: str
    #: the goal that interrupts this one
    by: By
    at: float | None = None
    n: int | None = None

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        return {**_event_json("interrupted", self), "by": self.by.to_json()}


@frozen
class PausedChanged:
    """An event that is sent when all speech is paused or resumed."""

    paused: bool
    #: id of the paused or resumed goal, or None if nothing was being spoken
    id: str | None = None
    #: the client that paused or resumed speech
    by: By | None = None
    at: float | None = None
    n: int | None = None

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        return {**_event_json("paused", self), "by": None if self.by is None else self.by.to_json()}


@frozen
class Result:
    """An event that is sent when a goal has ended, with the whole goal."""

    goal: Goal

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        return {"event": "result", "goal": self.goal.to_json()}


@frozen
class Snapshot:
    """An event with the state of the server and its goals, sent when a client starts to watch."""

    status: ServerStatus

    def to_json(self) -> JsonObject:
        """Return the event's JSON object."""
        return {"event": "snapshot", **self.status.to_json()}


Event = StateChanged | WordHeard | TextAdded | TextMissing | GoalInterrupted | PausedChanged | Result | Snapshot

#: Event classes by kind. Snapshot is missing, because its fields differ from those of its message.
_EVENTS_BY_KIND: dict[str, type[Event]] = {
    "state": StateChanged,
    "word": WordHeard,
    "text": TextAdded,
    "waits": TextMissing,
    "interrupted": GoalInterrupted,
    "paused": PausedChanged,
    "result": Result,
}


def from_json(message: JsonObject) -> Event | None:
    """Read an event from its JSON object. Return None if the kind of event is unknown.

    Raises:
        Unreadable: a field is malformed.
    """
    kind = str(message.get("event"))
    if kind == "snapshot":
        return Snapshot(ServerStatus.from_json(message))
    event = _EVENTS_BY_KIND.get(kind)
    if event is None:
        return None
    found = read_fields(event, message)
    for name, annotation in event.__annotations__.items():
        value = message.get(name)
        # A time outside the calendar's range is treated as missing, because the rest of the event is still valid.
        missing = value is None or (annotation.startswith("float") and type(value) in (int, float))
        if name not in found and not (missing and annotation.endswith(" | None")):
            raise Unreadable(f"received a {kind!a} event with an invalid {name!r}: {value!a}")
    return event(**found)


def _event_json(
    kind: str, event: StateChanged | WordHeard | TextAdded | TextMissing | GoalInterrupted | PausedChanged
) -> JsonObject:
    """Return the JSON object of an event, without its goal.

    The caller converts enums and objects.
    """
    own = {name: value for name, value in fields(event).items() if name not in {"at", "n", "goal"}}
    return {"event": kind, **own, "n": event.n, "at": event.at}


def goals(items: list[JsonObject], name: str) -> Iterator[Goal]:
    """Yield the goal in the field `name` of each list item that has one. Raise Unreadable if a goal is malformed."""
    return (Goal.from_json(each[name]) for each in items if name in each)


def goal_in(reply: JsonObject, name: str = "goal") -> Goal | None:
    """Read a goal from a field of a reply. Return None if the field is null.

    Raises Unreadable if the goal is malformed.
    """
    return None if reply.get(name) is None else Goal.from_json(reply[name])


def greeting(version: str, pid: int, boot_id: str) -> JsonObject:
    """Return the greeting of a server. `boot_id` identifies this start of the server.

    The greeting is the first message that a server sends.
    """
    return {"talk": PROTOCOL, "version": version, "pid": pid, "boot": boot_id, "features": list(FEATURES)}


def busy_greeting(message: str | None = None) -> JsonObject:
    """Return the greeting for a client that is refused because the server is full.

    `message` gives the reason and the next step. It is None if the server has reached `--max-clients`.
    """
    return {"talk": PROTOCOL, "error": "busy", **({} if message is None else {"message": message})}


def check_greeting(message: JsonObject) -> None:
    """Raise an error if a greeting shows that this client can't use the server.

    Raises:
        ProtocolMismatch: the server uses another version of the protocol.
        Busy: the server is full.
    """
    theirs = message.get("talk")
    if theirs != PROTOCOL or isinstance(theirs, bool):
        server = ascii(message.get("version", "unknown"))
        older = isinstance(theirs, int) and theirs < PROTOCOL
        side = "restart the server with the newer version" if older else "upgrade this command"
        raise ProtocolMismatch(
            f"the server (version {server}) uses protocol {theirs!a}, but this command (version {__version__}) uses "
            f"protocol {PROTOCOL}: {side}"
        )
    if message.get("error") == "busy":
        words = message.get("message")
        if not (isinstance(words, str) and words and words.isprintable()):  # not safe to show on a terminal
            words = "the server has too many clients; try again later, or start it with a higher --max-clients"
        raise Busy(words, "busy")


def item(seq: int | None, **fields: object) -> JsonObject:
    """Return the message for a list item: the given fields, and the request's `seq`, if any.

    List items are sent before the reply.
    """
    return fields if seq is None else {"seq": seq, **fields}


def ok(seq: int | None, **fields: object) -> JsonObject:
    """Return the reply to a successful request."""
    return item(seq, ok=True, **fields)


def failure(seq: int | None, code: str, message: str, **fields: object) -> JsonObject:
    """Return the reply to a failed request."""
    return item(seq, ok=False, error={"code": code, "message": message}, **fields)


def take_seq(message: JsonObject) -> int | None:
    """Remove a request's `seq` number. Return the number, or None if there is none.

    Raises BadRequest if it isn't an integer.
    """
    seq = message.pop("seq", None)
    if seq is not None and (isinstance(seq, bool) or not isinstance(seq, int)):
        raise BadRequest("'seq' must be an integer", "bad_field")
    return seq
