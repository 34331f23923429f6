"""Which robots there are, and how each stands: what the broker keeps of them, read at one moment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.fleet import topics
from talkcli.fleet.desk.desk import Desk
from talkcli.fleet.presence import Presence
from talkcli.fleet.status import Standing, Status

if TYPE_CHECKING:
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.link import Link
    from talkcli.fleet.message import Message


def roster(broker: Broker, patience: float) -> dict[str, Presence]:
    """Return the presence of each robot that the broker knows, by name, those that are offline among them.

    `patience`: seconds in which the broker must have told; errors as of `Desk.await_kept`.
    """
    kept = _kept(broker, patience, None, topics.PRESENCE)
    return {name: each for name, told in kept.items() if (each := Presence.read(name, told[topics.PRESENCE]))}


def standings(broker: Broker, patience: float, name: str | None = None) -> dict[str, Standing]:
    """Return how each robot stands that the broker knows, or the one of this name; errors as of `roster`."""
    found = {}
    for each, told in _kept(broker, patience, name, topics.PRESENCE, topics.STATUS).items():
        presence = Presence.read(each, told.get(topics.PRESENCE, b""))
        if presence:
            found[each] = Standing(presence, Status.read(told.get(topics.STATUS, b"")))
    return found


def _kept(broker: Broker, patience: float, name: str | None, *kinds: str) -> dict[str, dict[str, bytes]]:
    """Return what the broker keeps of these kinds for a robot, or for any: by name and kind."""
    reader = _Reader([topics.robot(name or topics.ANY, each) for each in kinds])
    desk = Desk(broker)
    desk.visitor = reader
    try:
        desk.await_kept(patience, lambda: bool(reader.found))
    finally:
        desk.close()
    return reader.found


class _Reader:
    """Takes what comes on some topics."""

    def __init__(self, wanted: list[str]) -> None:
        self._wanted = wanted
        #: the payloads, by the robot's name and their kind
        self.found: dict[str, dict[str, bytes]] = {}

    def came_up(self, link: Link) -> None:
        link.subscribe(*self._wanted, retained=True)

    def went_down(self, why: str) -> None:
        pass  # `failure` of the desk says it

    def hear(self, message: Message) -> None:
        _, _, name, kind = message.topic.split("/")
        self.found.setdefault(name, {})[kind] = message.payload
