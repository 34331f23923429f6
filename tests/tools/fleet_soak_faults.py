"""The faults of the fleet's soak test, and the check of its goals.

The check compares the ends that the desks received with what the robot spoke.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

from tests.tools.fleet_soak_desks import UNSPOKEN
from tests.tools.soak_faults import FaultInjector

if TYPE_CHECKING:
    import random

    from tests.support.bridge import Bridge
    from tests.support.broker import Broker
    from tests.support.processes import Talk
    from tests.support.proxy import Direction, Proxy
    from tests.tools.fleet_soak_desks import Ledger
    from tests.tools.goal_monitor import GoalMonitor

_AWAY_S = (0.1, 3.0)
#: Shorter and longer than the 6 s after which a robot refuses requests as stale.
_STALLED_S = ((1.0, 5.5), (8.0, 9.0))
_DIRECTIONS: tuple[tuple[Direction, ...], ...] = ((), ("to_client",), ("to_broker",))
#: Time in which a new bridge gets the goals that its server knows.
_RELOAD_S = 6.0
#: Time after which all events have been recorded.
_DELAY_S = 1.0
#: Age from which a robot refuses a goal.
_STALE_S = 6.0


@dataclass(slots=True)
class Outages:
    """The times at which each process was killed (Unix times)."""

    server: list[float] = field(default_factory=list)
    bridge: list[float] = field(default_factory=list)

    def excuse_repeat(self, sent: float, first: float, second: float) -> bool:
        """Whether a goal may be spoken twice, because the server and the bridge that knew its id were both killed."""
        servers = [killed for killed in self.server if first < killed < second]
        bridges = [killed for killed in self.bridge if sent < killed < second]
        return any(bridge > server - _RELOAD_S for server in servers for bridge in bridges)


class FleetFaults(FaultInjector):
    def __init__(self, rng: random.Random, talk: Talk, broker: Broker, bridge: Bridge, proxy: Proxy) -> None:
        super().__init__(rng)
        self._talk, self._broker, self._bridge, self._proxy = talk, broker, bridge, proxy
        self.outages = Outages()
        killed = (self.broker_killed, self.bridge_killed, self.server_killed)
        self.kinds = {
            kind.__name__: kind for kind in (*killed, self.bridge_stopped, self.connection_stalled, proxy.cut)
        }

    def broker_killed(self) -> None:
        self._broker.kill()
        time.sleep(self.rng.uniform(*_AWAY_S))
        self._broker.start()

    def bridge_killed(self) -> None:
        self.outages.bridge.append(time.time())
        self._bridge.kill()
        time.sleep(self.rng.uniform(*_AWAY_S))
        self._bridge.start()

    def bridge_stopped(self) -> None:
        self._bridge.stop_process()
        time.sleep(self.rng.uniform(*self.rng.choice(_STALLED_S)))
        self._bridge.resume_process()

    def server_killed(self) -> None:
        self.outages.server.append(time.time())
        self._talk.kill()
        time.sleep(self.rng.uniform(*_AWAY_S))
        self._talk.start_server()

    def connection_stalled(self) -> None:
        self._proxy.hold(*self.rng.choice(_DIRECTIONS))
        time.sleep(self.rng.uniform(*self.rng.choice(_STALLED_S)))
        self._proxy.release()


def check_goals(ledger: Ledger, monitor: GoalMonitor, outages: Outages) -> None:
    """Assert that all goals so far were spoken and ended correctly."""
    now = time.time()
    for goal in list(ledger.goals):
        starts = monitor.starts(goal.text)
        details = f"{goal}, spoken at {starts}, {outages}"
        known = {end for end, at in goal.ends if at < now - _DELAY_S}
        all_known = all(at < now - _DELAY_S for _, at in goal.ends)
        repeats = all(outages.excuse_repeat(goal.sent_at[0], *pair) for pair in pairwise(starts))
        assert repeats, f"spoken {len(starts)} times: {details}"
        for at in starts:
            age = at - max((sent for sent in goal.sent_at if sent < at), default=goal.sent_at[0])
            assert goal.ttl is None or age <= goal.ttl + _STALE_S, f"spoken {age:.1f} s after it was sent: {details}"
        unspoken = known and known <= UNSPOKEN and all_known
        assert not (starts and unspoken), f"spoken, but reported as not spoken: {details}"
        assert starts or not known & {"SUCCEEDED", "PREEMPTED"}, f"not spoken, but reported as spoken: {details}"
