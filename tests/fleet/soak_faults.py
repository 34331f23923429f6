"""The faults of a fleet's soak: one after the other, of every kind in turn, each with what brings the world back."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

from tests.faults.soak_faults import in_turn
from tests.fleet.soak_witness import Outages

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from tests.fleet.soak_witness import Overheard
    from tests.support.bridge import Bridge
    from tests.support.broker import Broker
    from tests.support.processes import Talk
    from tests.support.proxy import Proxy, Way

#: Seconds for which who was killed is away, and for which one is stopped, or its link held: within 6 what is sent
#: meanwhile is taken then, and later on it is stale.
_AWAY, _HELD = (0.1, 3.0), ((1.0, 5.5), (8.0, 9.0))
_WAYS: tuple[tuple[Way, ...], ...] = ((), ("to_client",), ("to_broker",))


class Faults:
    """Injects a fault every few seconds, in the thread that calls: what it starts would end with any other."""

    def __init__(
        self,
        talk: Talk,
        broker: Broker,
        bridge: Bridge,
        proxy: Proxy,
        overheard: Overheard,
        chance: random.Random,
        every: float,
    ) -> None:
        self._talk, self._broker, self._bridge, self._proxy = talk, broker, bridge, proxy
        self._overheard = overheard
        self._chance = chance
        self._every = every
        #: how many of each kind there were
        self.done: Counter[str] = Counter()
        #: the last fault, for messages
        self.last = "none"
        self.outages = Outages()
        self._kinds: list[Callable[[], None]] = [
            self.broker_killed,
            self.bridge_killed,
            self.bridge_stopped,
            self.server_killed,
            self.link_held,
            self.link_cut,
        ]

    def run(self, seconds: float, enough: Callable[[], bool]) -> None:
        """Inject faults for so long, or until it is enough."""
        end = time.monotonic() + seconds
        for kind in in_turn(self._kinds, self._chance, self._every, lambda: enough() or time.monotonic() >= end):
            self.last = kind.__name__
            kind()
            self.done[kind.__name__] += 1

    def broker_killed(self) -> None:
        self.outages.broker.append(time.time())
        self._broker.kill()
        self._overheard.close()
        time.sleep(self._chance.uniform(*_AWAY))
        self._broker.start()
        self._overheard.listen()

    def bridge_killed(self) -> None:
        self.outages.bridge.append(time.time())
        self._bridge.kill()
        time.sleep(self._chance.uniform(*_AWAY))
        self._bridge.start()

    def bridge_stopped(self) -> None:
        self._bridge.stop_process()
        time.sleep(self._chance.uniform(*self._chance.choice(_HELD)))
        self._bridge.go_on()

    def server_killed(self) -> None:
        self.outages.server.append(time.time())
        self._talk.kill()
        time.sleep(self._chance.uniform(*_AWAY))
        self._talk.start_server()

    def link_held(self) -> None:
        self._proxy.hold(*self._chance.choice(_WAYS))
        time.sleep(self._chance.uniform(*self._chance.choice(_HELD)))
        self._proxy.release()

    def link_cut(self) -> None:
        self._proxy.cut()
