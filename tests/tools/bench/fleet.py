"""Rows of a fleet: a robot that is asked from a desk over a broker, beside the same on the robot's own socket."""

from __future__ import annotations

import contextlib
import threading
import time
from functools import partial
from typing import TYPE_CHECKING

from talkcli import Client, State
from talkcli.fleet.broker import from_environment
from talkcli.fleet.desk.robot import connect_robot
from talkcli.protocol.events import StateChanged
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.tools.bench.machine import megabytes, taken_in
from tests.tools.bench.stage import SHORT, TALK, serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.support.processes import Talk
    from tests.tools.bench.stage import Stage

_ROBOT, _ON_ROBOT = "anna", "on the robot"
_LONG = "please step back from the moving platform, and wait until it stands still"
#: Words per minute of sentences that are spoken to their end: as fast as possible.
_RATE_WPM = 450
#: These rows are short.
_MORE_ROUNDS = 4
_PATIENCE_S = 10.0


def fleet(stage: Stage) -> list[Row]:
    """Measure a robot at a broker without TLS; then at one with TLS, beside the first."""
    rounds, seconds = stage.options.rounds * _MORE_ROUNDS, stage.options.idle
    with contextlib.ExitStack() as stack:
        talk, bridge, env = stack.enter_context(_robot())
        desk = stack.enter_context(_reach(env))
        local = stack.enter_context(Client(talk.socket, name="bench"))

        def beside(action: Callable[[Client], float], other: Client, there: Client) -> dict[str, list[float]]:
            return stage.in_turn({"here": partial(action, other), "there": partial(action, there)}, rounds)

        def command(words: tuple[str, ...], env: dict[str, str]) -> float:
            took = stage.until_end([TALK, *words], env)
            local.cancel()  # every command meets an idle server
            return took

        said, asked, ended = (beside(each, local, desk) for each in (_accepted, _answered, _cancelled))
        later = stage.in_turn({"later": partial(_result_later, desk, local)}, rounds)["later"]
        commands = {"here": partial(command, ("say", "hi"), talk.env)}
        commands |= {"there": partial(command, ("--robot", _ROBOT, "say", "hi"), env)}
        whole = stage.in_turn(commands, rounds)
        switches = taken_in([bridge.pid], seconds).switches / seconds
        memory = {each: megabytes(bridge.pid, each) for each in ("Pss", "Rss")}
        by_tls = stack.enter_context(_reach(stack.enter_context(_robot(secure=True))[2]))
        said_by_tls, asked_by_tls = (beside(each, desk, by_tls) for each in (_accepted, _answered))

    def row(name: str, times: dict[str, list[float]], peer: str, *limits: Limit) -> Row:
        return Row(name, "ms", times["there"], peer, times["here"], limits)

    where = f"idle for {seconds:.0f} s"
    return [
        row("`Client.say()` at a desk → accepted", said, _ON_ROBOT, Limit("median", 10)),
        Row("result at a client on the robot → at the desk", "ms", later, limits=(Limit("median", 5),)),
        row("`Client.status()` at a desk", asked, _ON_ROBOT),
        row("`GoalHandle.cancel()` at a desk, of the active goal", ended, _ON_ROBOT),
        row(f"`talk --robot {_ROBOT} say hi`", whole, "`talk say hi`"),
        Row(f"{where}: context switches of the bridge per second", "/s", [switches], limits=(Limit("median", 2),)),
        Row("memory of the bridge (Pss)", "MB", [memory["Pss"]], limits=(Limit("median", 25),)),
        # With what it shares with other programs: libssl, libpython.
        Row("… with shared memory (Rss)", "MB", [memory["Rss"]]),
        row("`Client.say()` at a desk with TLS → accepted", said_by_tls, "without"),
        row("`Client.status()` at a desk with TLS", asked_by_tls, "without"),
    ]


@contextlib.contextmanager
def _robot(*, secure: bool = False) -> Iterator[tuple[Talk, Bridge, dict[str, str]]]:
    """Run a broker and a robot there; yield its server, its bridge and the environment of a desk."""
    with Broker(secure=secure) as broker, serving("--player", "null") as talk, Bridge(talk, broker, _ROBOT) as bridge:
        bridge.await_online()
        with Desk(broker, user="desk", password=False) as desk:
            yield talk, bridge, desk.env
        bridge.terminate()


def _reach(env: dict[str, str]) -> Client:
    return Client.over(connect_robot(_ROBOT, from_environment(env), name="bench"))


def _accepted(client: Client) -> float:
    began = time.monotonic()
    goal = client.say(SHORT)
    took = time.monotonic() - began
    goal.cancel()
    return took


def _answered(client: Client) -> float:
    began = time.monotonic()
    client.status()
    return time.monotonic() - began


def _cancelled(client: Client) -> float:
    goal = client.say(_LONG)
    for event in goal.events(_PATIENCE_S):
        if isinstance(event, StateChanged) and event.state is State.ACTIVE:
            break
    began = time.monotonic()
    ended = goal.cancel()
    took = time.monotonic() - began
    assert ended.state is State.PREEMPTED, ended
    return took


def _result_later(desk: Client, local: Client) -> float:
    """Return by how many seconds a desk has a result later than a client that waits for the goal on the robot."""
    goal = desk.say(SHORT, rate=_RATE_WPM)
    (same,) = local.follow([goal.id])
    times: list[float] = []

    def wait_here() -> None:
        same.wait(_PATIENCE_S)
        times.append(time.monotonic())

    waiting = threading.Thread(target=wait_here)
    waiting.start()
    ended = goal.wait(_PATIENCE_S)
    there = time.monotonic()
    waiting.join()
    assert ended.state is State.SUCCEEDED, ended
    return there - times[0]
