"""The library for a fleet: list its robots, use one robot as a client, or send a request to several at once.

from talkcli import Fleet

fleet = Fleet("mqtts://broker.example")
for outcome in fleet.say("@warehouse", "the shift is over"):
    print(outcome.robot, outcome.state)
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from talkcli.client.client import Client
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.fleet.broker import URL, from_environment, require_paho
from talkcli.fleet.desk.request import Selection
from talkcli.goals.options import Cancel, Say, Set
from talkcli.protocol.requests import Pause, Resume, Status, Wait

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any

    from talkcli.fleet.desk.several import FleetRequest
    from talkcli.fleet.payloads import Presence
    from talkcli.protocol.requests import Request


class Fleet:
    """The robots that use one broker.

    The argument `to` of most methods selects robots. It is a robot's name, a glob that matches names (`wh-*`), or a
    group (`@warehouse`). The group `@all` contains every robot.

    These methods return a FleetRequest. Iterate over it to get the robots' outcomes as they come: one from each robot,
    or one for each goal if the request is about several. The outcome of an offline robot has exit code 3, and the
    request is not kept for it.

    Every request has its own connection to the broker, which ends with the last outcome. To end it earlier, use the
    FleetRequest in a `with` block or call its `close`. Always exhaust or close it, or the request may not be sent.

    Several threads may use the same Fleet. Only one thread may use a FleetRequest.
    """

    def __init__(self, broker: str | None = None, *, name: str | None = None, insecure: bool = False) -> None:
        """Read the settings. No connection is made yet.

        The login and the certificates come from the environment variables TALK_MQTT_*.

        Args:
            broker: URL of the broker, mqtts://HOST or mqtt://HOST; default TALK_BROKER.
            name: what the sender calls itself; default TALK_NAME.
            insecure: whether a password may be sent to another machine without TLS.

        Raises:
            UsageError: A setting is wrong or missing, or paho-mqtt is not installed.
        """
        require_paho()
        environment = dict(os.environ) if broker is None else {**os.environ, URL: broker}
        self._broker = from_environment(environment, insecure=insecure)
        self._name = name

    def robots(self) -> list[Presence]:
        """Return all robots that the broker knows, also those that are offline, sorted by name.

        Raises:
            ServerUnavailable: There is no broker.
            AccessDenied: The broker doesn't let this user log in, or ask.
        """
        from talkcli.fleet.desk.watch import read_robots

        return [each.presence for each in read_robots(self._broker, ANSWER_LIMIT_S, with_status=False)]

    def robot(self, name: str) -> Client:
        """Return a client of one robot's server, which is used like a client of a local server.

        Raises:
            ServerUnavailable: There is no broker or no such robot, or the robot is offline or has no server.
            AccessDenied: The broker doesn't let this user log in, or ask.
        """
        from talkcli.fleet.desk.robot import connect_robot

        return Client.over(connect_robot(name, self._broker, name=self._name))

    def say(self, to: str, text: str, *, wait: bool = True, ttl: float | None = None, **options: Any) -> FleetRequest:
        """Speak a text at each robot. All robots' goals have the same id.

        To cancel the goals, call `cancel` of the returned FleetRequest. After its last outcome, use `Fleet.cancel` with
        the id instead.

        Args:
            to: the robots.
            text: the text.
            wait: whether to wait for the end of each goal. Without it, outcomes tell whether the goal was accepted.
            ttl: seconds in which each robot must start to speak, 0 for no limit; default 10.
            options: the other options of `Client.say`, except `follow`.
        """
        return self._ask(to, Say(text, wait=wait, ttl=ttl, **options))

    def cancel(
        self,
        to: str,
        ids: Iterable[str] | None = None,
        *,
        current: bool = False,
        before: str | None = None,
        key: str | None = None,
    ) -> FleetRequest:
        """Cancel the goals that the arguments select, as in `Client.cancel`. Without arguments, cancel all goals.

        A robot's outcome comes when the robot is silent.
        """
        return self._ask(to, Cancel(None if ids is None else tuple(ids), current, before, key))

    def wait(self, to: str, ids: Iterable[str] | None = None) -> FleetRequest:
        """Wait until these goals have ended. Without ids, wait for all present goals."""
        return self._ask(to, Wait(None if ids is None else tuple(ids)))

    def status(self, to: str) -> FleetRequest:
        """Ask for the status of each robot's server. `said["status"]` of an outcome has all details."""
        return self._ask(to, Status())

    def pause(self, to: str) -> FleetRequest:
        """Hold speech until `resume`."""
        return self._ask(to, Pause())

    def resume(self, to: str) -> FleetRequest:
        """Continue held speech."""
        return self._ask(to, Resume())

    def set(self, to: str, **settings: Any) -> FleetRequest:
        """Change settings, as in `Client.set`, if the robots' bridges allow it."""
        return self._ask(to, Set(**settings))

    def _ask(self, to: str, request: Request) -> FleetRequest:
        from talkcli.fleet.desk.several import FleetRequest

        return FleetRequest(self._broker, Selection(to), request, name=self._name)
