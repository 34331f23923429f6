"""A bridge, a broker, a server, a network or a desk that goes away: it is told in time, and each result once."""

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

#: Seconds in which a desk knows that a bridge was killed, and that a robot's network is gone.
KILLED, CUT_OFF = 1.0, 20.0
#: Seconds in which all are back after a broker, and for which a desk waits for a broker.
BACK, ABSENCE = 15.0, 30.0
#: Seconds for which the broker keeps that a robot is online.
EXPIRY = 150


def assert_one_result(done: Finished) -> None:
    """Assert that a `--json say --wait` was told one result, SUCCEEDED."""
    assert done.code == 0, done
    told = [json.loads(line) for line in done.out.splitlines()]
    assert [each["state"] for each in told] == ["SUCCEEDED"], done


@pytest.mark.parametrize(("text", "over"), [("length=0.5 long", False), ("short", True)])
def test_a_bridge_that_is_killed_is_offline_within_a_second_and_the_next_tells_the_result(
    robot: Robot, text: str, over: bool
) -> None:
    with robot.listen() as listener, Desk(robot.broker) as somebody:
        asked = somebody.start("--robot", "anna", "--json", "say", "--wait", "--id", "mine", "--", text)
        robot.talk.watcher.wait_for("mine", "ACTIVE")
        with limits():
            killed = time.monotonic()
            robot.bridge.kill()
            offline = listener.await_message(robot.is_offline)
            assert_within(offline.arrived - killed, KILLED, "OFFLINE after the bridge was killed")
        if over:  # before the next bridge is there
            robot.talk.watcher.wait_for_terminal("mine")
        robot.bridge.start()
        robot.bridge.await_online()
        assert_one_result(somebody.finish(asked))
    assert robot.spoken == [text]


@pytest.mark.slow
def test_a_robot_whose_network_is_gone_is_offline_within_20_seconds(broker: Broker, make_robot: MakeRobot) -> None:
    with Proxy(broker.port) as proxy:
        robot = make_robot("anna", port=proxy.port)
        with robot.listen() as listener:
            gone = time.monotonic()
            proxy.hold()
            offline = listener.await_message(robot.is_offline, within=CUT_OFF + 5)
            assert_within(offline.arrived - gone, CUT_OFF, "OFFLINE without a network")
            proxy.cut()
            proxy.release()
            listener.await_message(lambda each: robot.is_online(each) and each.arrived > offline.arrived, within=BACK)
        assert robot.desk("say", "--wait", "back").code == 0


def test_a_broker_that_is_killed_in_mid_sentence_costs_no_result(robot: Robot) -> None:
    with Desk(robot.broker) as somebody:
        asked = somebody.start("--robot", "anna", "--json", "say", "--wait", "--id", "mine", "--", "length=0.5 long")
        robot.talk.watcher.wait_for("mine", "ACTIVE")
        robot.broker.kill()
        assert robot.talk.run("say", "one of its own").code == 0
        robot.bridge.await_log("can't connect to the broker")  # it has tried to come back
        robot.broker.start()
        with limits():
            up = time.monotonic()
            assert_one_result(somebody.finish(asked, timeout=BACK + 10))
            assert_within(time.monotonic() - up, BACK, "the result after the broker was back")
        robot.bridge.await_online(within=BACK)
        assert robot.desk("say", "--wait", "back").code == 0
    assert robot.spoken == ["length=0.5 long", "one of its own", "back"]


def test_a_growing_text_is_continued_after_the_broker_was_killed(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk("--player", "null", "--rate", "450")
    bridge = make_bridge(talk, broker, "anna")
    with Desk(broker) as somebody:
        options = ("--stall", "30", "--wait", "--id", "mine")
        asked = somebody.start("--robot", "anna", "--json", "say", "--stream", *options, stdin=subprocess.PIPE)
        for text in ("One. ", "Two. "):
            assert asked.stdin
            asked.stdin.write(text)
            asked.stdin.flush()
            if text == "Two. ":
                broker.start()
            talk.watcher.wait_until(lambda each, text=text: text.strip(". ") in each.get("word", ""), BACK)  # type: ignore[misc]
            if text == "One. ":
                broker.kill()
                bridge.await_log("can't connect to the broker")
        assert_one_result(somebody.finish(asked, stdin="Three."))
    assert talk.goal("mine")["text"] == "One. Two. Three."
    assert talk.watcher.states("mine") == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert [each["word"] for each in talk.watcher.words("mine")] == ["One", "Two", "Three"]
    bridge.await_online(within=BACK)


@pytest.mark.parametrize("way", ["to_client", "to_broker"])
def test_a_goal_whose_acceptance_was_lost_on_the_way_is_asked_for_and_spoken_once(robot: Robot, way: Direction) -> None:
    with Proxy(robot.broker.port) as proxy, Fleet(robot.broker.url_at(proxy.port)).robot("anna") as client:
        proxy.hold(way)
        said: list[str] = []
        saying = threading.Thread(target=lambda: said.append(client.say("only once").wait().state.name))
        saying.start()
        if way == "to_client":
            robot.talk.watcher.wait_for(None, "SUCCEEDED")
        proxy.cut()
        proxy.release()
        saying.join(BACK)
        assert said == ["SUCCEEDED"]
    assert robot.spoken == ["only once"]


@pytest.mark.slow
def test_a_broker_that_does_not_come_back_is_given_up_after_half_a_minute(robot: Robot) -> None:
    with Desk(robot.broker) as somebody:
        asked = somebody.start("--robot", "anna", "say", "--wait", "--", "length=4 long")
        robot.talk.watcher.wait_for(None, "ACTIVE")
        with limits():
            robot.broker.kill()
            done = somebody.finish(asked, timeout=ABSENCE + 10)
            assert_within(done.seconds, ABSENCE + 1, "giving up")
        assert done.seconds > ABSENCE - 1
    assert done.code == 12, done
    assert f"broker at {robot.broker.url}" in done.err
    robot.talk.watcher.wait_for(None, "SUCCEEDED")


def test_a_server_that_is_killed_is_told_at_once_and_so_is_the_next(robot: Robot) -> None:
    with robot.listen() as listener:
        killed = time.monotonic()
        robot.talk.kill()
        without = listener.await_message(robot.is_without_server)
        assert without.arrived - killed < KILLED
        done = robot.desk("say", "hello")
        assert (done.code, done.out) == (3, ""), done
        assert "anna has no running talk server, so nothing was sent" in done.err
        robot.talk.start_server()
        listener.await_message(lambda each: robot.is_online(each) and each.json["server"]["pid"] == robot.talk.pid)
    assert robot.desk("say", "--wait", "back").code == 0
    assert robot.spoken == ["back"]


def test_a_server_that_is_killed_under_a_desk_that_waits_has_lost_the_goal(robot: Robot) -> None:
    with Desk(robot.broker) as somebody, Listener(robot.broker, "talk/reply/#") as replies:
        asked = somebody.start("--robot", "anna", "say", "--wait", "--", LONG)
        replies.await_message(lambda each: "ACTIVE" in each.text)  # else the desk may not know that it was accepted
        robot.talk.kill()
        done = somebody.finish(asked)
    assert (done.code, "result unknown: " in done.err) == (12, True), done


def test_a_robot_that_ends_says_goodbye(robot: Robot) -> None:
    with robot.listen() as listener:
        online = listener.messages[0]
        assert online.expiry is not None
        assert EXPIRY - 20 < online.expiry <= EXPIRY  # a robot may die while the broker is away
        assert robot.bridge.terminate() == 0
        listener.await_message(robot.is_offline)
        with Listener(robot.broker, robot.presence) as later:
            kept = later.await_message(robot.is_offline)
            assert (kept.retain, kept.expiry) == (True, None)  # so that a missing robot is seen
        listener.publish(robot.presence, b"")  # which comes after all words of the bridge
        listener.await_message(lambda each: not each.payload)
        assert [each.json["online"] for each in listener.messages if each.payload] == [True, False]


@pytest.mark.parametrize(("how", "code"), [("interrupted", 130), ("unread", 141), ("too-late", 124)])
def test_a_goal_of_a_desk_that_goes_away_is_cancelled_at_the_robot(lasting_robot: Robot, how: str, code: int) -> None:
    words = {"unread": ["--feedback"], "too-late": ["--timeout", "0.5"]}.get(how, [])
    with Desk(lasting_robot.broker) as somebody:
        asked = somebody.start("--robot", "anna", "say", "--wait", *words, "--id", how, "--", LONG)
        lasting_robot.talk.watcher.wait_for(how, "ACTIVE")
        assert asked.stdout
        if how == "interrupted":
            asked.send_signal(signal.SIGINT)
        elif how == "unread":
            asked.stdout.close()
        assert asked.wait(10) == code
        assert lasting_robot.talk.goal(how)["state"] == "PREEMPTED"


def test_a_command_waits_for_a_robot_to_be_online(robot: Robot) -> None:
    assert robot.bridge.terminate() == 0
    with Desk(robot.broker) as somebody, Listener(robot.broker, topics.reply("+", "+", "+")) as listener:
        client = somebody.start("--robot", "anna", "--connect-timeout", "60", "say", "--wait", "length=0.1")
        listener.await_message(lambda _: True)  # the desk's marker: it has asked who is there
        robot.bridge.start()
        assert somebody.finish(client).code == 0
    assert robot.spoken == ["length=0.1"]


def test_a_command_waits_for_the_broker(robot: Robot) -> None:
    with Proxy(robot.broker.port) as proxy, Desk(robot.broker, port=proxy.port) as somebody:
        came = proxy.hold_from("to_broker", b"MQTT")
        client = somebody.start("--robot", "anna", "--connect-timeout", "60", "say", "--wait", "length=0.1")
        assert came.wait(PATIENCE)
        proxy.release()
        proxy.cut()
        assert somebody.finish(client).code == 0
    assert robot.spoken == ["length=0.1"]


@pytest.mark.parametrize(
    ("robot", "line", "code", "words"),
    [
        ("anna", "--connect-timeout 0.1 say hello", 3, "waited 0.1 s: no robot 'anna' is known"),
        ("anna", "--connect-timeout 60 say --wait --timeout 0.1 hello", 124, "waited "),
        ("@all", "--connect-timeout 60 status", 2, "--connect-timeout only works with one robot"),
    ],
)
def test_a_robot_is_waited_for_no_longer(broker: Broker, robot: str, line: str, code: int, words: str) -> None:
    with Desk(broker, env={"TALK_ROBOT": robot}) as somebody:
        done = somebody.run(*line.split())
    assert (done.code, done.out) == (code, "")
    assert words in done.err


# Two bridges of one name


def assert_ends(younger: Robot) -> None:
    log = younger.bridge.log if younger.bridge.wait(BACK) == 11 else "it did not end with 11"
    assert "another bridge already uses the name 'anna'" in log
    assert "Traceback" not in log


def assert_answers(robot: Robot) -> None:
    """Assert that the robot's first bridge answers."""
    assert robot.bridge.running, robot.bridge.log
    assert robot.desk("say", "--wait", "still here").code == 0
    assert robot.spoken == ["still here"]


def test_the_younger_of_two_bridges_ends_and_the_older_goes_on(robot: Robot, make_robot: MakeRobot) -> None:
    with robot.listen() as listener:
        another = make_robot("anna", online=False)
        assert_ends(another)
        assert_answers(robot)
        told = [each.json for each in listener.messages]
    assert {(each["online"], each["server"]["pid"]) for each in told} == {(True, robot.talk.pid)}
    assert another.talk.watcher.goals() == []


def test_of_two_bridges_that_find_the_broker_together_the_younger_ends(robot: Robot, make_robot: MakeRobot) -> None:
    robot.broker.kill()
    another = make_robot("anna", online=False)
    another.bridge.await_log("can't connect to the broker")  # so it has started
    robot.broker.start()
    assert_ends(another)
    robot.bridge.await_online(BACK)
    assert_answers(robot)
    assert another.talk.watcher.goals() == []


def test_a_bridge_that_began_while_the_older_had_no_network_ends_when_that_is_back(
    broker: Broker, make_robot: MakeRobot
) -> None:
    with Proxy(broker.port) as proxy:
        robot = make_robot("anna", port=proxy.port)
        with robot.listen() as listener:
            proxy.refuse()
            proxy.cut()
            listener.await_message(robot.is_offline)
            another, first, pid = make_robot("anna"), listener.messages[0], robot.talk.pid
            proxy.accept()
            assert_ends(another)
            listener.await_message(
                lambda each: robot.is_online(each) and each is not first and each.json["server"]["pid"] == pid
            )
        assert_answers(robot)
        assert another.talk.watcher.goals() == []


def test_the_remains_of_a_killed_bridge_keep_no_other_from_its_name(broker: Broker, make_robot: MakeRobot) -> None:
    with Proxy(broker.port) as proxy:
        lost = make_robot("anna", port=proxy.port)
        proxy.hold()  # so that the broker doesn't hear of its end
        lost.bridge.kill()
        robot = make_robot("anna")
        assert_answers(robot)
        with robot.listen() as listener:
            proxy.cut()  # now it does, and publishes the will of the killed bridge
            will = listener.await_message(robot.is_offline)
            listener.await_message(lambda each: robot.is_online(each) and each.arrived > will.arrived)
        assert robot.desk("status").code == 0
