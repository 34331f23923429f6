"""Measure requests to a thousand robots at once.

This program starts mosquitto, simulated robots (real bridges and servers without sound) and a few real robots. It sends
requests to all of them with the real command, and prints the median and the maximum of each measurement. With the
default options, it takes three minutes. A sentence that is spoken twice or too late is an error.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import time
from typing import TYPE_CHECKING

from talkcli.fleet.broker import from_environment
from talkcli.fleet.desk.watch import read_robots
from talkcli.polling import run_blocking
from tests.fleet.many import PresenceListener, RealRobots, SimulatedRobots
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener
from tests.tools.bench.machine import megabytes

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.processes import Finished, Process

#: Only log errors instead of all packets, and update the counts every second.
_SETTINGS = ("log_type none", "log_type error", "sys_interval 1")
_LIMIT_S = 60.0
#: Time after which a command has no effects any more. A robot publishes its status once per second.
_SETTLE_S = 2.5
_TTL_S = 10.0
#: Environment that prevents forking, so that real processes are started.
_NOT_FORKED = {"PYTHONHASHSEED": "0"}
_COUNTS = {
    "messages to the broker": "$SYS/broker/publish/messages/received",
    "messages from the broker": "$SYS/broker/publish/messages/sent",
    "bytes to the broker": "$SYS/broker/bytes/received",
    "bytes from the broker": "$SYS/broker/bytes/sent",
}


class MeasuredFleet:
    """A broker, its robots, and a desk that sends requests to all of them."""

    def __init__(self, options: argparse.Namespace, stack: contextlib.ExitStack) -> None:
        self.rounds, self.idle_s = range(options.rounds), options.idle
        self._goals = 0
        self.broker = stack.enter_context(Broker(settings=_SETTINGS))
        self.simulated = stack.enter_context(SimulatedRobots(self.broker, options.robots, processes=4))
        self.simulated.await_online(_LIMIT_S)
        self.real = stack.enter_context(RealRobots(self.broker, [f"real-{n + 1}" for n in range(options.real)]))
        env = {"TALK_ROBOT": "@all", **_NOT_FORKED}
        self.desk = stack.enter_context(Desk(self.broker, user="desk", password=False, env=env))
        self.names = [*self.real.names, *self.simulated.names]

    def start_say(self, seconds: float, *options: str) -> tuple[str, Process]:
        """Start a command that makes all robots speak for some seconds. Return the goal's id and the process."""
        self._goals += 1
        goal = f"goal-{self._goals}"
        text = f"length={seconds:g} {goal}"
        return goal, self.desk.start("say", *options, "--id", goal, "--ttl", f"{_TTL_S:g}", "--", text)

    def say(self, seconds: float) -> float:
        """Make all robots speak, check that each spoke once and in time, and return the seconds of the command."""
        started_at = time.monotonic()
        goal, process = self.start_say(seconds, "--wait")
        self.finish(process)
        seconds = time.monotonic() - started_at
        self.check(goal, started_at)
        time.sleep(_SETTLE_S)
        return seconds

    def finish(self, process: Process, code: int = 0) -> Finished:
        done = self.desk.finish(process, timeout=_LIMIT_S)
        assert done.code == code, f"exit code {done.code}: {done.err[-1000:]}"
        return done

    def await_spoken(self, goal: str) -> None:
        self.real.each(lambda robot: robot.talk.watcher.wait_for(goal, "ACTIVE"))
        self.simulated.await_spoken(goal, _LIMIT_S)

    def check(self, goal: str, sent_at: float) -> None:
        """Assert that each robot has started a goal once and in time."""
        delay = self.simulated.assert_spoken_once(goal) - sent_at
        assert delay < _TTL_S, f"{goal} was spoken {delay:.1f} s after it was sent"
        for name, texts in self.real.spoken().items():
            assert [text.endswith(goal) for text in texts].count(True) == 1, f"{name}: {texts}"

    def traffic(self, action: Callable[[], object]) -> dict[str, float]:
        """Return the broker's traffic per robot during an action."""
        time.sleep(_SETTLE_S)
        before = self._counts()
        action()
        after = self._counts()
        return {name: (after[name] - before[name]) / len(self.names) for name in after}

    def _counts(self) -> dict[str, float]:
        """Return the broker's counts, and the time at which they were updated."""
        with Listener(self.broker, *_COUNTS.values()) as listener:
            first = next(iter(_COUNTS.values()))
            old = listener.await_message(lambda message: message.topic == first)
            new = listener.await_message(
                lambda message: message.topic == first and message.arrived > old.arrived + 0.1, 15
            )
            time.sleep(0.1)  # the other counts come at the same time
            values = {message.topic: float(message.text) for message in listener.messages}
        return {name: values.get(topic, 0.0) for name, topic in _COUNTS.items()} | {"seconds": new.arrived}


def measure_roster(fleet: MeasuredFleet) -> None:
    broker, times = from_environment(fleet.desk.env), []
    for _ in fleet.rounds:
        started_at = time.monotonic()
        assert len(run_blocking(read_robots(broker, _LIMIT_S, with_status=False))) == len(fleet.names)
        times.append(time.monotonic() - started_at)
    _print("all robots, in a program", times)
    _print("`talk fleet status`", [fleet.desk.run("fleet", "status", timeout=_LIMIT_S).seconds for _ in fleet.rounds])


def measure_idle(fleet: MeasuredFleet) -> None:
    traffic = fleet.traffic(lambda: time.sleep(fleet.idle_s))
    for name in _COUNTS:
        _print(f"idle: {name} per robot", [traffic[name] / traffic["seconds"] / len(fleet.names)], "/s")


def measure_sentence(fleet: MeasuredFleet) -> None:
    traffic = fleet.traffic(lambda: fleet.say(1))
    for name in list(_COUNTS)[:2]:
        _print(f"a sentence: {name} per robot", [traffic[name]], "")


def measure_cancel(fleet: MeasuredFleet) -> None:
    """Measure a cancel while all robots speak, without and with a desk that waits for the ends."""
    for options, code, name in (((), 0, ""), (("--wait",), 7, ", while another desk waits for all ends")):
        times = []
        with Listener(fleet.broker, "talk/group/all/request/+") as listener:
            for _ in fleet.rounds:
                said_at = time.monotonic()
                goal, speaking = fleet.start_say(60, *options)
                fleet.await_spoken(goal)
                time.sleep(_SETTLE_S)
                cancelled_at = time.monotonic()
                cancel = fleet.desk.start("cancel")
                assert cancel.stdout
                for _line in cancel.stdout:
                    last = time.monotonic()
                fleet.finish(cancel)
                sent = listener.await_message(lambda message, start=cancelled_at: message.arrived > start)  # type: ignore[misc]
                fleet.finish(speaking, code)
                fleet.check(goal, said_at)
                times.append(last - sent.arrived)
                time.sleep(_SETTLE_S)
        _print(f"`talk --robot @all cancel`: message → last acknowledgement{name}", times)


def measure_say(fleet: MeasuredFleet) -> None:
    _print("`talk --robot @all say -w` of 1 s", [fleet.say(1) for _ in fleet.rounds])


def measure_broker(fleet: MeasuredFleet) -> None:
    """Measure the time until all robots are online after the broker was killed while they spoke."""
    said_at = time.monotonic()
    goal, speaking = fleet.start_say(5, "--wait")
    fleet.await_spoken(goal)
    fleet.broker.kill()
    time.sleep(1)  # so that all robots have tried to reconnect
    fleet.broker.start()
    restarted_at = time.monotonic()
    with PresenceListener(fleet.broker) as presences:
        _print("broker restarted → last robot online", [presences.await_online(fleet.names, _LIMIT_S) - restarted_at])
    fleet.finish(speaking)
    fleet.check(goal, said_at)
    time.sleep(_SETTLE_S)
    fleet.say(1)


def measure_memory(fleet: MeasuredFleet) -> None:
    goal, speaking = fleet.start_say(2, "--wait")
    fleet.await_spoken(goal)
    _print("memory of a desk that waits for all", [megabytes(speaking.pid)], "MB")
    fleet.finish(speaking)
    _print("memory of the broker", [megabytes(fleet.broker.pid)], "MB")
    with Bridge(fleet.real[fleet.real.names[0]].talk, fleet.broker, "measured", env=_NOT_FORKED) as bridge:
        bridge.await_online()
        _print("memory of a bridge", [megabytes(bridge.pid)], "MB")
        bridge.terminate()


def _print(name: str, values: list[float], unit: str = "s") -> None:
    print(f"{statistics.median(values):8.2f} {max(values):8.2f} {unit:3} {name}", flush=True)


MEASUREMENTS: dict[str, Callable[[MeasuredFleet], None]] = {
    "roster": measure_roster,
    "idle": measure_idle,
    "sentence": measure_sentence,
    "cancel": measure_cancel,
    "say": measure_say,
    "broker": measure_broker,
    "memory": measure_memory,
}


def main() -> None:
    parser = argparse.ArgumentParser("python -m tests.tools.thousand", description=__doc__)
    parser.add_argument("--robots", type=int, default=1000, help="simulated robots (%(default)s)")
    parser.add_argument("--real", type=int, default=3, help="real robots (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="repetitions of each measurement (%(default)s)")
    parser.add_argument("--idle", type=float, default=60, metavar="SECONDS", help="time without requests (%(default)g)")
    parser.add_argument("--only", action="append", choices=[*MEASUREMENTS], help="only measure this")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        fleet = MeasuredFleet(options, stack)
        print(f"{len(fleet.names)} robots are online", file=sys.stderr)
        for name in options.only or MEASUREMENTS:
            MEASUREMENTS[name](fleet)
        fleet.simulated.stop()


if __name__ == "__main__":
    main()
