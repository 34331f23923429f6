"""What must hold of all that a watcher was told since before the first goal, whatever the goals were.

It reads events alone and knows nothing of what was asked for: it is the same for every mix of requests.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.conformance.witness import await_ends
from tests.support.watcher import TERMINAL

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tests.support.connection import Message
    from tests.support.processes import Talk

#: All the ways that a goal may take.
WAYS = (
    ["REJECTED"],
    ["PENDING", "RECALLED"],
    ["PENDING", "ACTIVE", "SUCCEEDED"],
    ["PENDING", "ACTIVE", "ABORTED"],
    ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"],
    ["PENDING", "ACTIVE", "PREEMPTING", "SUCCEEDED"],
)


def submit(talk: Talk, text: str, **fields: Any) -> Message:
    """Send a goal and return it as the reply has it, REJECTED too."""
    reply = talk.request("say", text=text, **fields)
    assert reply["ok"], reply
    goal: Message = reply["goal"]
    return goal


def assert_rejected(goal: Message, reason: str, *words: str) -> None:
    """Assert that a goal was REJECTED for that reason, with these words in its message."""
    assert (goal["state"], goal["reason"]) == ("REJECTED", reason), goal
    assert goal["message"].startswith("not spoken: "), goal
    for word in words:
        assert word in goal["message"], goal


def assert_recalled(talk: Talk, goal_id: str, reason: str, by: str | None = None) -> None:
    """Assert that a goal was taken out of the queue for that reason, by that goal."""
    assert talk.watcher.wait_for_terminal(goal_id, 10) == "RECALLED"
    assert talk.watcher.states(goal_id) == ["PENDING", "RECALLED"]
    goal = talk.goal(goal_id)
    assert goal["reason"] == reason, goal
    assert goal["started_at"] is None
    assert by is None or goal["by"] == {"goal": by}, goal


def assert_event_order(talk: Talk) -> None:
    """Assert the order of section 9 of all goals that there were; all of them must have ended."""
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
    _check_newcomers(events)


def _check_goal(events: list[Message]) -> None:
    """One goal: its states are one of the ways, its words are between ACTIVE and its end."""
    steps = [event.get("state", "word") for event in events]
    states = [state for state in steps if state != "word"]
    assert states in WAYS, events
    assert steps[0] != "word" != steps[-1], steps
    assert "word" not in steps or steps.index("word") > steps.index("ACTIVE"), steps
    for event in (event for event in events if event["event"] == "state"):
        with_goal = event["state"] == "PENDING" or event["state"] in TERMINAL
        assert ("goal" in event) == with_goal, event
        assert not with_goal or (event["goal"]["id"], event["goal"]["state"]) == (event["id"], event["state"]), event
    words = [event["number"] for event in events if event["event"] == "word"]
    assert words == sorted(set(words)), words


def _check_one_at_a_time(events: Iterable[Message]) -> None:
    """No goal becomes ACTIVE before the one before it has ended."""
    active = None
    for event in events:
        if event.get("state") == "ACTIVE":
            assert active is None, f"{event['id']} became ACTIVE while {active} was"
            active = event["id"]
        elif event.get("state") in TERMINAL and event["id"] == active:
            active = None


def _check_newcomers(events: Iterable[Message]) -> None:
    """A goal that another one replaced, preempted or displaced: told between that one's PENDING and its ACTIVE."""
    seen: dict[str, str] = {}
    for event in events:
        if event["event"] != "state":
            continue
        seen[event["id"]] = event["state"]
        newcomer = (event.get("goal", {}).get("by") or {}).get("goal")
        if newcomer is not None and event["state"] in {"RECALLED", "PREEMPTED"}:
            error = f"{event['id']} ended by {newcomer}, which was {seen.get(newcomer)}"
            # One that was stopped may end long after the newcomer was recalled in its turn.
            allowed = {"PENDING"} if event["state"] == "RECALLED" else {"PENDING", "RECALLED"}
            assert seen.get(newcomer) in allowed, error
