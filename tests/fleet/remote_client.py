"""A remote client that can send any request, and that records all lines it receives."""

from __future__ import annotations

import contextlib
import itertools
import json
import uuid
from typing import TYPE_CHECKING, Any

from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.broker import Broker
    from tests.support.connection import Message

#: The robot that gets the requests by default.
ANNA = "talk/robot/anna"


class RemoteClient(contextlib.AbstractContextManager["RemoteClient"]):
    """A user with one session. `listener` records all messages to it."""

    def __init__(self, broker: Broker, user: str = "bob", session: str = "", *, login: str | None = None) -> None:
        """`user` is the name in the topics, and `login` is the user name at a broker with passwords."""
        self._user = user
        self.response = f"talk/reply/{user}/{session or uuid.uuid4().hex}"
        self.listener = Listener(broker, f"{self.response}/#", user=login)
        self._numbers = itertools.count(1)

    def __exit__(self, *_error: object) -> None:
        self.listener.close()

    @property
    def lines(self) -> list[Message]:
        return [json.loads(line) for message in self.listener.messages for line in message.payload.splitlines()]

    def send(
        self, payload: object, *, to: str = ANNA, kind: str = "request", response: str | None = "", **more: Any
    ) -> None:
        """Publish an object, a text or bytes. `response` overrides the response topic; None omits it."""
        topic = self.response if response == "" else response
        data = payload if isinstance(payload, str | bytes) else json.dumps(payload, ensure_ascii=False)
        self.listener.publish(f"{to}/{kind}/{self._user}", data, response=topic, **more)

    def ask(self, request: str, *, to: str = ANNA, **fields: object) -> Message:
        """Send a request, and return the reply."""
        return self.reply(self.post(request, to=to, **fields))

    def post(self, request: str, *, to: str = ANNA, **fields: object) -> int:
        number = next(self._numbers)
        self.send({"seq": number, "request": request, **fields}, to=to)
        return number

    def say(self, text: str, **fields: Any) -> Message:
        """Send a goal, and return the accepted goal."""
        reply = self.ask("say", text=text, **fields)
        assert reply["ok"], reply
        goal: Message = reply["goal"]
        return goal

    def reply(self, number: int | None, within: float = PATIENCE) -> Message:
        return self.line(lambda line: line.get("seq") == number and "ok" in line, within)

    def result(self, goal_id: str, within: float = 20) -> Message:
        """Wait for the result of a goal, and return the goal."""

        def is_result(line: Message) -> bool:
            return bool(line.get("event") == "result" and line["goal"]["id"] == goal_id)

        goal: Message = self.line(is_result, within)["goal"]
        return goal

    def send_goodbye(self) -> None:
        self.send(b"")

    def line(self, matches: Callable[[Message], bool], within: float = PATIENCE) -> Message:
        """Return the first line that matches. It may have arrived before this call."""
        self.listener.find(lambda _: any(map(matches, self.lines)), within)
        found = list(filter(matches, self.lines))
        assert found, f"no such line within {within} s: {self.lines}"
        return found[0]
