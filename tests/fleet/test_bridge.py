"""Requests to a bridge, and the messages that it publishes. The server and the broker are real."""

from __future__ import annotations

import json
import time
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from tests.fleet.remote_client import ANNA, RemoteClient
from tests.support.broker import Broker
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge, MakeRobot
    from tests.fleet.robot import Robot
    from tests.support.connection import Message
    from tests.support.mqtt import Message as Published
    from tests.support.processes import Talk

#: Seconds until a bridge has found a new server.
BACK = 15.0


@pytest.fixture
def client(shared_robot: Robot) -> Iterator[RemoteClient]:
    """A remote client of the shared robot. Its goals are cancelled, and its session ends, after the test."""
    with RemoteClient(shared_robot.broker) as result:
        yield result
        result.ask("cancel")
        result.ask("resume")
        result.send_goodbye()


def texts_before(client: RemoteClient, talk: Talk) -> list[str]:
    """Return the texts of all earlier goals, after the robot has processed all messages."""
    client.result(client.say("the last goal", wait=True)["id"])
    with talk.connect() as wire:
        wire.request("log", count=100)
        *others, last = [item["goal"]["text"] for item in wire.items]
    assert last == "the last goal"
    return others


def fill_queue(robot: Robot, client: RemoteClient) -> None:
    """Pause the robot, and use all places that one user may have."""
    robot.talk.request("pause")
    assert [client.say(f"{number}")["state"] for number in range(15)] == ["PENDING"] * 15


def is_reply(topic: str, number: int, message: Published) -> bool:
    return message.topic == topic and f'"seq": {number}'.encode() in message.payload


def retained(broker: Broker, topic: str, wanted: Callable[[Any], bool] = bool, within: float = 5) -> Message:
    """Wait until the retained message of a topic matches, and return it."""
    with Listener(broker, topic) as listener:
        return listener.await_message(lambda message: bool(message.payload) and wanted(message.json), within).json


# Requests and replies


def test_a_remote_goal_has_the_same_events_as_a_local_one(shared_robot: Robot, client: RemoteClient) -> None:
    """Word events are sent with QoS 0, and results with QoS 1."""
    goal = client.say("battery low", feedback=True)
    assert (goal["state"], goal["text"]) == ("PENDING", "battery low")
    ended = client.result(goal["id"])
    assert (ended["state"], ended["spoken"]) == ("SUCCEEDED", "battery low")
    events = [line for line in client.lines if line.get("id") == goal["id"]]
    assert [event["state"] for event in events if event["event"] == "state"] == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert [event["word"] for event in events if event["event"] == "word"] == ["battery", "low"]
    assert ended == shared_robot.talk.goal(goal["id"])
    assert ended["client"]["name"] == "mqtt:bob"
    for message in client.listener.messages:
        light = all(json.loads(line).get("event") in ("word", "alive") for line in message.payload.splitlines())
        assert message.qos == (0 if light else 1), message
        assert (message.payload[-1:], message.topic) == (b"\n", f"{client.response}/anna")


def test_a_reply_has_the_correlation_and_the_number_of_its_request(client: RemoteClient) -> None:
    client.send({"seq": 7, "request": "say", "text": "hello", "wait": True}, correlation=b"one")
    client.send({"request": "status"}, correlation=b"two")
    client.reply(7)
    client.reply(None)
    by_correlation = {
        message.correlation: [json.loads(line) for line in message.payload.splitlines()]
        for message in client.listener.messages
    }
    assert [line.get("seq") for line in by_correlation[b"one"]] == [7]
    assert by_correlation[b"two"][-1]["server"]["engine"]
    assert not any("seq" in line for line in by_correlation[b"two"])


def test_a_session_has_its_own_name_and_gets_only_its_own_replies(shared_robot: Robot, client: RemoteClient) -> None:
    with RemoteClient(shared_robot.broker) as other, RemoteClient(shared_robot.broker, "eve") as eve:
        client.ask("hello", name="patrol")
        other.ask("hello", name="other")
        goal = client.say("for one alone", wait=True)
        client.result(goal["id"])
        assert goal["client"]["name"] == "mqtt:bob patrol"
        assert (len(other.lines), len(eve.lines)) == (1, 0)
        assert eve.say("hello")["client"]["name"] == "mqtt:eve"


def test_one_message_reaches_all_robots_of_a_group(robot: Robot, make_robot: MakeRobot) -> None:
    make_robot("berta", groups=["warehouse", "night"])
    with RemoteClient(robot.broker) as client:
        for group in ("warehouse", "night"):
            client.send({"seq": 101, "request": "say", "text": f"to {group}"}, to=f"talk/group/{group}")
            client.listener.await_message(lambda message: message.topic.endswith("/berta"))
        client.send({"seq": 102, "request": "say", "text": "to all"}, to="talk/group/all")
        for topic in (f"{client.response}/anna", f"{client.response}/berta"):
            client.listener.await_message(partial(is_reply, topic, 102))
        assert texts_before(client, robot.talk) == ["to all"]


def test_a_long_reply_is_split_or_sent_without_its_text(make_talk: MakeTalk, make_bridge: MakeBridge) -> None:
    talk = make_talk(scripted=True)
    with Broker(max_packet=4096) as broker, RemoteClient(broker) as client:
        make_bridge(talk, broker, "anna")
        goal = client.say("never-ends " + "long " * 700, wait=True, key="door")
        assert (goal["text"], goal["key"]) == (None, "door")
        client.line(lambda line: line.get("state") == "ACTIVE")
        for number in range(15):
            client.say(f"{number} " + "long " * 60)
        status = client.ask("status")
        assert status["server"]["pending"] == 15
        assert (status["active"]["id"], status["active"]["text"]) == (goal["id"], None)
        pending = [line["pending"]["text"].partition(" ")[0] for line in client.lines if "pending" in line]
        assert pending == [str(number) for number in range(15)]
        assert max(len(message.payload) for message in client.listener.messages) <= 4096
        client.ask("cancel")
        assert goal["id"] in [line["canceled"]["id"] for line in client.lines if "canceled" in line]
        ended = client.result(goal["id"])
        assert (ended["state"], ended["text"], ended["spoken"]) == ("PREEMPTED", None, None)
        assert ended["by"]["client"]["name"] == "mqtt:bob"
        assert not [line for line in client.lines if line.get("ok") is False]


def test_a_request_is_refused_only_if_it_is_too_long_for_the_server(client: RemoteClient) -> None:
    longest = "\N{GRINNING FACE}" * 10_000
    assert client.say(longest)["state"] == "PENDING"
    ids = json.dumps({"seq": 1000, "request": "wait", "ids": ["a" * 12] * 4096}, separators=(",", ":"))
    assert len(ids) < 65_536  # but the bridge sends it with blanks, which makes it too long
    client.send(ids.encode())
    assert client.reply(1000)["error"]["code"] == "line_too_long"
    client.ask("cancel")


# Places in the queue


def test_a_remote_user_has_15_of_20_places_in_the_queue(shared_robot: Robot, client: RemoteClient) -> None:
    shared_robot.talk.request("pause")
    goals = [client.say(f"flood {number}", wait=True) for number in range(25)]
    assert [goal["state"] for goal in goals] == ["PENDING"] * 15 + ["REJECTED"] * 10
    assert {goal["reason"] for goal in goals[15:]} == {"queue_full"}
    ended = client.result(goals[-1]["id"])
    assert (ended["state"], ended["text"]) == ("REJECTED", "flood 24")
    with RemoteClient(shared_robot.broker, "eve") as eve:
        assert [eve.say(f"another's {number}")["state"] for number in range(5)] == ["PENDING"] * 4 + ["REJECTED"]
    own = shared_robot.talk.request("say", text="the robot's own")["goal"]
    assert own["state"] == "PENDING"
    assert client.ask("cancel")["count"] == 20
    fire = client.say("fire", preempt=True)
    assert fire["state"] == "PENDING"
    goals = [client.say(f"flood {number}") for number in range(16)]
    assert [goal["state"] for goal in goals] == ["PENDING"] * 15 + ["REJECTED"], "fire took a place"
    fire = client.say("fire", preempt=True)
    assert fire["state"] == "PENDING"
    assert client.ask("cancel")["count"] == 16
    assert client.say("again there is room")["state"] == "PENDING"
    client.ask("cancel")


def test_an_active_goal_takes_none_of_the_places(client: RemoteClient) -> None:
    client.say("never-ends")
    assert [client.say(f"{number}")["state"] for number in range(16)] == ["PENDING"] * 15 + ["REJECTED"]


def test_patient_goals_wait_for_room_in_their_order(shared_robot: Robot, client: RemoteClient) -> None:
    fill_queue(shared_robot, client)
    client.send({"seq": 100, "request": "say", "text": "patient", "patient": True, "wait": True})
    client.send({"seq": 101, "request": "say", "text": "behind it", "patient": True})
    client.ask("status")  # the bridge has read the requests before it
    assert not [line for line in client.lines if line.get("seq") in (100, 101)]
    client.ask("cancel", ids=[robot_goals(shared_robot)[0]["id"]])
    assert client.reply(100)["goal"]["state"] == "PENDING"
    assert not [line for line in client.lines if line.get("seq") == 101]
    shared_robot.talk.request("cancel", ids=[robot_goals(shared_robot)[0]["id"]])
    assert client.reply(101)["goal"]["state"] == "PENDING"
    assert [goal["text"] for goal in robot_goals(shared_robot)][-2:] == ["patient", "behind it"]


@pytest.mark.slow
def test_a_remote_client_that_waits_for_room_gets_alive_events(shared_robot: Robot, client: RemoteClient) -> None:
    fill_queue(shared_robot, client)
    client.send({"seq": 100, "request": "say", "text": "patient", "patient": True})
    client.line(lambda line: line == {"event": "alive"}, 8)


@pytest.mark.parametrize("case", ["here", "by its id", "elsewhere", "at the robot"])
def test_any_client_can_cancel_goals_that_wait_for_room(shared_robot: Robot, client: RemoteClient, case: str) -> None:
    fill_queue(shared_robot, client)
    client.send({"seq": 100, "request": "say", "text": "patient", "patient": True, "wait": True, "id": "p"})
    client.ask("status")  # the bridge has read the request before it
    if case == "at the robot":
        assert shared_robot.talk.request("cancel")["count"] == 15
    elif case == "elsewhere":
        with RemoteClient(shared_robot.broker, "eve") as eve:
            assert eve.ask("cancel")["count"] == 16
            assert len([line for line in eve.lines if "canceled" in line]) == 16
    else:
        fields: dict[str, Any] = {"ids": ["p"]} if case == "by its id" else {}
        reply = client.ask("cancel", **fields)
        assert (reply["ok"], reply["count"]) == (True, 1 if fields else 16)
    goal = client.reply(100)["goal"]
    assert (goal["id"], goal["state"], goal["reason"]) == ("p", "RECALLED", "canceled")
    assert client.result("p")["by"]["client"]
    assert len(robot_goals(shared_robot)) == (15 if case == "by its id" else 0)


def test_a_goodbye_recalls_goals_that_wait_for_room_and_disconnects(shared_robot: Robot, client: RemoteClient) -> None:
    fill_queue(shared_robot, client)
    with shared_robot.talk.connect() as wire:  # one connection for all requests, so that a closing one isn't counted
        before = wire.request("status")["server"]["clients"]
        client.send({"seq": 100, "request": "say", "text": "patient", "patient": True})
        client.ask("status")
        client.send_goodbye()
        end = time.monotonic() + 5
        while wire.request("status")["server"]["clients"] >= before:
            assert time.monotonic() < end, "the bridge keeps its connection to the server"
    with RemoteClient(shared_robot.broker, "eve") as eve:
        assert eve.ask("cancel")["count"] == 15
        assert eve.say("next")["state"] == "PENDING"
        assert [goal["text"] for goal in robot_goals(shared_robot)] == ["next"]
        eve.ask("cancel")


def test_many_requests_are_answered_late_and_in_their_order_but_a_cancel_at_once(shared_robot: Robot) -> None:
    with RemoteClient(shared_robot.broker, "mary") as mary:
        start = time.monotonic()
        for number in range(260):
            mary.send({"seq": number, "request": "hello"})
            if number < 240 and number % 40 == 39:  # at most 64 requests of a client may be waiting
                mary.reply(number)
        assert time.monotonic() - start > 0.35
        mary.send({"seq": 260, "request": "cancel"})
        mary.reply(260)
        assert [line["seq"] for line in mary.lines] == [*range(261)]


def test_more_than_64_waiting_requests_of_a_client_are_refused(shared_robot: Robot, client: RemoteClient) -> None:
    shared_robot.talk.request("pause")
    for number in range(100):
        client.send({"seq": number, "request": "say", "text": f"{number}", "patient": True})
    refused = client.line(lambda line: line.get("ok") is False)
    assert refused["error"]["code"] == "busy"
    with RemoteClient(shared_robot.broker, "eve") as eve:
        eve.ask("cancel")


def robot_goals(robot: Robot) -> list[Message]:
    """Return the pending goals of the robot's server in their order."""
    with robot.talk.connect() as wire:
        wire.request("status")
        return [item["pending"] for item in wire.items if "pending" in item]


# Presence


def test_a_robot_refuses_requests_while_it_has_no_server(robot: Robot) -> None:
    with RemoteClient(robot.broker) as client:
        goal = client.say("never heard " * 50, wait=True)
        robot.talk.kill()
        assert client.line(lambda line: line.get("event") == "gone")["message"]
        assert retained(robot.broker, f"{ANNA}/presence", lambda presence: presence["server"] is None)["online"]
        assert client.ask("say", text="to nobody")["error"]["code"] == "no_server"
        assert client.ask("status")["error"]["code"] == "no_server"
        robot.talk.start_server()
        retained(robot.broker, f"{ANNA}/presence", lambda presence: presence["server"] is not None, BACK)
        assert client.ask("wait", ids=[goal["id"]])["error"]["code"] == "unknown_goal"
        assert texts_before(client, robot.talk) == []


def test_a_goal_rejected_by_an_earlier_server_may_be_sent_again(robot: Robot) -> None:
    with RemoteClient(robot.broker) as client:
        client.say("too late", id="bob-1", ttl=-1)
        robot.talk.kill()
        robot.talk.start_server()
        retained(robot.broker, robot.presence, lambda new: (new["server"] or {}).get("pid") == robot.talk.pid, BACK)
        assert client.say("in time", id="bob-1")["state"] == "PENDING"


@pytest.mark.parametrize(
    "wrong",
    [b"", b"7", b'{"talk": 1, "online": false, "session": "old"}', b'{"talk": 1, "online": true, "session": "old"}'],
)
def test_a_bridge_corrects_a_wrong_presence(shared_robot: Robot, wrong: bytes) -> None:
    presence = retained(shared_robot.broker, f"{ANNA}/presence")
    with Listener(shared_robot.broker, f"{ANNA}/presence") as listener:
        listener.publish(f"{ANNA}/presence", wrong, retain=True)

        def is_corrected(message: Published) -> bool:
            payloads = [one.payload for one in listener.messages]
            return wrong in payloads and payloads.index(wrong) < len(payloads) - 1 and message.payload == payloads[-1]

        assert listener.await_message(is_corrected).json == presence
    assert retained(shared_robot.broker, f"{ANNA}/presence") == presence


@pytest.mark.slow
def test_a_hung_server_counts_as_missing_until_it_responds(robot: Robot) -> None:
    robot.talk.freeze()
    retained(robot.broker, f"{ANNA}/presence", lambda presence: presence["server"] is None, 25)
    robot.talk.thaw()
    retained(robot.broker, f"{ANNA}/presence", lambda presence: presence["server"] is not None, BACK)
    assert "does not respond; restart it if it hangs" in robot.bridge.log


# Status and events


def test_the_status_after_a_cancel_shows_the_final_state(robot: Robot) -> None:
    """It isn't PREEMPTING first, with the final state a second later."""
    with RemoteClient(robot.broker) as client, Listener(robot.broker, f"{ANNA}/status") as listener:
        goal = client.say("never-ends")
        listener.await_message(lambda message: message.json["active"] == goal["id"])
        time.sleep(1.1)  # the next status may be sent a second after the last
        sent_at = time.monotonic()
        client.ask("cancel")
        status = listener.await_message(lambda message: message.arrived > sent_at).json
        assert (status["active"], status["last"]["state"]) == (None, "PREEMPTED")


def test_the_status_shows_the_goal_that_is_spoken_even_if_it_interrupts_another_one(robot: Robot) -> None:
    with RemoteClient(robot.broker) as client:
        first, waiting = client.say("never-ends words=1"), client.say("length=0")
        client.say("never-ends", id="aside", interject=True)

        def await_status(active: str, pending: int) -> None:
            wanted = {"active": active, "pending": pending}.items()
            retained(robot.broker, f"{ANNA}/status", lambda status: wanted <= status.items())

        await_status("aside", 1)
        client.ask("cancel", current=True)
        await_status(first["id"], 1)
        client.ask("cancel", ids=[first["id"]])
        retained(robot.broker, f"{ANNA}/status", lambda status: status["last"]["id"] == waiting["id"])


def test_the_status_contains_the_text_that_has_arrived(shared_robot: Robot, client: RemoteClient) -> None:
    goal = client.say("never-ends battery", more=True)
    topic = f"{ANNA}/status"
    retained(shared_robot.broker, topic, lambda status: status["active"] == goal["id"])
    for text in (" is", " low", " now" * 400):
        assert client.ask("append", id=goal["id"], text=text)["ok"]
    found = retained(shared_robot.broker, topic, lambda status: len(status["text"] or "") == 1_000)
    assert found["text"] == ("never-ends battery is low" + " now" * 400)[:1_000]


def payloads(messages: list[Published], kind: str) -> list[Message]:
    return [message.json for message in messages if message.topic == f"{ANNA}/{kind}"]


def test_every_change_is_an_event_and_the_status_is_sent_once_a_second(robot: Robot) -> None:
    with RemoteClient(robot.broker) as client:
        text = "never-ends battery low"
        with Listener(robot.broker, f"{ANNA}/event/+", f"{ANNA}/status") as listener:
            goal = client.say(text, wait=True)
            listener.await_message(lambda event: event.topic.endswith("/state") and event.json["state"] == "ACTIVE")
            client.ask("pause")
            listener.await_message(lambda message: message.topic.endswith("event/paused"))
            status = listener.await_message(lambda message: message.topic.endswith("status") and message.json["paused"])
            assert status.json == {"active": goal["id"], "text": text, "pending": 0, "paused": True, "last": None}
            client.ask("resume")
            client.ask("cancel")
            ended = client.result(goal["id"])
            last = listener.await_message(
                lambda message: message.topic.endswith("status") and bool(message.json["last"])
            ).json
            of_goal = {"id": goal["id"], "state": "PREEMPTED", "reason": "canceled", "text": text}
            of_goal["at"] = ended["ended_at"]
            assert last == {"active": None, "text": None, "pending": 0, "paused": False, "last": of_goal}
            states = payloads(listener.messages, "event/state")
            assert [state["state"] for state in states] == ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"]
            assert states[-1]["goal"] == ended
            assert [event["paused"] for event in payloads(listener.messages, "event/paused")] == [True, False]
            # The retained status, without goals, arrived after the subscription, so its time doesn't count.
            statuses = [message for message in listener.messages if message.topic.endswith("status")]
            times = [message.arrived for message in statuses if message.json["active"] or message.json["last"]]
            assert len(times) > 1
            assert all(later - sooner > 0.9 for sooner, later in pairwise(times)), times
        assert retained(robot.broker, f"{ANNA}/status") == last
