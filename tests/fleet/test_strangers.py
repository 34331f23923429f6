"""Messages of strangers: spoken as they stand, answered to nobody else, and harmless to a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.fleet.asker import Asker
from tests.fleet.robot import Robot
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge
    from tests.support.broker import Broker

EVIL = "\x1b[31m\x07"
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
    """Return whether a log has nothing in it that a terminal would obey."""
    return all(each == "\n" or each.isprintable() for each in log)


def test_a_plain_text_is_spoken_as_it_stands_and_no_log_has_control_characters(robot: Robot) -> None:
    talk, watcher = robot.talk, robot.talk.watcher
    before = talk.request("set")["settings"]
    with Asker(robot.broker, "olga") as olga:
        for each in TEXTS:
            olga.send(each, kind="say", response=None)
        watcher.wait_until(lambda _: len(watcher.texts("PENDING")) == len(TEXTS))
        assert watcher.texts("PENDING") == list(TEXTS)
        assert {talk.goal(each)["client"]["name"] for each in watcher.goals()} == {"mqtt:olga"}
        olga.send("\x1b[31m--key no such", kind="cancel", response=None)  # any payload cancels everything
        for each in watcher.goals():
            watcher.wait_for_terminal(each)
        for request in (
            {"request": EVIL},
            {"request": "say", "text": "x", EVIL: 1},
            {"request": "say", "text": "x", "id": EVIL},
            {"request": "status", "id": EVIL},
        ):
            olga.send(request)
        assert not olga.ask("status", id=EVIL)["ok"]
        olga.send(EVIL, retain=True)
        olga.send({"request": "hello", "name": EVIL})
        for topic in ("presence", "echo"):
            olga.listener.publish(f"talk/robot/anna/{topic}", EVIL)
        olga.listener.publish("talk/robot/anna/request/\u202e", '{"request": "say", "text": "x"}')
        assert olga.ask("status")["ok"]
    assert watcher.texts("PENDING") == list(TEXTS)
    assert talk.request("set")["settings"] == before
    assert is_plain(robot.bridge.log), robot.bridge.log
    assert is_plain(talk.log), talk.log


def test_a_robot_publishes_nothing_on_the_response_topic_of_another(lasting_robot: Robot) -> None:
    """`tests/unit/test_fleet_topics.py` has all forms of such topics."""
    responses = {"talk/reply/otto/session/anna", "talk/robot/bert/say/olga", "elsewhere"}
    with Listener(lasting_robot.broker, "#") as everything, Asker(lasting_robot.broker, "olga") as olga:
        for each in responses:
            olga.send({"request": "say", "text": "hello"}, response=each)
        assert olga.ask("status")["ok"]
        assert not responses & {each.topic for each in everything.messages}
    assert lasting_robot.spoken == []


def test_with_no_text_only_the_asker_reads_a_sentence(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    robot = Robot(talk, broker, make_bridge(talk, broker, "anna", "--no-text"))
    with Listener(broker, "talk/robot/anna/+", "talk/robot/anna/event/+") as everybody:
        done = robot.desk("say", "--wait", "--feedback", "--key", "door", "the secret word")
        assert (done.code, "secret" in done.out) == (0, True), done
        assert talk.run("say", "--wait", "--key", "door", "another secret").code == 0
        everybody.await_message(lambda each: each.topic.endswith("/state") and each.json["state"] == "SUCCEEDED")
        everybody.await_message(lambda each: each.topic.endswith("/status") and "SUCCEEDED" in each.text)
        told = everybody.messages
    assert {each.topic.rpartition("/")[2] for each in told} >= {"state", "status", "presence"}
    assert [each for each in told if "secret" in each.text] == []
