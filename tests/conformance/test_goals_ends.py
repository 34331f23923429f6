"""How goals end if the engine fails, crashes or ignores a stop, or if clients cancel. The engine is scripted."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.checks import count_ends, states
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.connection import Message, Wire
    from tests.support.processes import Talk

#: Limit in seconds for the reply to `status` and `cancel`, whatever the engine does.
ANSWER = 0.1


def submit(wire: Wire, text: str, *, wait: bool = False) -> str:
    """Send a goal and return its id."""
    reply = wire.request("say", text=text, wait=wait)
    assert reply["ok"], reply
    return str(reply["goal"]["id"])


def test_row_02_an_engine_failure_aborts_only_the_current_goal(scripted: Talk) -> None:
    text = "length=0.6 fail=audio_lost message=the_cable_is_out one two three four"
    done = scripted.run("--json", "say", "--wait", "--", text)
    goal = json.loads(done.out)
    assert (done.code, goal["state"], goal["reason"]) == (4, "ABORTED", "audio_lost")
    assert goal["message"] == "speech failed: the cable is out"
    assert "the cable is out" in done.err
    assert states(scripted, goal["id"]) == ["PENDING", "ACTIVE", "ABORTED"]
    assert 0 < len(goal["spoken"]) < len(text)
    assert goal["spoken"] == text[: scripted.watcher.words(goal["id"])[-1]["end"]]
    assert scripted.run("say", "--wait", "battery low").code == 0


def test_row_04_an_engine_that_exits_during_a_goal_is_replaced(scripted: Talk) -> None:
    with limits():
        with scripted.connect() as wire:
            first = submit(wire, "length=0.2 exit and more", wait=True)
            second = submit(wire, "the next one", wait=True)
            goal = wire.receive_event("result")["goal"]
            assert (goal["id"], goal["state"], goal["reason"]) == (first, "ABORTED", "engine_crashed")
            assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
        watcher = scripted.watcher
        assert states(scripted, first) == ["PENDING", "ACTIVE", "ABORTED"]
        word, aborted = watcher.wait_for_word(second), watcher.wait_for(first, "ABORTED")
        assert_within(watcher.arrived(word) - watcher.arrived(aborted), 0.5, "speaking again after a crash")

    assert scripted.running


def test_row_05_a_sentence_that_completes_despite_a_stop_has_succeeded(scripted: Talk) -> None:
    waiter = scripted.start("say", "--wait", "--", "length=20 on-stop=complete words=1")
    goal_id = scripted.watcher.wait_for(None, "ACTIVE")["id"]
    scripted.watcher.wait_for_word(goal_id)
    canceled = scripted.run("cancel", goal_id)
    assert (canceled.code, canceled.out) == (0, "")  # it ended, but not because of the cancel
    assert states(scripted, goal_id) == ["PENDING", "ACTIVE", "PREEMPTING", "SUCCEEDED"]
    assert scripted.finish(waiter).code == 0
    goal = scripted.goal(goal_id)
    assert (goal["reason"], goal["by"], goal["message"]) == (None, None, "Talk completed successfully")


@pytest.mark.parametrize("how", ["ignore-stop never-ends", "length=20 on-stop=hang"])
def test_row_06_an_engine_that_ignores_a_stop_is_killed(scripted: Talk, how: str) -> None:
    with limits(), scripted.connect() as asker, scripted.connect() as canceler, scripted.connect() as speaker:
        ended = submit(speaker, "length=0", wait=True)
        speaker.receive_event("result", timeout=10)
        goal_id = submit(speaker, f"{how} words=1")
        following = submit(speaker, "length=0 the next one", wait=True)
        scripted.watcher.wait_for_word(goal_id)
        times: dict[str, float] = {"status": 0.0, "cancel": 0.0}
        started_at = time.monotonic()
        canceler.send({"seq": 0, "request": "cancel", "ids": [goal_id]})
        while scripted.watcher.states(goal_id)[-1] != "PREEMPTED":
            assert time.monotonic() - started_at < 2, scripted.watcher.states(goal_id)
            for request in ("status", "cancel"):
                sent_at = time.monotonic()
                reply = asker.request("status") if request == "status" else asker.request("cancel", ids=[ended])
                assert reply["ok"]
                times[request] = max(times[request], time.monotonic() - sent_at)
            time.sleep(0.02)  # otherwise, the requests would keep a CPU core busy
        silent = scripted.watcher.arrived(scripted.watcher.wait_for(goal_id, "PREEMPTED")) - started_at
        reply = canceler.receive()
        assert reply["canceled"]["id"] == goal_id
        assert (reply["canceled"]["state"], reply["canceled"]["reason"]) == ("PREEMPTED", "canceled")
        assert canceler.receive() == {"seq": 0, "ok": True, "count": 1}
        result = speaker.receive_event("result", timeout=10)["goal"]
        assert (result["id"], result["state"]) == (following, "SUCCEEDED")
        assert states(scripted, goal_id) == ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"]
        assert silent >= 0.14, "the engine was killed before the limit"
        for request, seconds in times.items():
            assert_within(seconds, ANSWER, request)
        assert_within(silent, 0.15 + 0.35, "the end of a process that ignores stop")


def test_row_09_each_goal_gets_its_own_message(scripted: Talk) -> None:
    with scripted.connect() as wire:
        good = submit(wire, "length=0.2 all is well", wait=True)
        bad = submit(wire, "fail=audio_device message=no_such_card", wait=True)
        results = {(goal := wire.receive_event("result")["goal"])["id"]: goal for _ in range(2)}
    assert list(results) == [good, bad]
    assert (results[good]["state"], results[good]["message"]) == ("SUCCEEDED", "Talk completed successfully")
    assert (results[bad]["state"], results[bad]["message"]) == ("ABORTED", "speech failed: no such card")
    assert results[good]["text"] == "length=0.2 all is well"


def test_row_11_a_cancel_without_an_id_ends_all_goals(scripted: Talk) -> None:
    ids = [scripted.run("say", "never-ends", f"number {number}").id for number in range(4)]
    scripted.watcher.wait_for_word(ids[0])
    done = scripted.run("cancel")
    assert (done.code, sorted(done.out.split()), done.err) == (0, sorted(ids), "")
    assert [scripted.goal(goal_id)["state"] for goal_id in ids] == ["PREEMPTED", "RECALLED", "RECALLED", "RECALLED"]
    assert {scripted.goal(goal_id)["reason"] for goal_id in ids} == {"canceled"}
    assert count_ends(scripted, *ids) == [1, 1, 1, 1]
    assert states(scripted, ids[1]) == ["PENDING", "RECALLED"]  # never ACTIVE


def test_row_12_feedback_names_its_goal_and_precedes_the_result(make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True)
    texts = [f"length=0.15 this is goal number {number}" for number in range(4)]
    with talk.connect() as watching, talk.connect() as one, talk.connect() as two:
        assert watching.request("watch")["ok"]
        ids = [submit(wire, text) for wire, text in zip((one, two, one, two), texts, strict=True)]
        talk.watcher.wait_for(ids[-1], "SUCCEEDED")
        events: list[Message] = [*watching.events]
        while not events or events[-1].get("id") != ids[-1] or events[-1].get("state") != "SUCCEEDED":
            events.append(watching.receive())
    assert [event["n"] for event in events if "n" in event] == list(range(1, 1 + len(events)))  # nothing was dropped
    for goal_id, text in zip(ids, texts, strict=True):
        own = [event for event in events if event.get("id") == goal_id]
        assert [event.get("state") for event in own] == ["PENDING", "ACTIVE", *[None] * 6, "SUCCEEDED"]
        words = [event for event in own if event["event"] == "word"]
        assert [word["word"] for word in words] == text.split()
        assert all(text[word["start"] : word["end"]] == word["word"] for word in words)
        assert [word["number"] for word in words] == [1, 2, 3, 4, 5, 6]


def test_row_14_a_cancel_without_any_goals_succeeds(scripted: Talk) -> None:
    for options in ([], ["--current"]):
        done = scripted.run("cancel", *options)
        assert (done.code, done.out, done.err) == (0, "", "")


def test_row_19_unknown_ids_are_errors_and_ended_goals_do_not_change(scripted: Talk) -> None:
    ended = scripted.run("say", "--wait", "length=0").id
    before = scripted.goal(ended)
    active, pending = (scripted.run("say", f"never-ends {name}").id for name in ("active", "pending"))
    for args in (["cancel", "none-7"], ["wait", "none-7"], ["status", "none-7"], ["cancel", "--before", "none-7"]):
        done = scripted.run(*args)
        assert (done.code, done.out) == (8, ""), done
        assert "none-7" in done.err
    unknown_too = scripted.run("wait", active, "none-7")
    assert unknown_too.code == 8
    assert unknown_too.seconds < 2, "an unknown id was not reported at once"
    note = scripted.run("cancel", ended)
    assert (note.code, note.out) == (0, "")
    assert ended in note.err
    assert "SUCCEEDED" in note.err
    assert scripted.goal(ended) == before
    both = scripted.run("cancel", pending, "none-7")
    assert (both.code, both.id) == (8, pending)  # the known goal is cancelled nevertheless
    assert scripted.goal(active)["state"] == "ACTIVE"
    assert scripted.run("cancel", "--current").id == active


def test_row_20_cancel_before_ends_all_goals_accepted_up_to_that_goal(scripted: Talk) -> None:
    with scripted.connect() as wire:
        ids = [
            str(wire.request("say", text=f"never-ends number {number}", priority=priority)["goal"]["id"])
            for number, priority in enumerate([0, 0, 5, 1, 0, 9, 3, 5, 0, 9])
        ]
    scripted.watcher.wait_for_word(ids[0])
    number = ids[6].rpartition("-")[2]
    done = scripted.run("cancel", "--before", number)  # a number means a goal of this server
    assert (done.code, sorted(done.out.split())) == (0, sorted(ids[:7]))
    assert [states(scripted, goal_id)[-1] for goal_id in ids[:7]] == ["PREEMPTED", *["RECALLED"] * 6]
    assert [scripted.goal(goal_id)["state"] for goal_id in ids[7:]] == ["PENDING", "PENDING", "ACTIVE"]
    more = scripted.run("cancel", ids[8].rpartition("-")[2], "--current")  # the selectors are combined
    assert sorted(more.out.split()) == sorted(ids[8:])
    assert scripted.run("cancel").id == ids[7]


def test_row_32_a_watcher_sees_all_states_of_very_short_goals(scripted: Talk) -> None:
    with scripted.connect() as wire:
        ids = [submit(wire, "length=0") for _ in range(50)]
        assert wire.request("wait", ids=ids[-1:])["ok"]
        wire.receive_event("result", timeout=20)
    for goal_id in ids:
        assert states(scripted, goal_id) == ["PENDING", "ACTIVE", "SUCCEEDED"]
