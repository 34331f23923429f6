"""The reasons why goals end: their strings, their documentation, and their use in the code."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

import talkcli
from talkcli.doctor import sentence
from talkcli.goals.goal import Goal
from talkcli.goals.reasons import Reason
from talkcli.goals.states import State
from talkcli.protocol.lines import encode
from tests.support.documents import WIRE, code_spans, tables

#: Additional reasons that the doctor reports for its own sentence.
OF_THE_DOCTOR = {"late", "paused"}
#: Reasons that the doctor's sentence can't have, because it has no option that a driver could refuse.
WITHOUT_ADVICE = {Reason.BAD_OPTION}


@pytest.mark.parametrize("reason", Reason)
def test_a_reason_is_the_string_that_is_sent(reason: Reason) -> None:
    assert (str(reason), f"{reason}", f"{reason:<1}", repr(reason)) == (*[reason.value] * 3, repr(reason.value))
    assert reason == reason.value
    assert hash(reason) == hash(reason.value)
    assert encode({"reason": reason}) == json.dumps({"reason": reason.value}).encode() + b"\n"
    assert all(state.terminal for state in reason.states)
    assert reason.meaning


def test_the_document_has_every_reason_and_the_doctor_advises_on_no_other() -> None:
    documented = [(code_spans(row[0])[0], *row[1:]) for row in tables(WIRE.section("States"))[1][1:]]
    assert documented == [(each.value, ", ".join(map(str, each.states)), each.meaning) for each in Reason]
    assert sentence.ADVICE.keys() - OF_THE_DOCTOR <= {*Reason}
    aborted = {each for each in Reason if State.ABORTED in each.states}
    assert aborted - sentence.ADVICE.keys() == WITHOUT_ADVICE


def test_a_goal_with_a_reason_that_is_not_known_here_is_read() -> None:
    goal = Goal.from_json({"id": "4k7f-1", "state": "REJECTED", "reason": "too_loud"})
    assert (goal.reason, goal.exit_code) == ("too_loud", 5)


def test_the_code_names_no_other_reason() -> None:
    for path in Path(talkcli.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            for each in named(node):
                assert each in {*Reason, *OF_THE_DOCTOR}, f"{path}:{node.lineno} gives a reason that is none: {each}"  # type: ignore[attr-defined]


def named(node: ast.AST) -> list[str]:
    """Return the reasons that occur as plain strings in a call, a comparison or an assignment."""
    match node:
        case ast.keyword(arg="reason", value=ast.Constant(value=str() as found)):
            return [found]
        case ast.Compare(left=ast.Attribute(attr="reason"), comparators=[ast.Constant(value=str() as found)]):
            return [found]
        case ast.Call(func=ast.Name(id="CannotSpeak" | "EngineFailed"), args=[ast.Constant(value=str() as found), *_]):
            return [found]
    return []
