"""`say --feedback` and `wait --feedback` print each event to a pipe at once, as a line or an object."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.processes import Process, Talk


def lines_of(client: Process) -> Iterator[str]:
    """Yield the client's lines as they arrive."""
    assert client.stdout
    return (line.rstrip("\n") for line in client.stdout)


#: Ten words per second until it is stopped, so that a client that follows it soon prints one.
TALKING = "never-ends length=60 " + "word " * 600


def objects(out: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.splitlines()]


def test_each_event_is_printed_as_one_line_of_fields(scripted: Talk) -> None:
    done = scripted.run("say", "-wf", "--", "length=0.4 battery d'été 日本\x1b[m")
    goal_id = scripted.watcher.goals()[0]
    assert done.code == 0
    assert done.err == ""
    assert done.out.splitlines() == [
        f"{goal_id} PENDING",
        f"{goal_id} ACTIVE",
        f"{goal_id} word 1 0-10 0.000 length=0.4",
        f"{goal_id} word 2 11-18 0.100 battery",
        f"{goal_id} word 3 19-24 0.200 d'été",
        f"{goal_id} word 4 25-30 0.300 日本\\x1b[m",
        f"{goal_id} SUCCEEDED",
    ]


def test_json_prints_the_protocols_events_and_then_the_result(scripted: Talk) -> None:
    done = scripted.run("--json", "say", "-wf", "--", "length=0.2 battery low")
    *events, result = objects(done.out)
    goal_id = events[0]["id"]
    # A watcher's events also contain the whole goal.
    watched = [
        {name: value for name, value in event.items() if name != "goal"} for event in scripted.watcher.events(goal_id)
    ]
    assert events == watched
    assert [event["event"] for event in events] == ["state", "state", "word", "word", "word", "state"]
    assert events[3].keys() == {"event", "id", "word", "start", "end", "number", "time", "n", "at"}
    assert result == {"event": "result", "goal": scripted.goal(goal_id)}


def test_the_last_object_is_the_result_for_every_outcome(scripted: Talk) -> None:
    for text, code, state in (("", 5, "REJECTED"), ("fail=audio_lost", 4, "ABORTED"), ("never-ends", 124, "PREEMPTED")):
        done = scripted.run("--json", "say", "-f", "-t", "0.3", "--", text)
        last = objects(done.out)[-1]
        assert (done.code, last["event"], last["goal"]["state"]) == (code, "result", state)
        assert code == 124 or last["goal"]["message"] in done.err
    done = scripted.run("say", "-wf", "")
    assert (done.code, done.out, "the text is empty" in done.err) == (5, "", True)
    client = scripted.start("--json", "say", "-f", TALKING)
    lines = lines_of(client)
    goal_id = json.loads(next(lines))["id"]
    waiting = scripted.start("wait", "-f", goal_id)
    printed = lines_of(waiting)
    assert next(printed).startswith(f"{goal_id} ")
    scripted.kill()
    assert (json.loads(list(lines)[-1])["goal"]["state"], list(printed)[-1]) == ("LOST", f"{goal_id} LOST")
    assert (client.wait(10), waiting.wait(10)) == (12, 12)


def test_pauses_and_interruptions_are_shown(scripted: Talk) -> None:
    client = scripted.start("say", "-wf", "--", "never-ends words=1")
    lines = lines_of(client)
    goal_id = next(lines).split()[0]
    scripted.watcher.wait_for_word(goal_id)
    for command in ("pause", "resume"):
        assert scripted.run(command).code == 0
    aside = scripted.run("say", "-w", "--interject", "length=0").id
    client.send_signal(signal.SIGTERM)
    shown = [line.split()[1:] for line in lines if " word " not in line]
    states = [["ACTIVE"], ["PAUSED"], ["RESUMED"], ["INTERRUPTED", aside], ["ACTIVE"], ["PREEMPTING"], ["PREEMPTED"]]
    assert shown == states
    assert client.wait(10) == 143


@pytest.mark.parametrize(("options", "noted"), [((), True), (("--quiet",), False)])
def test_a_command_that_waits_notes_an_interruption(scripted: Talk, options: tuple[str, ...], noted: bool) -> None:
    client = scripted.start(*options, "say", "-w", "--", "never-ends words=1")
    goal_id = scripted.watcher.wait_until(lambda event: event["event"] == "word")["id"]
    aside = scripted.run("say", "-w", "--interject", "length=0").id
    assert scripted.run("cancel").code == 0
    note = f"talk: goal {goal_id} was interrupted by goal {aside}, and continues afterwards"
    assert (scripted.finish(client).err.splitlines()[:1] == [note]) == noted


def test_wait_follows_several_goals_in_the_servers_order(scripted: Talk) -> None:
    blocking = scripted.run("say", TALKING).id
    scripted.watcher.wait_for_word(blocking)
    low = scripted.run("say", "length=0.1 low").id
    high = scripted.run("say", "--priority", "1", "length=0.1 high").id
    client = scripted.start("--json", "wait", "-f", low, high, low, blocking)
    lines = lines_of(client)
    first = next(lines)
    scripted.run("cancel", "--current")
    events = [json.loads(line) for line in (first, *lines)]
    assert client.wait(10) == 7
    ids = [event["id"] if "id" in event else event["goal"]["id"] for event in events]
    assert list(dict.fromkeys(ids)) == [blocking, high, low]
    numbers = [event["n"] for event in events if "n" in event]
    assert numbers == sorted(set(numbers))
    assert [event["goal"]["id"] for event in events if event["event"] == "result"] == [blocking, high, low]
    for goal_id in (low, high):
        own = [event.get("state", event["event"]) for event in events if event.get("id") == goal_id]
        assert own == ["ACTIVE", "word", "word", "SUCCEEDED"]


def test_wait_without_ids_follows_all_current_goals(scripted: Talk) -> None:
    assert scripted.run("wait", "-f").out == ""
    first = scripted.run("say", TALKING).id
    scripted.watcher.wait_for_word(first)
    second = scripted.run("say", "fail=audio_lost").id
    client = scripted.start("wait", "-f")
    lines = lines_of(client)
    assert next(lines).startswith(f"{first} word ")
    for arguments in (["pause"], ["resume"], ["cancel", first]):
        assert scripted.run(*arguments).code == 0
    states = [line for line in lines if " word " not in line]
    assert states == [
        f"{first} PAUSED",  # once for all goals
        f"{first} RESUMED",
        f"{first} PREEMPTING",
        f"{first} PREEMPTED",
        f"{second} ACTIVE",
        f"{second} ABORTED",
    ]
    assert scripted.finish(client).err == ""
    assert client.returncode == 0  # without ids, failures don't count


def test_wait_for_an_ended_goal_shows_its_state(scripted: Talk) -> None:
    goal_id = scripted.run("say", "--wait", "fail=audio_lost").id
    done = scripted.run("wait", "--feedback", goal_id)
    assert (done.code, done.out) == (4, f"{goal_id} ABORTED\n")
    events = objects(scripted.run("--json", "wait", "-f", goal_id).out)
    assert events == [{"event": "result", "goal": scripted.goal(goal_id)}]
