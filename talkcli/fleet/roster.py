"""Which robots there are, and how each stands: what the broker keeps of them, read at one moment."""

from __future__ import annotations

import os
import select
import time
from typing import TYPE_CHECKING

from talkcli.client.connect import ready
from talkcli.errors import AccessDenied, ServerUnavailable
from talkcli.fleet import topics
from talkcli.fleet.broker import user
from talkcli.fleet.link import MANY_AT_ONCE, NOT_AUTHORIZED, Link
from talkcli.fleet.presence import Presence
from talkcli.fleet.status import Standing, Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.message import Message

#: Stands for any robot in a topic that is subscribed to.
_ANY = "+"
#: Seconds for which a first robot is awaited that the broker keeps: some send it a moment after the rest.
_GRACE = 0.3


def roster(broker: Broker, patience: float) -> dict[str, Presence]:
    """Return the presence of each robot that the broker knows, by name, those that are offline among them.

    `patience`: seconds in which the broker must have told. Errors as of `Link.open`, which has a patience of its own;
    AccessDenied where the broker doesn't let this user ask.
    """
    found: dict[str, Presence | None] = {}

    def hear(name: str, _: str, payload: bytes) -> None:
        found[name] = Presence.read(name, payload)

    _ask(broker, patience, hear, _ANY, topics.PRESENCE)
    return {name: each for name, each in found.items() if each}


def standings(broker: Broker, patience: float, name: str = _ANY) -> dict[str, Standing]:
    """Return how each robot stands that the broker knows, or the one of this name; errors as of `roster`."""
    presences: dict[str, Presence | None] = {}
    statuses: dict[str, Status | None] = {}

    def hear(name: str, kind: str, payload: bytes) -> None:
        if kind == topics.PRESENCE:
            presences[name] = Presence.read(name, payload)
        else:
            statuses[name] = Status.read(payload)

    _ask(broker, patience, hear, name, topics.PRESENCE, topics.STATUS)
    return {name: Standing(each, statuses.get(name)) for name, each in presences.items() if each}


def _ask(broker: Broker, patience: float, hear: Callable[[str, str, bytes], None], name: str, *kinds: str) -> None:
    """Have all that the broker keeps of these kinds for a robot, or for any, be heard: name, kind, and payload."""
    asker, session = user(broker), os.urandom(8).hex()
    marker = topics.reply(asker, session, topics.MARKER)
    #: until when something is awaited at all, once the marker is back; whether something has come; the marker's code
    until: float | None = None
    heard = False
    codes: list[int] = []

    def take(message: Message) -> None:
        nonlocal until, heard
        if message.topic == marker:
            until = time.monotonic() + _GRACE
            return
        heard = True
        _, _, name, kind = message.topic.split("/")
        hear(name, kind, message.payload)

    link = Link(broker, f"talk-desk-{asker}-{session}", take, at_once=MANY_AT_ONCE)
    link.open()
    end = time.monotonic() + patience
    try:
        link.subscribe(marker, retained=False)
        link.subscribe(*(topics.robot(name, each) for each in kinds), retained=True)
        link.publish(marker, b"\n", acknowledged=codes.append)  # it comes back behind all that the broker keeps
        while until is None or not heard:
            now = time.monotonic()
            if until is not None and now >= until:
                break
            if NOT_AUTHORIZED in codes:
                words = f"the broker at {broker.url} does not let '{asker}' ask which robots there are"
                raise AccessDenied(f"{words}: its ACL needs the lines of an operator, see 'talk bridge --print-acl'")
            if link.ended or now >= end:
                raise ServerUnavailable(f"the broker at {broker.url} does not tell which robots there are")
            ready({link.fileno(): select.POLLIN}, min(end, until or end) - now)
            link.read()
    finally:
        link.close()
