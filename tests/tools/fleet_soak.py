"""Random goals for a robot at a broker with a fault every few seconds, for as long as one likes.

    python -m tests.tools.fleet_soak --seconds 1800 [--seed N] [--every SECONDS]

Every goal must have one end at its desk. Nothing may be spoken twice, or long after its time, and no result that has
reached the broker may be lost. Bridge and server must not take more of the machine at the end than at the beginning.
An error raises an exception.
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
from tests.tools.fleet_soak_faults import FleetFaults, Overheard, judge
from tests.tools.soak import Report, assert_no_bug, parser
from tests.tools.witness import Witness

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.tools.soak_clients import Workers

ROBOT = "anna"
_WARM_UP_ENDS = 60
_WARM_UP_LIMIT_S = 120.0
_GROWTH_LIMIT_KB = {"server": 8 * 1024, "bridge": 4 * 1024}
#: Seconds in which a robot is back after the last fault, and in which it then speaks.
_BACK_LIMIT_S, _LAST_GOAL_LIMIT_S = 15.0, 5.0
#: Seconds in which a bridge forgets all desks after its link was cut.
_FORGET_LIMIT_S = 10.0
_JUDGE_EVERY_S = 30.0


class FleetSoak:
    """A robot at a broker, with a link that can be disturbed, desks and witnesses."""

    def __init__(self, seed: int, stack: contextlib.ExitStack) -> None:
        self._seed = seed
        self.ledger = Ledger()
        self._broker = stack.enter_context(Broker())
        self._proxy = stack.enter_context(Proxy(self._broker.port))
        self._talk = Talk(("--player", "null"), watched=False)
        stack.callback(self._talk.close)
        self._bridge = stack.enter_context(Bridge(self._talk, self._broker, ROBOT, port=self._proxy.port))
        self._bridge.await_online()
        self._witness = stack.enter_context(contextlib.closing(Witness(self._talk.socket, restarts=True)))
        self._overheard = stack.enter_context(contextlib.closing(Overheard(self._broker)))
        chance = random.Random(f"{seed} faults")
        self.faults = FleetFaults(chance, self._talk, self._broker, self._bridge, self._proxy, self._overheard)

    def run(self, seconds: float, every: float, warm_up: int) -> Report:
        self._speak()
        calm = self._count()
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
        took = self._speak()
        assert took <= _LAST_GOAL_LIMIT_S, f"the last goal took {took:.1f} s"
        for name, process in self._processes.items():
            least = calm[name].descriptors
            now = usage.wait_until(process.pid, lambda now, least=least: now.descriptors <= least, _FORGET_LIMIT_S)  # type: ignore[misc]
            assert now.descriptors <= least, f"the {name} has more than before: {usage.describe(process.pid)}"
        self._judge(warm)
        assert self._bridge.terminate() == 0, self._bridge.log[-2000:]
        self._talk.stop()
        assert_no_bug(self._talk.log, self._bridge.log)
        return Report(Counter({(how, None): count for how, count in self.ledger.ends.items()}), self.faults.done)

    @property
    def _processes(self) -> dict[str, Talk | Bridge]:
        return {"server": self._talk, "bridge": self._bridge}

    def _count(self) -> dict[str, usage.Usage]:
        return {name: usage.count(process.pid) for name, process in self._processes.items()}

    @contextlib.contextmanager
    def _desks(self, phase: str) -> Iterator[Workers]:
        """Have desks send goals, and wait for the end of each goal."""
        desks = Desks(ROBOT, self._broker, self.ledger, f"{self._seed} {phase}").workers
        try:
            yield desks
        finally:
            desks.stop(f"after {self.faults.done}, the last was {self.faults.last}")
        self._judge({})

    def _over(self, end: float, desks: Workers, warm: dict[str, usage.Usage]) -> Callable[[], bool]:
        """Return the check between two faults. Now and then it looks at everything."""
        due = time.monotonic() + _JUDGE_EVERY_S

        def over() -> bool:
            nonlocal due
            if time.monotonic() >= due:
                due += _JUDGE_EVERY_S
                self._judge(warm)
            return time.monotonic() >= end or bool(desks.failures)

        return over

    def _judge(self, warm: dict[str, usage.Usage]) -> None:
        judge(self.ledger, self._witness, self._overheard, self.faults.outages)
        assert not self._witness.faults, self._witness.faults
        for name, process in self._processes.items():
            assert process.running, f"the {name} has ended, after {self.faults.last}: {process.log[-3000:]}"
            limit = warm[name].memory + _GROWTH_LIMIT_KB[name] if warm else float("inf")
            assert (now := usage.count(process.pid)).memory <= limit, f"the {name} has grown: {now}, before {warm}"

    def _speak(self) -> float:
        """Send a goal from a desk of its own, and return the seconds that it took."""
        goal = self.ledger.new()
        began = time.monotonic()
        with Client.over(connect(self._broker, ROBOT, "calm")) as client:
            found = client.say(goal.text, id=goal.id, rate=RATE).wait(_BACK_LIMIT_S)
        self.ledger.end(goal, found.state.name)
        assert found.state is State.SUCCEEDED, f"{goal.id} is {found.state.name}: {found.message}"
        return time.monotonic() - began


def soak(seconds: float, seed: int, every: float = 10.0, warm_up: int = _WARM_UP_ENDS) -> Report:
    """Run a soak. `warm_up` is the number of ends before the first fault."""
    print(f"seed {seed}", flush=True)
    with contextlib.ExitStack() as stack:
        return FleetSoak(seed, stack).run(seconds, every, warm_up)


def main() -> None:
    asked = parser(every=10.0).parse_args()
    print(soak(asked.seconds, asked.seed, asked.every))


if __name__ == "__main__":
    main()
