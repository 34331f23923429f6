"""The askers of a robot without a broker: what comes is handed to them, and what they publish is kept."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from talkcli.fleet import policy, topics
from talkcli.fleet.message import Message
from tests.support.connection import PATIENCE
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.askers import Askers


class House:
    """The askers of anna, in the event loop that runs."""

    def __init__(self, socket: str, room: int = 200_000) -> None:
        """`socket`: the server's; `room`: bytes that the broker takes in one payload."""
        needs_packages("paho")
        from talkcli.fleet.askers import Askers

        #: what was published: the topic, and the lines
        self.published: list[tuple[str, list[dict[str, Any]]]] = []
        self._more = asyncio.Event()
        self._policy = policy.Policy("anna", policy.ASKABLE)
        self.askers: Askers = Askers("anna", socket, self._publish, lambda: room, lambda: None)

    def post(self, fields: object, session: str = "s1", *, correlation: bytes | None = None) -> None:
        """Have bob ask for something; bytes as they stand, and b"" is a goodbye."""
        payload = fields if isinstance(fields, bytes) else json.dumps(fields).encode()
        topic, response = "talk/robot/anna/request/bob", f"talk/reply/bob/{session}"
        asked = topics.asked(topic)
        assert asked
        message = Message(topic, payload, response=response, correlation=correlation)
        found = self._policy.judge(message, asked, self.askers.boottime(), stale=False)
        if isinstance(found, policy.HungUp):
            self.askers.hang_up(found.user, found.topic)
        else:
            assert isinstance(found, policy.Ask), found
            self.askers.ask(found)

    def lines(self, session: str = "s1") -> list[dict[str, Any]]:
        """Return all that one of bob's sessions was told so far."""
        return [each for topic, lines in self.published if topic == f"talk/reply/bob/{session}/anna" for each in lines]

    async def line(self, wanted: Callable[[dict[str, Any]], bool], session: str = "s1") -> dict[str, Any]:
        """Return the first line, of those that came and will, that is wanted."""

        async def find() -> dict[str, Any]:
            while True:
                for each in self.lines(session):
                    if wanted(each):
                        return each
                self._more.clear()
                await self._more.wait()

        try:
            return await asyncio.wait_for(find(), PATIENCE)
        except asyncio.TimeoutError:
            raise AssertionError(f"no such line within {PATIENCE} s: {self.published}") from None

    async def ask(self, fields: dict[str, Any], session: str = "s1") -> dict[str, Any]:
        """Have bob ask for something, and return the reply; `fields` has a number of its own."""
        self.post(fields, session)
        return await self.line(lambda each: each.get("seq") == fields["seq"] and "ok" in each, session)

    def _publish(self, topic: str, payload: bytes, _qos: int, _correlation: bytes | None) -> None:
        self.published.append((topic, [json.loads(each) for each in payload.splitlines()]))
        self._more.set()
