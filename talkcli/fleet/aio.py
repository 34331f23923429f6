"""The fleet's Python interface for asyncio.

    from talkcli.aio import Fleet

    async for outcome in Fleet("mqtts://broker.example").say("@warehouse", "the shift is over"):
        print(outcome.robot, outcome.state)

The event loop watches the sockets of paho-mqtt. While a connection is being opened, it has a thread, because paho
blocks in this time.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from talkcli.aio.client import Client
from talkcli.aio.connection import LoopConnection, wait_ready
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.client.goal import end_time
from talkcli.fleet.api import FleetCalls
from talkcli.fleet.desk.request import Outcome, Selection
from talkcli.fleet.desk.robot import RobotConnection
from talkcli.fleet.desk.several import FleetRequestCalls
from talkcli.fleet.desk.watch import read_robots

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from talkcli.fleet.payloads import Presence
    from talkcli.protocol.requests import Request


class LoopRobotConnection(LoopConnection, RobotConnection):
    """A connection to a robot, for use in an asyncio event loop."""


class FleetRequest(FleetRequestCalls):
    """A request to several robots. Iterate over it to send it, and to receive the outcomes as they arrive.

    The request is sent when the iteration or an `async with` block begins. The connection to the broker is closed after
    the last outcome, by `close`, or at the end of the block. This doesn't cancel the request. Only one task may use
    this object.
    """

    async def __aenter__(self) -> FleetRequest:
        await self._start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def __aiter__(self) -> AsyncIterator[Outcome]:
        return self.results()

    async def results(self, timeout: float | None = None) -> AsyncIterator[Outcome]:
        """Yield the outcomes as they arrive. Raise TimeoutError if some are missing after `timeout` seconds."""
        end = end_time(timeout)
        while (outcome := await self._next_outcome(end, timeout)) is not None:
            yield outcome

    async def close(self) -> None:
        """Send all queued messages, and close the connection. This doesn't cancel the request."""
        await self._close()


class Fleet(FleetCalls[FleetRequest]):
    """All robots that are connected to the same broker.

    The methods and their arguments are those of the blocking fleet. Methods for several robots return a FleetRequest,
    which is sent when the iteration over its outcomes begins.
    """

    async def robots(self) -> list[Presence]:
        """Read the presence of all robots of the fleet, even offline ones, and return it sorted by name."""
        found = await read_robots(self._broker, ANSWER_LIMIT_S, with_status=False, wait=wait_ready)
        return [each.presence for each in found]

    def robot(self, name: str) -> Client:
        """Return a client of one robot, which connects when its `async with` block begins."""
        client = Client()
        client._open = partial(LoopRobotConnection.open, name, self._broker, name=self._name)
        return client

    def _create_request(self, to: str, request: Request) -> FleetRequest:
        """Create a request to the selected robots, without sending it."""
        return FleetRequest(self._broker, Selection(to), request, name=self._name, wait=wait_ready)
