"""What strangers send is text, and is answered to nobody else; who may not know what is said is not told."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.fleet.asker import Asker
from tests.fleet.robot import Robot
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge
    from tests.support.broker import Broker

TEXTS = (
    "--robot bert --flush",
    '{"request": "cancel"}',
    '{"request": "say", "text": "inside"}\n{"request": "set", "rate": 80}',
    "$(reboot); `reboot` | 'reboot",
    "\x1b[31mred\x07 \x1b]0;title\x07 and\r\nmore",
    "\u202egnihton\u2066 \u0085",
    "  blanks  ",
)


def is_plain(log: str) -> bool:
    """Whether a log has nothing in it that a terminal would obey."""
    return all(each == "\n" or each.isprintable() for each in log)


def test_what_is_said_plainly_is_spoken_as_it_stands(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    bridge = make_bridge(talk, broker, "anna")
    before = talk.request("set")["settings"]
    with Asker(broker, "olga") as olga:
        for each in TEXTS:
            olga.send(each, kind="say", response=None)
        talk.watcher.wait_until(lambda _: len(talk.watcher.texts("PENDING")) == len(TEXTS))
        assert talk.watcher.texts("PENDING") == list(TEXTS)
        assert {talk.goal(each)["client"]["name"] for each in talk.watcher.goals()} == {"mqtt:olga"}
        olga.send("\x1b[31m--key no such", kind="cancel", response=None)  # whatever it says, all is cancelled
        for each in talk.watcher.goals():
            talk.watcher.wait_for_terminal(each)
    assert talk.request("set")["settings"] == before
    assert is_plain(bridge.log)
    assert is_plain(talk.log)


def test_nothing_that_comes_reaches_a_terminal_by_a_log(robot: Robot) -> None:
    evil = "\x1b[31m\x07"
    with Asker(robot.broker, "olga") as olga:
        for request in (
            {"request": evil},
            {"request": "say", "text": "x", evil: 1},
            {"request": "say", "text": "x", "id": evil},
            {"request": "status", "id": evil},
        ):
            olga.send(request)
            assert not olga.ask("status", id=evil)["ok"]
        olga.send(evil, retain=True)
        olga.send({"request": "hello", "name": evil})
        olga.listener.publish("talk/robot/anna/presence", evil)
        olga.listener.publish("talk/robot/anna/echo", evil)
        olga.listener.publish("talk/robot/anna/request/\u202e", '{"request": "say", "text": "x"}')
        assert olga.ask("status")["ok"]
    assert robot.spoken == []
    assert is_plain(robot.bridge.log), robot.bridge.log
    assert is_plain(robot.talk.log), robot.talk.log


@pytest.mark.parametrize(
    "response",
    [
        "talk/reply/otto/session/anna",
        "talk/reply/otto/session",
        "talk/reply/olga",
        "talk/reply/olga/session/bert",
        "talk/reply/olga/session/anna/more",
        "talk/reply/olga//anna",
        "talk/robot/bert/say/olga",
        "talk/robot/anna/presence",
        "elsewhere",
    ],
)
def test_nobody_has_a_robot_publish_anywhere_else(lasting_robot: Robot, response: str) -> None:
    with Listener(lasting_robot.broker, "#") as everything, Asker(lasting_robot.broker, "olga") as olga:
        olga.send({"request": "say", "text": "hello"}, response=response)
        assert olga.ask("status")["ok"]
        assert not [each for each in everything.messages if each.topic == response and not each.retain]
    assert lasting_robot.spoken == []


def test_with_no_text_nobody_reads_what_is_said_who_did_not_ask(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    robot = Robot(talk, broker, make_bridge(talk, broker, "anna", "--no-text"))
    told = []
    with Listener(broker, "talk/robot/anna/+", "talk/robot/anna/event/+") as everybody:
        done = robot.desk("say", "--wait", "--feedback", "--key", "door", "the secret word")
        assert (done.code, "secret" in done.out) == (0, True), done
        assert talk.run("say", "--wait", "--key", "door", "another secret").code == 0
        everybody.await_message(lambda each: each.topic.endswith("/state") and each.json["state"] == "SUCCEEDED")
        everybody.await_message(lambda each: each.topic.endswith("/status") and "SUCCEEDED" in each.text)
        told = [each for each in everybody.messages if "/request/" not in each.topic]
    assert {each.topic.rpartition("/")[2] for each in told} >= {"state", "status", "presence"}
    assert [each for each in told if "secret" in each.text] == []
