"""Soak test of a robot with a broker: random goals and growing texts, and a fault every few seconds.

    python -m tests.tools.fleet_soak --seconds 1800 [--seed N] [--every SECONDS]

Each goal must have exactly one end at its desk, and no goal may be spoken twice or too late. At the end, bridge and
server must not use more resources than at the beginning. An error raises an exception.
"""

from __future__ import annotations

import contextlib
import random
import time
from collections import Counter
from typing import TYPE_CHECKING

from talkcli import Client
from talkcli.goals.states import State
from tests.support import usage
from tests.support.bridge import Bridge
from tests.support.broker import Broker
from tests.support.processes import Talk
from tests.support.proxy import Proxy
from tests.tools.fleet_soak_desks import RATE, Desks, Ledger, connect
from tests.tools.fleet_soak_faults import FleetFaults, check_goals
from tests.tools.goal_monitor import GoalMonitor
from tests.tools.soak import Report, assert_no_bug, parser

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.tools.soak_clients import Workers

ROBOT = "anna"
_WARM_UP_ENDS = 60
_WARM_UP_LIMIT_S = 120.0
_GROWTH_LIMIT_KB = {"server": 8 * 1024, "bridge": 4 * 1024}
#: Time limits until a robot is online again after the last fault, and for its next goal.
_BACK_LIMIT_S, _LAST_GOAL_LIMIT_S = 15.0, 5.0
#: Time limit until a bridge forgets all desks after a lost connection.
_FORGET_LIMIT_S = 10.0
_CHECK_INTERVAL_S = 30.0


class FleetSoak:
    """A robot whose connection to its broker can be disturbed, with desks and monitors."""

    def __init__(self, seed: int, stack: contextlib.ExitStack) -> None:
        self._seed = seed
        self.ledger = Ledger()
        self._broker = stack.enter_context(Broker())
        self._proxy = stack.enter_context(Proxy(self._broker.port))
        self._talk = Talk(("--player", "null"), watched=False)
        stack.callback(self._talk.close)
        self._bridge = stack.enter_context(Bridge(self._talk, self._broker, ROBOT, port=self._proxy.port))
        self._bridge.await_online()
        self._monitor = stack.enter_context(contextlib.closing(GoalMonitor(self._talk.socket, restarts=True)))
        rng = random.Random(f"{seed} faults")
        self.faults = FleetFaults(rng, self._talk, self._broker, self._bridge, self._proxy)

    def run(self, seconds: float, every: float, warm_up: int) -> Report:
        self._speak()
        idle = self._count()
        with self._desks("warm-up") as desks:
            end = time.monotonic() + _WARM_UP_LIMIT_S
            while self.ledger.ends.total() < warm_up and not desks.failures:
                assert time.monotonic() < end, f"only {self.ledger.ends} in the warm-up"
                time.sleep(0.1)
        warm = self._count()
        with self._desks("") as desks:
            self.faults.run(every, self._over(time.monotonic() + seconds, desks, warm))
        self._proxy.cut()
        self._bridge.await_online(_BACK_LIMIT_S)
        seconds = self._speak()
        assert seconds <= _LAST_GOAL_LIMIT_S, f"the last goal took {seconds:.1f} s"
        for name, process in self._processes.items():
            limit = idle[name].descriptors
            now = usage.wait_until(process.pid, lambda now, limit=limit: now.descriptors <= limit, _FORGET_LIMIT_S)  # type: ignore[misc]
            assert now.descriptors <= limit, f"the {name} has too many descriptors: {usage.describe(process.pid)}"
        self._check(warm)
        assert self._bridge.terminate() == 0, self._bridge.log[-2000:]
        self._talk.stop()
        assert_no_bug(self._talk.log, self._bridge.log)
        return Report(Counter({(end, None): count for end, count in self.ledger.ends.items()}), self.faults.done)

    @property
    def _processes(self) -> dict[str, Talk | Bridge]:
        return {"server": self._talk, "bridge": self._bridge}

    def _count(self) -> dict[str, usage.Usage]:
        return {name: usage.count(process.pid) for name, process in self._processes.items()}

    @contextlib.contextmanager
    def _desks(self, phase: str) -> Iterator[Workers]:
        """Let desks send goals during the block, and check all goals at its end."""
        desks = Desks(ROBOT, self._broker, self.ledger, f"{self._seed} {phase}").workers
        try:
            yield desks
        finally:
            desks.stop(f"after {self.faults.done}; last fault: {self.faults.last}")
        self._check({})

    def _over(self, end: float, desks: Workers, warm: dict[str, usage.Usage]) -> Callable[[], bool]:
        """Return the function that is called between two faults. It also checks all goals from time to time."""
        due = time.monotonic() + _CHECK_INTERVAL_S

        def over() -> bool:
            nonlocal due
            if time.monotonic() >= due:
                due += _CHECK_INTERVAL_S
                self._check(warm)
            return time.monotonic() >= end or bool(desks.failures)

        return over

    def _check(self, warm: dict[str, usage.Usage]) -> None:
        check_goals(self.ledger, self._monitor, self.faults.outages)
        assert not self._monitor.faults, self._monitor.faults
        for name, process in self._processes.items():
            assert process.running, f"the {name} has ended after {self.faults.last}: {process.log[-3000:]}"
            limit = warm[name].memory + _GROWTH_LIMIT_KB[name] if warm else float("inf")
            assert (now := usage.count(process.pid)).memory <= limit, (
                f"the {name} uses too much memory: {now}, before {warm}"
            )

    def _speak(self) -> float:
        """Send a goal from a new desk, and return the seconds until its end."""
        goal = self.ledger.new()
        started_at = time.monotonic()
        with Client.over(connect(self._broker, ROBOT, "check")) as client:
            ended = client.say(goal.text, id=goal.id, rate=RATE).wait(_BACK_LIMIT_S)
        self.ledger.end(goal, ended.state.name)
        assert ended.state is State.SUCCEEDED, f"{goal.id} is {ended.state.name}: {ended.message}"
        return time.monotonic() - started_at


def soak(seconds: float, seed: int, every: float = 10.0, warm_up: int = _WARM_UP_ENDS) -> Report:
    """Run a soak test. `warm_up` is the number of goals that end before the first fault."""
    print(f"seed {seed}", flush=True)
    with contextlib.ExitStack() as stack:
        return FleetSoak(seed, stack).run(seconds, every, warm_up)


def main() -> None:
    options = parser(every=10.0).parse_args()
    print(soak(options.seconds, options.seed, options.every))


if __name__ == "__main__":
    main()
