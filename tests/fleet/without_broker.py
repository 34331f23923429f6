"""A robot's sessions without a broker. The test submits requests and inspects what is published."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from talkcli.fleet import topics
from talkcli.fleet.bridge import policy
from talkcli.fleet.payloads import Message
from tests.support.connection import PATIENCE
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.bridge.session import RemoteSessions
    from talkcli.goals.goal import Goal


class SessionsWithoutBroker:
    """The sessions of the robot anna, in the running event loop."""

    def __init__(self, socket: str, room: int = 200_000) -> None:
        """`socket` is the path of the server's socket, and `room` the size of the largest payload in bytes."""
        needs_packages("paho")
        from talkcli.fleet.bridge.session import RemoteSessions
        from talkcli.fleet.link import boottime

        #: the topic and the lines of each published message
        self.published: list[tuple[str, list[dict[str, Any]]]] = []
        #: goals that ended without being sent to the server
        self.ended: list[Goal] = []
        self._more = asyncio.Event()
        self._boottime = boottime
        self._policy = policy.Policy("anna", policy.ALLOWABLE_REQUESTS)
        self.sessions: RemoteSessions = RemoteSessions(
            "anna",
            socket,
            self._publish,
            lambda: room,
            lambda: None,
            lambda: "token",
            self.ended.append,
        )

    def post(self, fields: object, session: str = "s1", *, correlation: bytes | None = None) -> None:
        """Send an object or bytes as a request. An empty payload is a goodbye.

        The user is bob, unless the session is called USER/SESSION.
        """
        payload = fields if isinstance(fields, bytes) else json.dumps(fields).encode()
        full_name = _full_name(session)
        topic = f"talk/robot/anna/request/{full_name.partition('/')[0]}"
        parsed = topics.parse_request_topic(topic)
        assert parsed
        message = Message(topic, payload, response=f"talk/reply/{full_name}", correlation=correlation)
        now = self._policy.newest_echo_at = self._boottime()
        decision = self._policy.decide(message, *parsed, now)
        if isinstance(decision, policy.Goodbye):
            self.sessions.handle_goodbye(decision.user, decision.reply_topic)
        else:
            assert isinstance(decision, policy.RemoteRequest), decision
            self.sessions.submit(decision)

    def lines(self, session: str = "s1") -> list[dict[str, Any]]:
        wanted = f"talk/reply/{_full_name(session)}/anna"
        return [line for topic, lines in self.published if topic == wanted for line in lines]

    async def line(self, wanted: Callable[[dict[str, Any]], bool], session: str = "s1") -> dict[str, Any]:
        """Return the first line that matches. It may have been published before this call."""

        async def find() -> dict[str, Any]:
            while not (matches := list(filter(wanted, self.lines(session)))):
                self._more.clear()
                await self._more.wait()
            return matches[0]

        try:
            return await asyncio.wait_for(find(), PATIENCE)
        except asyncio.TimeoutError:
            raise AssertionError(f"no such line within {PATIENCE} s: {self.published}") from None

    async def ask(self, fields: dict[str, Any], session: str = "s1") -> dict[str, Any]:
        """Send a request, and return the reply."""
        self.post(fields, session)
        return await self.line(lambda line: line.get("seq") == fields["seq"] and "ok" in line, session)

    def _publish(self, message: Message, _qos: int) -> None:
        self.published.append((message.topic, [json.loads(line) for line in message.payload.splitlines()]))
        self._more.set()


def _full_name(session: str) -> str:
    """Return the user and the session. The user is bob by default."""
    return session if "/" in session else f"bob/{session}"
