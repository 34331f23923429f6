"""Goals and senders in JSON: all keys always, there and back, and whatever a newer or a broken server may send."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals.goal import By, Goal, Output, Sender
from talkcli.goals.states import State

#: A goal always has all of these, null where unknown.
KEYS = [
    "id", "state", "status", "reason", "by", "message", "text", "format", "spoken", "priority", "key", "ttl", "data",
    "client", "paused", "queued_at", "started_at", "ended_at", "duration", "voice", "output",
]  # fmt: skip
SENDER_KEYS = ["pid", "uid", "command", "parent", "name"]

numbers = st.integers(-(10**18), 10**18)
seconds = st.none() | st.floats(-1e15, 1e15)
strings = st.none() | st.text()
values = st.recursive(
    st.none() | st.booleans() | numbers | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=10,
)
senders = st.builds(
    Sender, pid=st.none() | numbers, uid=st.none() | numbers, command=strings, parent=strings, name=strings
)
ends = st.builds(By, goal=st.text()) | st.builds(By, client=senders)
outputs = st.builds(Output, player=st.text(), device=st.text(), volume=st.floats(0, 1), muted=st.booleans())
goals = st.builds(
    Goal,
    id=st.text("4k7f-:", max_size=64),
    state=st.sampled_from(State),
    text=strings,
    reason=strings,
    by=st.none() | ends,
    message=strings,
    format=st.text(min_size=1),
    spoken=strings,
    priority=numbers,
    key=strings,
    ttl=seconds,
    data=st.none() | st.dictionaries(st.text(), values, max_size=3),
    client=st.none() | senders,
    paused=st.booleans(),
    queued_at=seconds,
    started_at=seconds,
    ended_at=seconds,
    duration=seconds,
    voice=st.none() | st.text(),
    output=st.none() | outputs,
)


@given(goals)
def test_a_goal_has_all_its_keys_and_no_other(goal: Goal) -> None:
    message = goal.to_json()
    assert list(message) == KEYS
    assert message["state"] == goal.state.name
    assert message["status"] == goal.state.value
    assert type(message["status"]) is int


def test_what_is_not_known_of_a_goal_is_null() -> None:
    message = Goal("4k7f-1", State.PENDING).to_json()
    assert message == dict.fromkeys(KEYS) | {
        "id": "4k7f-1", "state": "PENDING", "status": 0, "format": "text", "priority": 0, "paused": False
    }  # fmt: skip


@given(goals)
def test_a_goal_goes_there_and_back(goal: Goal) -> None:
    assert Goal.from_json(json.loads(json.dumps(goal.to_json()))) == goal


def test_an_output_that_lacks_something_is_none() -> None:
    message = Goal("4k7f-1", State.ACTIVE, output=Output("pulse", "card", 0.5, True)).to_json()
    assert Goal.from_json(message).output == Output("pulse", "card", 0.5, True)
    for name in ("player", "device", "volume", "muted"):
        whole = message["output"]
        assert isinstance(whole, dict)
        assert Goal.from_json({**message, "output": {**whole, name: None}}).output is None


def test_a_goal_without_a_client_has_none_there_and_back() -> None:
    assert Goal.from_json(Goal("4k7f-1", State.REJECTED).to_json()).client is None


@given(goals, st.dictionaries(st.text().filter(lambda key: key not in KEYS), values, max_size=3))
def test_fields_that_a_client_does_not_know_are_ignored(goal: Goal, extra: dict[str, object]) -> None:
    assert Goal.from_json({**extra, **goal.to_json(), **extra}) == goal


@given(goals)
def test_fields_within_sender_and_by_that_a_client_does_not_know_are_ignored(goal: Goal) -> None:
    message = goal.to_json()
    for name in ("by", "client", "output"):
        within = message[name]
        if isinstance(within, dict):
            message[name] = {**within, "group": "robots"}
    assert Goal.from_json(message) == goal


@given(values | st.dictionaries(st.sampled_from(KEYS), values))
def test_any_json_value_is_a_goal_or_a_value_error(value: object) -> None:
    try:
        goal = Goal.from_json(value)
    except ValueError:
        return
    assert list(goal.to_json()) == KEYS


@given(goals, st.sampled_from(KEYS), values)
def test_a_goal_with_one_wrong_field_is_a_goal_or_a_value_error(goal: Goal, name: str, value: object) -> None:
    try:
        read = Goal.from_json({**goal.to_json(), name: value})
    except ValueError:
        assert name in {"id", "state"}
        return
    assert Goal.from_json(read.to_json()).to_json() == read.to_json()


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        "4k7f-1",
        7,
        {},
        {"id": "4k7f-1"},
        {"state": "ACTIVE"},
        {"id": 1, "state": "ACTIVE"},
        {"id": "4k7f\x1b[31m", "state": "ACTIVE"},
        {"id": "4k7f-1", "state": 1},
        {"id": "4k7f-1", "state": "DANCING"},
        {"id": "4k7f-1", "state": "active"},
        {"id": "4k7f-1", "state": None},
    ],
)
def test_what_has_no_id_and_no_state_that_is_known_is_no_goal(value: object) -> None:
    with pytest.raises(ValueError, match="goal"):
        Goal.from_json(value)


@given(senders)
def test_a_sender_has_all_its_keys_and_goes_there_and_back(sender: Sender) -> None:
    assert list(sender.to_json()) == SENDER_KEYS
    assert Sender.from_json(sender.to_json()) == sender


@given(values)
def test_any_json_value_for_a_sender_is_a_sender(value: object) -> None:
    assert isinstance(Sender.from_json(value), Sender)


def test_by_names_a_goal_or_a_client_never_both() -> None:
    sender = Sender(pid=7, uid=1000, command="talk", parent="bash patrol.sh", name="patrol")
    assert By(goal="4k7f-2").to_json() == {"goal": "4k7f-2"}
    assert By(client=sender).to_json() == {
        "client": {"pid": 7, "uid": 1000, "command": "talk", "parent": "bash patrol.sh", "name": "patrol"}
    }
    assert By().to_json() is None
