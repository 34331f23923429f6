"""Checks of goals, and of the order of all events that a watcher has received.

The watcher reads in a thread, so these helpers first wait until the goals have ended.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from tests.support.watcher import TERMINAL

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tests.support.connection import Message
    from tests.support.processes import Talk

#: All valid sequences of a goal's states.
STATE_SEQUENCES = (
    ["REJECTED"],
    ["PENDING", "RECALLED"],
    ["PENDING", "ACTIVE", "SUCCEEDED"],
    ["PENDING", "ACTIVE", "ABORTED"],
    ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"],
    ["PENDING", "ACTIVE", "PREEMPTING", "SUCCEEDED"],
)


def states(talk: Talk, goal_id: str) -> list[str]:
    """Wait for a goal to end, and return all its states."""
    talk.watcher.wait_for_terminal(goal_id)
    return talk.watcher.states(goal_id)


def count_ends(talk: Talk, *goal_ids: str) -> list[int]:
    """Wait for these goals to end, and return the number of terminal states of each."""
    await_ends(talk, goal_ids)
    counts = talk.watcher.terminal_counts()
    return [counts[goal_id] for goal_id in goal_ids]


def await_ends(talk: Talk, goal_ids: Iterable[str]) -> None:
    """Wait until these goals have ended or were rejected."""
    seen = {(event.get("id"), event.get("state")) for event in talk.watcher.events()}
    ended = {goal_id for goal_id, state in seen if state in TERMINAL - {"REJECTED"}}
    rejected = {goal_id for goal_id, state in seen if state == "REJECTED" and (goal_id, "PENDING") not in seen}
    done = ended | rejected
    for goal_id in goal_ids:
        if goal_id not in done:
            talk.watcher.wait_for_terminal(goal_id)


def submit(talk: Talk, text: str, **fields: Any) -> Message:
    """Send a goal, and return the goal of the reply, which may be REJECTED."""
    reply = talk.request("say", text=text, **fields)
    assert reply["ok"], reply
    goal: Message = reply["goal"]
    return goal


def assert_rejected(goal: Message, reason: str, *texts: str) -> None:
    """Assert that a goal was REJECTED for this reason, with these strings in its message."""
    assert (goal["state"], goal["reason"]) == ("REJECTED", reason), goal
    assert goal["message"].startswith("not spoken: "), goal
    for text in texts:
        assert text in goal["message"], goal


def assert_recalled(talk: Talk, goal_id: str, reason: str, by: str | None = None) -> None:
    """Assert that a pending goal was RECALLED for this reason, by this goal."""
    assert talk.watcher.wait_for_terminal(goal_id, 10) == "RECALLED"
    assert talk.watcher.states(goal_id) == ["PENDING", "RECALLED"]
    goal = talk.goal(goal_id)
    assert goal["reason"] == reason, goal
    assert goal["started_at"] is None
    assert by is None or goal["by"] == {"goal": by}, goal


def assert_event_order(talk: Talk) -> None:
    """Wait until all goals have ended, and assert that their events have the documented order."""
    await_ends(talk, talk.watcher.goals())
    events = talk.watcher.events()
    numbers = [event["n"] for event in events]
    assert numbers == list(range(1, len(events) + 1)), "events are missing"
    goals: dict[str, list[Message]] = {}
    for event in events:
        if event.get("id") is not None:
            goals.setdefault(event["id"], []).append(event)
    for own in goals.values():
        _check_goal([event for event in own if event["event"] != "paused"])
    _check_one_at_a_time(events)
    _check_new_goals(events)


def _check_goal(events: list[Message]) -> None:
    """Assert that a goal's states are a valid sequence, and that its words come between ACTIVE and its end.

    An interrupted goal has no words until it is ACTIVE again.
    """
    steps = re.sub(
        r"interrupted (interrupted )*(ACTIVE )?", "", "".join(f"{_step(event)} " for event in events)
    ).split()
    states = [state for state in steps if state != "word"]
    assert states in STATE_SEQUENCES, events
    assert steps[0] != "word" != steps[-1], steps
    assert "word" not in steps or steps.index("word") > steps.index("ACTIVE"), steps
    for event in (event for event in events if event["event"] == "state"):
        with_goal = event["state"] == "PENDING" or event["state"] in TERMINAL
        assert ("goal" in event) == with_goal, event
        assert not with_goal or (event["goal"]["id"], event["goal"]["state"]) == (event["id"], event["state"]), event
    words = [event["number"] for event in events if event["event"] == "word"]
    assert words == sorted(set(words)), words


def _step(event: Message) -> str:
    return "interrupted" if event["event"] == "interrupted" else str(event.get("state", "word"))


def _check_one_at_a_time(events: Iterable[Message]) -> None:
    """Assert that no goal becomes ACTIVE before the previous one has ended or was interrupted."""
    active = None
    for event in events:
        if event.get("state") == "ACTIVE":
            assert active is None, f"{event['id']} became ACTIVE while {active} was"
            active = event["id"]
        elif (event.get("state") in TERMINAL or event["event"] == "interrupted") and event["id"] == active:
            active = None


def _check_new_goals(events: Iterable[Message]) -> None:
    """Assert that a replaced, preempted or displaced goal ends between PENDING and ACTIVE of the new goal."""
    seen: dict[str, str] = {}
    for event in events:
        if event["event"] != "state":
            continue
        seen[event["id"]] = event["state"]
        new_goal = (event.get("goal", {}).get("by") or {}).get("goal")
        if new_goal is not None and event["state"] in {"RECALLED", "PREEMPTED"}:
            error = f"{event['id']} ended by {new_goal}, which was {seen.get(new_goal)}"
            # A stopped goal may end long after the new goal was recalled itself.
            allowed = {"PENDING"} if event["state"] == "RECALLED" else {"PENDING", "RECALLED"}
            assert seen.get(new_goal) in allowed, error
