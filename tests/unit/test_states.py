"""The table of transitions. The allowed ones are listed here, and all others must be refused."""

from __future__ import annotations

import itertools
import json

import pytest

from talkcli.goals.goal import Goal, Sender
from talkcli.goals.options import Say
from talkcli.goals.record import Record
from talkcli.goals.states import EXIT_CODES, TRANSITIONS, IllegalTransition, State

#: actionlib's names, in the order of their numbers.
NAMES = [
    *("PENDING", "ACTIVE", "PREEMPTED", "SUCCEEDED", "ABORTED"),
    *("REJECTED", "PREEMPTING", "RECALLING", "RECALLED", "LOST"),
]
NUMBERS = {name: number for number, name in enumerate(NAMES)}
#: The allowed transitions. A client sets LOST if the connection ends before the goal.
ALLOWED = {
    "PENDING": ["ACTIVE", "RECALLING", "LOST"],
    "RECALLING": ["RECALLED", "LOST"],
    "ACTIVE": ["PREEMPTING", "SUCCEEDED", "ABORTED", "LOST"],
    "PREEMPTING": ["PREEMPTED", "SUCCEEDED", "ABORTED", "LOST"],
}


def test_names_and_numbers_are_actionlibs() -> None:
    assert {state.name: state.value for state in State} == NUMBERS


@pytest.mark.parametrize(("name", "number"), NUMBERS.items())
def test_a_state_prints_as_its_name_and_is_a_number_in_json(name: str, number: int) -> None:
    state = State[name]
    assert (str(state), f"{state}", f"{state:>11}") == (name, name, f"{name:>11}")
    assert (f"{state:d}", json.dumps(state)) == (f"{number}", f"{number}")


@pytest.mark.parametrize(("state", "target"), [*itertools.product(NUMBERS, repeat=2)])
def test_only_the_transitions_in_the_table_are_allowed(state: str, target: str) -> None:
    record = Record("4k7f-1", 1, Say("door open"), Sender(), 1.0)
    record.state = State[state]
    before = record.snapshot()
    if target in ALLOWED.get(state, []):
        record.change_state(State[target])
        assert record.state is State[target]
    else:
        with pytest.raises(IllegalTransition, match=rf"{state}.*{target}") as refused:
            record.change_state(State[target])
        assert refused.value.code == "illegal_transition"
        assert record.snapshot() == before


def test_a_state_without_transitions_is_terminal() -> None:
    ended = {"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED", "LOST"}
    assert {state.name for state in State if state.terminal} == ended == set(NAMES) - ALLOWED.keys()
    assert {state.name for state, following in TRANSITIONS.items() if not following} == ended


def test_each_terminal_state_has_its_exit_code() -> None:
    codes = {"SUCCEEDED": 0, "ABORTED": 4, "REJECTED": 5, "RECALLED": 6, "PREEMPTED": 7, "LOST": 12}
    assert {state.name: code for state, code in EXIT_CODES.items()} == codes
    for state in State:
        assert Goal("4k7f-1", state).exit_code == codes.get(state.name)
    assert Goal("4k7f-1", State.REJECTED, reason="throttled").exit_code == 0
