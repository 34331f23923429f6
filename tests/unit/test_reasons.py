"""The reasons why goals end: their strings and their documentation."""

from __future__ import annotations

import json

import pytest

from talkcli.doctor import sentence
from talkcli.goals.goal import Goal
from talkcli.goals.reasons import Reason
from talkcli.goals.states import State
from talkcli.protocol.lines import encode
from tests.support.documents import WIRE, code_spans, tables

#: Additional reasons that the doctor reports for its own sentence.
DOCTOR_REASONS = {"late", "paused"}


@pytest.mark.parametrize("reason", Reason)
def test_a_reason_behaves_like_the_string_that_is_sent(reason: Reason) -> None:
    assert (str(reason), f"{reason}", f"{reason:<1}", repr(reason)) == (*[reason.value] * 3, repr(reason.value))
    assert reason == reason.value
    assert hash(reason) == hash(reason.value)
    assert encode({"reason": reason}) == json.dumps({"reason": reason.value}).encode() + b"\n"
    assert all(state.terminal for state in reason.states)
    assert reason.meaning


def test_the_document_and_the_doctors_advice_cover_the_reasons() -> None:
    documented = [(code_spans(row[0])[0], *row[1:]) for row in tables(WIRE.section("States"))[1][1:]]
    assert documented == [(reason.value, ", ".join(map(str, reason.states)), reason.meaning) for reason in Reason]
    assert sentence.ADVICE.keys() - DOCTOR_REASONS <= {*Reason}
    assert {reason for reason in Reason if State.ABORTED in reason.states} <= sentence.ADVICE.keys()


def test_a_goal_with_an_unknown_reason_is_read() -> None:
    goal = Goal.from_json({"id": "4k7f-1", "state": "REJECTED", "reason": "too_loud"})
    assert (goal.reason, goal.exit_code) == ("too_loud", 5)
