"""Rows about a fleet: requests from a desk through a broker, compared with requests on the robot's socket."""

from __future__ import annotations

import contextlib
import threading
import time
from functools import partial
from typing import TYPE_CHECKING

from talkcli import Client, State
from talkcli.fleet.broker import from_environment
from talkcli.fleet.desk.robot import RobotConnection
from talkcli.polling import run_blocking
from talkcli.protocol.events import StateChanged
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.tools.bench.harness import SHORT, TALK, serving
from tests.tools.bench.machine import measure_use, megabytes
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.support.processes import Talk
    from tests.tools.bench.harness import Harness

_ROBOT, _ON_ROBOT = "anna", "on the robot"
_LONG = "please step back from the moving platform, and wait until it stands still"
#: Words per minute of sentences that are spoken completely: the fastest rate.
_RATE_WPM = 450
#: Factor, because these rows are short.
_MORE_ROUNDS = 4
_PATIENCE_S = 10.0


def fleet(harness: Harness) -> list[Row]:
    """Measure a robot with a broker on the same machine."""
    rounds, seconds = harness.options.rounds * _MORE_ROUNDS, harness.options.idle
    with contextlib.ExitStack() as stack:
        talk, bridge, env = stack.enter_context(_robot())
        desk = stack.enter_context(_connect(env))
        local = stack.enter_context(Client(talk.socket, name="bench"))

        def compare(action: Callable[[Client], float], here: Client, there: Client) -> dict[str, list[float]]:
            return harness.in_turn({"here": partial(action, here), "there": partial(action, there)}, rounds)

        def command(words: tuple[str, ...], env: dict[str, str]) -> float:
            seconds = harness.until_end([TALK, *words], env)
            local.cancel()  # so that the server is idle for the next command
            return seconds

        say, cancel = (compare(action, local, desk) for action in (_time_say, _time_cancel))
        later = harness.in_turn({"later": partial(_result_later, desk, local)}, rounds)["later"]
        commands = {"here": partial(command, ("say", "hi"), talk.env)}
        commands |= {"there": partial(command, ("--robot", _ROBOT, "say", "hi"), env)}
        whole = harness.in_turn(commands, rounds)
        switches = measure_use([bridge.pid], seconds).switches / seconds
        memory = megabytes(bridge.pid)

    def row(name: str, times: dict[str, list[float]], peer: str, *limits: Limit) -> Row:
        return Row(name, "ms", times["there"], peer, times["here"], limits)

    where = f"idle for {seconds:.0f} s"
    return [
        row("`Client.say()` at a desk → accepted", say, _ON_ROBOT, Limit("median", 10)),
        Row("result at a client on the robot → at the desk", "ms", later, limits=(Limit("median", 5),)),
        row("`GoalHandle.cancel()` at a desk, of the active goal", cancel, _ON_ROBOT),
        row(f"`talk --robot {_ROBOT} say hi`", whole, "`talk say hi`"),
        Row(f"{where}: context switches of the bridge per second", "/s", [switches], limits=(Limit("median", 2),)),
        Row("memory of the bridge (Pss)", "MB", [memory], limits=(Limit("median", 25),)),
    ]


@contextlib.contextmanager
def _robot() -> Iterator[tuple[Talk, Bridge, dict[str, str]]]:
    """Run a broker and a robot. Yield the robot's server, its bridge, and the environment of a desk."""
    with Broker() as broker, serving("--player", "null") as talk, Bridge(talk, broker, _ROBOT) as bridge:
        bridge.await_online()
        with Desk(broker, user="desk", password=False) as desk:
            yield talk, bridge, desk.env
        bridge.terminate()


def _connect(env: dict[str, str]) -> Client:
    return Client.over(run_blocking(RobotConnection.open(_ROBOT, from_environment(env), name="bench")))


def _time_say(client: Client) -> float:
    started_at = time.monotonic()
    goal = client.say(SHORT)
    seconds = time.monotonic() - started_at
    goal.cancel()
    return seconds


def _time_cancel(client: Client) -> float:
    goal = client.say(_LONG)
    for event in goal.events(_PATIENCE_S):
        if isinstance(event, StateChanged) and event.state is State.ACTIVE:
            break
    started_at = time.monotonic()
    ended = goal.cancel()
    seconds = time.monotonic() - started_at
    assert ended.state is State.PREEMPTED, ended
    return seconds


def _result_later(desk: Client, local: Client) -> float:
    """Return how many seconds later than a client on the robot a desk gets the result."""
    goal = desk.say(SHORT, rate=_RATE_WPM)
    (local_goal,) = local.follow([goal.id])
    times: list[float] = []

    def wait_here() -> None:
        local_goal.wait(_PATIENCE_S)
        times.append(time.monotonic())

    waiting = threading.Thread(target=wait_here)
    waiting.start()
    ended = goal.wait(_PATIENCE_S)
    desk_time = time.monotonic()
    waiting.join()
    assert ended.state is State.SUCCEEDED, ended
    return desk_time - times[0]
