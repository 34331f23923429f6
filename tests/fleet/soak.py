"""A soak of a robot over a broker: random goals from several desks, a fault every few seconds, as long as one likes.

    python -m tests.fleet.soak --seconds 1800 [--seed N] [--every SECONDS]

Every goal has one end at its desk, nothing is spoken twice or long after its time, no result that reached the broker
is lost to one who waits for it, and bridge and server have nothing more at the end than at the beginning. What they
take is counted from outside; every random choice comes from the seed.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from talkcli import Client
from talkcli.fleet.broker import from_environment
from talkcli.fleet.robot import reach
from talkcli.goals.states import State
from tests.fleet.soak_desks import RATE, Desks, Ledger
from tests.fleet.soak_faults import Faults
from tests.fleet.soak_witness import Overheard, Witness, judge
from tests.support import census
from tests.support.bridge import Bridge
from tests.support.broker import Broker
from tests.support.processes import Talk
from tests.support.proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Callable

ROBOT = "anna"
#: Ends that desks have been told before the first count: everything was used once.
WARM_UP = 60
#: Seconds for that.
_WARM_UP_LIMIT = 120.0
#: kB that the server with its engine, and the bridge, may have grown by.
GROWN = {"server": 8 * 1024, "bridge": 4 * 1024}
#: Seconds in which a robot is back after the last fault, and in which a goal then goes through.
BACK, AT_ONCE = 15.0, 5.0
#: Seconds in which a bridge has let go of all desks, those that were killed too, once its line is cut; they would be
#: missed 90 s after their last word.
_LET_GO = 10.0
#: Seconds between two lines about how it goes.
_NEWS = 30.0


@dataclass(slots=True)
class Report:
    """What a soak did and found."""

    seed: int
    seconds: float
    ledger: Ledger = field(default_factory=Ledger)
    faults: Counter[str] = field(default_factory=Counter)
    spoken: Counter[str] = field(default_factory=Counter)
    #: by "server" and "bridge"
    before: dict[str, census.Census] = field(default_factory=dict)
    after: dict[str, census.Census] = field(default_factory=dict)
    #: seconds that the last goal took
    last: float | None = None
    failures: list[str] = field(default_factory=list)

    @property
    def news(self) -> str:
        """How it goes, in a line."""
        goals, ends = len(self.ledger.all()), _told(self.ledger.ends)
        return f"{goals} goals: {ends}; {self.faults.total()} faults; {len(self.failures)} failures"

    def __str__(self) -> str:
        ledger = self.ledger
        took = [f"the last goal took {self.last:.1f} s"] if self.last is not None else []
        return "\n".join(
            (
                f"seed {self.seed}, {self.seconds:.0f} s, {len(ledger.all())} goals",
                f"at the desks: {_told(ledger.ends)}; {ledger.turned_away} times no robot, {ledger.killed} were killed",
                f"at the robot: {_told(self.spoken)}",
                f"{self.faults.total()} faults: {_told(self.faults)}",
                *(f"{name} before: {each}" for name, each in self.before.items()),
                *(f"{name} after:  {each}" for name, each in self.after.items()),
                *took,
                *(f"FAILED: {each}" for each in self.failures),
            )
        )


class Soak:
    """A robot at a broker, by a link that can be disturbed, its desks, and who watches them."""

    def __init__(self, report: Report, every: float, stack: contextlib.ExitStack) -> None:
        self.report = report
        self._every = every
        self._broker = stack.enter_context(Broker())
        self._proxy = stack.enter_context(Proxy(self._broker.port))
        self._talk = Talk(("--player", "null"), watched=False)
        stack.callback(self._talk.close)
        self._bridge = stack.enter_context(Bridge(self._talk, self._broker, ROBOT, port=self._proxy.port))
        self._bridge.await_online()
        self._witness = stack.enter_context(contextlib.closing(Witness(self._talk.socket)))
        self._overheard = stack.enter_context(contextlib.closing(Overheard(self._broker)))
        chance = random.Random(f"{report.seed} faults")
        self._faults = Faults(self._talk, self._broker, self._bridge, self._proxy, self._overheard, chance, self._every)
        report.faults, report.spoken = self._faults.done, self._witness.ends

    def run(self, warm_up: int) -> None:
        """Do all of it."""
        self._speak()
        calm = self._count()
        self._desks("warm-up", lambda over: self._await_ends(warm_up, over))
        warm = self._count()
        self.report.before = {
            name: census.Census(each.processes, calm[name].descriptors, each.threads, each.memory)
            for name, each in warm.items()
        }
        self._desks("", lambda over: self._faults.run(self.report.seconds, self._watched(over)))
        self._settle()

    def _desks(self, which: str, disturb: Callable[[Callable[[], bool]], None]) -> None:
        """Have desks at work while something is done to them, and wait for the last end of each."""
        seed = self.report.seed
        desks = Desks(ROBOT, self._broker, self.report.ledger, lambda name: random.Random(f"{seed} {which} {name}"))
        try:
            disturb(lambda: bool(desks.failures))
        finally:
            desks.stop()
            self.report.failures += desks.failures
            self._judge()

    def _await_ends(self, count: int, over: Callable[[], bool]) -> None:
        end = time.monotonic() + _WARM_UP_LIMIT
        while self.report.ledger.ended < count and not over():
            assert time.monotonic() < end, f"{self.report.ledger.ended} ends in {_WARM_UP_LIMIT:g} s of the warm-up"
            time.sleep(0.1)

    def _watched(self, over: Callable[[], bool]) -> Callable[[], bool]:
        """Return what tells, between two faults, whether it is enough; now and then it looks at everything."""
        due = time.monotonic() + _NEWS

        def enough() -> bool:
            nonlocal due
            if time.monotonic() >= due:
                due = time.monotonic() + _NEWS
                self._judge()
                print(self.report.news, file=sys.stderr, flush=True)
            found = self.report.failures or over() or self._witness.failures
            return bool(found) or not (self._talk.running and self._bridge.running)

        return enough

    def _judge(self) -> None:
        found = judge(self.report.ledger, self._witness, self._overheard, self._faults.outages)
        found += self._witness.failures
        for name, pid in self._pids().items():
            before, ended = self.report.before.get(name), not _exists(pid)
            if ended:
                found.append(f"the {name} has ended, after {self._faults.last}")
            elif before and (now := census.count(pid)).memory > before.memory + GROWN[name]:
                found.append(f"the {name} has grown: before {before}, now {now}")
        self.report.failures += [each for each in found if each not in self.report.failures]

    def _settle(self) -> None:
        """Wait until all is as it was before the first fault."""
        self._proxy.cut()
        self._bridge.await_online(BACK)
        self.report.last = self._speak()
        if self.report.last > AT_ONCE:
            self.report.failures.append(f"the last goal took {self.report.last:.1f} s")
        for name, pid in self._pids().items():
            before = self.report.before[name]
            now = self.report.after[name] = _settled(pid, before.descriptors)
            if now.descriptors > before.descriptors or now.memory > before.memory + GROWN[name]:
                self.report.failures.append(f"the {name} has more than before: {census.told(pid)}")
        self._judge()

    def end(self) -> None:
        """End robot and bridge, which must go well."""
        code = self._bridge.terminate()
        assert code == 0, f"the bridge ended with {code}: {self._bridge.log[-2000:]}"
        self._talk.stop()
        for name, log in (("server", self._talk.log), ("bridge", self._bridge.log)):
            assert "a bug" not in log, f"a bug, says the log of the {name}: {log[-2000:]}"

    def logs(self) -> str:
        """Return the end of what robot and bridge wrote."""
        return f"the end of the bridge's log: {self._bridge.log[-3000:]}"

    def _speak(self) -> float:
        """Have a goal go through from a desk of its own, and return the seconds."""
        goal = self.report.ledger.new()
        began = time.monotonic()
        broker = from_environment(self._broker.env("calm", password=False))
        with Client.over(reach(ROBOT, broker)) as client:
            found = client.say(goal.text, id=goal.id, rate=RATE).wait(BACK)
        took = time.monotonic() - began
        self.report.ledger.end(goal, found.state.name)
        assert found.state is State.SUCCEEDED, f"all was calm, and {goal.id} is {found.state.name}: {found.message}"
        return took

    def _count(self) -> dict[str, census.Census]:
        return {name: census.count(pid) for name, pid in self._pids().items()}

    def _pids(self) -> dict[str, int]:
        return {"server": self._talk.pid, "bridge": self._bridge.pid}


def soak(seconds: float, seed: int, every: float = 10.0, warm_up: int = WARM_UP) -> Report:
    """Run a soak and return what it found; `failures` is empty if all was well. `every`: seconds between two faults."""
    report = Report(seed, seconds)
    with contextlib.ExitStack() as stack:
        found = Soak(report, every, stack)
        try:
            found.run(warm_up)
            found.end()
        except (AssertionError, TimeoutError, OSError) as error:
            report.failures.append(f"{type(error).__name__}: {error}")
        if report.failures:
            report.failures.append(found.logs())
    return report


def _settled(pid: int, descriptors: int) -> census.Census:
    return census.settled(pid, lambda now: now.descriptors <= descriptors, _LET_GO)


def _exists(pid: int) -> bool:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/stat", "rb") as file:
        return file.read().rpartition(b")")[2].split()[0] != b"Z"
    return False


def _told(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.most_common()) or "nothing"


def main() -> None:
    """Run a soak as the command line says, and print what it found."""
    parser = argparse.ArgumentParser(description="Random goals from several desks, and a fault every few seconds.")
    parser.add_argument("--seconds", type=float, default=1800)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--every", type=float, default=10.0, help="seconds between two faults, on average")
    options = parser.parse_args()
    report = soak(options.seconds, options.seed, options.every)
    print(report)
    sys.exit(bool(report.failures))


if __name__ == "__main__":
    main()
