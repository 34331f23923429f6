"""Who asks robots by the broker without talk's own desk: requests as they stand, and every line that answers them."""

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

#: The robot that is asked where no other is named.
ANNA = "talk/robot/anna"


class Asker(contextlib.AbstractContextManager["Asker"]):
    """A user with one session. `listener` has all that came to it, as it came."""

    def __init__(
        self, broker: Broker, user: str = "bob", session: str = "", *, login: str | None = None, **more: Any
    ) -> None:
        """`user`: who asks, by the topics; `login`: who logs in at the broker, if anybody has to.

        `session`: one of its own, where none is named.
        """
        self._user = user
        self.response = f"talk/reply/{user}/{session or uuid.uuid4().hex}"
        self.listener = Listener(broker, f"{self.response}/#", user=login, **more)
        self._numbers = itertools.count(1)

    def __exit__(self, *_error: object) -> None:
        self.listener.close()

    @property
    def lines(self) -> list[Message]:
        """All lines that came so far, in their order."""
        return [json.loads(line) for each in self.listener.messages for line in each.payload.splitlines()]

    def send(
        self, payload: object, *, to: str = ANNA, kind: str = "request", response: str | None = "", **more: Any
    ) -> None:
        """Publish a payload as it stands, or an object; `response`: another topic, None for none."""
        where = self.response if response == "" else response
        data = payload if isinstance(payload, str | bytes) else json.dumps(payload, ensure_ascii=False)
        self.listener.publish(f"{to}/{kind}/{self._user}", data, response=where, **more)

    def ask(self, request: str, *, to: str = ANNA, **fields: object) -> Message:
        """Ask for something, and return the reply."""
        return self.reply(self.post(request, to=to, **fields))

    def post(self, request: str, *, to: str = ANNA, **fields: object) -> int:
        """Ask for something, and return the number of the request."""
        number = next(self._numbers)
        self.send({"seq": number, "request": request, **fields}, to=to)
        return number

    def say(self, text: str, **fields: Any) -> Message:
        """Have a sentence said, and return the goal as it was accepted."""
        reply = self.ask("say", text=text, **fields)
        assert reply["ok"], reply
        goal: Message = reply["goal"]
        return goal

    def reply(self, number: int | None, within: float = PATIENCE) -> Message:
        """Return the reply to a request, by its number."""
        return self.line(lambda each: each.get("seq") == number and "ok" in each, within)

    def result(self, goal_id: str, within: float = 20) -> Message:
        """Return a goal, once it has ended."""
        goal: Message = self.line(lambda each: _is_result(each, goal_id), within)["goal"]
        return goal

    def hang_up(self) -> None:
        """Say goodbye to the robot."""
        self.send(b"")

    def line(self, wanted: Callable[[Message], bool], within: float = PATIENCE) -> Message:
        """Return the first line, of those that came and will, that is wanted."""
        found: list[Message] = []

        def come(_: object) -> bool:
            found[:] = filter(wanted, self.lines)
            return bool(found)

        self.listener.find(come, within)
        assert found or come(None), f"no such line within {within} s: {self.lines}"
        return found[0]


def _is_result(line: Message, goal_id: str) -> bool:
    return bool(line.get("event") == "result" and line["goal"]["id"] == goal_id)
