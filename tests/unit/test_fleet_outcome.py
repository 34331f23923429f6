"""What became of a request at a robot, and how it is told to programs."""

from __future__ import annotations

import pytest

from talkcli.errors import (
    AccessDenied,
    BadOption,
    Busy,
    Lost,
    ProtocolMismatch,
    RequestRefused,
    ServerUnavailable,
    TalkError,
    UnknownGoal,
    UsageError,
)
from talkcli.fleet.outcome import IDLE, NO_SERVER, OFFLINE, PAUSED, SET, Outcome, failed
from talkcli.goals.goal import Goal
from talkcli.goals.states import State


@pytest.mark.parametrize(
    ("error", "state", "exit_code", "code"),
    [
        (UnknownGoal("no goal 'a' is known"), "UNKNOWN", 8, "unknown_goal"),
        (UnknownGoal("no goal 'a' is known", "unknown_goal", [{"id": "b"}]), "UNKNOWN", 8, "unknown_goal"),
        (Lost("it was sent"), "LOST", 12, "lost"),
        (AccessDenied("not allowed"), "REFUSED", 10, "permission_denied"),
        (ServerUnavailable("no answer"), "UNREACHABLE", 3, "no_server"),
        (Busy("too many"), "REFUSED", 5, "busy"),
        (BadOption("no such voice", "unknown_voice"), "REFUSED", 2, "unknown_voice"),
        (RequestRefused("a line is too long", "too_long"), "REFUSED", 1, "too_long"),
        (ProtocolMismatch("another version"), "REFUSED", 9, "protocol_mismatch"),
        (UsageError("no meaning"), "REFUSED", 2, "usage"),
        (TalkError("anything"), "REFUSED", 1, "error"),
    ],
)
def test_an_error_is_a_state_and_the_exit_code_that_talk_has_for_it(
    error: TalkError, state: str, exit_code: int, code: str
) -> None:
    outcome = failed("anna", error)
    assert (outcome.robot, outcome.state, outcome.exit_code, outcome.last) == ("anna", state, exit_code, True)
    assert (outcome.error, outcome.goal, outcome.said) == (error, None, None)
    assert outcome.to_json() == {
        "robot": "anna",
        "state": state,
        "exit_code": exit_code,
        "error": {"code": code, "message": str(error)},
    }


@pytest.mark.parametrize("state", [OFFLINE, NO_SERVER])
def test_where_the_robot_itself_is_why_that_is_the_state(state: str) -> None:
    outcome = failed("anna", ServerUnavailable("nothing was sent"), state)
    assert (outcome.state, outcome.exit_code) == (state, 3)


def test_with_a_goal_the_object_has_it_as_the_wire_has() -> None:
    goal = Goal("a", State.PREEMPTED, "hello", reason="canceled")
    found = Outcome("anna", goal.state.name, 7, goal).to_json()
    assert found == {"robot": "anna", "state": "PREEMPTED", "exit_code": 7, "goal": goal.to_json()}


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (PAUSED, {"paused": True}),
        (SET, {"settings": {"rate": 150}}),
        (IDLE, {"status": {"active": None, "pending": []}}),
    ],
)
def test_what_a_robot_said_besides_stands_in_the_object(state: str, said: dict[str, object]) -> None:
    assert Outcome("anna", state, said=said).to_json() == {"robot": "anna", "state": state, "exit_code": 0, **said}


def test_a_goal_and_what_was_said_stand_side_by_side() -> None:
    goal = Goal("a", State.ACTIVE, "hello")
    found = Outcome("anna", PAUSED, goal=goal, said={"paused": True}).to_json()
    assert (found["paused"], found["goal"]) == (True, goal.to_json())


def test_one_that_has_nothing_to_say_is_as_was_asked() -> None:
    assert Outcome("anna", IDLE).to_json() == {"robot": "anna", "state": "IDLE", "exit_code": 0}


def test_two_are_alike_that_say_the_same_and_none_changes() -> None:
    outcome = Outcome("anna", IDLE)
    assert outcome == Outcome("anna", IDLE)
    assert outcome != Outcome("bert", IDLE)
    with pytest.raises(AttributeError):
        outcome.state = PAUSED  # type: ignore[misc]
