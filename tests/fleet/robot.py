"""A robot of a fleet, with its server, bridge and broker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.support.bridge import desk
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from tests.support.bridge import Bridge
    from tests.support.broker import Broker
    from tests.support.mqtt import Message
    from tests.support.processes import Finished, Talk

#: A text that the scripted engine speaks until it is stopped.
LONG = "never-ends until it is stopped"


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot that is online."""

    talk: Talk
    broker: Broker
    bridge: Bridge

    @property
    def name(self) -> str:
        return self.bridge.name

    @property
    def presence(self) -> str:
        return f"talk/robot/{self.name}/presence"

    @property
    def spoken(self) -> list[str]:
        """The texts that the robot has started to speak since its server started."""
        return self.talk.watcher.texts("ACTIVE")

    def desk(self, *arguments: str, timeout: float = 20) -> Finished:
        """Run a command at a desk: `robot.desk("say", "--wait", "--", "battery low")`."""
        return desk(self.broker, self.name, *arguments, timeout=timeout)

    def listen(self, *topics: str) -> Listener:
        """Return a listener that has received the presence, and that also listens on `topics` of this robot."""
        listener = Listener(self.broker, self.presence, *(f"talk/robot/{self.name}/{topic}" for topic in topics))
        try:
            listener.await_message(self.is_online)
        except BaseException:
            listener.close()
            raise
        return listener

    def is_online(self, message: Message) -> bool:
        presence = self._presence_in(message)
        return bool(presence.get("online") and presence["server"])

    def has_current_server(self, message: Message) -> bool:
        """Return whether the robot is online with its current server process."""
        return self.is_online(message) and message.json["server"]["pid"] == self.talk.pid

    def is_offline(self, message: Message) -> bool:
        return self._presence_in(message).get("online") is False

    def is_without_server(self, message: Message) -> bool:
        presence = self._presence_in(message)
        return bool(presence.get("online") and presence["server"] is None)

    def _presence_in(self, message: Message) -> dict[str, object]:
        return message.json if message.topic == self.presence and message.payload else {}
