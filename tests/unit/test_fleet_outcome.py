"""The outcome of a request at a robot, as programs see it."""

from __future__ import annotations

from typing import Any

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
from talkcli.fleet.desk.outcome import IDLE, NO_SERVER, OFFLINE, PAUSED, SET, Outcome, failed
from talkcli.goals.goal import Goal
from talkcli.goals.states import State

GOAL = Goal("a", State.PREEMPTED, "hello", reason="canceled")


@pytest.mark.parametrize(
    ("error", "named", "state", "exit_code", "code"),
    [
        (UnknownGoal("no goal 'a'", "unknown_goal", [{"id": "b"}]), None, "UNKNOWN", 8, "unknown_goal"),
        (Lost("it was sent"), None, "LOST", 12, "lost"),
        (AccessDenied("not allowed"), None, "REFUSED", 10, "permission_denied"),
        (ServerUnavailable("no answer"), None, "UNREACHABLE", 3, "no_server"),
        (ServerUnavailable("nothing was sent"), OFFLINE, OFFLINE, 3, "no_server"),
        (ServerUnavailable("nothing was sent"), NO_SERVER, NO_SERVER, 3, "no_server"),
        (Busy("too many"), None, "REFUSED", 5, "busy"),
        (BadOption("no such voice", "unknown_voice"), None, "REFUSED", 2, "unknown_voice"),
        (RequestRefused("a line is too long", "too_long"), None, "REFUSED", 1, "too_long"),
        (ProtocolMismatch("another version"), None, "REFUSED", 9, "protocol_mismatch"),
        (UsageError("no meaning"), None, "REFUSED", 2, "usage"),
        (TalkError("anything"), None, "REFUSED", 1, "error"),
    ],
)
def test_an_error_is_a_state_and_an_exit_code(
    error: TalkError, named: str | None, state: str, exit_code: int, code: str
) -> None:
    outcome = failed("anna", error, named)
    assert (outcome.error, outcome.goal, outcome.said, outcome.last) == (error, None, None, True)
    told = {"code": code, "message": str(error)}
    assert outcome.to_json() == {"robot": "anna", "state": state, "exit_code": exit_code, "error": told}


@pytest.mark.parametrize(
    ("outcome", "told"),
    [
        (Outcome("anna", "PREEMPTED", 7, GOAL), {"state": "PREEMPTED", "exit_code": 7, "goal": GOAL.to_json()}),
        (Outcome("anna", SET, said={"settings": {"rate": 150}}), {"state": "SET", "settings": {"rate": 150}}),
        (
            Outcome("anna", PAUSED, goal=GOAL, said={"paused": True}),
            {"state": "PAUSED", "paused": True, "goal": GOAL.to_json()},
        ),
        (Outcome("anna", IDLE), {"state": "IDLE"}),
    ],
)
def test_an_outcome_has_its_goal_and_the_answer_of_the_robot(outcome: Outcome, told: dict[str, Any]) -> None:
    assert outcome.to_json() == {"robot": "anna", "exit_code": 0, **told}
