"""The table of states: every pair, the allowed ones written out here, all others refused."""

from __future__ import annotations

import itertools
import json

import pytest

from talkcli.goals.goal import Sender
from talkcli.goals.options import Say
from talkcli.goals.record import Record
from talkcli.goals.states import EXIT_CODES, TRANSITIONS, IllegalTransition, State, follow

#: actionlib's names and numbers.
NUMBERS = {
    "PENDING": 0,
    "ACTIVE": 1,
    "PREEMPTED": 2,
    "SUCCEEDED": 3,
    "ABORTED": 4,
    "REJECTED": 5,
    "PREEMPTING": 6,
    "RECALLING": 7,
    "RECALLED": 8,
    "LOST": 9,
}
ALLOWED = {
    ("PENDING", "ACTIVE"),
    ("PENDING", "RECALLING"),
    ("RECALLING", "RECALLED"),
    ("ACTIVE", "PREEMPTING"),
    ("ACTIVE", "SUCCEEDED"),
    ("ACTIVE", "ABORTED"),
    ("PREEMPTING", "PREEMPTED"),
    ("PREEMPTING", "SUCCEEDED"),
    ("PREEMPTING", "ABORTED"),
    # What a client concludes for a goal that had not ended when the connection did.
    ("PENDING", "LOST"),
    ("RECALLING", "LOST"),
    ("ACTIVE", "LOST"),
    ("PREEMPTING", "LOST"),
}


def test_names_and_numbers_are_actionlibs() -> None:
    assert {each.name: each.value for each in State} == NUMBERS


@pytest.mark.parametrize(("name", "number"), NUMBERS.items())
def test_a_state_prints_as_its_name_and_is_a_number_in_json(name: str, number: int) -> None:
    state = State[name]
    assert (str(state), f"{state}", f"{state:>11}") == (name, name, f"{name:>11}")
    assert (f"{state:d}", json.dumps(state)) == (f"{number}", f"{number}")


@pytest.mark.parametrize(("state", "target"), [*itertools.product(NUMBERS, repeat=2)])
def test_a_transition_of_the_table_is_made_and_any_other_is_refused(state: str, target: str) -> None:
    record = Record("4k7f-1", 1, Say("door open"), Sender(), 1.0)
    record.state = State[state]
    before = record.snapshot()
    if (state, target) in ALLOWED:
        assert follow(State[state], State[target]) is State[target]
        record.become(State[target])
        assert record.state is State[target]
    else:
        with pytest.raises(IllegalTransition, match=rf"{state}.*{target}") as refused:
            record.become(State[target])
        assert refused.value.code == "illegal_transition"
        assert record.snapshot() == before


def test_a_goal_has_ended_where_nothing_may_follow() -> None:
    ended = {"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED", "LOST"}
    assert {each.name for each in State if each.terminal} == ended
    assert {each.name for each, following in TRANSITIONS.items() if not following} == ended


def test_each_end_has_its_exit_code() -> None:
    codes = {"SUCCEEDED": 0, "ABORTED": 4, "REJECTED": 5, "RECALLED": 6, "PREEMPTED": 7, "LOST": 12}
    assert {each.name: code for each, code in EXIT_CODES.items()} == codes
