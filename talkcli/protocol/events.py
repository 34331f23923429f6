"""What a server says, and its form in JSON: the greeting, replies and their lists, and the events that are heard.

Rules for this file: form only, no I/O. `to_json` gives what the wire has, which is what the commands print. A field may
be added, never renamed or given another meaning, and means the same in each event; a reader ignores what it doesn't
know. A change that an older peer could not read needs another PROTOCOL number; `{"request": "cancel"}` and
`{"request": "status"}` stay the same in all of them.
"""

from __future__ import annotations

from talkcli.errors import BadRequest, Busy, ProtocolMismatch, Unreadable
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.goal import By, Goal, known

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.goal import JsonObject
    from talkcli.goals.states import State


PROTOCOL = 1


@frozen
class ServerStatus:
    """What a server says, will say and said. `server` is its own description, for people and programs."""

    server: JsonObject
    #: the goal that is ACTIVE or PREEMPTING
    active: Goal | None
    #: what comes next, in its order
    pending: tuple[Goal, ...]
    #: what ended last, oldest first
    recent: tuple[Goal, ...]

    def to_json(self) -> JsonObject:
        return {
            "server": self.server,
            "active": None if self.active is None else self.active.to_json(),
            "pending": [each.to_json() for each in self.pending],
            "recent": [each.to_json() for each in self.recent],
        }

    @classmethod
    def from_json(cls, message: JsonObject) -> ServerStatus:
        """Return the status in an object; Unreadable where one of its goals is none."""
        server, pending, recent = message.get("server"), message.get("pending"), message.get("recent")
        return cls(
            server if isinstance(server, dict) else {},
            goal_in(message, "active"),
            tuple(map(Goal.from_json, pending)) if isinstance(pending, list) else (),
            tuple(map(Goal.from_json, recent)) if isinstance(recent, list) else (),
        )

    @classmethod
    def from_reply(cls, reply: JsonObject, items: list[JsonObject]) -> ServerStatus:
        """Return what a reply and the lines of its list say."""
        lists = {name: [each[name] for each in items if name in each] for name in ("pending", "recent")}
        return cls.from_json({**reply, **lists})


def unfinished(status: ServerStatus) -> list[Goal]:
    """Return the goals of a status that have not ended: the active one, then those that wait, in their order."""
    return [*([status.active] if status.active else []), *status.pending]


@frozen
class Canceled:
    """What a cancel did: the goals that it ended, and those named that had ended before."""

    canceled: tuple[Goal, ...]
    ended: tuple[Goal, ...]

    @classmethod
    def from_items(cls, items: list[JsonObject]) -> Canceled:
        """Return what the lines of a cancel's list say."""
        return cls(tuple(goals(items, "canceled")), tuple(goals(items, "ended")))


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
    at: float | None = None
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
    at: float | None = None
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
    """Return the event in a message; None for a kind that is not known here; Unreadable where its fields are wrong."""
    kind = str(message.get("event"))
    if kind == "snapshot":
        return Snapshot(ServerStatus.from_json(message))
    event = _KINDS.get(kind)
    if event is None:
        return None
    found = known(event, message)
    for name, annotation in event.__annotations__.items():
        value = message.get(name)
        # A time past all calendars is none, as in a goal: what has happened is no less true for that.
        none = value is None or (annotation.startswith("float") and type(value) in (int, float))
        if name not in found and not (none and annotation.endswith(" | None")):
            raise Unreadable(f"the {name!r} of a {kind!a} event is {value!a}")
    return event(**found)


def _counted(kind: str, event: StateChanged | WordHeard | PausedChanged) -> JsonObject:
    """Return an event as an object: the kind first, the server's count and the time last."""
    own = fields(event)
    at, n = own.pop("at"), own.pop("n")
    return {"event": kind, **own, "n": n, "at": at}


def goals(items: list[JsonObject], name: str) -> Iterator[Goal]:
    """Return the goals that the lines of a list have under this name."""
    return (Goal.from_json(each[name]) for each in items if name in each)


def goal_in(reply: JsonObject, name: str = "goal") -> Goal | None:
    """Return the goal in a reply, None where it is null; Unreadable where it is no goal."""
    return None if reply.get(name) is None else Goal.from_json(reply[name])


def greeting(version: str, pid: int, boot: str) -> JsonObject:
    """Return what a server says first."""
    return {"talk": PROTOCOL, "version": version, "pid": pid, "boot": boot, "features": []}


def busy_greeting(message: str | None = None) -> JsonObject:
    """Return the greeting of a server that takes no more clients.

    `message`: why, and what to do; None if the limit is `--max-clients`.
    """
    return {"talk": PROTOCOL, "error": "busy", **({} if message is None else {"message": message})}


def check_greeting(message: JsonObject, version: str) -> None:
    """Raise ProtocolMismatch or Busy where a client of `version` can't go on after this greeting."""
    theirs = message.get("talk")
    if theirs != PROTOCOL or isinstance(theirs, bool):
        server = ascii(message.get("version", "unknown"))
        older = isinstance(theirs, int) and theirs < PROTOCOL
        side = "restart the server with the newer version" if older else "upgrade this command"
        raise ProtocolMismatch(
            f"this command (version {version}) speaks protocol {PROTOCOL}, the server (version {server}) speaks "
            f"{theirs!a}: {side}"
        )
    if message.get("error") == "busy":
        words = message.get("message")
        if not (isinstance(words, str) and words and words.isprintable()):  # it may be a stranger's, for a terminal
            words = "the server has as many clients as it takes (`talk serve --max-clients`)"
        raise Busy(words, "busy")


def item(seq: int | None, **fields: object) -> JsonObject:
    """Return one line of a list; the list's reply follows."""
    return fields if seq is None else {"seq": seq, **fields}


def ok(seq: int | None, **fields: object) -> JsonObject:
    """Return the reply that closes a request that was carried out."""
    return item(seq, ok=True, **fields)


def failure(seq: int | None, code: str, message: str) -> JsonObject:
    """Return the reply to a request that was not carried out."""
    return item(seq, ok=False, error={"code": code, "message": message})


def take_seq(message: JsonObject) -> int | None:
    """Take the number of a request out of it; BadRequest where it is no number."""
    seq = message.pop("seq", None)
    if seq is not None and (isinstance(seq, bool) or not isinstance(seq, int)):
        raise BadRequest('"seq" must be an integer', "bad_field")
    return seq
