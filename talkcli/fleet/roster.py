"""Which robots there are: what the broker keeps of the presence of each, read at one moment."""

from __future__ import annotations

import os
import select
import time
from typing import TYPE_CHECKING

from talkcli.client.connect import ready
from talkcli.errors import BadRequest, ServerUnavailable
from talkcli.fleet import topics
from talkcli.fleet.broker import user
from talkcli.fleet.link import Link
from talkcli.protocol.lines import decode

if TYPE_CHECKING:
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.message import Message
    from talkcli.goals.goal import JsonObject


def roster(broker: Broker, patience: float) -> dict[str, JsonObject]:
    """Return the presence of each robot that the broker knows, by name, those that are offline among them.

    `patience`: seconds in which the broker must have told. Errors as of `Link.open`, which has a patience of its own.
    """
    found: dict[str, JsonObject] = {}
    name, session = user(broker), os.urandom(8).hex()
    marker = topics.reply(name, session, topics.MARKER)
    told = False

    def hear(message: Message) -> None:
        nonlocal told
        told = told or message.topic == marker
        levels = message.topic.split("/")
        if levels[-1] == topics.PRESENCE:
            try:
                found[levels[-2]] = decode(message.payload.strip())
            except BadRequest:
                found.pop(levels[-2], None)  # somebody has cleared it

    link = Link(broker, f"talk-desk-{name}-{session}", hear)
    link.open()
    end = time.monotonic() + patience
    try:
        link.subscribe(marker, retained=False)
        link.subscribe(topics.robot("+", topics.PRESENCE), retained=True)
        link.publish(marker, b"\n")  # it comes back behind all that the broker keeps
        while not told:
            left = end - time.monotonic()
            if link.ended or left <= 0:
                raise ServerUnavailable(f"the broker at {broker.url} does not tell which robots there are")
            ready({link.fileno(): select.POLLIN}, left)
            link.read()
    finally:
        link.close()
    return found
