"""The outcomes of a request to a robot, as programs see them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

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
from talkcli.fleet.desk.request import (
    NoServer,
    Outcome,
    RobotOffline,
    cancel_outcomes,
    failure_outcome,
    reply_outcomes,
)
from talkcli.goals.goal import Goal
from talkcli.goals.options import Cancel, Pause, Say, Set
from talkcli.goals.states import State
from talkcli.protocol.requests import Resume, Status, Wait

if TYPE_CHECKING:
    from talkcli.protocol.requests import Request

GOAL = Goal("a", State.PREEMPTED, "hello", reason="canceled")


@pytest.mark.parametrize(
    ("error", "state", "exit_code", "code"),
    [
        (UnknownGoal("no goal 'a'", "unknown_goal", [{"id": "b"}]), "UNKNOWN", 8, "unknown_goal"),
        (Lost("it was sent"), "LOST", 12, "lost"),
        (AccessDenied("not allowed"), "REFUSED", 10, "permission_denied"),
        (ServerUnavailable("no answer"), "UNREACHABLE", 3, "no_server"),
        (RobotOffline("nothing was sent"), "OFFLINE", 3, "no_server"),
        (NoServer("nothing was sent"), "NO_SERVER", 3, "no_server"),
        (Busy("too many"), "REFUSED", 5, "busy"),
        (BadOption("no such voice", "unknown_voice"), "REFUSED", 2, "unknown_voice"),
        (RequestRefused("a line is too long", "too_long"), "REFUSED", 1, "too_long"),
        (ProtocolMismatch("another version"), "REFUSED", 9, "protocol_mismatch"),
        (UsageError("no meaning"), "REFUSED", 2, "usage"),
        (TalkError("anything"), "REFUSED", 1, "error"),
    ],
)
def test_an_error_has_a_state_and_an_exit_code(error: TalkError, state: str, exit_code: int, code: str) -> None:
    outcome = failure_outcome("anna", error)
    assert (outcome.error, outcome.goal, outcome.said, outcome.last) == (error, None, None, True)
    error_json = {"code": code, "message": str(error)}
    assert outcome.to_json() == {"robot": "anna", "state": state, "exit_code": exit_code, "error": error_json}


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (Outcome("anna", "PREEMPTED", 7, GOAL), {"state": "PREEMPTED", "exit_code": 7, "goal": GOAL.to_json()}),
        (Outcome("anna", "SET", said={"settings": {"rate": 150}}), {"state": "SET", "settings": {"rate": 150}}),
        (
            Outcome("anna", "PAUSED", goal=GOAL, said={"paused": True}),
            {"state": "PAUSED", "paused": True, "goal": GOAL.to_json()},
        ),
        (Outcome("anna", "IDLE"), {"state": "IDLE"}),
    ],
)
def test_an_outcome_includes_its_goal_and_the_robots_reply(outcome: Outcome, expected: dict[str, Any]) -> None:
    assert outcome.to_json() == {"robot": "anna", "exit_code": 0, **expected}


ENDED, SPOKEN = GOAL.to_json(), Goal("b", State.ACTIVE, "hello").to_json()
SERVER: dict[str, Any] = {"server": {"paused": False}, "active": None}


@pytest.mark.parametrize(
    ("request_", "reply", "items", "outcomes"),
    [
        (Say("hello", wait=False), {"goal": SPOKEN}, [], [("ACTIVE", 0, "b")]),
        (Say("hello", wait=False), {"goal": ENDED}, [], [("PREEMPTED", 7, "a")]),
        (Wait(), {}, [], [("IDLE", 0, None)]),
        (Cancel(), {}, [], [("IDLE", 0, None)]),
        (Cancel(), {}, [{"canceled": ENDED}, {"ended": SPOKEN}], [("PREEMPTED", 0, "a"), ("ACTIVE", 0, "b")]),
        (Status("a"), {"goal": ENDED}, [], [("PREEMPTED", 0, "a")]),
        (Status(), SERVER, [], [("IDLE", 0, None)]),
        (Status(), {**SERVER, "active": SPOKEN}, [], [("ACTIVE", 0, "b")]),
        (Status(), {"server": {"paused": True}, "active": SPOKEN}, [], [("PAUSED", 0, "b")]),
        (Pause(), {"goal": SPOKEN}, [], [("PAUSED", 0, "b")]),
        (Resume(), {"goal": None}, [], [("RESUMED", 0, None)]),
        (Set(), {"settings": {"rate": 150}}, [], [("SET", 0, None)]),
    ],
)
def test_a_reply_gives_one_outcome_per_goal_or_a_single_one(
    request_: Request, reply: dict[str, Any], items: list[dict[str, Any]], outcomes: list[tuple[str, int, str | None]]
) -> None:
    actual = reply_outcomes("anna", request_, {"ok": True, **reply}, items)
    assert [(outcome.state, outcome.exit_code, outcome.goal and outcome.goal.id) for outcome in actual] == outcomes
    assert [outcome.last for outcome in actual] == [False] * (len(actual) - 1) + [True]
    assert {outcome.robot for outcome in actual} == {"anna"}


def test_the_reply_to_a_status_request_for_a_goal_must_contain_it() -> None:
    with pytest.raises(ValueError, match="goal"):
        reply_outcomes("anna", Status("a"), {"ok": True}, [])


def test_goals_of_a_refused_cancel_are_not_the_last_outcomes() -> None:
    assert [outcome.last for outcome in cancel_outcomes("anna", [{"canceled": ENDED}], last=False)] == [False]
