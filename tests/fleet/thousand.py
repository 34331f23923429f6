"""Measures a desk over a thousand robots: see `python -m tests.fleet.thousand --help`."""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

from talkcli.errors import TalkError
from talkcli.fleet.broker import from_environment
from talkcli.fleet.roster import roster
from tests.fleet.many import RealRobots, Roll, SimulatedRobots
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener
from tests.tools.bench import machine
from tests.tools.bench.machine import megabytes, taken
from tests.tools.bench.table import Limit, Row, as_table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_ABOUT = """\
Starts a private mosquitto, simulated robots (real bridges and servers, but for the engine) and a few that are real, and
prints a table of what it takes to ask all of them with the real command. With the usual numbers it takes three minutes.
Exit code 1 where something could not be measured, or a sentence was spoken twice or late; a goal that is not met is no
error.
"""
#: As a broker comes, but for a log of every packet, and numbers that are a second old at most.
_SETTINGS = ("log_type none", "log_type error", "sys_interval 1")
#: Seconds in which a command must have ended.
_PATIENCE = 60.0
#: Seconds after which what a command has set in motion has come to rest: a robot's status is told once a second.
_REST = 2.5
#: Seconds that a sentence to several may wait for its turn, as the desk has it.
_TTL = 10.0
_SYS = "$SYS/broker"


class Asked:
    """A `talk` that was started, with the time of each of its lines."""

    def __init__(self, env: dict[str, str], words: Sequence[str]) -> None:
        self.words = " ".join(words)
        self.began = time.monotonic()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "talkcli", *words],
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.pid = self._process.pid
        self.lines: list[str] = []
        self.error = ""
        #: monotonic times: of the last line, and of the end
        self.last = self.ended = 0.0
        self._readers = [threading.Thread(target=each, daemon=True) for each in (self._read, self._read_error)]
        for each in self._readers:
            each.start()

    def finish(self, code: int | None = 0) -> Asked:
        """Wait for the end; AssertionError where its exit code is another."""
        try:
            found = self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            raise AssertionError(f"talk {self.words} does not end: {self._told()}") from None
        self.ended = time.monotonic()
        for each in self._readers:
            each.join(_PATIENCE)
        if code is not None and found != code:
            raise AssertionError(f"talk {self.words}: exit code {found}: {self._told()}")
        return self

    def _read(self) -> None:
        assert self._process.stdout
        with self._process.stdout as lines:
            for line in lines:
                self.last = time.monotonic()
                self.lines.append(line)

    def _read_error(self) -> None:
        assert self._process.stderr
        with self._process.stderr as lines:
            for line in lines:
                self.error = (self.error + line)[-1000:]

    def _told(self) -> str:
        return f"{len(self.lines)} lines; {self.error.strip()}"


class Stage(contextlib.AbstractContextManager["Stage"]):
    """A broker, its robots, and who asks them."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self._goals = 0
        with contextlib.ExitStack() as stack:
            self.broker = stack.enter_context(Broker(settings=_SETTINGS))
            self.simulated = stack.enter_context(
                SimulatedRobots(self.broker, options.robots, processes=options.processes)
            )
            self.simulated.await_there(_PATIENCE)
            self.real = stack.enter_context(
                RealRobots(self.broker, [f"real-{each + 1}" for each in range(options.real)])
            )
            self.env = stack.enter_context(Desk(self.broker, user="desk", password=False)).env
            self.names = [*self.real.names, *self.simulated.names]
            self._stack = stack.pop_all()

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def talk(self, *words: str) -> Asked:
        """Start a command."""
        return Asked(self.env, words)

    def say(self, seconds: float, *, wait: bool = True) -> tuple[str, Asked]:
        """Start a command that has all say a sentence of so many seconds, and return the goal's id with it."""
        self._goals += 1
        goal = f"goal-{self._goals}"
        words = ["--robot", "@all", "say", *(["--wait"] if wait else []), "--id", goal, "--ttl", f"{_TTL:g}", "--"]
        return goal, self.talk(*words, f"length={seconds:g} {goal}")

    def await_spoken(self, goal: str) -> None:
        """Wait until all speak a goal."""
        self.real.each(lambda each: each.talk.watcher.wait_for(goal, "ACTIVE"))
        self.simulated.await_spoken(goal, _PATIENCE)

    def check(self, goal: str, asked: Asked) -> None:
        """See that each has begun a goal once, and in its time."""
        spoken = self.simulated.assert_spoken_once(goal)
        late = max(each.at for each in spoken) - asked.began
        assert late < _TTL, f"{goal} was spoken {late:.1f} s after it was said"
        for name, texts in self.real.spoken().items():
            assert [each.endswith(goal) for each in texts].count(True) == 1, f"{name}: {texts}"

    def rest(self) -> None:
        """Wait until all have done what there was to do."""
        time.sleep(_REST)


def memory(stage: Stage) -> list[Row]:
    """Measure what is there, and a desk while all speak."""
    rows = [_memory("the broker", stage.broker.pid)]
    each = sum(megabytes(pid, "Pss") for pid in stage.simulated.pids) / len(stage.simulated.names)
    rows.append(Row("memory of a simulated robot, its part of its process", "MB", (each,)))
    goal, asked = stage.say(2)
    stage.await_spoken(goal)
    rows.append(_memory("a desk that waits for all", asked.pid))
    asked.finish()
    rows.append(_memory("the broker after that", stage.broker.pid))
    stage.check(goal, asked)
    # One that is no fork, and so shares nothing with the program that measures: an interpreter's setting is its own.
    talk = stage.real[stage.real.names[0]].talk
    with Bridge(talk, stage.broker, "measured", env={"PYTHONHASHSEED": "0"}) as bridge:
        bridge.await_online()
        rows.append(_memory("a bridge", bridge.pid))
        bridge.terminate()
    return rows


def presences(stage: Stage) -> list[Row]:
    """Measure how long it takes to know who is there."""
    broker = from_environment(stage.env)
    times = []
    for _ in range(stage.options.rounds):
        began = time.monotonic()
        found = roster(broker, _PATIENCE)
        times.append(time.monotonic() - began)
        assert len(found) == len(stage.names), f"{len(found)} of {len(stage.names)} robots"
    rows = [_row("the roster, in a program that runs", times, 0.5)]
    if subprocess.run(
        [sys.executable, "-m", "talkcli", "fleet", "--help"], env=stage.env, capture_output=True, check=False
    ).returncode:
        return rows
    asked = [stage.talk("fleet", "status").finish() for _ in range(stage.options.rounds)]
    return [
        *rows,
        _row("`talk fleet status`, start to end", [each.ended - each.began for each in asked], 0.5),
    ]


def cancel(stage: Stage) -> list[Row]:
    """Measure a cancel of all while all speak: where nobody waits for that, and where another desk does."""
    alone, alone_whole = _cancelled(stage, wait=False)
    both, _ = _cancelled(stage, wait=True)
    return [
        _row("`talk --robot @all cancel`: on its way → last acknowledgement", alone, 1),
        _row("… start to end of the command", alone_whole),
        _row("… on its way → last acknowledgement, where another desk waits for all ends", both),
    ]


def _cancelled(stage: Stage, *, wait: bool) -> tuple[list[float], list[float]]:
    """Return the seconds from the message to the last line of the command, and those of the whole command."""
    last, whole = [], []
    with Listener(stage.broker, "talk/group/all/request/+") as witness:
        for _ in range(stage.options.rounds):
            goal, speaking = stage.say(60, wait=wait)
            stage.await_spoken(goal)
            stage.rest()
            asked = stage.talk("--robot", "@all", "cancel").finish()
            sent = witness.await_message(lambda each, asked=asked: each.arrived > asked.began)  # type: ignore[misc]
            speaking.finish(7 if wait else 0)
            stage.check(goal, speaking)
            last.append(asked.last - sent.arrived)
            whole.append(asked.ended - asked.began)
            stage.rest()
    return last, whole


def say(stage: Stage) -> list[Row]:
    """Measure a sentence of a second that is awaited."""
    times = []
    for _ in range(stage.options.rounds):
        goal, asked = stage.say(1)
        asked.finish()
        stage.check(goal, asked)
        times.append(asked.ended - asked.began)
        stage.rest()
    return [_row("`talk --robot @all say -w` of 1 s, start to end of the command", times, 3)]


def broker_gone(stage: Stage) -> list[Row]:
    """Measure how soon all are back after the broker was killed in mid-sentence and started again."""
    goal, asked = stage.say(5)
    stage.await_spoken(goal)
    stage.broker.kill()
    time.sleep(1)  # so that all have tried in vain
    stage.broker.start()
    up = time.monotonic()
    with Roll(stage.broker) as roll:
        back = roll.await_there(stage.names, _PATIENCE) - up
    asked.finish()
    stage.check(goal, asked)
    stage.rest()
    again, then = stage.say(1)
    then.finish()
    stage.check(again, then)
    return [
        _row("broker back → the last robot, too", [back], 15),
        _row("… → the desk has the last result of a sentence of 5 s", [max(0.0, asked.ended - up)]),
    ]


def idle(stage: Stage) -> list[Row]:
    """Count what the broker has to carry while nobody asks for anything."""
    robots, pids = len(stage.names), stage.simulated.pids
    stage.rest()
    before, began = _carried(stage.broker), time.monotonic()
    ours, brokers = taken(pids), taken([stage.broker.pid])
    time.sleep(stage.options.idle)
    seconds = time.monotonic() - began
    ours, brokers = taken(pids).since(ours), taken([stage.broker.pid]).since(brokers)
    after = _carried(stage.broker)
    a_second = {name: (after[name] - before[name]) / (after["at"] - before["at"]) / robots for name in _COUNTED}
    return [
        Row("idle: messages to the broker a second, of each robot", "/s", (a_second["received"],)),
        Row("… from the broker", "/s", (a_second["sent"],)),
        Row("… bytes to the broker", "B/s", (a_second["bytes received"],)),
        Row("… bytes from the broker", "B/s", (a_second["bytes sent"],)),
        Row("… processor of the broker, for all", "%", (100 * brokers.processor / seconds,)),
        Row("… processor of all simulated robots", "%", (100 * ours.processor / seconds,)),
        Row("… context switches of all simulated robots", "/s", (ours.switches / seconds,)),
    ]


def sentence(stage: Stage) -> list[Row]:
    """Count what the broker has to carry for a sentence to all that is awaited, and for all echoes meanwhile."""
    stage.rest()
    before = _carried(stage.broker)
    goal, asked = stage.say(1)
    asked.finish()
    stage.rest()
    after = _carried(stage.broker)
    stage.check(goal, asked)
    each = {name: (after[name] - before[name]) / len(stage.names) for name in _COUNTED}
    return [
        Row("a sentence to all: messages to the broker, of each robot", "", (each["received"],)),
        Row("… from the broker", "", (each["sent"],)),
        Row("… messages that the broker has dropped by now", "", (after["dropped"],)),
    ]


#: What is read of the broker's own count.
_COUNTED = {
    "received": f"{_SYS}/publish/messages/received",
    "sent": f"{_SYS}/publish/messages/sent",
    "bytes received": f"{_SYS}/bytes/received",
    "bytes sent": f"{_SYS}/bytes/sent",
    "dropped": f"{_SYS}/publish/messages/dropped",
}


def _carried(broker: Broker) -> dict[str, float]:
    """Return what the broker has carried by the moment `at`, when it had just counted."""
    with Listener(broker, *_COUNTED.values()) as listener:
        first = _COUNTED["received"]
        kept = listener.await_message(lambda each: each.topic == first)
        fresh = listener.await_message(lambda each: each.topic == first and each.arrived > kept.arrived + 0.1, 15)
        time.sleep(0.1)  # the others come with it
        found = dict.fromkeys(_COUNTED, 0.0)
        for name, topic in _COUNTED.items():
            for each in listener.messages:
                if each.topic == topic:
                    found[name] = float(each.text)
    return found | {"at": fresh.arrived}


def _memory(name: str, pid: int) -> Row:
    return Row(f"memory of {name} (Pss)", "MB", (megabytes(pid, "Pss"),))


def _row(name: str, seconds: Sequence[float], limit: float | None = None) -> Row:
    limits = () if limit is None else (Limit("p99", limit),)
    return Row(name, "s", tuple(seconds), limits=limits)


GROUPS: dict[str, Callable[[Stage], list[Row]]] = {
    "roster": presences,
    "idle": idle,
    "sentence": sentence,
    "cancel": cancel,
    "say": say,
    "broker": broker_gone,
    "memory": memory,
}


def measure(name: str, stage: Stage) -> list[Row]:
    """Return the rows of a group; one row that says why, where they could not be measured."""
    try:
        return GROUPS[name](stage)
    except (TalkError, AssertionError, TimeoutError, OSError) as error:
        return [Row(f"({name})", "", failure=f"{type(error).__name__}: {error}")]


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser("python -m tests.fleet.thousand", description=_ABOUT)
    parser.add_argument("--robots", type=int, default=1000, help="that are simulated (%(default)s)")
    parser.add_argument("--processes", type=int, default=4, help="that they share (%(default)s)")
    parser.add_argument("--real", type=int, default=3, help="robots that are real (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each row (%(default)s)")
    parser.add_argument("--idle", type=float, default=60, metavar="SECONDS", help="without a request (%(default)g)")
    parser.add_argument("--only", action="append", choices=[*GROUPS], metavar="ROW", help=f"of {', '.join(GROUPS)}")
    asked = parser.parse_args()
    found = machine.head()
    rows: list[Row] = []
    began = time.monotonic()
    with Stage(asked) as stage:
        print(f"{len(stage.names)} robots after {time.monotonic() - began:.1f} s", file=sys.stderr, flush=True)
        for name in [each for each in GROUPS if not asked.only or each in asked.only]:
            print(f"{name} …", file=sys.stderr, flush=True)
            rows += measure(name, stage)
        stage.simulated.stop()
    print("; ".join(f"{name} {value}" for name, value in found.items()))
    print(as_table(rows))
    sys.exit(any(each.failure is not None for each in rows))


if __name__ == "__main__":
    main()
