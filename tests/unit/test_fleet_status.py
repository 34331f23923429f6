"""What is made of a robot's status, whoever wrote it."""

from __future__ import annotations

import json

import pytest

from talkcli.fleet.status import LastGoal, Status
from talkcli.goals.states import State

LAST = {"id": "door-17", "state": "ABORTED", "reason": "player", "text": "the door", "at": 1767225601.5}


def read(said: object) -> Status | None:
    return Status.read(json.dumps(said).encode() + b"\n")


def test_what_a_bridge_says_is_taken_up_and_told_again() -> None:
    said = {"active": "a-1", "text": "hello", "pending": 3, "paused": True, "last": LAST}
    found = read({**said, "later": "a field that is not known yet"})
    last = LastGoal("door-17", State.ABORTED, "player", "the door", 1767225601.5)
    assert found == Status("a-1", "hello", 3, paused=True, last=last)
    assert found is not None
    assert found.to_json() == said


def test_without_texts_there_are_none() -> None:
    """As with --no-text, and of a robot that has said nothing yet."""
    silent = {name: value for name, value in LAST.items() if name != "text"}
    found = read({"active": "a-1", "pending": 0, "paused": False, "last": silent})
    assert found is not None
    assert (found.text, found.last and found.last.text) == (None, None)
    assert read({"active": None, "text": None, "pending": 0, "paused": False, "last": None}) == Status()


@pytest.mark.parametrize("payload", [b"", b"\n", b"[]", b"3", b"{", b"\xff", b'{"a": NaN}'])
def test_what_is_cleared_or_is_no_object_is_no_status(payload: bytes) -> None:
    assert Status.read(payload) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"active": 3, "text": ["hello"], "pending": "many", "paused": "no", "last": "door-17"},
        {"pending": -1, "last": {"id": 3, "state": "ABORTED"}},
        {"pending": None, "last": {"id": "a", "state": "SUNG"}},
        {"last": {"id": "a", "state": ["ABORTED"]}},
        {},
    ],
)
def test_what_is_not_of_its_form_is_not_said(wrong: object) -> None:
    assert read(wrong) == Status()


def test_when_the_last_one_ended_may_be_missing() -> None:
    found = read({"last": {"id": "a", "state": "SUCCEEDED", "at": True}})
    assert found is not None
    assert found.last == LastGoal("a", State.SUCCEEDED)
