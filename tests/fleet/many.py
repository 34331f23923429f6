"""Many robots at one broker, real and simulated."""

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
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from tests.fleet.robot import Robot
from tests.support.bridge import STOP_LIMIT, Bridge
from tests.support.mqtt import Listener
from tests.support.processes import Talk
from tests.support.resources import Resource
from tests.support.surroundings import clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from tests.support.broker import Broker
    from tests.support.mqtt import Message
    from tests.support.processes import Clients, Finished

#: Time for started robots to come online, even on two processors.
ONLINE_LIMIT_S = 30.0
#: Number of robots that are started or stopped at the same time.
_AT_ONCE = 8
_ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))


class PresenceListener(Listener):
    """A listener for the presence of all robots."""

    def __init__(self, broker: Broker) -> None:
        super().__init__(broker, "talk/robot/+/presence")

    def await_online(self, names: Iterable[str], within: float = ONLINE_LIMIT_S) -> float:
        """Wait until these robots are online with a server, and return the monotonic time of the last one."""
        missing = expected = set(names)

        def complete(message: Message) -> bool:
            nonlocal missing
            name = {message.topic.split("/")[2]}
            presence = message.json if message.payload else {}
            online = presence.get("online") and presence.get("server")
            missing = missing - name if online else missing | (name & expected)
            return not missing

        last = self.find(complete, within)
        assert last, f"{len(missing)} are not online within {within} s: {sorted(missing)[:10]}"
        return last.arrived

    def await_offline(self, name: str, within: float = ONLINE_LIMIT_S) -> None:
        self.await_message(
            lambda message: (
                message.topic.split("/")[2] == name and bool(message.payload) and message.json.get("online") is False
            ),
            within,
        )


class RealRobots(contextlib.AbstractContextManager["RealRobots"]):
    """Online robots with the scripted engine. Each has its own server and bridge.

    After a block without an exception, all robots are stopped with SIGTERM and checked.
    """

    def __init__(
        self, broker: Broker, names: Sequence[str], groups: Sequence[str] = (), options: Sequence[str] = ()
    ) -> None:
        """Start the robots. Each bridge gets the `groups` and `options`."""
        self.broker = broker
        self._groups, self._options = groups, options
        self._by_name: dict[str, Robot] = {}
        with contextlib.ExitStack() as stack:
            self._stack = stack.enter_context(contextlib.ExitStack())
            _in_parallel(self.add, names)
            with PresenceListener(broker) as presences:
                presences.await_online(names)
            stack.pop_all()

    def __exit__(self, kind: object, *_error: object) -> None:
        with self._stack:
            if kind is None:
                _in_parallel(_end, self._by_name.values())

    def __getitem__(self, name: str) -> Robot:
        return self._by_name[name]

    @property
    def names(self) -> list[str]:
        return sorted(self._by_name)

    def add(self, name: str) -> Robot:
        # Both processes are forked from a process that outlives this thread, so they don't die with the thread.
        talk = self._stack.enter_context(contextlib.closing(Talk(scripted=True)))
        bridge = self._stack.enter_context(Bridge(talk, self.broker, name, *self._options, groups=self._groups))
        self._by_name[name] = robot = Robot(talk, self.broker, bridge)
        return robot

    def each(self, action: Callable[[Robot], Any]) -> list[Any]:
        """Run an action for all robots, and return the results in the order of the robots' names."""
        return _in_parallel(action, [self._by_name[name] for name in self.names])

    def spoken(self) -> dict[str, list[str]]:
        """Return the texts that each robot has started to speak."""
        return dict(zip(self.names, self.each(lambda robot: robot.spoken), strict=True))


def _end(robot: Robot) -> None:
    if robot.bridge.running:
        assert robot.bridge.terminate() == 0, robot.bridge.log
    if robot.talk.running:
        robot.talk.stop()
    else:
        robot.talk.check()


def _in_parallel(action: Callable[[Any], Any], items: Collection[Any]) -> list[Any]:
    """Run an action for several items in parallel, and return the results or raise the first error at the end."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        done = [pool.submit(action, item) for item in items]
        wait(done)
    return [future.result() for future in done]


class SimulatedRobots(Resource):
    """Simulated robots in separate processes (see `tests.tools.simulated`)."""

    def __init__(self, broker: Broker, count: int, *, processes: int = 1) -> None:
        self.names = [f"sim-{number + 1:04d}" for number in range(count)]
        self._processes: list[subprocess.Popen[str]] = []
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("sim-"))
            stack.callback(self._kill)
            for first, end in pairwise(count * part // processes for part in range(processes + 1)):
                self._start(["--robots", str(end - first), "--first", str(first + 1), "--broker", broker.url])
            self._stack = stack.pop_all()

    def spoken(self, goal_id: str) -> dict[str, float]:
        """Return the monotonic time at which each robot started a goal. No robot may have started it twice."""
        with open(f"{self.directory}/spoken", encoding="utf-8") as file:
            *lines, _unfinished = file.read().split("\n")
        entries = [entry for entry in map(json.loads, lines) if entry["id"] == goal_id]
        result = {entry["robot"]: entry["at"] for entry in entries}
        assert len(result) == len(entries), (
            f"{goal_id} was spoken more than once: {Counter(entry['robot'] for entry in entries)}"
        )
        return result

    def await_online(self, within: float = ONLINE_LIMIT_S) -> None:
        """Wait until all robots are online for the first time."""
        end = time.monotonic() + within
        for process in self._processes:
            assert process.stdout
            ready, _, _ = select.select([process.stdout], [], [], max(0.0, end - time.monotonic()))
            assert ready, f"simulated robots are not online within {within} s: {self.log[-2000:]}"
            assert "online" in process.stdout.readline(), self.log[-2000:]

    def await_spoken(self, goal_id: str, within: float = ONLINE_LIMIT_S) -> None:
        """Wait until all robots have started to speak a goal."""
        end = time.monotonic() + within
        while (started := len(self.spoken(goal_id))) < len(self.names):
            assert time.monotonic() < end, f"{started} of {len(self.names)} speak {goal_id} within {within} s"
            time.sleep(0.05)  # a growing file sends no event

    def assert_spoken_once(self, goal_id: str) -> float:
        """Assert that each robot has started a goal once, and return the monotonic time of the last start."""
        spoken = self.spoken(goal_id)
        assert spoken.keys() == set(self.names), f"not spoken by {set(self.names) - spoken.keys()}"
        return max(spoken.values())

    def stop(self) -> None:
        """Stop the processes with SIGTERM, and check them."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            code = process.wait(STOP_LIMIT + len(self.names) / 100)
            assert code == 0, f"simulated robots exited with {code}: {self.log[-2000:]}"
        for text in ("Traceback", "a bug"):
            assert text not in self.log, self.log[-2000:]

    def _start(self, arguments: Sequence[str]) -> None:
        command = [sys.executable, "-m", "tests.tools.simulated", *arguments, "--spoken", f"{self.directory}/spoken"]
        with open(f"{self.directory}/log", "ab") as log:
            process = subprocess.Popen(
                dying_with_parent(command),
                cwd=_ROOT,
                env=clean_environment(self.directory),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        self._processes.append(process)

    def _kill(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()
            assert process.stdout
            process.stdout.close()


def request(robots: RealRobots, name: str, **fields: Any) -> None:
    for reply in robots.each(lambda robot: robot.talk.request(name, **fields)):
        assert reply["ok"], reply


def at_once(clients: Clients, *lines: Sequence[str]) -> list[Finished]:
    """Run several commands at the same time."""
    return [clients.finish(client) for client in [clients.start(*line) for line in lines]]


def printed_outcomes(done: Finished) -> dict[str, tuple[str, str, int]]:
    """Return the goal's id, the state and the exit code that a desk printed for each robot."""
    lines = [line.split() for line in done.out.splitlines()]
    outcomes = {robot: (goal_id, state, int(code)) for robot, goal_id, state, code in lines}
    assert len(outcomes) == len(lines), f"a robot was printed twice: {done.out}"
    return outcomes


def objects(done: Finished) -> dict[str, dict[str, Any]]:
    """Return the JSON object that a desk printed for each robot."""
    return {outcome["robot"]: outcome for outcome in map(json.loads, done.out.splitlines())}


def alike(names: Sequence[str], goal_id: str, state: str, code: int) -> dict[str, tuple[str, str, int]]:
    """Return the outcomes that a desk prints if all robots have the same one."""
    return dict.fromkeys(names, (goal_id, state, code))


def assert_outcomes(done: Finished, code: int, expected: Mapping[str, tuple[str, str, int]], summary: str) -> None:
    """Assert the outcomes, the exit code and the summary of a command."""
    assert printed_outcomes(done) == expected, done
    assert (done.code, done.err.splitlines()[-1:]) == (code, [f"talk: {summary}"]), done
