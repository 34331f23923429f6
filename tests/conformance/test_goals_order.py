"""The order of goals, and which goals are displaced or wait for room. The engine is scripted."""

from __future__ import annotations

import contextlib
import json
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from tests.conformance.checks import assert_event_order, assert_recalled, assert_rejected, states, submit
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.connection import Message, Wire
    from tests.support.processes import Talk


def start_goal(talk: Talk, text: str = "never-ends words=1", **fields: object) -> str:
    """Send a goal, wait for its first word, and return its id."""
    goal_id = str(submit(talk, text, **fields)["id"])
    talk.watcher.wait_for_word(goal_id)
    return goal_id


def queue(talk: Talk, *priorities: int, text: str = "length=0 waits") -> list[str]:
    """Queue goals of these priorities, and return their ids."""
    return [str(submit(talk, f"{text} {number}", priority=level)["id"]) for number, level in enumerate(priorities)]


def start_full_server(make_talk: MakeTalk) -> tuple[Talk, str, str]:
    """Return a server with a full queue, its active goal, and the only pending goal."""
    talk = make_talk("--max-queue", "1", scripted=True)
    active = start_goal(talk)
    return talk, active, queue(talk, 0)[0]


def send_patient(wire: Wire, text: str, **fields: object) -> None:
    """Send a goal that waits for room, and wait until the server has received it."""
    wire.send({"request": "say", "text": f"length=0 {text}", "patient": True, "wait": True, **fields})
    assert wire.request("hello")["ok"]


def pending_ids(talk: Talk) -> list[str]:
    """Return the ids of the pending goals, in order."""
    with talk.connect() as wire:
        assert wire.request("status")["ok"]
        return [item["pending"]["id"] for item in wire.items if "pending" in item]


def spoken_ids(talk: Talk) -> list[str]:
    """Return the ids of the goals that became ACTIVE, in order."""
    return [event["id"] for event in talk.watcher.events() if event.get("state") == "ACTIVE"]


def test_row_47_a_full_queue_displaces_its_newest_goal_of_lowest_priority(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "3", scripted=True)
    active = start_goal(talk)
    first, second, third = queue(talk, 0, 0, 0)
    high = submit(talk, "length=0 urgent", priority=5)
    assert high["state"] == "PENDING"
    assert_recalled(talk, third, "displaced", by=high["id"])
    low = talk.run("say", "--wait", "--", "length=0 not now")
    assert (low.code, "not spoken: " in low.err, "the queue is full (3 goals)" in low.err) == (5, True, True)
    assert pending_ids(talk) == [high["id"], first, second]
    assert talk.request("cancel", ids=[active])["ok"]
    assert states(talk, second)[-1] == "SUCCEEDED"
    assert spoken_ids(talk) == [active, high["id"], first, second]
    assert_event_order(talk)


def test_row_47_a_preempting_goal_displaces_the_newest_queued_goal(make_talk: MakeTalk) -> None:
    """A client that always keeps the queue full must not block an urgent goal."""
    talk = make_talk("--max-queue", "3", scripted=True)
    active = start_goal(talk)
    with talk.connect() as logger:
        for number in range(5):
            logger.send({"request": "say", "text": f"length=0 line {number}", "patient": True})
        assert logger.request("hello")["ok"]
        lines = pending_ids(talk)
        assert len(lines) == 3
        fire = submit(talk, "length=0 fire", preempt=True)["id"]
        assert_recalled(talk, lines[-1], "displaced", by=fire)
        assert states(talk, fire)[-1] == "SUCCEEDED"
        assert states(talk, active)[-1] == "PREEMPTED"
    assert_event_order(talk)


def test_a_patient_goal_is_accepted_when_there_is_room(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "2", scripted=True)
    active = start_goal(talk)
    first, second = queue(talk, 0, 0, text="never-ends")
    with talk.connect() as wire:
        wire.send({"seq": 1, "request": "say", "text": "length=0 patient", "patient": True, "wait": True})
        # This request is answered first, so the waiting goal does not block the connection.
        wire.send({"seq": 2, "request": "status", "id": active})
        assert wire.receive()["seq"] == 2
        assert_rejected(submit(talk, "length=0", patient=True, voice="klingon"), "unknown_voice")
        assert talk.request("cancel", ids=[first])["count"] == 1
        reply = wire.receive()
        assert (reply["seq"], reply["goal"]["state"]) == (1, "PENDING")
        patient = reply["goal"]["id"]
        assert pending_ids(talk) == [second, patient]
        assert talk.request("cancel", ids=[active, second])["ok"]
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
    recalled, queued = talk.watcher.wait_for(first, "RECALLED"), talk.watcher.wait_for(patient, "PENDING")
    assert recalled["n"] < queued["n"]
    assert_event_order(talk)


def test_a_later_goal_does_not_take_the_place_of_a_patient_goal(make_talk: MakeTalk) -> None:
    talk, _, waiting = start_full_server(make_talk)
    with talk.connect() as wire:
        wire.send({"seq": 1, "request": "say", "text": "length=0 patient", "patient": True})
        cancel = {"seq": 2, "request": "cancel", "ids": [waiting]}
        late = {"seq": 3, "request": "say", "text": "length=0 late"}
        # In one segment, so that the server handles both before anything else.
        wire.send_raw(b"".join(json.dumps(request).encode() + b"\n" for request in (cancel, late)))
        replies = {message["seq"]: message for message in (wire.receive() for _ in range(4)) if "ok" in message}
    assert replies[2]["count"] == 1
    assert replies[1]["goal"]["state"] == "PENDING"
    assert_rejected(replies[3]["goal"], "queue_full")
    assert pending_ids(talk) == [replies[1]["goal"]["id"]]
    assert talk.request("cancel")["count"] == 2
    assert_event_order(talk)


def test_at_most_a_thousand_goals_of_a_connection_wait_for_room(make_talk: MakeTalk) -> None:
    talk, _, _ = start_full_server(make_talk)
    lines = [
        json.dumps({"seq": number, "request": "say", "text": f"length=0 line {number}", "patient": True, "wait": True})
        for number in range(5_001, 6_003)
    ]
    with talk.connect() as wire, talk.connect() as other, limits():
        wire.send_raw("\n".join(lines).encode() + b"\n")
        # The server still reads this connection, and goals of other connections can wait, too.
        started_at = time.monotonic()
        assert wire.request("status")["server"]["pending"] == 1
        refused = [reply for reply in wire.items if reply.get("ok")]
        assert [reply["seq"] for reply in refused] == [6_001, 6_002]
        for reply in refused:
            assert_rejected(reply["goal"], "queue_full", "1,000 ")
        send_patient(other, "another's")
        assert_within(time.monotonic() - started_at, 0.5, "replies to a client with too many goals")
        wire.items.clear()
        wire.events.clear()
        assert wire.request("cancel")["count"] == 1_003
        assert other.receive_event("result")["goal"]["state"] == "RECALLED"
        replies = [reply["seq"] for reply in wire.items if reply.get("ok")]
        ends = [event["goal"]["text"] for event in wire.events if event["event"] == "result"]
    assert replies == list(range(5_001, 6_001))
    assert ends == [f"length=0 line {number}" for number in replies]
    assert len(spoken_ids(talk)) == 1
    assert_event_order(talk)
    states_seen = [event["state"] for event in talk.watcher.events() if event["event"] == "state"]
    # The current goal is stopped before a thousand waiting goals are reported as recalled.
    assert states_seen.index("PREEMPTING") < states_seen.index("PENDING", 3)


def test_a_cancel_reports_more_goals_than_the_output_buffer_holds(make_talk: MakeTalk) -> None:
    count = 800
    talk, _, _ = start_full_server(make_talk)
    text = "length=0 " + "w" * 9_900  # 20 kB per goal, in total four times the limit of the output buffer
    with contextlib.ExitStack() as stack:
        sender, one, other = (stack.enter_context(talk.connect()) for _ in range(3))
        for number in range(count):
            sender.send({"request": "say", "text": text, "id": f"goal/{number}", "patient": True, "wait": True})
        assert sender.request("hello")["ok"]
        with ThreadPoolExecutor() as pool:
            replies = [pool.submit(one.request, "cancel", timeout=10)]
            goals = [sender.receive_event("result")["goal"]]  # the server has received this cancel before the next one
            replies += [pool.submit(other.request, "cancel", timeout=10, ids=[f"goal/{count - 1}"])]
            goals += [sender.receive_event("result")["goal"] for _ in range(count - 1)]
            ends = [(goal["id"], goal["state"]) for goal in goals]
            assert all(reply.result()["ok"] for reply in replies), "a goal that is being cancelled was unknown"
    assert ends == [(f"goal/{number}", "RECALLED") for number in range(count)]
    talk.watcher.wait_for(f"goal/{count - 1}", "RECALLED")
    assert_event_order(talk)


def test_all_clients_get_their_results_at_shutdown_even_beyond_the_output_limit(make_talk: MakeTalk) -> None:
    count = 150
    talk, _, _ = start_full_server(make_talk)
    with talk.connect() as wire, ThreadPoolExecutor() as pool:
        for _ in range(count):
            send_patient(wire, "🤖" * 9_900)
        reasons = pool.submit(lambda: [wire.receive_event("result")["goal"]["reason"] for _ in range(count)])
        talk.stop()
        assert reasons.result() == ["shutdown"] * count


def test_subscribers_get_the_words_before_the_result(scripted: Talk) -> None:
    text = "length=0.2 one two three"
    with scripted.connect() as sender, scripted.connect() as waiter, scripted.connect() as quiet:
        other = sender.request("say", text="length=0 not followed", wait=True)["goal"]["id"]
        goal = sender.request("say", text=text, feedback=True)["goal"]["id"]
        for wire, feedback in ((waiter, True), (quiet, False)):
            assert wire.request("wait", ids=[goal], feedback=feedback)["ok"]
        first = _until_result(sender)
        assert (first[-1]["goal"]["id"], "word" in _shapes(first)) == (other, False)
        events = {name: _until_result(wire) for name, wire in (("s", sender), ("w", waiter), ("q", quiet))}
    words = scripted.watcher.words(goal)
    assert [word["word"] for word in words] == text.split()
    assert [event for event in events["s"] if event["event"] == "word"] == words
    assert _shapes(events["s"])[-7:] == ["ACTIVE", *["word"] * 4, "SUCCEEDED", "result"]
    # This client may have missed the first words, and gets all later ones.
    heard = [event for event in events["w"] if event["event"] == "word"]
    assert heard == words[len(words) - len(heard) :]
    assert len(heard) >= 2
    assert _shapes(events["w"])[-3:] == ["word", "SUCCEEDED", "result"]
    assert "word" not in _shapes(events["q"])


def _until_result(wire: Wire) -> list[Message]:
    events: list[Message] = []
    while not events or events[-1]["event"] != "result":
        events.append(wire.events.pop(0) if wire.events else wire.receive())
    return events


def _shapes(events: list[Message]) -> list[str]:
    return [str(event.get("state", event["event"])) for event in events]


def test_row_50_every_event_is_sent_once_and_in_order(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "4", scripted=True)
    wanted: dict[str, str] = {}
    with talk.connect() as wire:
        messages: list[Message] = []

        def say(reason: str, text: str = "length=0", **fields: object) -> str:
            wire.send({"request": "say", "text": text, "wait": True, **fields})
            while "ok" not in (message := _take(wire, messages)):
                pass
            goal = str(message["goal"]["id"])
            wanted[goal] = reason
            return goal

        canceled = say("PREEMPTED canceled", "length=20 words=1", id="robot.1")
        say("REJECTED invalid_text", "")
        say("REJECTED bad_option", rate=5)
        say("REJECTED unknown_voice", voice="klingon")
        say("REJECTED id_conflict", id="robot.1")
        say("SUCCEEDED", "length=0 once", throttle=60)
        say("REJECTED throttled", "length=0 once", throttle=60)
        late = say("RECALLED expired", ttl=0.3)
        say("RECALLED replaced", key="battery")
        say("RECALLED displaced", key="battery")
        say("ABORTED audio_lost", "length=0.05 fail=audio_lost", priority=2)
        say("ABORTED engine_crashed", "length=0.05 crash", priority=3)
        say("REJECTED queue_full", priority=-1)
        talk.watcher.wait_for_terminal(late)
        recalled = say("RECALLED canceled", "length=0 not this one")
        for goal_id in (recalled, canceled):
            wire.send({"request": "cancel", "ids": [goal_id]})
            while "ok" not in _take(wire, messages):
                pass
            # The event of the goal's end comes before the reply that depends on it.
            assert any(one.get("state") in {"RECALLED", "PREEMPTED"} and one.get("id") == goal_id for one in messages)
        while sum(message.get("event") == "result" for message in messages) < len(wanted):
            _take(wire, messages)
        active = say("PREEMPTED preempted", "length=20 words=1")
        talk.watcher.wait_for_word(active)
        say("RECALLED preempted")
        talk.watcher.wait_for_word(say("PREEMPTED preempted", "length=20 words=1", flush=True))
        say("SUCCEEDED", "length=0 the last", preempt=True)
        while sum(message.get("event") == "result" for message in messages) < len(wanted):
            _take(wire, messages)
    _check_replies_first(messages)
    results = {message["goal"]["id"]: message["goal"] for message in messages if message.get("event") == "result"}
    ended = {goal_id: " ".join(filter(None, (goal["state"], goal["reason"]))) for goal_id, goal in results.items()}
    assert ended == wanted
    assert_event_order(talk)
    assert sorted(talk.watcher.goals()) == sorted(wanted)
    last = {event["id"]: event["state"] for event in talk.watcher.events() if event["event"] == "state"}
    assert last == {goal_id: reason.split()[0] for goal_id, reason in wanted.items()}


def _take(wire: Wire, messages: list[Message]) -> Message:
    message = wire.receive()
    messages.append(message)
    return message


def _check_replies_first(messages: list[Message]) -> None:
    """Assert that the reply to `say` comes before the events of its goal, and that PENDING is the first event."""
    known: dict[str, str] = {}
    for message in messages:
        if "ok" in message and "goal" in message:
            assert message["goal"]["id"] not in known, message
            known[message["goal"]["id"]] = "reply"
        elif message.get("event") == "state":
            first = known[message["id"]] == "reply"
            assert first == (message["state"] in {"PENDING", "REJECTED"}), message
            known[message["id"]] = message["state"]
        elif message.get("event") == "result":
            assert known[message["goal"]["id"]] == message["goal"]["state"], message
