"""A robot without a bridge or a server. The test chooses its replies."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from tests.fleet import publish
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from paho.mqtt.client import MQTTMessage

    from tests.support.broker import Broker


class FakeRobot(Listener):
    """A robot that is online until it is closed."""

    def __init__(
        self,
        broker: Broker,
        name: str,
        answer: Callable[[dict[str, Any]], Sequence[dict[str, Any]]],
        groups: Sequence[str] = (),
    ) -> None:
        """`answer` returns the lines of the reply to a request."""
        self._robot, self._answer_to = name, answer
        topics = [f"talk/robot/{name}/request/+", *(f"talk/group/{group}/request/+" for group in ("all", *groups))]
        super().__init__(broker, *topics)
        publish.presence(self, name, groups=groups)

    def __enter__(self) -> FakeRobot:
        return self

    def close(self) -> None:
        """Clear the robot's presence, and disconnect."""
        if self.ended is None:
            self.publish(f"talk/robot/{self._robot}/presence", b"", retain=True)
        super().close()

    def _receive(self, message: MQTTMessage) -> None:
        super()._receive(message)
        request = self.messages[-1]
        if not request.payload or request.response is None:  # a goodbye
            return
        topic = f"{request.response.removesuffix(f'/{self._robot}')}/{self._robot}"
        for line in self._answer_to(request.json):
            # This thread reads the acknowledgements, so it can't wait for one.
            self._client.publish(topic, json.dumps({"seq": request.json.get("seq"), **line}) + "\n", 1)
