"""Requests to a robot by the broker, and what the robot publishes there: a real server, a real broker, a bridge."""

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

#: Seconds in which a robot must have come back to a broker, or a server to its robot.
BACK = 15.0


@pytest.fixture
def client(lasting_robot: Robot) -> Iterator[RemoteClient]:
    """A remote client of the robot that the tests share; in the end nothing of it is left there."""
    with RemoteClient(lasting_robot.broker) as result:
        yield result
        result.ask("cancel")
        result.ask("resume")
        result.hang_up()


def after(client: RemoteClient, talk: Talk) -> list[str]:
    """Return all texts that the robot was asked to say before, once it has looked at all messages."""
    client.result(client.say("the last of them", wait=True)["id"])
    with talk.connect() as wire:
        wire.request("log", count=100)
        *others, last = [each["goal"]["text"] for each in wire.items]
    assert last == "the last of them"
    return others


def fill(robot: Robot, client: RemoteClient) -> None:
    """Pause the robot, and have as many goals wait as may from afar."""
    robot.talk.request("pause")
    assert [client.say(f"{each}")["state"] for each in range(20)] == ["PENDING"] * 20


def is_answer(topic: str, number: int, each: Published) -> bool:
    return each.topic == topic and f'"seq": {number}'.encode() in each.payload


def kept(broker: Broker, topic: str, wanted: Callable[[Any], bool] = bool, within: float = 5) -> Message:
    """Return the retained message of a topic, once it is wanted."""
    with Listener(broker, topic) as listener:
        return listener.await_message(lambda each: bool(each.payload) and wanted(each.json), within).json


# Requests and answers


def test_a_sentence_is_answered_as_on_the_socket(lasting_robot: Robot, client: RemoteClient) -> None:
    """Words may be lost on their way, results may not."""
    goal = client.say("battery low", feedback=True)
    assert (goal["state"], goal["text"]) == ("PENDING", "battery low")
    ended = client.result(goal["id"])
    assert (ended["state"], ended["spoken"]) == ("SUCCEEDED", "battery low")
    events = [each for each in client.lines if each.get("id") == goal["id"]]
    assert [each["state"] for each in events if each["event"] == "state"] == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert [each["word"] for each in events if each["event"] == "word"] == ["battery", "low"]
    assert ended == lasting_robot.talk.goal(goal["id"])
    assert ended["client"]["name"] == "mqtt:bob"
    for each in client.listener.messages:
        light = all(json.loads(line).get("event") in ("word", "alive") for line in each.payload.splitlines())
        assert each.qos == (0 if light else 1), each
        assert (each.payload[-1:], each.topic) == (b"\n", f"{client.response}/anna")


def test_an_answer_has_the_correlation_and_the_number_of_its_request(client: RemoteClient) -> None:
    client.send({"seq": 7, "request": "say", "text": "hello", "wait": True}, correlation=b"one")
    client.send({"request": "status"}, correlation=b"two")
    client.reply(7)
    client.reply(None)
    by_correlation = {
        each.correlation: [json.loads(line) for line in each.payload.splitlines()] for each in client.listener.messages
    }
    assert [each.get("seq") for each in by_correlation[b"one"]] == [7]
    assert by_correlation[b"two"][-1]["server"]["engine"]
    assert not any("seq" in each for each in by_correlation[b"two"])


def test_each_session_has_its_name_and_hears_its_own_answers_alone(lasting_robot: Robot, client: RemoteClient) -> None:
    with RemoteClient(lasting_robot.broker) as other, RemoteClient(lasting_robot.broker, "eve") as eve:
        client.ask("hello", name="patrol")
        other.ask("hello", name="other")
        goal = client.say("for one alone", wait=True)
        client.result(goal["id"])
        assert goal["client"]["name"] == "mqtt:bob patrol"
        assert (len(other.lines), len(eve.lines)) == (1, 0)
        assert eve.say("hello")["client"]["name"] == "mqtt:eve"


def test_a_group_is_asked_by_one_message(robot: Robot, make_robot: MakeRobot) -> None:
    make_robot("berta", groups=["warehouse", "night"])
    with RemoteClient(robot.broker) as client:
        for group in ("warehouse", "night"):
            client.send({"seq": 101, "request": "say", "text": f"to {group}"}, to=f"talk/group/{group}")
            client.listener.await_message(lambda each: each.topic.endswith("/berta"))
        client.send({"seq": 102, "request": "say", "text": "to all"}, to="talk/group/all")
        for topic in (f"{client.response}/anna", f"{client.response}/berta"):
            client.listener.await_message(partial(is_answer, topic, 102))
        assert after(client, robot.talk) == ["to all"]


def test_an_answer_that_is_longer_than_the_broker_takes_comes_in_pieces_or_without_its_words(
    make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    with Broker(max_packet=4096) as broker, RemoteClient(broker) as client:
        make_bridge(talk, broker, "anna")
        goal = client.say("never-ends " + "long " * 700, wait=True, key="door")
        assert (goal["text"], goal["key"]) == (None, "door")
        client.line(lambda each: each.get("state") == "ACTIVE")
        for each in range(15):
            client.say(f"{each} " + "long " * 60)
        status = client.ask("status")
        assert status["server"]["pending"] == 15
        assert (status["active"]["id"], status["active"]["text"]) == (goal["id"], None)
        pending = [each["pending"]["text"].partition(" ")[0] for each in client.lines if "pending" in each]
        assert pending == [str(each) for each in range(15)]
        assert max(len(each.payload) for each in client.listener.messages) <= 4096
        client.ask("cancel")
        assert goal["id"] in [each["canceled"]["id"] for each in client.lines if "canceled" in each]
        ended = client.result(goal["id"])
        assert (ended["state"], ended["text"], ended["spoken"]) == ("PREEMPTED", None, None)
        assert ended["by"]["client"]["name"] == "mqtt:bob"
        assert not [each for each in client.lines if each.get("ok") is False]


def test_the_longest_text_is_taken_and_a_request_that_grows_too_long_is_refused(client: RemoteClient) -> None:
    longest = "\N{GRINNING FACE}" * 10_000
    assert client.say(longest)["state"] == "PENDING"
    ids = json.dumps({"seq": 1000, "request": "wait", "ids": ["a" * 12] * 4096}, separators=(",", ":"))
    assert len(ids) < 65_536  # and with blanks, as this server's library writes it, it is longer
    client.send(ids.encode())
    assert client.reply(1000)["error"]["code"] == "line_too_long"
    client.ask("cancel")


# The share of the queue


def test_twenty_goals_from_afar_may_wait_and_those_of_the_robot_have_their_places(
    lasting_robot: Robot, client: RemoteClient
) -> None:
    lasting_robot.talk.request("pause")
    goals = [client.say(f"flood {each}", wait=True) for each in range(25)]
    assert [each["state"] for each in goals] == ["PENDING"] * 20 + ["REJECTED"] * 5
    assert {each["reason"] for each in goals[20:]} == {"queue_full"}
    ended = client.result(goals[-1]["id"])
    assert (ended["state"], ended["text"]) == ("REJECTED", "flood 24")
    with RemoteClient(lasting_robot.broker, "eve") as eve:
        assert eve.say("another's")["reason"] == "queue_full"
    own = lasting_robot.talk.request("say", text="the robot's own")["goal"]
    assert own["state"] == "PENDING"
    assert client.ask("cancel")["count"] == 21
    fire = client.say("fire", preempt=True)
    assert fire["state"] == "PENDING"
    goals = [client.say(f"flood {each}") for each in range(21)]
    assert [each["state"] for each in goals] == ["PENDING"] * 20 + ["REJECTED"], "fire was counted"
    fire = client.say("fire", preempt=True)
    assert fire["state"] == "PENDING"
    assert client.ask("cancel")["count"] == 21
    assert client.say("again there is room")["state"] == "PENDING"
    client.ask("cancel")


def test_a_goal_that_is_spoken_takes_no_place_among_the_twenty(client: RemoteClient) -> None:
    client.say("never-ends")
    assert [client.say(f"{each}")["state"] for each in range(21)] == ["PENDING"] * 20 + ["REJECTED"]


def test_a_patient_goal_waits_for_room(lasting_robot: Robot, client: RemoteClient) -> None:
    fill(lasting_robot, client)
    client.send({"seq": 100, "request": "say", "text": "patient", "patient": True, "wait": True})
    client.send({"seq": 101, "request": "say", "text": "behind it", "patient": True})
    client.ask("status")  # behind them
    assert not [each for each in client.lines if each.get("seq") in (100, 101)]
    client.ask("cancel", ids=[robot_goals(lasting_robot)[0]["id"]])
    assert client.reply(100)["goal"]["state"] == "PENDING"
    assert not [each for each in client.lines if each.get("seq") == 101]
    lasting_robot.talk.request("cancel", ids=[robot_goals(lasting_robot)[0]["id"]])
    assert client.reply(101)["goal"]["state"] == "PENDING"
    assert [each["text"] for each in robot_goals(lasting_robot)][-2:] == ["patient", "behind it"]


@pytest.mark.slow
def test_a_remote_client_that_waits_for_room_is_told_that_the_robot_lives(
    lasting_robot: Robot, client: RemoteClient
) -> None:
    fill(lasting_robot, client)
    client.send({"seq": 100, "request": "say", "text": "patient", "patient": True})
    client.line(lambda each: each == {"event": "alive"}, 8)


@pytest.mark.parametrize("where", ["here", "by its id", "elsewhere", "at the robot"])
def test_a_cancel_from_anywhere_ends_goals_that_wait_for_room_too(
    lasting_robot: Robot, client: RemoteClient, where: str
) -> None:
    fill(lasting_robot, client)
    client.send({"seq": 100, "request": "say", "text": "patient", "patient": True, "wait": True, "id": "p"})
    client.ask("status")  # the one before has been looked at
    if where == "at the robot":
        assert lasting_robot.talk.request("cancel")["count"] == 20
    elif where == "elsewhere":
        with RemoteClient(lasting_robot.broker, "eve") as eve:
            assert eve.ask("cancel")["count"] == 21
            assert len([each for each in eve.lines if "canceled" in each]) == 21
    else:
        fields: dict[str, Any] = {"ids": ["p"]} if where == "by its id" else {}
        reply = client.ask("cancel", **fields)
        assert (reply["ok"], reply["count"]) == (True, 1 if fields else 21)
    goal = client.reply(100)["goal"]
    assert (goal["id"], goal["state"], goal["reason"]) == ("p", "RECALLED", "canceled")
    assert client.result("p")["by"]["client"]
    assert len(robot_goals(lasting_robot)) == (20 if where == "by its id" else 0)


def test_a_goodbye_takes_back_waiting_goals_and_closes_the_connection(
    lasting_robot: Robot, client: RemoteClient
) -> None:
    fill(lasting_robot, client)
    with lasting_robot.talk.connect() as wire:  # one for all questions, so that no closing one is counted
        before = wire.request("status")["server"]["clients"]
        client.send({"seq": 100, "request": "say", "text": "patient", "patient": True})
        client.ask("status")
        client.hang_up()
        end = time.monotonic() + 5
        while wire.request("status")["server"]["clients"] >= before:
            assert time.monotonic() < end, "the bridge keeps its connection"
    with RemoteClient(lasting_robot.broker, "eve") as eve:
        assert eve.ask("cancel")["count"] == 20
        assert eve.say("next")["state"] == "PENDING"
        assert [each["text"] for each in robot_goals(lasting_robot)] == ["next"]
        eve.ask("cancel")


def test_more_than_64_requests_of_one_remote_client_at_once_are_busy(
    lasting_robot: Robot, client: RemoteClient
) -> None:
    lasting_robot.talk.request("pause")
    for each in range(100):
        client.send({"seq": each, "request": "say", "text": f"{each}", "patient": True})
    refused = client.line(lambda each: each.get("ok") is False)
    assert refused["error"]["code"] == "busy"
    with RemoteClient(lasting_robot.broker, "eve") as eve:
        eve.ask("cancel")


def robot_goals(robot: Robot) -> list[Message]:
    """Return the goals that wait at the robot's server, in their order."""
    with robot.talk.connect() as wire:
        wire.request("status")
        return [each["pending"] for each in wire.items if "pending" in each]


# Presence


def test_a_robot_without_a_server_says_so_and_refuses_requests_until_it_is_back(robot: Robot) -> None:
    with RemoteClient(robot.broker) as client:
        goal = client.say("never heard " * 50, wait=True)
        robot.talk.kill()
        assert client.line(lambda each: each.get("event") == "gone")["message"]
        assert kept(robot.broker, f"{ANNA}/presence", lambda each: each["server"] is None)["online"]
        assert client.ask("say", text="to nobody")["error"]["code"] == "no_server"
        assert client.ask("status")["error"]["code"] == "no_server"
        robot.talk.start_server()
        kept(robot.broker, f"{ANNA}/presence", lambda each: each["server"] is not None, BACK)
        assert client.ask("wait", ids=[goal["id"]])["error"]["code"] == "unknown_goal"
        assert after(client, robot.talk) == []


def test_a_goal_that_an_earlier_server_has_rejected_may_be_sent_to_the_next(robot: Robot) -> None:
    with RemoteClient(robot.broker) as client:
        client.say("too late", id="bob-1", ttl=-1)
        robot.talk.kill()
        robot.talk.start_server()
        kept(robot.broker, f"{ANNA}/presence", lambda each: (each["server"] or {}).get("pid") == robot.talk.pid, BACK)
        assert client.say("in time", id="bob-1")["state"] == "PENDING"


@pytest.mark.parametrize(
    "wrong",
    [b"", b"7", b'{"talk": 1, "online": false, "session": "old"}', b'{"talk": 1, "online": true, "session": "old"}'],
)
def test_a_false_presence_is_corrected(lasting_robot: Robot, wrong: bytes) -> None:
    said = kept(lasting_robot.broker, f"{ANNA}/presence")
    with Listener(lasting_robot.broker, f"{ANNA}/presence") as listener:
        listener.publish(f"{ANNA}/presence", wrong, retain=True)

        def put_right(each: Published) -> bool:
            told = [one.payload for one in listener.messages]
            return wrong in told and told.index(wrong) < len(told) - 1 and each.payload == told[-1]

        assert listener.await_message(put_right).json == said
    assert kept(lasting_robot.broker, f"{ANNA}/presence") == said


@pytest.mark.slow
def test_a_hung_server_counts_as_missing_until_it_responds(robot: Robot) -> None:
    robot.talk.freeze()
    kept(robot.broker, f"{ANNA}/presence", lambda each: each["server"] is None, 25)
    robot.talk.thaw()
    kept(robot.broker, f"{ANNA}/presence", lambda each: each["server"] is not None, BACK)
    assert "does not respond; restart it if it hangs" in robot.bridge.log


# Status and events


def test_the_status_after_a_cancel_tells_the_end_of_the_goal(robot: Robot) -> None:
    """It doesn't tell PREEMPTING first, and the end a second later."""
    with RemoteClient(robot.broker) as client, Listener(robot.broker, f"{ANNA}/status") as everybody:
        goal = client.say("never-ends")
        everybody.await_message(lambda each: each.json["active"] == goal["id"])
        time.sleep(1.1)  # that nothing is told before the next may be, is no event
        asked = time.monotonic()
        client.ask("cancel")
        told = everybody.await_message(lambda each: each.arrived > asked).json
        assert (told["active"], told["last"]["state"]) == (None, "PREEMPTED")


def test_the_status_has_the_beginning_of_a_text_as_far_as_it_has_grown(
    lasting_robot: Robot, client: RemoteClient
) -> None:
    goal = client.say("never-ends battery", more=True)
    status = f"{ANNA}/status"
    kept(lasting_robot.broker, status, lambda each: each["active"] == goal["id"])
    for text in (" is", " low", " now" * 400):
        assert client.ask("append", id=goal["id"], text=text)["ok"]
    told = kept(lasting_robot.broker, status, lambda each: len(each["text"] or "") == 1_000)
    assert told["text"] == ("never-ends battery is low" + " now" * 400)[:1_000]


def of(messages: list[Published], kind: str) -> list[Message]:
    return [each.json for each in messages if each.topic == f"{ANNA}/{kind}"]


def test_events_tell_each_change_and_the_status_comes_at_most_once_a_second(robot: Robot) -> None:
    with RemoteClient(robot.broker) as client:
        text = "never-ends battery low"
        with Listener(robot.broker, f"{ANNA}/event/+", f"{ANNA}/status") as everybody:
            goal = client.say(text, wait=True)
            everybody.await_message(lambda each: each.topic.endswith("event/state") and each.json["state"] == "ACTIVE")
            client.ask("pause")
            everybody.await_message(lambda each: each.topic.endswith("event/paused"))
            told = everybody.await_message(lambda each: each.topic.endswith("status") and each.json["paused"])
            assert told.json == {"active": goal["id"], "text": text, "pending": 0, "paused": True, "last": None}
            client.ask("resume")
            client.ask("cancel")
            ended = client.result(goal["id"])
            last = everybody.await_message(lambda each: each.topic.endswith("status") and bool(each.json["last"])).json
            of_goal = {"id": goal["id"], "state": "PREEMPTED", "reason": "canceled", "text": text}
            of_goal["at"] = ended["ended_at"]
            assert last == {"active": None, "text": None, "pending": 0, "paused": False, "last": of_goal}
            states = of(everybody.messages, "event/state")
            assert [each["state"] for each in states] == ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"]
            assert states[-1]["goal"] == ended
            assert [each["paused"] for each in of(everybody.messages, "event/paused")] == [True, False]
            # What the broker had kept, of a robot that had said nothing, came when that was asked for.
            statuses = [each for each in everybody.messages if each.topic.endswith("status")]
            times = [each.arrived for each in statuses if each.json["active"] or each.json["last"]]
            assert len(times) > 1
            assert all(later - sooner > 0.9 for sooner, later in pairwise(times)), times
        assert kept(robot.broker, f"{ANNA}/status") == last
