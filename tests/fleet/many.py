"""Many robots at one broker, as tests have them: real ones that are started together, and simulated by the hundred."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from tests.fleet.robot import Robot
from tests.support.bridge import STOP_LIMIT, Bridge
from tests.support.mqtt import Listener
from tests.support.processes import Talk
from tests.support.surroundings import clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from tests.support.broker import Broker
    from tests.support.mqtt import Message
    from tests.support.processes import Clients, Finished

#: Seconds in which robots are there that were just started: some have to share two processors.
THERE_LIMIT = 30.0
#: Robots that are started, or ended, at the same time.
_AT_ONCE = 8
_ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))


class Roll(contextlib.AbstractContextManager["Roll"]):
    """Who is there, as the broker tells it on one connection, until that ends."""

    def __init__(self, broker: Broker) -> None:
        self._listener = Listener(broker, "talk/robot/+/presence")

    def __exit__(self, *_error: object) -> None:
        self._listener.close()

    def await_there(self, names: Iterable[str], within: float = THERE_LIMIT) -> float:
        """Wait until all of these are online, each with a server; return the monotonic time at which the last was."""
        wanted = set(names)
        missing = set(wanted)

        def complete(message: Message) -> bool:
            name = message.topic.split("/")[2]
            told = message.json if message.payload else {}
            if told.get("online") and told.get("server"):
                missing.discard(name)
            elif name in wanted:
                missing.add(name)
            return not missing

        found = self._listener.find(complete, within)
        assert found, f"{len(missing)} are not there within {within} s: {sorted(missing)[:10]}"
        return found.arrived

    def await_gone(self, name: str, within: float = THERE_LIMIT) -> None:
        """Wait until a robot is offline."""
        self._listener.await_message(
            lambda each: each.topic.split("/")[2] == name and bool(each.payload) and each.json.get("online") is False,
            within,
        )


class RealRobots(contextlib.AbstractContextManager["RealRobots"]):
    """Robots that speak by a script, each a server and a bridge of its own, all online; `with` ends them.

    What is still there at the end of a block that went well is ended in peace, and must have gone well, too.
    """

    def __init__(
        self, broker: Broker, names: Sequence[str], groups: Sequence[str] = (), options: Sequence[str] = ()
    ) -> None:
        """`groups` and `options` are those of each bridge."""
        self.broker = broker
        self._groups, self._options = groups, options
        self._by_name: dict[str, Robot] = {}
        with contextlib.ExitStack() as stack:
            self._stack = stack.enter_context(contextlib.ExitStack())
            for each in _together(self._start, names):
                self._by_name[each.name] = each
            with Roll(broker) as roll:
                roll.await_there(names)
            stack.pop_all()

    def __exit__(self, kind: object, *_error: object) -> None:
        with self._stack:
            if kind is None:
                _together(_end, self._by_name.values())

    def __getitem__(self, name: str) -> Robot:
        return self._by_name[name]

    @property
    def names(self) -> list[str]:
        """All names, sorted."""
        return sorted(self._by_name)

    def add(self, name: str) -> Robot:
        """Start another robot, and return it, started."""
        self._by_name[name] = robot = self._start(name)
        return robot

    def each(self, action: Callable[[Robot], Any]) -> list[Any]:
        """Return what comes of an action for each robot, by their names' order; several are done at once."""
        return _together(action, [self._by_name[each] for each in self.names])

    def spoken(self) -> dict[str, list[str]]:
        """Return the texts that each has begun to speak, in their order."""
        return dict(zip(self.names, self.each(lambda each: each.spoken), strict=True))

    def _start(self, name: str) -> Robot:
        # Both are forks of a process that lives as long as the tests; one that dies with the thread that has started it
        # would be gone with this.
        talk = self._stack.enter_context(contextlib.closing(Talk(scripted=True)))
        bridge = self._stack.enter_context(Bridge(talk, self.broker, name, *self._options, groups=self._groups))
        return Robot(talk, self.broker, bridge)


def _end(robot: Robot) -> None:
    if robot.bridge.running:
        assert robot.bridge.terminate() == 0, robot.bridge.log
    if robot.talk.running:
        robot.talk.stop()
    else:
        robot.talk.check()


def _together(action: Callable[[Any], Any], those: Collection[Any]) -> list[Any]:
    """Return what comes of an action for each; all are done, before what went wrong with the first is raised."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        done = [pool.submit(action, each) for each in those]
        wait(done)
    return [each.result() for each in done]


@dataclass(frozen=True, slots=True)
class Spoken:
    """A sentence that a simulated robot has begun to speak."""

    robot: str
    id: str
    text: str
    at: float  # monotonic time


class SimulatedRobots(contextlib.AbstractContextManager["SimulatedRobots"]):
    """Simulated robots in processes of their own, started; `with` kills them, unless they were ended before."""

    def __init__(self, broker: Broker, count: int, *, processes: int = 1, groups: Sequence[str] = ()) -> None:
        from tests.fleet.simulated import name_of

        #: their names, in their order
        self.names = [name_of(each + 1) for each in range(count)]
        self._processes: list[subprocess.Popen[str]] = []
        with contextlib.ExitStack() as stack:
            self._directory = stack.enter_context(short_directory("sim-"))
            stack.callback(self._kill)
            bounds = [count * each // processes for each in range(processes + 1)]
            for first, behind in pairwise(bounds):
                words = ["--robots", str(behind - first), "--first", str(first + 1), "--broker", broker.url]
                words += [word for each in groups for word in ("--group", each)]
                self._processes.append(self._start(words))
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    @property
    def pids(self) -> list[int]:
        """The processes that they share."""
        return [each.pid for each in self._processes]

    @property
    def log(self) -> str:
        """What bridges and servers wrote so far."""
        with open(f"{self._directory}/log", encoding="utf-8", errors="replace") as file:
            return file.read()

    @property
    def spoken(self) -> list[Spoken]:
        """What was begun to be spoken so far, by its time."""
        with open(f"{self._directory}/spoken", encoding="utf-8") as file:
            *lines, _ = file.read().split("\n")  # the last of them may be in the middle of being written
        return sorted((Spoken(**json.loads(line)) for line in lines), key=lambda each: each.at)

    def await_there(self, within: float = THERE_LIMIT) -> None:
        """Wait until all can be asked for the first time."""
        end = time.monotonic() + within
        for each in self._processes:
            assert each.stdout
            found, _, _ = select.select([each.stdout], [], [], max(0.0, end - time.monotonic()))
            assert found, f"simulated robots are not there within {within} s: {self.log[-2000:]}"
            assert "there" in each.stdout.readline(), self.log[-2000:]

    def await_spoken(self, goal_id: str, within: float = THERE_LIMIT) -> None:
        """Wait until all have begun to speak a goal."""
        end = time.monotonic() + within
        while (begun := sum(each.id == goal_id for each in self.spoken)) < len(self.names):
            assert time.monotonic() < end, f"{begun} of {len(self.names)} speak {goal_id} within {within} s"
            time.sleep(0.05)  # that a file grows is no event here

    def assert_spoken_once(self, goal_id: str, names: Collection[str] | None = None) -> list[Spoken]:
        """Assert that this goal was begun once on each of these robots, all if none are named, and on no other."""
        found = [each for each in self.spoken if each.id == goal_id]
        counts, wanted = Counter(each.robot for each in found), Counter(self.names if names is None else names)
        assert counts == wanted, f"not once each: too often {counts - wanted}, lacking {wanted - counts}"
        return found

    def stop(self) -> None:
        """End them in peace; each process must have gone well."""
        for each in self._processes:
            each.terminate()
        for each in self._processes:
            code = each.wait(STOP_LIMIT + len(self.names) / 100)
            assert code == 0, f"simulated robots ended with {code}: {self.log[-2000:]}"
        assert "Traceback" not in self.log, self.log[-2000:]
        assert "a bug" not in self.log, self.log[-2000:]

    def _start(self, words: Sequence[str]) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.fleet.simulated", *words, "--spoken", f"{self._directory}/spoken"]
        with open(f"{self._directory}/log", "ab") as log:
            return subprocess.Popen(
                dying_with_parent(command),
                cwd=_ROOT,
                env=clean_environment(self._directory),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )

    def _kill(self) -> None:
        for each in self._processes:
            each.kill()
            each.wait()
            assert each.stdout
            each.stdout.close()


def request(robots: RealRobots, name: str, **fields: Any) -> None:
    """Ask the server of each for something, at the robot."""
    for reply in robots.each(lambda each: each.talk.request(name, **fields)):
        assert reply["ok"], reply


def at_once(clients: Clients, *lines: Sequence[str]) -> list[Finished]:
    """Run these commands beside each other: each waits, most of its time, for what the broker may still tell."""
    return [clients.finish(each) for each in [clients.start(*line) for line in lines]]


def told(done: Finished) -> dict[str, tuple[str, str, int]]:
    """Return what a desk was told of each robot: id, state, code; each is told of once."""
    lines = [line.split() for line in done.out.splitlines()]
    found = {robot: (goal_id, state, int(code)) for robot, goal_id, state, code in lines}
    assert len(found) == len(lines), f"a robot twice: {done.out}"
    return found


def objects(done: Finished) -> dict[str, dict[str, Any]]:
    """Return what a desk was told of each robot, for programs."""
    return {each["robot"]: each for each in map(json.loads, done.out.splitlines())}


def alike(names: Sequence[str], goal_id: str, state: str, code: int) -> dict[str, tuple[str, str, int]]:
    """Return what a desk is told where all of these end alike."""
    return dict.fromkeys(names, (goal_id, state, code))


def assert_told(done: Finished, code: int, wanted: Mapping[str, tuple[str, str, int]], summary: str) -> None:
    """Assert what a desk was told of each robot, its exit code, and how many did as they were asked."""
    assert told(done) == wanted, done
    assert (done.code, done.err.splitlines()[-1:]) == (code, [f"talk: {summary}"]), done
