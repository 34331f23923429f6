"""Measures one robot over a broker beside the same on the robot itself: see `python -m tests.bench.fleet --help`."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from importlib.metadata import version
from typing import TYPE_CHECKING

from talkcli.errors import TalkError
from talkcli.goals.states import State
from talkcli.protocol.events import StateChanged
from tests.bench import machine
from tests.bench.ear import Command
from tests.bench.failure import FailedError
from tests.bench.fleet_stage import ROBOT, FleetOptions, FleetStage
from tests.bench.idle import megabytes, settle, taken
from tests.bench.onset import milliseconds
from tests.bench.table import Limit, Row, as_markdown, as_text

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli import Client

_ABOUT = """\
Starts a private mosquitto as it comes, the checkout's talk with the null player and its bridge, and prints a table of
what is asked at a desk by the broker, beside the same on the robot's own socket, in turn. With the usual rounds it
takes three minutes, of which one is the idle bridge's. Exit code 1 where a row could not be measured (it says why, in
the place of a figure); a goal that is not met is no error.
"""
_TEXT, _LONG = "ready", "please step back from the moving platform, and wait until it stands still"
#: The fastest there is: more rounds in the time.
_RATE = 450
#: Seconds in which a goal has begun, or ended.
_PATIENCE = 10.0
_ON_ROBOT = "on the robot"


def say(stage: FleetStage) -> list[Row]:
    """Measure a goal that is accepted, on an open connection."""
    return [_beside("say", "`Client.say()` at a desk → accepted", _accepted, stage, 10)]


def result(stage: FleetStage) -> list[Row]:
    """Measure by how much later a desk has a result than one who waits for the same goal on the robot."""
    later = []
    with stage.plain.desk() as desk, stage.plain.local() as local:
        for _ in range(stage.options.rounds + 1):
            goal = desk.say(_TEXT, rate=_RATE)
            (same,) = local.follow([goal.id])
            times: list[float] = []

            def wait_here() -> None:
                same.wait(_PATIENCE)  # noqa: B023 - it has ended before the next round
                times.append(time.monotonic())  # noqa: B023

            waiting = threading.Thread(target=wait_here)
            waiting.start()
            found = goal.wait(_PATIENCE)
            there = time.monotonic()
            waiting.join()
            if found.state is not State.SUCCEEDED or not times:
                raise FailedError(f"{found.state}: {found.message}")
            later.append(there - times[0])
    name = "result at one who waits on the robot → at the desk"
    return [Row("result", name, "ms", milliseconds(later[1:]), limits=(Limit("median", 5),))]


def status(stage: FleetStage) -> list[Row]:
    """Measure a question and its answer."""
    return [_beside("status", "`Client.status()` at a desk", _status, stage)]


def cancel(stage: FleetStage) -> list[Row]:
    """Measure a cancel of what is being spoken, until it is known to be silent."""
    return [_beside("cancel", "`GoalHandle.cancel()` at a desk, of what is spoken", _cancelled, stage)]


def command(stage: FleetStage) -> list[Row]:
    """Measure whole processes, from their start to their end."""
    talk = [sys.executable, "-m", "talkcli"]
    there = [*talk, "--robot", ROBOT, "say", "hi"], stage.plain.env
    here = [*talk, "say", "hi"], stage.plain.robot.talk.env
    times: tuple[list[float], list[float]] = ([], [])
    with stage.plain.local() as local:
        for _ in range(stage.options.rounds + 1):
            for number in stage.shuffled((0, 1)):
                words, env = (there, here)[number]
                began = time.monotonic()
                Command(words, env).finish()
                times[number].append(time.monotonic() - began)
                local.cancel()  # all that is timed is timed on an idle server
    desk, robot = (milliseconds(each[1:]) for each in times)
    return [Row("command", f"`talk --robot {ROBOT} say hi`", "ms", desk, "`talk say hi`", robot)]


def idle(stage: FleetStage) -> list[Row]:
    """Measure a bridge that was asked something, and is asked nothing for a minute."""
    bridge = stage.plain.robot.bridge.pid
    with stage.plain.desk() as desk:
        desk.say(_TEXT).wait(_PATIENCE)
    settle([bridge])
    before, began = taken([bridge]), time.monotonic()
    time.sleep(stage.options.idle)
    seconds = time.monotonic() - began
    switches = taken([bridge]).since(before).switches / seconds
    where = f"idle for {seconds:.0f} s: context switches of the bridge a second"
    return [
        Row("idle", where, "/s", (switches,), limits=(Limit("median", 2),)),
        Row("idle", "memory of the bridge (Pss)", "MB", (megabytes(bridge, "Pss"),), limits=(Limit("median", 25),)),
        # With what it shares with other programs: libssl, libpython.
        Row("idle", "… with all that it shares (Rss)", "MB", (megabytes(bridge, "Rss"),)),
    ]


def tls(stage: FleetStage) -> list[Row]:
    """Measure the same by TLS, beside what it is without."""
    return [
        _beside("tls", "`Client.say()` at a desk by TLS → accepted", _accepted, stage, secure=True),
        _beside("tls", "`Client.status()` at a desk by TLS", _status, stage, secure=True),
    ]


GROUPS: dict[str, Callable[[FleetStage], list[Row]]] = {
    "say": say,
    "result": result,
    "status": status,
    "cancel": cancel,
    "command": command,
    "idle": idle,
    "tls": tls,
}


def measure(name: str, stage: FleetStage) -> list[Row]:
    """Return the rows of a group; one row that says why, where they could not be measured."""
    try:
        return GROUPS[name](stage)
    except (FailedError, TalkError, AssertionError, TimeoutError, OSError) as error:
        return [Row(name, f"({name})", "", failure=f"{type(error).__name__}: {error}")]


def _beside(
    group: str,
    name: str,
    action: Callable[[Client], float],
    stage: FleetStage,
    limit: float | None = None,
    *,
    secure: bool = False,
) -> Row:
    """Return the row of something that is done at a desk, and in turn on the robot, or by TLS, and in turn without."""
    times: tuple[list[float], list[float]] = ([], [])
    site = stage.secure if secure else stage.plain
    with site.desk() as desk, stage.plain.desk() if secure else site.local() as other:
        for _ in range(stage.options.rounds + 1):
            for number in stage.shuffled((0, 1)):
                times[number].append(action((desk, other)[number]))
    there, here = (milliseconds(each[1:]) for each in times)  # the first of each warmed up
    limits = () if limit is None else (Limit("median", limit),)
    return Row(group, name, "ms", there, "without" if secure else _ON_ROBOT, here, limits)


def _accepted(client: Client) -> float:
    began = time.monotonic()
    goal = client.say(_TEXT)
    took = time.monotonic() - began
    goal.cancel()
    return took


def _status(client: Client) -> float:
    began = time.monotonic()
    client.status()
    return time.monotonic() - began


def _cancelled(client: Client) -> float:
    goal = client.say(_LONG)
    for event in goal.events(_PATIENCE):
        if isinstance(event, StateChanged) and event.state is State.ACTIVE:
            break
    began = time.monotonic()
    ended = goal.cancel()
    took = time.monotonic() - began
    if ended.state is not State.PREEMPTED:
        raise FailedError(f"{ended.state}: {ended.message}")
    return took


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser("python -m tests.bench.fleet", description=_ABOUT)
    parser.add_argument("--rounds", type=int, default=60, help="rounds of each row (%(default)s)")
    parser.add_argument("--idle", type=float, default=60, metavar="SECONDS", help="of the idle bridge (%(default)g)")
    parser.add_argument("--only", action="append", choices=[*GROUPS], metavar="ROW", help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--markdown", action="store_true", help="print the table in Markdown")
    asked = parser.parse_args()
    rows: list[Row] = []
    with FleetStage(FleetOptions(asked.rounds, asked.idle)) as stage:
        found = machine.head(None, peers=False) | {"mosquitto": stage.mosquitto(), "paho-mqtt": version("paho-mqtt")}
        for name in [each for each in GROUPS if not asked.only or each in asked.only]:
            began = time.monotonic()
            print(f"{name} …", end=" ", file=sys.stderr, flush=True)
            rows += measure(name, stage)
            print(f"{time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    print("; ".join(f"{name} {value}" for name, value in found.items()))
    print(as_markdown(rows) if asked.markdown else as_text(rows))
    sys.exit(any(each.failure is not None for each in rows))


if __name__ == "__main__":
    main()
