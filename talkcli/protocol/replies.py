"""What a server's replies and their lists say, as frozen values. Form only, no I/O."""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import Goal

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from talkcli.goals.goal import JsonObject


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
        """Return the status in an object; ValueError where one of its goals is none."""
        lists = [each if isinstance(each, list) else [] for each in (message.get("pending"), message.get("recent"))]
        return cls._read(message, *lists)

    @classmethod
    def from_reply(cls, reply: JsonObject, items: list[JsonObject]) -> ServerStatus:
        """Return what a reply and the lines of its list say."""
        lists = [[each[name] for each in items if name in each] for name in ("pending", "recent")]
        return cls._read(reply, *lists)

    @classmethod
    def _read(cls, fields: JsonObject, pending: Iterable[object], recent: Iterable[object]) -> ServerStatus:
        server = fields.get("server")
        return cls(
            server if isinstance(server, dict) else {},
            goal_in(fields, "active"),
            tuple(Goal.from_json(each) for each in pending),
            tuple(Goal.from_json(each) for each in recent),
        )


@frozen
class Canceled:
    """What a cancel did: the goals that it ended, and those named that had ended before."""

    canceled: tuple[Goal, ...]
    ended: tuple[Goal, ...]

    @classmethod
    def from_items(cls, items: list[JsonObject]) -> Canceled:
        """Return what the lines of a cancel's list say."""
        return cls(tuple(goals(items, "canceled")), tuple(goals(items, "ended")))


def goals(items: list[JsonObject], name: str) -> Iterator[Goal]:
    """Return the goals that the lines of a list have under this name."""
    return (Goal.from_json(each[name]) for each in items if name in each)


def goal_in(reply: JsonObject, name: str = "goal") -> Goal | None:
    """Return the goal in a reply, None where it is null; ValueError where it is no goal."""
    return None if reply.get(name) is None else Goal.from_json(reply[name])
