"""The Python interface to a fleet of robots.

from talkcli import Fleet

fleet = Fleet("mqtts://broker.example")
for outcome in fleet.say("@warehouse", "the shift is over"):
    print(outcome.robot, outcome.state)
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Generic, TypeVar

from talkcli.client.client import Client
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.fleet.broker import URL, from_environment, require_paho
from talkcli.fleet.desk.request import Selection
from talkcli.goals.options import Cancel, Pause, Say, Set
from talkcli.polling import run_blocking
from talkcli.protocol.requests import Request, Resume, Status, Wait

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any

    from talkcli.fleet.desk.several import FleetRequest
    from talkcli.fleet.payloads import Presence


#: The class of a fleet's requests: either the blocking or the asyncio `FleetRequest`.
FleetRequestT = TypeVar("FleetRequestT")


class FleetCalls(Generic[FleetRequestT]):
    """The base class of fleets, with the methods that create requests."""

    def __init__(self, broker: str | None = None, *, name: str | None = None, insecure: bool = False) -> None:
        """Configure access to a fleet, without connecting to the broker.

        The login and the certificates come from the environment variables TALK_MQTT_*.

        Args:
            broker: the URL of the broker, mqtts://HOST or mqtt://HOST. The default is TALK_BROKER.
            name: the name of the sender. The default is TALK_NAME.
            insecure: whether a password may be sent to another machine without TLS.

        Raises:
            UsageError: A setting is wrong or missing, or paho-mqtt is not installed.
        """
        require_paho()
        environment = dict(os.environ) if broker is None else {**os.environ, URL: broker}
        self._broker = from_environment(environment, insecure=insecure)
        self._name = name

    def say(self, to: str, text: str, *, wait: bool = True, ttl: float | None = None, **options: Any) -> FleetRequestT:
        """Speak a text on each robot. Return the request, which yields the outcomes.

        The goal has the same id on all robots. To cancel it, call `cancel` on the returned FleetRequest. After the last
        outcome, call `Fleet.cancel` with the id instead.

        Args:
            to: the name of a robot, a pattern or a group.
            text: the text to speak.
            wait: whether to wait until each goal has ended. Otherwise, wait only until each robot has accepted it.
            ttl: the time in seconds within which each robot must start speaking, or 0 for no limit. The default is 10.
            options: other options of `Client.say`, except `follow`.
        """
        return self._create_request(to, Say(text, wait=wait, ttl=ttl, **options))

    def cancel(
        self,
        to: str,
        ids: Iterable[str] | None = None,
        *,
        current: bool = False,
        before: str | None = None,
        key: str | None = None,
    ) -> FleetRequestT:
        """Cancel some or all goals on each robot. Return the request.

        The request yields the outcomes. By default, all goals are cancelled. The other arguments are those of
        `Client.cancel`. The outcome of a robot arrives when the robot is silent.
        """
        return self._create_request(to, Cancel(None if ids is None else tuple(ids), current, before, key))

    def wait(self, to: str, ids: Iterable[str] | None = None) -> FleetRequestT:
        """Return a request that waits for some or all goals on each robot."""
        return self._create_request(to, Wait(None if ids is None else tuple(ids)))

    def status(self, to: str) -> FleetRequestT:
        """Request the status of each robot's server. Return the request.

        The request yields the outcomes. Each outcome contains the status as `said["status"]`.
        """
        return self._create_request(to, Status())

    def pause(self, to: str, seconds: float | None = None) -> FleetRequestT:
        """Pause speech on each robot, for `seconds` or until `resume` is called. Return the request.

        `seconds` is 0.1 to 86,400. If it is None, only `resume` ends the pause.
        """
        return self._create_request(to, Pause(seconds))

    def resume(self, to: str) -> FleetRequestT:
        """Resume paused speech on each robot. Return the request."""
        return self._create_request(to, Resume())

    def set(self, to: str, **settings: Any) -> FleetRequestT:
        """Change the settings of each robot's server. Return the request.

        The request yields the outcomes. If a robot's bridge doesn't allow this, its outcome is REFUSED. The arguments
        are those of `Client.set`.
        """
        return self._create_request(to, Set(**settings))

    def _create_request(self, to: str, request: Request) -> FleetRequestT:
        """Create a request to the selected robots. The blocking fleet also sends it."""
        raise NotImplementedError


class Fleet(FleetCalls["FleetRequest"]):
    """All robots that use the same broker.

    Most methods have an argument `to` that selects robots. It is the name of a robot, a pattern that matches names
    (`wh-*`), or a group (`@warehouse`). The group `@all` contains every robot.

    These methods return a FleetRequest. Iterate over it to receive the outcomes as they arrive. There is one for each
    robot, or one for each goal if the request affects several goals. If a robot is offline, its outcome has exit code
    3, and the robot doesn't receive the request later.

    Each request opens its own connection to the broker, and closes it after the last outcome. To close it earlier, use
    the FleetRequest in a `with` block or call its `close`. Always exhaust or close the FleetRequest, or the request may
    not be sent.

    Several threads may use the same Fleet. Only one thread may use a FleetRequest.
    """

    def robots(self) -> list[Presence]:
        """Read the presence of all robots of the fleet, even offline ones, and return it sorted by name.

        Raises:
            ServerUnavailable: The broker can't be reached.
            AccessDenied: The broker rejected the login, or its access rules don't allow the request.
        """
        from talkcli.fleet.desk.watch import read_robots

        robots = run_blocking(read_robots(self._broker, ANSWER_LIMIT_S, with_status=False))
        return [each.presence for each in robots]

    def robot(self, name: str) -> Client:
        """Connect to one robot. The returned client works like the client of a local server.

        Raises:
            ServerUnavailable: The broker can't be reached, or the robot is unknown, offline or without a server.
            AccessDenied: The broker rejected the login, or its access rules don't allow the request.
        """
        from talkcli.fleet.desk.robot import RobotConnection

        return Client.over(run_blocking(RobotConnection.open(name, self._broker, name=self._name)))

    def _create_request(self, to: str, request: Request) -> FleetRequest:
        """Create a request to the selected robots, and send it. Return the FleetRequest."""
        from talkcli.fleet.desk.several import FleetRequest

        return FleetRequest(self._broker, Selection(to), request, name=self._name)
