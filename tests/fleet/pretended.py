"""A robot that a test makes up: it is there for all who look, and answers what it is asked as the test has it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from tests.fleet import told
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from paho.mqtt.client import MQTTMessage

    from tests.support.broker import Broker
    from tests.support.mqtt import Message


class Pretended(Listener):
    """A robot at a broker, of the group of all and of one of its own; once it is closed nothing of it is kept.

    It has no server, and so no schedule: what it answers is all that there is to it.
    """

    def __init__(
        self,
        broker: Broker,
        name: str,
        answer: Callable[[dict[str, Any]], Sequence[dict[str, Any]]],
        groups: Sequence[str] = (),
    ) -> None:
        self._robot, self._answering = name, answer
        topics = [f"talk/robot/{name}/request/+", *(f"talk/group/{each}/request/+" for each in ("all", *groups))]
        super().__init__(broker, *topics)
        told.presence(self, name, groups=groups)

    def __enter__(self) -> Pretended:
        return self

    def close(self) -> None:
        """Go, and have the broker forget it; a second time is nothing."""
        if self.ended is None:
            self.publish(f"talk/robot/{self._robot}/presence", b"", retain=True)
        super().close()

    def _take(self, message: MQTTMessage) -> None:
        super()._take(message)
        self._reply(self.messages[-1])

    def _reply(self, message: Message) -> None:
        if not message.payload or message.response is None:  # somebody hangs up
            return
        asked = message.json
        topic = (
            message.response if message.response.endswith(f"/{self._robot}") else f"{message.response}/{self._robot}"
        )
        for line in self._answering(asked):
            # By the thread that reads: it can wait for no acknowledgement.
            self._client.publish(topic, json.dumps({"seq": asked.get("seq"), **line}) + "\n", 1)
