"""The wire: the greeting, replies, and the order of events."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance.checks import await_ends
from tests.conformance.rawsocket import Raw

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk

KEYS = {
    "id", "state", "status", "reason", "by", "message", "text", "format", "said", "spoken", "spoken_end",
    "heard", "priority", "key", "ttl", "data", "client", "paused", "interrupted_by", "more", "waits",
    "queued_at", "started_at", "ended_at", "duration", "voice", "output",
}  # fmt: skip


def line(**fields: object) -> bytes:
    return json.dumps(fields).encode() + b"\n"


def shape(message: Message) -> str:
    """Return an event's state or kind, "reply" or "item"."""
    if "event" in message:
        return str(message.get("state", message["event"]))
    return "reply" if "ok" in message else "item"


@pytest.mark.parametrize("text", ["length=0.1 one two", "length=0.1 crash"])
def test_row_50_the_reply_comes_first_and_the_result_last(scripted: Talk, text: str) -> None:
    with Raw(scripted.socket) as raw:
        raw.send(line(seq=1, request="say", text=text, wait=True))
        _, reply, *events = raw.receive_lines(6)
    state = "ABORTED" if "crash" in text else "SUCCEEDED"
    assert [shape(message) for message in (reply, *events)] == ["reply", "PENDING", "ACTIVE", state, "result"]
    assert reply["goal"].keys() == events[-1]["goal"].keys() == KEYS
    assert reply["goal"]["state"] == "PENDING"  # the state when it was accepted, so that states never go backwards
    numbers = [event["n"] for event in events[:-1]]
    assert numbers == sorted(set(numbers))
    moments = [event["at"] for event in events[:-1]]
    assert moments == sorted(moments)
    assert abs(moments[0] - time.time()) < 10
    result = events[-1]["goal"]
    assert result["queued_at"] <= result["started_at"] <= result["ended_at"]


def test_two_requests_in_one_segment_are_both_handled(scripted: Talk) -> None:
    with Raw(scripted.socket) as raw:
        requests = [line(seq=1, request="say", text="length=0"), line(seq=2, request="say", text="length=0 two")]
        raw.send(b"".join([*requests, line(seq=3, request="status")[:10]]))
        _, one, two = raw.receive_lines(3)
        assert [reply["seq"] for reply in (one, two)] == [1, 2]
        raw.send(line(seq=3, request="status")[10:])
        assert raw.receive_lines(4)[3]["seq"] == 3
    for reply in (one, two):
        assert scripted.watcher.wait_for_terminal(reply["goal"]["id"]) == "SUCCEEDED"


def test_a_request_sent_byte_by_byte_is_handled(scripted: Talk) -> None:
    with Raw(scripted.socket) as raw:
        for byte in line(seq=1, request="say", text="length=0 é", wait=True):
            raw.send(bytes([byte]))
        *_, result = raw.receive_lines(6)
    assert (result["goal"]["state"], result["goal"]["text"]) == ("SUCCEEDED", "length=0 é")


def test_a_client_that_has_closed_its_sending_half_gets_the_result(scripted: Talk) -> None:
    with Raw(scripted.socket) as raw:
        raw.send(line(request="say", text="length=0.5", wait=True))
        raw.half_close()
        *_, result = raw.receive_all(timeout=5)
    assert (shape(result), result["goal"]["state"]) == ("result", "SUCCEEDED")


def test_a_client_that_has_closed_its_sending_half_gets_its_replies(scripted: Talk) -> None:
    scripted.request("say", text="length=20 slow-stop=0.1")
    scripted.watcher.wait_for(None, "ACTIVE")
    with Raw(scripted.socket) as raw:
        raw.send(line(seq=1, request="cancel") + line(seq=2, request="voices") + line(seq=3, request="status"))
        raw.half_close()
        replies = [message["seq"] for message in raw.receive_all() if "ok" in message]
    assert sorted(replies) == [1, 2, 3]


@pytest.mark.parametrize("last_request", ["status", "cancel"])
def test_requests_that_wait_for_the_voices_keep_their_order(make_talk: MakeTalk, last_request: str) -> None:
    """After the server's start, a goal with a voice and all later requests wait until the voices are known."""
    count = 60
    talk = make_talk("--max-queue", str(2 * count), scripted=True, env={"SCRIPTED_START": "slow=0.3"})
    with talk.connect() as wire:
        boot = wire.greeting["boot"]
        for number in range(5_000, 5_000 + count):
            voice = {} if number % 3 else {"voice": "default"}
            wire.send({"seq": number, "request": "say", "text": "length=0", **voice})
        wire.send({"seq": 6_000, "request": "say", "text": "length=0", "voice": "default", "id": "last"})
        wire.send({"seq": 6_001, "request": "wait", "ids": ["last"]})
        wire.send({"seq": 6_002, "request": "set", "rate": 100})
        assert wire.request(last_request)["ok"]
        replies = [(reply["seq"], reply) for reply in wire.items if "ok" in reply]
    assert [seq for seq, _ in replies] == [*range(5_000, 5_000 + count), 6_000, 6_001, 6_002]
    assert all(reply["ok"] for _, reply in replies)
    assert [reply["goal"]["id"] for _, reply in replies[:count]] == [f"{boot}-{number + 1}" for number in range(count)]
    await_ends(talk, talk.watcher.goals())
    spoken = [event["id"] for event in talk.watcher.events() if event.get("state") == "ACTIVE"]
    expected = [f"{boot}-{number + 1}" for number in range(count)]
    assert spoken == ([*expected, "last"] if last_request == "status" else expected[: len(spoken)])


def test_a_cancel_or_a_pause_does_not_answer_waiting_requests_early(make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True, env={"SCRIPTED_START": "slow=0.3"})
    with talk.connect() as asking, talk.connect() as canceling, talk.connect() as pausing:
        requests: list[dict[str, Any]] = [
            {"request": "voices"},
            {"request": "set", "voice": "nonsense"},
            {"request": "say", "text": "length=0 one", "voice": "default", "id": "one"},
            {"request": "say", "text": "length=0 two", "voice": "nonsense", "id": "two", "wait": True},
            {"request": "say", "text": "length=0 three", "voice": "nonsense"},
        ]
        asking.send_raw(b"".join(line(seq=seq, **request) for seq, request in enumerate(requests, 5_000)))
        assert canceling.request("cancel", key="nobody")["count"] == 0
        assert canceling.request("cancel", ids=["two"])["count"] == 1
        assert asking.receive_event("result")["goal"]["state"] == "RECALLED"
        pausing.send({"request": "set", "voice": "default"})
        assert pausing.request("pause")["ok"]
        assert pausing.request("resume")["ok"]
        assert asking.request("hello")["ok"]
        replies: dict[int, Any] = {}
        while 5_004 not in replies:
            message = asking.items.pop(0) if asking.items else asking.receive()
            if "ok" in message:
                replies[message["seq"]] = message
    assert replies[5_000]["count"] > 0
    assert replies[5_001]["error"]["code"] == "unknown_voice"
    assert replies[5_002]["goal"]["state"] == "PENDING"
    assert replies[5_004]["goal"]["reason"] == "unknown_voice"
    assert talk.watcher.wait_for_terminal("one") == "SUCCEEDED"


@pytest.mark.parametrize("extra", [{"wait": True}, {"feedback": True}, {}])
def test_a_rejected_goal_has_a_state_and_a_result_if_the_client_waits(scripted: Talk, extra: dict[str, bool]) -> None:
    with Raw(scripted.socket) as raw:
        raw.send(line(request="say", text="", **extra))
        raw.half_close()
        _, reply, *events = raw.receive_all()
    assert [shape(event) for event in events] == (["REJECTED", "result"] if extra else [])
    assert {message["goal"]["state"] for message in (reply, *events[1:])} == {"REJECTED"}
