"""One connection to a broker that ends at the wrong moment."""

from __future__ import annotations

import select
from typing import TYPE_CHECKING

import pytest

from talkcli.fleet import broker as brokers
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from talkcli.fleet.message import Message
    from tests.support.broker import Broker


@pytest.mark.timeout(20)
def test_broker_that_dies_while_it_is_answered_ends_the_connection(broker: Broker) -> None:
    """What comes is answered where it is heard: that the broker is gone by then must not be waited for in there."""
    needs_packages("paho")
    from talkcli.fleet.link import Link

    heard = []

    def hear(message: Message) -> None:
        heard.append(message.payload)
        broker.kill()
        for _ in range(3):  # the first is answered by a reset, which the next one finds
            link.publish("an/answer", b"answer")

    link = Link(brokers.from_environment(broker.env()), "somebody", hear)
    link.open()
    link.subscribe("a/question", retained=False)
    link.publish("a/question", b"question")
    while link.ended is None:
        assert select.select([link.fileno()], [], [], 10)[0], "the broker tells nothing"
        link.read()
    assert heard == [b"question"]
    assert link.ended == "the broker went away"
