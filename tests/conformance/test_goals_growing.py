"""Growing texts over the wire: who may add text, when replies come, and what happens if a client leaves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from talkcli.server.requests import MAX_CLIENT_REQUESTS
from talkcli.server.speech import MAX_UNHEARD_CHARS
from tests.support.connection import Wire

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.connection import Message
    from tests.support.processes import Talk

#: A text that is spoken at once and for some time. While a goal waits for text, additions are answered at once.
BEGINNING = "One two three four five six seven eight nine ten eleven twelve. And "


def begin(client: Wire, text: str = "One. ", **fields: Any) -> str:
    """Send a goal that waits for more text, and return its id."""
    reply = client.request("say", text=text, more=True, wait=True, **fields)
    assert reply["ok"], reply
    return str(reply["goal"]["id"])


def result(client: Wire) -> Message:
    goal = client.receive_event("result", timeout=20)["goal"]
    assert isinstance(goal, dict)
    return goal


def test_a_text_grows_and_watching_clients_see_how(soundless: Talk) -> None:
    with soundless.connect() as client:
        goal_id = begin(client)
        assert client.request("append", id=goal_id, text="Two", at=5) == {
            "seq": 2, "ok": True, "length": 8, "state": "ACTIVE",
        }  # fmt: skip
        assert client.request("append", id=goal_id, text="Two. ", at=5)["length"] == 10  # a part was sent before
        assert client.request("append", id=goal_id, end=True)["length"] == 10
        assert client.request("append", id=goal_id, text="Two. ", at=5, end=True)["ok"]  # all of it was sent before
        goal = result(client)
    assert (goal["state"], goal["text"], goal["spoken_end"]) == ("SUCCEEDED", "One. Two. ", 10)
    assert goal["heard"] == pytest.approx(goal["duration"])
    events = soundless.watcher.events(goal_id)
    assert [(event["start"], event["text"]) for event in events if event["event"] == "text"] == [(5, "Two"), (8, ". ")]
    waits = [event["waits"] for event in events if event["event"] == "waits"]
    assert waits[-1:] != [True]
    assert [event["word"] for event in events if event["event"] == "word"] == ["One", "Two"]


def test_a_long_block_of_code_does_not_hold_its_sender_back(soundless: Talk) -> None:
    code = "```\n" + "x = 1\n" * 1_500
    with soundless.connect() as client:
        goal_id = begin(client, "One.\n\n", format="markdown")
        for text in (code, "y = 2\n" * 500, "```\nTwo."):
            assert client.request("append", id=goal_id, text=text)["ok"]
        assert client.request("append", id=goal_id, end=True)["ok"]
        goal = result(client)
    assert (goal["state"], len(goal["text"]) > MAX_UNHEARD_CHARS) == ("SUCCEEDED", True)
    events = soundless.watcher.events(goal_id)
    assert [event["word"] for event in events if event["event"] == "word"] == ["One", "Two"]


def test_only_its_own_connection_may_add_text(soundless: Talk) -> None:
    with soundless.connect() as client, soundless.connect() as other:
        for goal_id in (begin(client), begin(client, id="mine/1")):
            reply = other.request("append", id=goal_id, text="Two.")
            assert (reply["error"]["code"], reply["state"] in ("ACTIVE", "PENDING")) == ("not_sender", True)
            assert reply["error"]["message"] == f"another connection is already sending the text of goal {goal_id}"
        assert other.request("append", id="4k7f-99", text="Two.")["error"]["code"] == "unknown_goal"
        assert other.request("cancel")["ok"]


def test_a_new_connection_continues_a_text_whose_sender_chose_the_id(soundless: Talk) -> None:
    with soundless.connect() as client:
        begin(client, id="mine/1")
    with soundless.connect() as client:
        assert client.request("say", id="mine/1", text="One. ", more=True, wait=True)["attached"]
        assert client.request("append", id="mine/1", text="Two.", at=5, end=True)["ok"]
        assert result(client)["state"] == "SUCCEEDED"


@pytest.mark.parametrize("leave", [Wire.close, Wire.half_close])
def test_a_client_that_leaves_breaks_off_its_texts(soundless: Talk, leave: Callable[[Wire], None]) -> None:
    with soundless.connect() as client:
        active, waiting = begin(client, "One two. Three fo"), begin(client)
        soundless.watcher.wait_for(active, "ACTIVE")
        leave(client)
        soundless.watcher.wait_for(active, "ABORTED")
        if leave is Wire.half_close:  # the results still arrive
            assert {result(client)["id"], result(client)["id"]} == {active, waiting}
    goal = soundless.goal(active)
    assert (goal["reason"], goal["spoken"]) == ("broken_off", "One two")
    goal = soundless.goal(waiting)
    assert (goal["state"], goal["reason"]) == ("RECALLED", "broken_off")


def test_the_reply_comes_when_enough_of_the_text_was_heard(soundless: Talk) -> None:
    with soundless.connect() as client:
        goal_id = begin(client, BEGINNING)
        assert client.request("append", id=goal_id, text="word " * (MAX_UNHEARD_CHARS // 5 - 20))["ok"]
        client.send({"seq": 99, "request": "append", "id": goal_id, "text": "word " * 20})
        assert client.request("status", id=goal_id)["goal"]["more"]  # other requests are answered meanwhile
        messages = client.events + client.items
        assert not any(message.get("seq") == 99 for message in messages)
        while (message := client.receive(20)).get("seq") != 99:
            pass
    assert message["length"] == len(BEGINNING) + MAX_UNHEARD_CHARS


def test_a_reply_that_is_held_back_in_a_pause_comes_at_the_end_of_the_goal(soundless: Talk) -> None:
    with soundless.connect() as client, soundless.connect() as other:
        goal_id = begin(client, feedback=True)
        client.receive_event("word")
        client.receive_event("waits", waits=True)
        assert other.request("pause")["ok"]
        for number in range(2):
            client.send({"seq": number, "request": "append", "id": goal_id, "text": "word " * 1_800})
        other.request("cancel", ids=[goal_id])
        while (reply := client.receive()).get("seq") != 1:
            pass
    assert reply["state"] in {"PREEMPTING", "PREEMPTED"}


def test_replies_beyond_the_limit_for_waiting_requests_come_at_once(soundless: Talk) -> None:
    with soundless.connect() as client:
        goal_id = begin(client, BEGINNING)
        for text in ("word " * 2_100, *[""] * MAX_CLIENT_REQUESTS):
            client.send({"request": "append", "id": goal_id, "text": text})
        while (reply := client.receive()).get("length") is None:
            pass
        assert (reply["ok"], reply["length"]) == (True, len(BEGINNING) + 10_500)
        assert client.request("status", id=goal_id)["goal"]["more"]
        assert client.items == []
        client.request("cancel")
