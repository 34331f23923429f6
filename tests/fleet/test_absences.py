"""Bridges, brokers, servers, networks and desks that go away, and bridges with the same name."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import Fleet
from talkcli.fleet import topics
from tests.fleet.robot import LONG, Robot
from tests.support.bridge import Desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.proxy import Proxy
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge, MakeRobot
    from tests.support.broker import Broker
    from tests.support.processes import Finished
    from tests.support.proxy import Direction

#: Seconds until a robot is OFFLINE after its bridge was killed, and after its network was lost.
KILLED, CUT_OFF = 1.0, 20.0
#: Seconds until robots and desks have reconnected, and for which a desk waits for a broker.
BACK, ABSENCE = 15.0, 30.0
#: Seconds after which a robot's presence expires.
EXPIRY = 150


def assert_one_result(done: Finished) -> None:
    """Assert that `--json say --wait` printed one goal, which has succeeded."""
    assert done.code == 0, done
    goals = [json.loads(line) for line in done.out.splitlines()]
    assert [goal["state"] for goal in goals] == ["SUCCEEDED"], done


@pytest.mark.parametrize(("text", "over"), [("length=0.5 long", False), ("short", True)])
def test_a_killed_bridge_is_offline_in_1_s_and_the_next_reports_the_result(robot: Robot, text: str, over: bool) -> None:
    with robot.listen() as listener, Desk(robot.broker) as desk:
        client = desk.start("--robot", "anna", "--json", "say", "--wait", "--id", "mine", "--", text)
        robot.talk.watcher.wait_for("mine", "ACTIVE")
        with limits():
            killed = time.monotonic()
            robot.bridge.kill()
            offline = listener.await_message(robot.is_offline)
            assert_within(offline.arrived - killed, KILLED, "OFFLINE after the bridge was killed")
        if over:  # before the next bridge starts
            robot.talk.watcher.wait_for_terminal("mine")
        robot.bridge.start()
        robot.bridge.await_online()
        assert_one_result(desk.finish(client))
    assert robot.spoken == [text]


@pytest.mark.slow
def test_a_robot_without_network_is_offline_within_20_s(broker: Broker, make_robot: MakeRobot) -> None:
    with Proxy(broker.port) as proxy:
        robot = make_robot("anna", port=proxy.port)
        with robot.listen() as listener:
            gone = time.monotonic()
            proxy.hold()
            lost = listener.await_message(robot.is_offline, within=CUT_OFF + 5)
            assert_within(lost.arrived - gone, CUT_OFF, "OFFLINE without a network")
            proxy.cut()
            proxy.release()
            listener.await_message(lambda message: robot.is_online(message) and message.arrived > lost.arrived, BACK)
        assert robot.desk("say", "--wait", "back").code == 0


def test_no_result_is_lost_if_the_broker_is_killed_in_mid_sentence(robot: Robot) -> None:
    with Desk(robot.broker) as desk:
        client = desk.start("--robot", "anna", "--json", "say", "--wait", "--id", "mine", "--", "length=0.5 long")
        robot.talk.watcher.wait_for("mine", "ACTIVE")
        robot.broker.kill()
        assert robot.talk.run("say", "a local goal").code == 0
        robot.bridge.await_log("can't connect to the broker")  # it has tried to reconnect
        robot.broker.start()
        with limits():
            up = time.monotonic()
            assert_one_result(desk.finish(client, timeout=BACK + 10))
            assert_within(time.monotonic() - up, BACK, "the result after the broker was back")
        robot.bridge.await_online(within=BACK)
        assert robot.desk("say", "--wait", "back").code == 0
    assert robot.spoken == ["length=0.5 long", "a local goal", "back"]


def test_a_growing_text_continues_after_the_broker_was_killed(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk("--player", "null", "--rate", "450")
    bridge = make_bridge(talk, broker, "anna")
    with Desk(broker) as operator:
        options = ("--stall", "30", "--wait", "--id", "mine")
        client = operator.start("--robot", "anna", "--json", "say", "--stream", *options, stdin=subprocess.PIPE)
        for text in ("One. ", "Two. "):
            assert client.stdin
            client.stdin.write(text)
            client.stdin.flush()
            if text == "Two. ":
                broker.start()
            talk.watcher.wait_until(lambda event, text=text: text.strip(". ") in event.get("word", ""), BACK)  # type: ignore[misc]
            if text == "One. ":
                broker.kill()
                bridge.await_log("can't connect to the broker")
        assert_one_result(operator.finish(client, stdin="Three."))
    assert talk.goal("mine")["text"] == "One. Two. Three."
    assert talk.watcher.states("mine") == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert [word["word"] for word in talk.watcher.words("mine")] == ["One", "Two", "Three"]
    bridge.await_online(within=BACK)


@pytest.mark.parametrize("way", ["to_client", "to_broker"])
def test_a_goal_is_spoken_once_if_its_request_or_reply_is_lost(robot: Robot, way: Direction) -> None:
    with Proxy(robot.broker.port) as proxy, Fleet(robot.broker.url_at(proxy.port)).robot("anna") as client:
        held = proxy.hold_from(way, b'"PENDING"' if way == "to_client" else b'"say"')
        states: list[str] = []
        saying = threading.Thread(target=lambda: states.append(client.say("only once").wait().state.name))
        saying.start()
        assert held.wait(PATIENCE)
        if way == "to_client":
            robot.talk.watcher.wait_for(None, "SUCCEEDED")
        proxy.cut()
        proxy.release()
        saying.join(BACK)
        assert states == ["SUCCEEDED"]
    assert robot.spoken == ["only once"]


@pytest.mark.slow
def test_a_desk_waits_30_s_for_a_missing_broker(robot: Robot) -> None:
    with Desk(robot.broker) as desk:
        client = desk.start("--robot", "anna", "say", "--wait", "--", "length=4 long")
        robot.talk.watcher.wait_for(None, "ACTIVE")
        with limits():
            robot.broker.kill()
            done = desk.finish(client, timeout=ABSENCE + 10)
            assert_within(done.seconds, ABSENCE + 1, "the end of the wait for the broker")
        assert done.seconds > ABSENCE - 1
    assert done.code == 12, done
    assert f"broker at {robot.broker.url}" in done.err
    robot.talk.watcher.wait_for(None, "SUCCEEDED")


def test_a_killed_server_and_its_successor_are_reported_at_once(robot: Robot) -> None:
    with robot.listen() as listener:
        killed = time.monotonic()
        robot.talk.kill()
        without = listener.await_message(robot.is_without_server)
        assert without.arrived - killed < KILLED
        done = robot.desk("say", "hello")
        assert (done.code, done.out) == (3, ""), done
        assert "anna has no running talk server, so nothing was sent" in done.err
        robot.talk.start_server()
        listener.await_message(robot.has_current_server)
    assert robot.desk("say", "--wait", "back").code == 0
    assert robot.spoken == ["back"]


def test_a_waiting_desk_reports_a_lost_goal_if_the_server_is_killed(robot: Robot) -> None:
    with Desk(robot.broker) as desk, Listener(robot.broker, "talk/reply/#") as replies:
        client = desk.start("--robot", "anna", "say", "--wait", "--", LONG)
        replies.await_message(lambda message: "ACTIVE" in message.text)  # the desk knows that the goal was accepted
        robot.talk.kill()
        done = desk.finish(client)
    assert (done.code, "result unknown: " in done.err) == (12, True), done


def test_a_bridge_that_ends_publishes_that_its_robot_is_offline(robot: Robot) -> None:
    with robot.listen() as listener:
        online = listener.messages[0]
        assert online.expiry is not None
        assert EXPIRY - 20 < online.expiry <= EXPIRY  # a robot may die while the broker is away
        assert robot.bridge.terminate() == 0
        listener.await_message(robot.is_offline)
        with Listener(robot.broker, robot.presence) as later:
            kept = later.await_message(robot.is_offline)
            assert (kept.retain, kept.expiry) == (True, None)  # so that a missing robot is noticed
        listener.publish(robot.presence, b"")  # arrives after all messages of the bridge
        listener.await_message(lambda message: not message.payload)
        assert [message.json["online"] for message in listener.messages if message.payload] == [True, False]


@pytest.mark.parametrize(("case", "code"), [("interrupted", 130), ("unread", 141), ("too-late", 124)])
def test_a_desk_that_stops_waiting_cancels_its_goal(shared_robot: Robot, case: str, code: int) -> None:
    options = {"unread": ["--feedback"], "too-late": ["--timeout", "0.5"]}.get(case, [])
    with Desk(shared_robot.broker) as desk:
        client = desk.start("--robot", "anna", "say", "--wait", *options, "--id", case, "--", LONG)
        shared_robot.talk.watcher.wait_for(case, "ACTIVE")
        assert client.stdout
        if case == "interrupted":
            client.send_signal(signal.SIGINT)
        elif case == "unread":
            client.stdout.close()
        assert client.wait(10) == code
        assert shared_robot.talk.goal(case)["state"] == "PREEMPTED"


def test_a_command_waits_until_its_robot_is_online(robot: Robot) -> None:
    assert robot.bridge.terminate() == 0
    with Desk(robot.broker) as desk, Listener(robot.broker, topics.reply("+", "+", "+")) as listener:
        client = desk.start("--robot", "anna", "--connect-timeout", "60", "say", "--wait", "length=0.1")
        listener.await_message(lambda _: True)  # the desk has requested the presence of all robots
        robot.bridge.start()
        assert desk.finish(client).code == 0
    assert robot.spoken == ["length=0.1"]


def test_a_command_waits_for_the_broker(robot: Robot) -> None:
    with Proxy(robot.broker.port) as proxy, Desk(robot.broker, port=proxy.port) as desk:
        arrived = proxy.hold_from("to_broker", b"MQTT")
        client = desk.start("--robot", "anna", "--connect-timeout", "60", "say", "--wait", "length=0.1")
        assert arrived.wait(PATIENCE)
        proxy.release()
        proxy.cut()
        assert desk.finish(client).code == 0
    assert robot.spoken == ["length=0.1"]


@pytest.mark.parametrize(
    ("robot", "line", "code", "error"),
    [
        ("anna", "--connect-timeout 0.1 say hello", 3, "waited 0.1 s: no robot 'anna' is known"),
        ("anna", "--connect-timeout 60 say --wait --timeout 0.1 hello", 124, "waited "),
        ("@all", "--connect-timeout 60 status", 2, "--connect-timeout only works with one robot"),
    ],
)
def test_a_command_waits_only_until_its_time_limit(
    broker: Broker, robot: str, line: str, code: int, error: str
) -> None:
    with Desk(broker, env={"TALK_ROBOT": robot}) as desk:
        done = desk.run(*line.split())
    assert (done.code, done.out) == (code, "")
    assert error in done.err


# Two bridges with the same name


def assert_exits(younger: Robot) -> None:
    log = younger.bridge.log if younger.bridge.wait(BACK) == 11 else "it did not exit with 11"
    assert "another bridge already uses the name 'anna'" in log
    assert "Traceback" not in log


def assert_answers(robot: Robot) -> None:
    """Assert that the robot's first bridge still works."""
    assert robot.bridge.running, robot.bridge.log
    assert robot.desk("say", "--wait", "still here").code == 0
    assert robot.spoken == ["still here"]


def test_the_younger_of_two_bridges_exits_and_the_older_continues(robot: Robot, make_robot: MakeRobot) -> None:
    with robot.listen() as listener:
        another = make_robot("anna", online=False)
        assert_exits(another)
        assert_answers(robot)
        presences = [message.json for message in listener.messages]
    assert {(presence["online"], presence["server"]["pid"]) for presence in presences} == {(True, robot.talk.pid)}
    assert another.talk.watcher.goals() == []


def test_the_younger_bridge_exits_if_both_connect_at_the_same_time(robot: Robot, make_robot: MakeRobot) -> None:
    robot.broker.kill()
    another = make_robot("anna", online=False)
    another.bridge.await_log("can't connect to the broker")  # it has started
    robot.broker.start()
    assert_exits(another)
    robot.bridge.await_online(BACK)
    assert_answers(robot)
    assert another.talk.watcher.goals() == []


def test_the_younger_bridge_exits_once_the_older_has_network_again(broker: Broker, make_robot: MakeRobot) -> None:
    with Proxy(broker.port) as proxy:
        robot = make_robot("anna", port=proxy.port)
        with robot.listen() as listener:
            proxy.refuse()
            proxy.cut()
            listener.await_message(robot.is_offline)
            another, first = make_robot("anna"), listener.messages[0]
            proxy.accept()
            assert_exits(another)
            listener.await_message(lambda message: robot.has_current_server(message) and message is not first)
        assert_answers(robot)
        assert another.talk.watcher.goals() == []


def test_a_new_bridge_can_use_the_name_of_a_killed_one(broker: Broker, make_robot: MakeRobot) -> None:
    with Proxy(broker.port) as proxy:
        lost = make_robot("anna", port=proxy.port)
        proxy.hold()  # so that the broker doesn't notice that the bridge ends
        lost.bridge.kill()
        robot = make_robot("anna")
        assert_answers(robot)
        with robot.listen() as listener:
            proxy.cut()  # now the broker notices, and publishes the will of the killed bridge
            will = listener.await_message(robot.is_offline)
            listener.await_message(lambda message: robot.is_online(message) and message.arrived > will.arrived)
        assert robot.desk("status").code == 0
