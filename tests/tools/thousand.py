"""Measure what it takes to ask a thousand robots at once.

Starts a mosquitto, simulated robots (real bridges and servers without sound) and a few real ones, asks all of them with
the real command, and prints the median and the maximum of each measurement. With the default options it takes three
minutes. A sentence that is spoken twice or late is an error.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import time
from typing import TYPE_CHECKING

from talkcli.fleet.broker import from_environment
from talkcli.fleet.roster import roster
from tests.fleet.many import RealRobots, Roll, SimulatedRobots
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.processes import Finished, Process

#: No log of every packet, and counts every second.
_SETTINGS = ("log_type none", "log_type error", "sys_interval 1")
_LIMIT_S = 60.0
#: Seconds after which a command has no effects any more: a robot publishes its status once a second.
_REST_S = 2.5
_TTL_S = 10.0
#: An environment in which processes are started rather than forked from one that the tests share.
_STARTED = {"PYTHONHASHSEED": "0"}
_COUNTS = {
    "messages to the broker": "$SYS/broker/publish/messages/received",
    "messages from the broker": "$SYS/broker/publish/messages/sent",
    "bytes to the broker": "$SYS/broker/bytes/received",
    "bytes from the broker": "$SYS/broker/bytes/sent",
}


class Stage:
    """A broker, its robots, and a desk that asks all of them."""

    def __init__(self, options: argparse.Namespace, stack: contextlib.ExitStack) -> None:
        self.rounds, self.idle_s = range(options.rounds), options.idle
        self._goals = 0
        self.broker = stack.enter_context(Broker(settings=_SETTINGS))
        self.simulated = stack.enter_context(SimulatedRobots(self.broker, options.robots, processes=4))
        self.simulated.await_there(_LIMIT_S)
        self.real = stack.enter_context(RealRobots(self.broker, [f"real-{n + 1}" for n in range(options.real)]))
        env = {"TALK_ROBOT": "@all", **_STARTED}
        self.desk = stack.enter_context(Desk(self.broker, user="desk", password=False, env=env))
        self.names = [*self.real.names, *self.simulated.names]

    def start_say(self, seconds: float, *options: str) -> tuple[str, Process]:
        """Start a command that has all robots speak for so many seconds, and return the goal's id with it."""
        self._goals += 1
        goal = f"goal-{self._goals}"
        text = f"length={seconds:g} {goal}"
        return goal, self.desk.start("say", *options, "--id", goal, "--ttl", f"{_TTL_S:g}", "--", text)

    def say(self, seconds: float) -> float:
        """Have all robots speak, check that each did so once and in time, and return the seconds of the command."""
        began = time.monotonic()
        goal, process = self.start_say(seconds, "--wait")
        self.finish(process)
        took = time.monotonic() - began
        self.check(goal, began)
        time.sleep(_REST_S)
        return took

    def finish(self, process: Process, code: int = 0) -> Finished:
        done = self.desk.finish(process, timeout=_LIMIT_S)
        assert done.code == code, f"exit code {done.code}: {done.err[-1000:]}"
        return done

    def await_spoken(self, goal: str) -> None:
        self.real.each(lambda each: each.talk.watcher.wait_for(goal, "ACTIVE"))
        self.simulated.await_spoken(goal, _LIMIT_S)

    def check(self, goal: str, began: float) -> None:
        """Assert that each robot has begun a goal once and in time."""
        late = self.simulated.assert_spoken_once(goal) - began
        assert late < _TTL_S, f"{goal} was spoken {late:.1f} s after it was said"
        for name, texts in self.real.spoken().items():
            assert [each.endswith(goal) for each in texts].count(True) == 1, f"{name}: {texts}"

    def traffic(self, action: Callable[[], object]) -> dict[str, float]:
        """Return what the broker has carried for each robot during an action."""
        time.sleep(_REST_S)
        before = self._counts()
        action()
        after = self._counts()
        return {name: (after[name] - before[name]) / len(self.names) for name in after}

    def _counts(self) -> dict[str, float]:
        """Return the broker's counts, and the time at which it had just counted."""
        with Listener(self.broker, *_COUNTS.values()) as listener:
            first = next(iter(_COUNTS.values()))
            kept = listener.await_message(lambda each: each.topic == first)
            fresh = listener.await_message(lambda each: each.topic == first and each.arrived > kept.arrived + 0.1, 15)
            time.sleep(0.1)  # the others come with it
            values = {each.topic: float(each.text) for each in listener.messages}
        return {name: values.get(topic, 0.0) for name, topic in _COUNTS.items()} | {"seconds": fresh.arrived}


def measure_roster(stage: Stage) -> None:
    broker, times = from_environment(stage.desk.env), []
    for _ in stage.rounds:
        began = time.monotonic()
        assert len(roster(broker, _LIMIT_S)) == len(stage.names)
        times.append(time.monotonic() - began)
    _print("all robots, in a program", times)
    _print("`talk fleet status`", [stage.desk.run("fleet", "status", timeout=_LIMIT_S).seconds for _ in stage.rounds])


def measure_idle(stage: Stage) -> None:
    """Measure the traffic of robots that do nothing."""
    found = stage.traffic(lambda: time.sleep(stage.idle_s))
    for name in _COUNTS:
        _print(f"idle: {name} for each robot", [found[name] / found["seconds"] / len(stage.names)], "/s")


def measure_sentence(stage: Stage) -> None:
    """Measure the traffic of a sentence."""
    found = stage.traffic(lambda: stage.say(1))
    for name in list(_COUNTS)[:2]:
        _print(f"a sentence: {name} for each robot", [found[name]], "")


def measure_cancel(stage: Stage) -> None:
    """Measure a cancel while all robots speak, without and with a desk that waits for their ends."""
    for options, code, name in (((), 0, ""), (("--wait",), 7, ", while another desk waits for all ends")):
        times = []
        with Listener(stage.broker, "talk/group/all/request/+") as listener:
            for _ in stage.rounds:
                said = time.monotonic()
                goal, speaking = stage.start_say(60, *options)
                stage.await_spoken(goal)
                time.sleep(_REST_S)
                began = time.monotonic()
                cancel = stage.desk.start("cancel")
                assert cancel.stdout
                for _line in cancel.stdout:
                    last = time.monotonic()
                stage.finish(cancel)
                sent = listener.await_message(lambda each, began=began: each.arrived > began)  # type: ignore[misc]
                stage.finish(speaking, code)
                stage.check(goal, said)
                times.append(last - sent.arrived)
                time.sleep(_REST_S)
        _print(f"`talk --robot @all cancel`: message → last acknowledgement{name}", times)


def measure_say(stage: Stage) -> None:
    _print("`talk --robot @all say -w` of 1 s", [stage.say(1) for _ in stage.rounds])


def measure_broker(stage: Stage) -> None:
    """Measure how soon all robots are back after the broker was killed while they spoke."""
    began = time.monotonic()
    goal, speaking = stage.start_say(5, "--wait")
    stage.await_spoken(goal)
    stage.broker.kill()
    time.sleep(1)  # so that all robots have tried in vain
    stage.broker.start()
    up = time.monotonic()
    with Roll(stage.broker) as roll:
        _print("broker back → last robot back", [roll.await_there(stage.names, _LIMIT_S) - up])
    stage.finish(speaking)
    stage.check(goal, began)
    time.sleep(_REST_S)
    stage.say(1)


def measure_memory(stage: Stage) -> None:
    goal, speaking = stage.start_say(2, "--wait")
    stage.await_spoken(goal)
    _print("memory of a desk that waits for all", [_megabytes(speaking.pid)], "MB")
    stage.finish(speaking)
    _print("memory of the broker", [_megabytes(stage.broker.pid)], "MB")
    with Bridge(stage.real[stage.real.names[0]].talk, stage.broker, "measured", env=_STARTED) as bridge:
        bridge.await_online()
        _print("memory of a bridge", [_megabytes(bridge.pid)], "MB")
        bridge.terminate()


def _megabytes(pid: int) -> float:
    with open(f"/proc/{pid}/smaps_rollup", encoding="ascii") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith("Pss:"))


def _print(name: str, values: list[float], unit: str = "s") -> None:
    print(f"{statistics.median(values):8.2f} {max(values):8.2f} {unit:3} {name}", flush=True)


MEASUREMENTS: dict[str, Callable[[Stage], None]] = {
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
    parser.add_argument(
        "--idle", type=float, default=60, metavar="SECONDS", help="time without a request (%(default)g)"
    )
    parser.add_argument("--only", action="append", choices=[*MEASUREMENTS], help="measure this only")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        stage = Stage(options, stack)
        print(f"{len(stage.names)} robots are online", file=sys.stderr)
        for name in options.only or MEASUREMENTS:
            MEASUREMENTS[name](stage)
        stage.simulated.stop()


if __name__ == "__main__":
    main()
