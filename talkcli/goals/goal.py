"""A goal and who sent it, as client and server tell each other of them: frozen values and their form in JSON.

Rules for this file: form only. Whether a goal is admitted is the scheduler's business, how a line is cut from a stream
is the wire's. A field may be added, never renamed or given another meaning. A reader ignores fields that it doesn't
know; requests, where that would drop what somebody asked for, are in `options` and `protocol.requests`.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import TypeVar

    _T = TypeVar("_T")

JsonObject = dict[str, object]


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
        return {"pid": self.pid, "uid": self.uid, "command": self.command, "parent": self.parent, "name": self.name}

    @classmethod
    def from_json(cls, value: object) -> Sender:
        fields = value if isinstance(value, dict) else {}
        return cls(
            _maybe(fields, "pid", int),
            _maybe(fields, "uid", int),
            _maybe(fields, "command", str),
            _maybe(fields, "parent", str),
            _maybe(fields, "name", str),
        )


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
        if not isinstance(value, dict):
            return None
        client = value.get("client")
        return cls(_maybe(value, "goal", str), None if client is None else Sender.from_json(client))


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

    def to_json(self) -> JsonObject:
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
        }

    @classmethod
    def from_json(cls, value: object) -> Goal:
        """Return the goal in a server's message; ValueError where it is none. Fields not known here are ignored."""
        if not isinstance(value, dict):
            raise ValueError("a goal is a JSON object")
        goal_id, state, data = value.get("id"), value.get("state"), value.get("data")
        if not isinstance(goal_id, str) or not isinstance(state, str) or state not in State.__members__:
            raise ValueError("a goal has an id and a state")
        return cls(
            id=goal_id,
            state=State[state],
            text=_maybe(value, "text", str),
            reason=_maybe(value, "reason", str),
            by=By.from_json(value.get("by")),
            message=_maybe(value, "message", str),
            format=_maybe(value, "format", str) or "text",
            spoken=_maybe(value, "spoken", str),
            priority=_maybe(value, "priority", int) or 0,
            key=_maybe(value, "key", str),
            ttl=_seconds(value, "ttl"),
            data=data if isinstance(data, dict) else None,
            client=None if value.get("client") is None else Sender.from_json(value["client"]),
            paused=_maybe(value, "paused", bool) or False,
            queued_at=_seconds(value, "queued_at"),
            started_at=_seconds(value, "started_at"),
            ended_at=_seconds(value, "ended_at"),
            duration=_seconds(value, "duration"),
        )


def _maybe(fields: Mapping[str, object], name: str, kind: type[_T]) -> _T | None:
    value = fields.get(name)
    return value if isinstance(value, kind) else None


def _seconds(fields: Mapping[str, object], name: str) -> float | None:
    value = fields.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
