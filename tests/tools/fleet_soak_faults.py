"""The faults of the fleet's soak, and the judge of what the desks were told.

The judge compares that with what the robot spoke, and with the results that reached the broker.
"""

from __future__ import annotations

import json
import threading
import time
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

from tests.support.mqtt import Listener
from tests.tools.fleet_soak_desks import UNSPOKEN
from tests.tools.soak_faults import FaultsInTurn

if TYPE_CHECKING:
    import random

    from tests.support.bridge import Bridge
    from tests.support.broker import Broker
    from tests.support.processes import Talk
    from tests.support.proxy import Direction, Proxy
    from tests.tools.fleet_soak_desks import Ledger
    from tests.tools.witness import Witness

_AWAY_S = (0.1, 3.0)
#: Within 6 s the robot accepts what was sent meanwhile, after that it is stale.
_HELD_S = ((1.0, 5.5), (8.0, 9.0))
_DIRECTIONS: tuple[tuple[Direction, ...], ...] = ((), ("to_client",), ("to_broker",))
#: Seconds in which a new bridge has asked its server for the goals that it knows.
_REMEMBERING_S = 6.0
#: Seconds after which everything that has happened was noted.
_DELAY_S = 1.0
#: Seconds under way after which a robot refuses a goal.
_STALE_S = 6.0


@dataclass(slots=True)
class Outages:
    """When each process was killed (wall clock)."""

    broker: list[float] = field(default_factory=list)
    server: list[float] = field(default_factory=list)
    bridge: list[float] = field(default_factory=list)

    def excuse_repeat(self, sent: float, first: float, second: float) -> bool:
        """Whether a goal may be spoken twice: both the server and the bridge that knew its id were killed."""
        servers = [each for each in self.server if first < each < second]
        bridges = [each for each in self.bridge if sent < each < second]
        return any(bridge > server - _REMEMBERING_S for server in servers for bridge in bridges)

    def excuse_lost(self, reached: float, ended: float) -> bool:
        """Whether a desk may miss a result: both the broker that had it and the server that could repeat it died."""
        died = any(reached - _DELAY_S < each < reached + _DELAY_S for each in self.broker)
        return died and any(reached - _DELAY_S < each < ended for each in self.server)


class Overheard:
    """Listens to all answers of the robot at the broker, on a new connection after each restart."""

    def __init__(self, broker: Broker) -> None:
        self._broker = broker
        self._lock = threading.Lock()
        self._results: dict[str, float] = {}
        self._seen = 0
        self._listener: Listener | None = None
        self.listen()

    def listen(self) -> None:
        self._listener, self._seen = Listener(self._broker, "talk/reply/#"), 0

    def close(self) -> None:
        if self._listener:
            self._listener.close()
        self.results()
        self._listener = None

    def results(self) -> dict[str, float]:
        """Return when the broker had the first result of each goal (wall clock)."""
        with self._lock:
            messages = self._listener.messages[self._seen :] if self._listener else []
            self._seen += len(messages)
            clock = time.time() - time.monotonic()
            for message in messages:
                for line in message.payload.splitlines():
                    if b'"result"' in line and (event := json.loads(line)).get("event") == "result":
                        self._results.setdefault(event["goal"]["id"], message.arrived + clock)
            return dict(self._results)


class FleetFaults(FaultsInTurn):
    """The faults of a robot at a broker."""

    def __init__(
        self, chance: random.Random, talk: Talk, broker: Broker, bridge: Bridge, proxy: Proxy, overheard: Overheard
    ) -> None:
        super().__init__(chance)
        self._talk, self._broker, self._bridge, self._proxy = talk, broker, bridge, proxy
        self._overheard = overheard
        self.outages = Outages()
        kinds = (self.broker_killed, self.bridge_killed, self.bridge_stopped, self.server_killed, self.link_held)
        self.kinds = {each.__name__: each for each in (*kinds, proxy.cut)}

    def broker_killed(self) -> None:
        self.outages.broker.append(time.time())
        self._broker.kill()
        self._overheard.close()
        time.sleep(self.chance.uniform(*_AWAY_S))
        self._broker.start()
        self._overheard.listen()

    def bridge_killed(self) -> None:
        self.outages.bridge.append(time.time())
        self._bridge.kill()
        time.sleep(self.chance.uniform(*_AWAY_S))
        self._bridge.start()

    def bridge_stopped(self) -> None:
        self._bridge.stop_process()
        time.sleep(self.chance.uniform(*self.chance.choice(_HELD_S)))
        self._bridge.resume_process()

    def server_killed(self) -> None:
        self.outages.server.append(time.time())
        self._talk.kill()
        time.sleep(self.chance.uniform(*_AWAY_S))
        self._talk.start_server()

    def link_held(self) -> None:
        self._proxy.hold(*self.chance.choice(_DIRECTIONS))
        time.sleep(self.chance.uniform(*self.chance.choice(_HELD_S)))
        self._proxy.release()


def judge(ledger: Ledger, witness: Witness, overheard: Overheard, outages: Outages) -> None:
    """Assert that nothing is wrong with the goals so far."""
    results = overheard.results()
    now = time.time()
    for goal in list(ledger.goals):
        begun = witness.begun(goal.text)
        told = f"{goal}, spoken at {begun}, {outages}"
        known = {how for how, at in goal.ends if at < now - _DELAY_S}
        all_known = all(at < now - _DELAY_S for _, at in goal.ends)
        repeats = all(outages.excuse_repeat(goal.sent_at[0], *each) for each in pairwise(begun))
        assert repeats, f"spoken {len(begun)} times: {told}"
        for at in begun:
            late = at - max((each for each in goal.sent_at if each < at), default=goal.sent_at[0])
            assert goal.ttl is None or late <= goal.ttl + _STALE_S, f"begun {late:.1f} s after it was sent: {told}"
        assert not (begun and known and known <= UNSPOKEN and all_known), (
            f"spoken, but its desk was not told so: {told}"
        )
        assert begun or not known & {"SUCCEEDED", "PREEMPTED"}, f"not spoken, but its desk was told so: {told}"
        reached = results.get(goal.id)
        for how, at in goal.ends if goal.once else ():
            lost = how == "LOST" and reached is not None and reached < at - _DELAY_S
            assert not lost or outages.excuse_lost(results[goal.id], at), f"LOST, but the broker had its result: {told}"
