"""Requests to missing robots or brokers, and repeated, retained, malformed and malicious requests."""

from __future__ import annotations

import asyncio
import select
import time
from typing import TYPE_CHECKING

import pytest
from paho.mqtt import client as paho

from talkcli.fleet import broker as brokers
from talkcli.fleet.bridge.main import Bridge, BridgeSettings
from talkcli.fleet.payloads import Message
from tests.fleet.conftest import in_loop
from tests.fleet.remote_client import RemoteClient
from tests.fleet.robot import LONG, Robot
from tests.support.bridge import desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge, MakeRobot
    from tests.support.broker import Broker
    from tests.support.processes import Finished, Talk

#: Seconds until a desk reports that a robot is missing.
AT_ONCE = 1.0
#: Maximum size of a request's line in bytes, with its line end.
LONGEST_LINE = 64 * 1024


def assert_refused(done: Finished, code: int, expected: str) -> None:
    assert (done.code, done.out) == (code, ""), done
    assert expected in done.err, done


def assert_spoken(robot: Robot, *texts: str) -> None:
    """Assert that exactly these texts were spoken before a control text."""
    assert robot.desk("say", "--wait", "control").code == 0
    assert robot.spoken == [*texts, "control"]


def test_an_offline_robot_is_reported_at_once_and_never_gets_the_goal(robot: Robot) -> None:
    assert robot.bridge.terminate() == 0
    with limits():
        for name, error in (("anna", "anna is offline, so nothing was sent"), ("nobody", "no robot 'nobody' is known")):
            done = desk(robot.broker, name, "say", "--wait", "not sent")
            assert_within(done.seconds, AT_ONCE, "a say to a missing robot")
            assert_refused(done, 3, error)
    with RemoteClient(robot.broker, "olga") as olga:  # sends without checking the presence
        olga.post("say", text="not spoken")
        olga.send("not spoken either", kind="say", response=None)
        robot.bridge.start()
        robot.bridge.await_online()
        assert_spoken(robot)
        assert olga.lines == []


def test_a_missing_broker_is_reported_and_never_gets_the_goal(robot: Robot) -> None:
    robot.broker.kill()
    assert_refused(robot.desk("say", "hello"), 3, f"can't connect to the broker at {robot.broker.url}")
    robot.broker.start()
    robot.bridge.await_online(within=15)
    assert_spoken(robot)


@in_loop
async def test_a_bridge_reconnects_if_it_is_disconnected_while_it_replies(
    scripted: Talk, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The request was received, but its reply can't be sent while the bridge waits for room in the socket."""
    bugs: list[object] = []
    original = paho.Client._sock_send

    def send(client: paho.Client, data: bytes) -> int:
        if b"not_allowed" in data:
            raise ConnectionResetError
        return original(client, data)

    async def until(condition: Callable[[], bool]) -> None:
        while not condition():  # noqa: ASYNC110 - a bridge has no event for this
            await asyncio.sleep(0.01)

    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: bugs.append(context))
    settings = BridgeSettings("anna", ("say",), socket=scripted.socket)
    bridge = Bridge(settings, lambda: brokers.from_environment(broker.env()))
    work = asyncio.create_task(bridge.run())
    await asyncio.wait_for(until(lambda: bridge._online and bridge._publisher.server is not None), PATIENCE)
    with RemoteClient(broker, "olga") as olga, Listener(broker, "talk/robot/anna/presence") as listener:
        monkeypatch.setattr(paho.Client, "_sock_send", send)
        olga.send({"seq": 1, "request": "set", "rate": 200})
        gone = await asyncio.to_thread(listener.await_message, lambda message: not message.json["online"], PATIENCE)
        # If the broker forwards the new presence, it has also processed the robot's subscriptions.
        await asyncio.to_thread(
            listener.await_message, lambda message: message.json["online"] and message.arrived > gone.arrived, PATIENCE
        )
        olga.send({"seq": 2, "request": "say", "text": "hello"})
        assert (await asyncio.to_thread(olga.reply, 2))["ok"]
    bridge.end()
    await work
    assert not bugs


def test_a_cancel_arrives_after_a_flood(robot: Robot) -> None:
    """With a higher receive maximum, mosquitto 2.0.11 would deliver nothing more on this connection."""
    with RemoteClient(robot.broker, "olga") as olga:
        robot.bridge.stop_process()
        for _ in range(1500):
            olga.send("flood " * 3333, kind="say", response=None)
        robot.bridge.resume_process()
        end = time.monotonic() + PATIENCE
        while not olga.lines:  # the broker drops messages until its queue has room again
            assert time.monotonic() < end, "no cancel got a reply"
            olga.post("cancel")
            olga.listener.find(lambda _: bool(olga.lines), 0.1)


def test_a_goal_that_arrives_several_times_is_spoken_once(robot: Robot) -> None:
    line = '{"seq": %d, "request": "say", "id": "once", "text": "only once"}'
    with RemoteClient(robot.broker, "olga") as olga:
        for seq in (1, 2, 3):
            olga.send(line % seq)
        olga.send(line % 4, to="talk/group/all")
        replies = [olga.reply(seq) for seq in (1, 2, 3, 4)]
    assert [(reply["ok"], reply["goal"]["id"], reply.get("attached", False)) for reply in replies] == [
        (True, "once", False),
        *[(True, "once", True)] * 3,
    ]
    done = robot.desk("say", "--wait", "--id", "once", "only once")
    assert (done.code, done.id) == (0, "once")
    assert robot.spoken == ["only once"]


@pytest.mark.parametrize("bridge", ["same", "restarted"])
def test_a_goal_of_an_earlier_server_is_not_sent_to_the_next(robot: Robot, bridge: str) -> None:
    assert robot.desk("say", "--wait", "--id", "mine", "only once").code == 0
    if bridge == "restarted":
        robot.bridge.kill()
        robot.bridge.start()
        robot.bridge.await_online()  # it has requested the server's log
    robot.talk.kill()
    robot.talk.start_server()
    with robot.listen() as listener:
        listener.await_message(robot.has_current_server)
    assert_refused(robot.desk("say", "--id", "mine", "only once"), 12, "it may have been spoken")
    assert_spoken(robot)


def test_a_new_retained_message_is_dropped(robot: Robot) -> None:
    robot.talk.run("say", "--id", "mine", "--", LONG)
    robot.talk.watcher.wait_for("mine", "ACTIVE")
    with RemoteClient(robot.broker, "olga") as olga:
        olga.send({"seq": 99, "request": "say", "text": "kept"}, retain=True)
        for kind, text in (("say", "kept, too"), ("cancel", "all")):
            olga.send(text, retain=True, kind=kind, response=None)
        assert olga.ask("status", id="mine")["goal"]["state"] == "ACTIVE"
        assert olga.ask("cancel")["ok"]
        assert not [line for line in olga.lines if line.get("seq") == 99]
    assert "retained" in robot.bridge.log
    assert_spoken(robot, LONG)


def test_an_old_retained_message_is_not_spoken(make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge) -> None:
    talk = make_talk(scripted=True)
    talk.run("say", "--id", "mine", "--", LONG)
    with RemoteClient(broker, "olga") as olga:
        say = {"seq": 99, "request": "say", "text": "kept"}
        for topic in ("robot/anna", "group/all", "group/warehouse"):
            olga.listener.publish(f"talk/{topic}/request/olga", say, retain=True, response=olga.response)
        for kind in ("say", "cancel"):
            olga.send("kept", retain=True, kind=kind, response=None)
        robot = Robot(talk, broker, make_bridge(talk, broker, "anna", groups=["warehouse"]))
        talk.watcher.wait_for("mine", "ACTIVE")
        assert robot.desk("cancel").out == "mine\n"  # so nothing had cancelled it
        assert_spoken(robot, LONG)
        assert olga.lines == []


def test_a_malformed_request_gets_the_protocols_error(shared_robot: Robot) -> None:
    """The other errors are in `tests/unit/test_fleet_policy.py`."""
    status = b'{"seq": 7, "request": "status"}'
    before = shared_robot.spoken
    with RemoteClient(shared_robot.broker, "olga") as olga:
        olga.send(status.ljust(LONGEST_LINE - 1))
        assert olga.reply(7)["ok"]
        for payload, code in ((b'["say", "hello"]', "bad_json"), (status.ljust(LONGEST_LINE), "line_too_long")):
            olga.send(payload)
            assert olga.line(lambda line: line.get("ok") is False and line["error"]["code"] == code)  # noqa: B023
        assert olga.ask("status")["ok"]  # the bridge still works
    assert shared_robot.spoken == before


def test_a_robot_accepts_only_allowed_requests(make_robot: MakeRobot) -> None:
    anna = make_robot("anna")
    assert_refused(anna.desk("set", "--rate", "300"), 10, "anna: this robot's bridge does not allow set requests")
    bert = make_robot("bert", "--allow", "say,set")
    assert bert.bridge.await_online()["allow"] == ["say", "set"]
    assert bert.desk("set", "--rate", "300").code == 0
    assert bert.talk.request("set")["settings"]["rate"] == 300
    for request in ("cancel", "status"):
        assert_refused(bert.desk(request), 10, f"bert: this robot's bridge does not allow {request} requests")
    assert bert.desk("say", "hello").code == 0


# Malicious clients


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
    """Return whether a log contains no control characters."""
    return all(char == "\n" or char.isprintable() for char in log)


def test_plain_text_is_spoken_verbatim_and_logged_without_control_chars(robot: Robot) -> None:
    talk, watcher = robot.talk, robot.talk.watcher
    before = talk.request("set")["settings"]
    with RemoteClient(robot.broker, "olga") as olga:
        for text in TEXTS:
            olga.send(text, kind="say", response=None)
        watcher.wait_until(lambda _: len(watcher.texts("PENDING")) == len(TEXTS))
        assert watcher.texts("PENDING") == list(TEXTS)
        assert {talk.goal(goal_id)["client"]["name"] for goal_id in watcher.goals()} == {"mqtt:olga"}
        olga.send("\x1b[31m--key no such", kind="cancel", response=None)  # any payload cancels all goals
        for text in watcher.goals():
            watcher.wait_for_terminal(text)
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


def test_a_robot_does_not_publish_on_the_response_topic_of_another_user(shared_robot: Robot) -> None:
    """The other forms of such topics are in `tests/unit/test_fleet_topics.py`."""
    responses = {"talk/reply/otto/session/anna", "talk/robot/bert/say/olga", "elsewhere"}
    before = shared_robot.spoken
    with Listener(shared_robot.broker, "#") as everything, RemoteClient(shared_robot.broker, "olga") as olga:
        for topic in responses:
            olga.send({"request": "say", "text": "hello"}, response=topic)
        assert olga.ask("status")["ok"]
        assert not responses & {message.topic for message in everything.messages}
    assert shared_robot.spoken == before


def test_with_no_text_only_the_remote_client_reads_a_sentence(broker: Broker, make_robot: MakeRobot) -> None:
    robot = make_robot("anna", "--no-text")
    with (
        Listener(broker, "talk/robot/anna/+", "talk/robot/anna/event/+") as listener,
        RemoteClient(broker, "olga") as olga,
        RemoteClient(broker, "carl") as carl,
    ):
        goal = olga.say("never-ends se", more=True)
        for text in ("cret word", " secret"):
            assert carl.ask("watch")["ok"]  # its reply contains the first text, and events contain the second one
            assert olga.ask("append", id=goal["id"], text=text)["ok"]
        listener.await_message(
            lambda message: message.topic.endswith("/status") and message.json["active"] == goal["id"]
        )
        assert olga.ask("cancel")["count"] == 1
        done = robot.desk("say", "--wait", "--feedback", "--key", "door", "the secret word")
        assert (done.code, "secret" in done.out) == (0, True), done
        assert robot.talk.run("say", "--wait", "--key", "door", "another secret").code == 0
        listener.await_message(lambda event: event.topic.endswith("/state") and event.json["state"] == "SUCCEEDED")
        listener.await_message(lambda message: message.topic.endswith("/status") and "SUCCEEDED" in message.text)
        carl.line(lambda line: line.get("state") == "SUCCEEDED")
        assert carl.ask("log", history=True)["count"] == carl.ask("log")["count"] == 3
        assert carl.ask("status", id=goal["id"])["goal"]["key"] is None
        assert carl.ask("log", grep="secret")["error"]["code"] == "not_allowed"
        assert olga.ask("pause")["ok"]
        assert [olga.say("secret")["state"] for _ in range(16)] == ["PENDING"] * 15 + ["REJECTED"]  # by the bridge
        listener.await_message(lambda event: event.topic.endswith("/state") and event.json["state"] == "REJECTED")
        messages = [*listener.messages, *carl.listener.messages]
    assert {message.topic.rpartition("/")[2] for message in messages} >= {"state", "status", "presence"}
    assert [message for message in messages if "secret" in message.text] == []


@pytest.mark.timeout(20)
def test_a_broker_that_dies_during_a_reply_ends_the_connection(broker: Broker) -> None:
    """The reply is sent by a callback, which must not wait for a broker that is gone."""
    needs_packages("paho")
    from talkcli.fleet.link import Link

    received = []

    def receive(message: Message) -> None:
        received.append(message.payload)
        broker.kill()
        for _ in range(3):  # the broker's host resets the connection, which the next attempt notices
            link.publish(Message("an/answer", b"answer"))

    link = Link(brokers.from_environment(broker.env()), "somebody", receive)
    link.open()
    link.subscribe("a/question", retained=False)
    link.publish(Message("a/question", b"question"))
    while link.ended is None:
        assert select.select([link.fileno()], [], [], 10)[0], "the connection did not end"
        link.read()
    assert received == [b"question"]
    assert link.ended == "the connection was lost"
