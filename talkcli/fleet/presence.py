"""What a robot's presence says of it: its bridge's words while it is there, the will's once it is gone. Pure.

A robot, or somebody in its place, may have written anything: what is not of the form that it should be is taken as not
said.
"""

from __future__ import annotations

from talkcli.errors import BadRequest
from talkcli.fleet import topics
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.goal import seconds
from talkcli.protocol.lines import decode

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject


@frozen
class Presence:
    """Whether a robot is there, and what it said of itself last."""

    name: str
    online: bool
    #: that of its bridge; "" where it doesn't say
    session: str = ""
    #: when its bridge began, in seconds since 1970 UTC by the robot's clock; None once that is gone
    since: float | None = None
    groups: tuple[str, ...] = ()
    #: the kinds of requests that it takes from afar
    allow: tuple[str, ...] = ()
    #: its server: boot, pid and version; None where there is none
    server: JsonObject | None = None
    #: the bridge's; "" once that is gone
    version: str = ""

    @classmethod
    def read(cls, name: str, payload: bytes) -> Presence | None:
        """Return what the broker keeps for the robot of this name; None where somebody has cleared it, or it is none.

        `name`: the level of the topic. One that no robot can have is none.
        """
        try:
            said = decode(payload.strip())
        except BadRequest:
            return None
        if topics.fault(name):
            return None
        server = said.get("server")
        return cls(
            name,
            said.get("online") is True,
            _text(said.get("session")),
            seconds(said.get("since")),
            _texts(said.get("groups")),
            _texts(said.get("allow")),
            server if isinstance(server, dict) else None,
            _text(said.get("version")),
        )

    def to_json(self) -> JsonObject:
        """Return it as an object, for programs; its name stands beside that."""
        said = fields(self)
        del said["name"]
        return {**said, "groups": list(self.groups), "allow": list(self.allow)}


def rank(said: Presence | None) -> tuple[float, str] | None:
    """Return the rank among bridges of one name: the lowest stays. None if no bridge that is online wrote this."""
    if said is None or said.since is None or not (said.online and said.session):
        return None
    return said.since, said.session


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _texts(value: object) -> tuple[str, ...]:
    return tuple(each for each in value if isinstance(each, str)) if isinstance(value, list) else ()
