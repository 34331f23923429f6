"""Commands to several robots, with faults of the network, the broker, a robot or the desk."""

from __future__ import annotations

import signal
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.errors import UsageError
from talkcli.fleet.broker import client_user
from tests.fleet import publish
from tests.fleet.conftest import fleet_of
from tests.fleet.fake_robot import FakeRobot
from tests.fleet.many import RealRobots, alike, assert_outcomes, at_once, printed_outcomes, request
from tests.fleet.remote_client import RemoteClient
from tests.fleet.robot import LONG
from tests.support.bridge import Desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.proxy import Proxy
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from talkcli import Fleet
    from tests.fleet.conftest import MakeBridge, MakeRobot
    from tests.support.broker import Broker
    from tests.support.processes import Finished, Process

PAIR = ["wh-1", "wh-2"]
#: A glob and a group that select both robots.
SELECTIONS = ("wh-*", "@warehouse")
#: Seconds until a goal is lost without a broker, and until a silent robot counts as gone.
ABSENCE, SILENCE = 30.0, 15.0
#: Maximum number of pending goals of one user.
PENDING = 15


@pytest.fixture
def proxied(pair: RealRobots) -> Iterator[tuple[Desk, Proxy]]:
    """A desk behind a proxy. All goals are cancelled afterwards."""
    with Proxy(pair.broker.port) as proxy, Desk(pair.broker, port=proxy.port) as result:
        yield result, proxy
        proxy.release()
    request(pair, "cancel")


def start_speaking(desk: Desk, robots: RealRobots, to: str, goal_id: str) -> Process:
    """Start a command that waits for a goal, and return it when both robots speak."""
    waiting = desk.start("--robot", to, "say", "--wait", "--id", goal_id, "--", LONG)
    robots.each(lambda robot: robot.talk.watcher.wait_for(goal_id, "ACTIVE"))
    return waiting


def states(robots: RealRobots, goal_id: str) -> list[str]:
    """Return the state of a goal on each robot."""
    return [goal["state"] for goal in robots.each(lambda robot: robot.talk.goal(goal_id))]


def line_of(process: Process) -> str:
    """Return the next line of a command's output."""
    assert process.stdout
    return process.stdout.readline()


@pytest.mark.parametrize("to", SELECTIONS)
def test_a_goal_cancelled_before_sending_is_never_spoken(
    pair: RealRobots, proxied: tuple[Desk, Proxy], to: str
) -> None:
    desk, proxy = proxied
    text = f"never spoken by {to.strip('@*-')}"
    stalled = proxy.hold_from("to_broker", text.encode())
    waiting = desk.start("--robot", to, "say", "--wait", "--", text)
    assert stalled.wait(PATIENCE)
    waiting.send_signal(signal.SIGINT)
    with Listener(pair.broker, "talk/reply/+/+/_") as replies:
        proxy.cut()
        proxy.release()
        assert replies.find(lambda _: True, PATIENCE)  # the desk has reconnected, and requests the presences
    done = desk.finish(waiting)
    assert (done.code, done.err.splitlines()[-1]) == (130, "talk: 0 of 2 robots succeeded"), done
    for name in PAIR:
        assert desk.run("--robot", name, "say", "--wait", "control").code == 0
    assert not [spoken_text for spoken in pair.spoken().values() for spoken_text in spoken if spoken_text == text]


@pytest.mark.parametrize("to", SELECTIONS)
def test_an_interrupted_desk_that_reconnects_in_time_cancels_its_goal(
    pair: RealRobots, proxied: tuple[Desk, Proxy], to: str
) -> None:
    desk, proxy = proxied
    goal = f"back-in-time-{SELECTIONS.index(to)}"
    waiting = start_speaking(desk, pair, to, goal)
    proxy.hold()  # so that the desk reconnects, but gets nothing through before the release
    proxy.cut()
    waiting.send_signal(signal.SIGINT)
    proxy.release()
    done = desk.finish(waiting)
    assert_outcomes(done, 130, alike(PAIR, goal, "PREEMPTED", 7), "0 of 2 robots succeeded")
    assert states(pair, goal) == ["PREEMPTED", "PREEMPTED"]


def test_robots_may_still_be_speaking_if_the_broker_is_gone(broker: Broker) -> None:
    with RealRobots(broker, PAIR, ["warehouse"]) as robots, Desk(broker) as desk:
        options, waiting = ["say", "--wait", "--ttl", "0", "--id"], []
        for to, state in zip(SELECTIONS, ("ACTIVE", "PENDING"), strict=True):
            waiting.append(desk.start("--robot", to, *options, state, "--", LONG))
            robots.each(lambda robot, state=state: robot.talk.watcher.wait_for(state, state))  # type: ignore[misc]
        broker.kill()
        for process in waiting:
            process.send_signal(signal.SIGINT)
        for process in waiting:
            done = desk.finish(process)
            assert (done.code, done.out) == (130, "")
            assert done.err == (
                f"talk: may still be speaking: wh-1, wh-2: the connection to the broker at {broker.url} was lost\n"
                "talk: 0 of 2 robots succeeded\n"
            )
        broker.start()
        robots.each(lambda robot: robot.bridge.await_online(within=20))
        assert [states(robots, goal) for goal in ("ACTIVE", "PENDING")] == [["ACTIVE"] * 2, ["PENDING"] * 2]
        assert desk.run("--robot", "@warehouse", "cancel").code == 0


def test_a_command_to_offline_robots_ends_without_a_broker(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    with Listener(broker) as publisher:
        publish.presence(publisher, "off-1", online=False)
    outcomes = iter(fleet_of(broker, monkeypatch, grace=60).say("@all", "hello"))
    assert next(outcomes).state == "OFFLINE"
    with limits():
        killed = time.monotonic()
        broker.kill()
        assert list(outcomes) == []
        assert_within(time.monotonic() - killed, 1, "the end of the command")


@pytest.mark.slow
def test_goals_are_lost_after_30_s_without_a_broker(broker: Broker) -> None:
    with RealRobots(broker, PAIR, ["warehouse"]) as robots, Desk(broker) as desk:
        with Listener(broker) as publisher:
            publish.presence(publisher, "wh-3", online=False, groups=["warehouse"])
        waiting = [
            desk.start("--robot", to, "say", "--wait", "--ttl", "0", "--id", f"asked-{number}", "--", LONG)
            for number, to in enumerate(SELECTIONS)
        ]
        assert [line_of(process) for process in waiting] == ["wh-3 - OFFLINE 3\n"] * 2
        with limits():
            killed = time.monotonic()
            broker.kill()
            for number, process in enumerate(waiting):
                done = desk.finish(process, timeout=ABSENCE + 10)
                assert_within(time.monotonic() - killed, ABSENCE + 1, "the end of the command")
                assert done.code == 13, done
                assert {
                    name: (state, code) for name, (_, state, code) in printed_outcomes(done).items()
                } == dict.fromkeys(PAIR, ("LOST", 12)), number
        request(robots, "cancel")
        for robot in PAIR:
            robots[robot].bridge.kill()


@pytest.mark.slow
def test_a_suspended_desk_loses_no_results(pair: RealRobots, desk: Desk) -> None:
    """The desk processes waiting messages before it reports a robot as gone."""
    waiting = [
        desk.start("--robot", to, "say", "--wait", "--ttl", "0", "--id", f"stopped-{number}", "--", "length=4 keep on")
        for number, to in enumerate(SELECTIONS)
    ]
    pair.each(lambda robot: [robot.talk.watcher.wait_for(f"stopped-{number}", "PENDING") for number in range(2)])
    for process in waiting:
        process.send_signal(signal.SIGSTOP)
    time.sleep(SILENCE + 1)
    for process in waiting:
        process.send_signal(signal.SIGCONT)
    for n, process in enumerate(waiting):
        assert_outcomes(desk.finish(process), 0, alike(PAIR, f"stopped-{n}", "SUCCEEDED", 0), "2 of 2 robots succeeded")


EVIL = "\x1b[31mred"
NO_STATE, NO_SUCH_STATE, NO_ID = {"id": "odd"}, {"id": "odd", "state": "DANCING"}, {"id": EVIL, "state": "PENDING"}
#: Malformed replies, by the text, the first id or the kind of the request.
MALFORMED_REPLIES: dict[str, list[dict[str, Any]]] = {
    "no state": [{"ok": True, "goal": NO_STATE}],
    "no such state": [{"ok": True, "goal": NO_SUCH_STATE}],
    "no id": [{"ok": True, "goal": NO_ID}],
    "no goal": [{"ok": True, "goal": [7]}],
    "nothing": [{"ok": True, "goal": None}],
    "no goal in status": [{"ok": True, "goal": None}],
    "canceled-odd": [{"canceled": NO_STATE}, {"ok": True}],
    "canceled-evil": [{"canceled": NO_ID}, {"ok": True}],
    "canceled-unknown": [{"canceled": {"id": 4}}, {"ok": False, "error": {"code": "unknown_goal", "message": EVIL}}],
    "waited-odd": [{"goal": NO_SUCH_STATE}, {"ok": True}],
    "waited-evil": [{"goal": NO_ID}, {"ok": True}],
    "status": [{"pending": NO_STATE}, {"ok": True, "server": {}, "active": NO_ID}],
    "pause": [{"ok": True, "goal": NO_SUCH_STATE}],
}
SPOKEN, UNKNOWN = ("SUCCEEDED", 0), ("UNKNOWN", 8)
#: A command, its goal or text, and its outcome on the other robots. None if the outcome depends on other tests.
COMMANDS: list[tuple[str, str, tuple[str, int] | None]] = [
    *(("say --wait", text, SPOKEN) for text in ("no state", "no such state", "no id", "no goal", "nothing")),
    ("say", "no such state", ("PENDING", 0)),
    *(("cancel", goal_id, UNKNOWN) for goal_id in ("canceled-odd", "canceled-evil", "canceled-unknown")),
    *(("wait", goal_id, UNKNOWN) for goal_id in ("waited-odd", "waited-evil")),
    ("status", "no goal in status", UNKNOWN),
    ("status", "", None),
]


def malformed_reply(request: dict[str, Any]) -> Sequence[dict[str, Any]]:
    """Return a malformed reply."""
    (first, *_) = request.get("ids") or [request.get("text") or request.get("id") or request["request"]]
    return MALFORMED_REPLIES.get(first, [])


def assert_plain(done: Finished) -> None:
    """Assert that the output names no bug, and has no control characters."""
    assert "a bug" not in done.err, done
    assert "\x1b" not in done.out + done.err, done


@pytest.mark.parametrize("to", ["*", "@all", "odd-1"])
def test_a_malformed_reply_is_only_a_failure_of_its_robot(pair: RealRobots, desk: Desk, to: str) -> None:
    # A pause of several robots would delay the other commands.
    commands = [*COMMANDS, ("pause", "", None)] if to == "odd-1" else COMMANDS
    lines = [["--robot", to, *command.split(), *([argument] if argument else [])] for command, argument, _ in commands]
    with FakeRobot(pair.broker, "odd-1", malformed_reply, ["odd"]):
        results = at_once(desk, *lines)
    for done, (_, _, others) in zip(results, commands, strict=True):
        assert_plain(done)
        if to == "odd-1":
            assert (done.code in (9, 12), done.err.startswith("talk: ")) == (True, True), done
            continue
        assert done.code == 13 if others == UNKNOWN else done.code in (9, 12), done
        outcomes = {name: (state, code) for name, (_, state, code) in printed_outcomes(done).items()}
        assert outcomes.pop("odd-1")[1] in (9, 12), done
        assert "odd-1: " in done.err
        if others is None:
            assert {code for _, code in outcomes.values()} == {0}
        else:
            assert outcomes == dict.fromkeys(PAIR, others), done


@pytest.mark.parametrize("name", ["presence", "reply"])
def test_a_robot_may_have_the_name_of_a_topic(
    scripted: Any, broker: Broker, make_bridge: MakeBridge, name: str
) -> None:
    make_bridge(scripted, broker, name, groups=["odd"])
    with Desk(broker) as desk:
        selections = [f"{name[:-1]}*", "@odd", "@all"]
        lines = [["--robot", to, "say", "--wait", "--id", f"of-{n}", "hello"] for n, to in enumerate(selections)]
        for number, done in enumerate(at_once(desk, *lines)):
            assert_outcomes(done, 0, {name: (f"of-{number}", "SUCCEEDED", 0)}, "1 of 1 robots succeeded")


def test_a_robot_that_left_the_group_while_it_spoke_is_cancelled_too(
    broker: Broker, make_robot: MakeRobot, make_bridge: MakeBridge
) -> None:
    robots = [make_robot(name, groups=["warehouse"]) for name in PAIR]
    with Desk(broker) as desk, Listener(broker, "talk/robot/wh-2/request/+") as listener:
        waiting = desk.start("--robot", "@warehouse", "say", "--wait", "--id", "left", "--", LONG)
        for robot in robots:
            robot.talk.watcher.wait_for("left", "ACTIVE")
        assert robots[1].bridge.terminate() == 0
        make_bridge(robots[1].talk, broker, "wh-2")
        # The desk has noticed that the bridge restarted, and requests the state of the goal.
        listener.await_message(lambda message: bool(message.payload) and message.json["request"] == "wait")
        waiting.send_signal(signal.SIGINT)
        assert_outcomes(desk.finish(waiting), 130, alike(PAIR, "left", "PREEMPTED", 7), "0 of 2 robots succeeded")


@pytest.mark.parametrize("to", SELECTIONS)
def test_a_goal_can_be_cancelled_until_all_outcomes_are_returned(fleet: Fleet, pair: RealRobots, to: str) -> None:
    goal = f"within-{SELECTIONS.index(to)}"
    assert pair["wh-2"].talk.request("say", text=LONG)["ok"]
    outcomes = fleet.say(to, "length=0", id=goal)
    for outcome in outcomes:
        if outcome.robot == "wh-1":  # finishes first
            assert len(outcomes) == 2
            pair["wh-2"].talk.watcher.wait_for(goal, "PENDING")
            outcomes.cancel()
        else:
            assert (outcome.robot, outcome.state) == ("wh-2", "RECALLED")
    assert states(pair, goal) == ["SUCCEEDED", "RECALLED"]
    with pytest.raises(UsageError, match="this request has ended; to cancel its goal, use the goal's id"):
        outcomes.cancel()


@pytest.mark.slow
@pytest.mark.parametrize("to", SELECTIONS)
def test_a_patient_goal_may_wait_for_room_longer_than_for_a_reply(fleet: Fleet, pair: RealRobots, to: str) -> None:
    goal = f"patient-{SELECTIONS.index(to)}"
    request(pair, "say", id=f"before-{goal}", text=LONG)
    with RemoteClient(pair.broker, client_user(fleet._broker)) as other:
        for number in range(PENDING):
            other.send({"seq": number, "request": "say", "text": "length=0"}, to="talk/group/warehouse")
        assert other.listener.find(lambda _: sum("ok" in line for line in other.lines) == 2 * PENDING, PATIENCE)
    room = threading.Timer(8, lambda: request(pair, "cancel", ids=[f"before-{goal}"]))
    room.start()
    started_at = time.monotonic()
    outcomes = list(fleet.say(to, "length=0", patient=True, ttl=0, id=goal, wait=False))
    seconds = time.monotonic() - started_at
    room.join()
    assert seconds > 7
    assert {outcome.robot: (outcome.state, outcome.exit_code) for outcome in outcomes} == dict.fromkeys(
        PAIR, ("PENDING", 0)
    )
    assert pair.each(lambda robot: robot.talk.watcher.wait_for_terminal(goal)) == ["SUCCEEDED"] * 2
