"""The library for a fleet: who is there, one robot as a client, several at once.

from talkcli import Fleet

fleet = Fleet("mqtts://broker.example")
for each in fleet.say("@warehouse", "the shift is over"):
    print(each.robot, each.state)
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from talkcli.client.client import Client
from talkcli.client.connect import ANSWER_LIMIT
from talkcli.fleet.broker import URL, from_environment, need_client
from talkcli.fleet.desk.selection import Selection
from talkcli.goals.options import Cancel, Say, Set
from talkcli.protocol.requests import Pause, Resume, Status, Wait

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any

    from talkcli.fleet.desk.crowd import Round
    from talkcli.fleet.presence import Presence
    from talkcli.protocol.requests import Request


class Fleet:
    """The robots of a broker.

    Whom a method means, its `to`, is a robot's name, a glob over the names of those that are there (`wh-*`), or a
    group, `@warehouse`; `@all` is everybody. What it returns is iterated over: an Outcome for each robot as it comes,
    or for each goal of its that this is about. A robot that is offline is among them, with exit code 3: nothing is
    kept for it.

    Each call has a connection of its own, which ends with its last outcome, with `with`, or by `close` of what was
    returned. One of these it needs: what is dropped without may never reach a robot. One thread uses what was returned;
    several may use the fleet.
    """

    def __init__(self, broker: str | None = None, *, name: str | None = None, insecure: bool = False) -> None:
        """`broker`: its URL, mqtts://HOST or mqtt://HOST, default TALK_BROKER; who logs in there, and by which
        certificates, the variables beside that one say. `name`: what the sender calls itself, default TALK_NAME;
        `insecure`: whether a password may go to another machine without TLS. Nothing is connected yet.

        UsageError if a setting is wrong or missing, or if paho-mqtt is not installed.
        """
        need_client()
        environment = dict(os.environ) if broker is None else {**os.environ, URL: broker}
        self._broker = from_environment(environment, insecure=insecure)
        self._name = name

    def robots(self) -> list[Presence]:
        """Return all robots that the broker knows, by name, those among them that are offline.

        ServerUnavailable where there is no broker, AccessDenied where it doesn't let this user in, or ask.
        """
        from talkcli.fleet.desk.roster import roster

        return sorted(roster(self._broker, ANSWER_LIMIT).values(), key=lambda each: each.name)

    def robot(self, name: str) -> Client:
        """Return a client of this robot's server, as one of a server on this machine.

        ServerUnavailable where there is no broker, no such robot, or that has no server; AccessDenied as of `robots`.
        """
        from talkcli.fleet.desk.robot import reach

        return Client.over(reach(name, self._broker, name=self._name))

    def say(self, to: str, text: str, *, wait: bool = True, ttl: float | None = None, **options: Any) -> Round:
        """Have them speak: one goal at each, all with one id. The options are those of `Client.say`, but `follow`.

        `wait`: an outcome is how the goal ended, else how it was accepted; `ttl`: seconds in which it must have begun
        on each, None is 10, 0 is no limit. `cancel` of what is returned cancels it wherever it has not ended, until the
        last outcome was taken; then `Fleet.cancel` does, by the goal's id.
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
    ) -> Round:
        """Cancel what these select, as of `Client.cancel`, or everything; an outcome comes once the robot is silent."""
        return self._ask(to, Cancel(None if ids is None else tuple(ids), current, before, key))

    def wait(self, to: str, ids: Iterable[str] | None = None) -> Round:
        """Wait until these goals have ended, or all that have not."""
        return self._ask(to, Wait(None if ids is None else tuple(ids)))

    def status(self, to: str) -> Round:
        """Ask how each stands: `said["status"]` of an outcome has all of it."""
        return self._ask(to, Status())

    def pause(self, to: str) -> Round:
        """Hold speech, until `resume`."""
        return self._ask(to, Pause())

    def resume(self, to: str) -> Round:
        """Go on where speech was held."""
        return self._ask(to, Resume())

    def set(self, to: str, **settings: Any) -> Round:
        """Change settings, those of `Client.set`, where the robots' bridges allow it."""
        return self._ask(to, Set(**settings))

    def _ask(self, to: str, request: Request) -> Round:
        from talkcli.fleet.desk.crowd import Crowd

        crowd = Crowd(self._broker, Selection(to), name=self._name)
        try:
            return crowd.ask(request)
        except BaseException:
            crowd.close()
            raise
