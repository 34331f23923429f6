"""Rows 21 and 22: ids chosen by a sender, on the wire and on the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.conformance.checks import assert_event_order, states

if TYPE_CHECKING:
    from tests.support.processes import Talk

TEXT = "length=0.3 the door is open"
SHORT = "length=0 the door is open"


def test_row_21_a_cancel_that_arrives_before_its_goal_recalls_it(scripted: Talk) -> None:
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
    assert_event_order(scripted)


def test_row_22_a_goal_sent_twice_is_spoken_once_for_both_senders(scripted: Talk) -> None:
    with scripted.connect() as one, scripted.connect() as two:
        first = one.request("say", text=TEXT, id="front-door.1", wait=True)
        scripted.watcher.wait_for_word("front-door.1")
        second = two.request("say", text=TEXT, id="front-door.1", wait=True)
        assert (first["goal"]["id"], first["goal"]["state"], "attached" in first) == ("front-door.1", "PENDING", False)
        assert (second["goal"]["id"], second["goal"]["state"], second["attached"]) == ("front-door.1", "ACTIVE", True)
        results = [wire.receive_event("result")["goal"] for wire in (one, two)]
        assert results[0] == results[1]
        assert results[0]["state"] == "SUCCEEDED"
        late = two.request("say", text=TEXT, id="front-door.1", wait=True)
        assert (late["attached"], late["goal"]) == (True, results[0])
        assert two.receive_event("result")["goal"] == results[0]
    assert states(scripted, "front-door.1") == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert len([word for word in scripted.watcher.words("front-door.1") if word["number"] == 1]) == 1


def test_row_22_the_commands_accept_ids_of_ros_goals(scripted: Talk) -> None:
    own = "/patrol/goal-1-1712.25"
    assert scripted.run("say", "--id", own, "--", "").code == 5  # the id of a rejected goal can be used again
    done = scripted.run("say", "--wait", "--id", own, "--", SHORT)
    assert (done.code, done.id) == (0, own), done
    assert scripted.request("say", text=SHORT, id=own)["attached"]
    conflict = scripted.run("say", "--wait", "--id", own, "--", "length=0 another text")
    assert (conflict.code, conflict.out, own in conflict.err) == (5, "", True)
    assert scripted.run("wait", own).code == 0
    assert scripted.run("cancel", own).code == 0
    assert scripted.run("cancel", f"{own}.later").code == 8
    assert scripted.run("say", "--wait", "--id", f"{own}.later", "--", SHORT).code == 6
    assert_event_order(scripted)
