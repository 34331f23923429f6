"""Ids that senders choose, and cancels by id: spoken once whoever sends it again, cancelled before it is there."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance.told import assert_rejected, assert_told_in_order, submit
from tests.conformance.witness import states

if TYPE_CHECKING:
    from tests.support.processes import Talk

TEXT = "length=0.3 the door is open"
SHORT = "length=0 the door is open"


def test_row_20_before_a_goal_means_accepted_before_it_not_spoken_before_it(scripted: Talk) -> None:
    """Ten goals whose order in the queue is another: those accepted later stay, wherever they are."""
    priorities = [0, 0, 5, 1, 0, 9, 3, 5, 0, 9]
    with scripted.connect() as wire:
        ids = [
            wire.request("say", text=f"never-ends number {number}", priority=priority)["goal"]["id"]
            for number, priority in enumerate(priorities)
        ]
        scripted.watcher.wait_for_word(ids[0])
        reply = wire.request("cancel", before=ids[6])
        canceled = [each["canceled"]["id"] for each in wire.items]
        assert (reply["ok"], reply["count"], sorted(canceled)) == (True, 7, sorted(ids[:7]))
        assert [states(scripted, each)[-1] for each in ids[:7]] == ["PREEMPTED", *["RECALLED"] * 6]
        wire.items.clear()
        reply = wire.request("status")
        # The cancel that was answered came before the next goal's start, which the engine told meanwhile.
        assert reply["active"]["id"] == ids[9]
        assert [each["pending"]["id"] for each in wire.items if "pending" in each] == [ids[7], ids[8]]
        assert wire.request("cancel")["count"] == 3
    assert_told_in_order(scripted)


def test_row_21_a_cancel_that_comes_before_its_goal_recalls_it(scripted: Talk) -> None:
    early = scripted.request("cancel", ids=["front-door.1"])
    assert (early["ok"], early["error"]["code"]) == (False, "unknown_goal")
    with scripted.connect() as wire:
        goal = wire.request("say", text=TEXT, id="front-door.1", wait=True)["goal"]
        assert (goal["id"], goal["state"]) == ("front-door.1", "PENDING")
        result = wire.receive_event("result")["goal"]
    assert (result["id"], result["state"], result["reason"]) == ("front-door.1", "RECALLED", "canceled")
    assert result["by"]["client"]["pid"]
    assert states(scripted, "front-door.1") == ["PENDING", "RECALLED"]
    again = scripted.request("say", text=TEXT, id="front-door.1")
    assert (again["attached"], again["goal"]["state"]) == (True, "RECALLED")
    other = submit(scripted, TEXT, id="front-door.2")
    assert states(scripted, other["id"])[-1] == "SUCCEEDED"
    assert_told_in_order(scripted)


def test_row_21_from_the_command_line(scripted: Talk) -> None:
    early = scripted.run("cancel", "front-door.1")
    assert (early.code, early.out) == (8, "")
    goal = scripted.run("say", "--wait", "--id", "front-door.1", "--", TEXT)
    assert (goal.code, goal.id) == (6, "front-door.1")
    assert "Talk recalled: " in goal.err
    assert states(scripted, "front-door.1") == ["PENDING", "RECALLED"]


def test_row_22_from_the_command_line(scripted: Talk) -> None:
    same = ["say", "--wait", "--id", "front-door.1", "--", TEXT]
    clients = [scripted.start(*same) for _ in range(2)]
    done = [scripted.finish(each) for each in clients]
    assert [(each.code, each.id) for each in done] == [(0, "front-door.1")] * 2
    assert states(scripted, "front-door.1") == ["PENDING", "ACTIVE", "SUCCEEDED"]
    conflict = scripted.run("say", "--wait", "--id", "front-door.1", "--", "length=0 another text")
    assert (conflict.code, conflict.out) == (5, "")
    assert "front-door.1" in conflict.err


def test_row_21_a_goal_that_was_cancelled_early_stops_nothing(scripted: Talk) -> None:
    active = submit(scripted, "never-ends here", key="door")["id"]
    pending = submit(scripted, "length=0 there", key="door", preempt=False)["id"]
    scripted.watcher.wait_for_word(active)
    assert not scripted.request("cancel", ids=["front-door.1"])["ok"]
    submit(scripted, "length=0 never", id="front-door.1", key="door", flush=True)
    assert states(scripted, "front-door.1") == ["PENDING", "RECALLED"]
    assert [scripted.goal(each)["state"] for each in (active, pending)] == ["ACTIVE", "PENDING"]
    assert scripted.request("cancel", ids=[active])["ok"]
    assert states(scripted, pending)[-1] == "SUCCEEDED"


def test_row_22_the_same_id_twice_is_spoken_once_and_both_see_the_result(scripted: Talk) -> None:
    with scripted.connect() as one, scripted.connect() as two:
        first = one.request("say", text=TEXT, id="front-door.1", wait=True)
        scripted.watcher.wait_for_word("front-door.1")
        second = two.request("say", text=TEXT, id="front-door.1", wait=True)
        assert (first["goal"]["id"], first["goal"]["state"], "attached" in first) == ("front-door.1", "PENDING", False)
        assert (second["goal"]["id"], second["goal"]["state"], second["attached"]) == ("front-door.1", "ACTIVE", True)
        results = [each.receive_event("result")["goal"] for each in (one, two)]
        assert results[0] == results[1]
        assert results[0]["state"] == "SUCCEEDED"
        late = two.request("say", text=TEXT, id="front-door.1", wait=True)
        assert (late["attached"], late["goal"]) == (True, results[0])
        assert two.receive_event("result")["goal"] == results[0]
    assert states(scripted, "front-door.1") == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert len([each for each in scripted.watcher.words("front-door.1") if each["number"] == 1]) == 1


@pytest.mark.parametrize("when", ["while it is spoken", "after its end"])
def test_row_22_the_same_id_with_another_text_is_rejected(scripted: Talk, when: str) -> None:
    first = submit(scripted, TEXT, id="front-door.1")["id"]
    scripted.watcher.wait_for_word(first)
    if when == "after its end":
        scripted.watcher.wait_for_terminal(first)
    conflict = submit(scripted, "length=0 another text", id="front-door.1", flush=True)
    assert_rejected(conflict, "id_conflict", "front-door.1")
    assert conflict["id"] != "front-door.1"
    assert states(scripted, first) == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert scripted.goal("front-door.1")["text"] == TEXT
    assert scripted.goal(conflict["id"])["state"] == "REJECTED"


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"text": "", "id": "front-door.1"}, "invalid_text"),
        ({"text": SHORT, "id": "front-door.1", "rate": 20}, "bad_option"),
        ({"text": SHORT, "id": "front-door.1", "voice": "klingon"}, "unknown_voice"),
        ({"text": SHORT, "id": "front-door.1", "throttle": 60}, "throttled"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_row_22_a_rejected_goal_does_not_use_its_id_up(scripted: Talk, fields: dict[str, Any], reason: str) -> None:
    # This text was said just now, under another id: that throttles it.
    assert states(scripted, submit(scripted, SHORT)["id"])[-1] == "SUCCEEDED"
    rejected = scripted.request("say", **fields)["goal"]
    assert_rejected(rejected, reason)
    assert rejected["id"] != "front-door.1"
    assert scripted.request("status", id="front-door.1")["error"]["code"] == "unknown_goal"
    reply = scripted.request("say", text=SHORT, id="front-door.1")
    assert (reply["goal"]["id"], reply["goal"]["state"], "attached" in reply) == ("front-door.1", "PENDING", False)
    assert states(scripted, "front-door.1") == ["PENDING", "ACTIVE", "SUCCEEDED"]


def test_row_22_a_sender_that_attached_and_leaves_ends_nothing(scripted: Talk) -> None:
    with scripted.connect() as one:
        one.request("say", text=TEXT, id="front-door.1", wait=True)
        with scripted.connect() as two:
            assert two.request("say", text=TEXT, id="front-door.1", wait=True)["attached"]
        assert one.receive_event("result")["goal"]["state"] == "SUCCEEDED"


@pytest.mark.parametrize("own", ["7", "4k7f-12", "-door", "door 1", "d" * 65, "", "dörr"])
def test_ids_that_a_sender_may_not_choose_are_rejected(scripted: Talk, own: str) -> None:
    goal = submit(scripted, TEXT, id=own, flush=True)
    assert_rejected(goal, "bad_option")
    assert goal["id"] != own


@pytest.mark.parametrize("own", ["goal-1", "task-2", "2024-12", "/patrol/goal-1-1712.25"])
def test_ids_that_programs_give_their_goals_are_taken(scripted: Talk, own: str) -> None:
    """Four characters and a number, too; and ROS's, which have slashes."""
    done = scripted.run("say", "--wait", "--id", own, "--", SHORT)
    assert (done.code, done.id) == (0, own), done
    assert scripted.request("say", text=SHORT, id=own)["attached"]
    assert scripted.run("wait", own).code == 0
    assert scripted.run("cancel", own).code == 0
    assert scripted.run("cancel", f"{own}.later").code == 8
    assert scripted.run("say", "--wait", "--id", f"{own}.later", "--", SHORT).code == 6
    assert_told_in_order(scripted)


def test_ids_of_a_server_are_of_a_form_that_nobody_types(scripted: Talk) -> None:
    goal = submit(scripted, SHORT)["id"]
    assert re.fullmatch("[0-9][a-z][0-9][a-z]-1", goal)
    assert scripted.run("wait", "1").code == 0
