"""The JSON form of goals and senders, and messages from newer or faulty servers."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals.goal import By, Goal, Output, Sender
from talkcli.goals.goal import read_seconds as seconds_of
from talkcli.goals.states import State
from tests.unit.test_lines import values

#: All keys of a goal. Unknown values are null.
KEYS = [
    "id", "state", "status", "reason", "by", "message", "text", "format", "said", "spoken", "spoken_end",
    "heard", "priority", "key", "ttl", "data", "client", "paused", "interrupted_by", "more", "waits",
    "queued_at", "started_at", "ended_at", "duration", "voice", "output",
]  # fmt: skip

numbers = st.integers(-(10**18), 10**18)
seconds = st.none() | st.floats(-1e15, 1e15)
strings = st.none() | st.text()
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
    more=st.booleans(),
    waits=st.booleans(),
    queued_at=seconds,
    started_at=seconds,
    ended_at=seconds,
    duration=seconds,
    voice=st.none() | st.text(),
    output=st.none() | outputs,
)


@given(goals, st.dictionaries(st.text().filter(lambda key: key not in KEYS), values, max_size=3))
def test_a_goal_has_all_its_keys_and_is_read_back_despite_unknown_ones(goal: Goal, extra: dict[str, object]) -> None:
    message = goal.to_json()
    assert list(message) == KEYS
    assert (message["state"], message["status"], type(message["status"])) == (goal.state.name, goal.state.value, int)
    read = {**extra, **json.loads(json.dumps(message)), **extra}
    for name in ("by", "client", "output"):
        if isinstance(read[name], dict):
            read[name]["group"] = "robots"
    assert Goal.from_json(read) == goal


def test_unknown_values_of_a_goal_are_null() -> None:
    message = Goal("4k7f-1", State.PENDING).to_json()
    assert message == dict.fromkeys(KEYS) | {
        "id": "4k7f-1", "state": "PENDING", "status": 0, "format": "text", "priority": 0,
        "paused": False, "more": False, "waits": False,
    }  # fmt: skip


def test_a_time_beyond_the_calendar_is_unknown() -> None:
    shown: list[object] = [0, -1e15, 1e15]
    assert [seconds_of(value) for value in shown] == shown
    assert {seconds_of(value) for value in (1e15 + 1, -1e15 - 1, float("nan"), True, "1", None)} == {None}


def test_an_incomplete_output_is_ignored() -> None:
    message = Goal("4k7f-1", State.ACTIVE, output=Output("pulse", "card", 0.5, True)).to_json()
    assert Goal.from_json(message).output == Output("pulse", "card", 0.5, True)
    for name in ("player", "device", "volume", "muted"):
        whole = message["output"]
        assert isinstance(whole, dict)
        assert Goal.from_json({**message, "output": {**whole, name: None}}).output is None


@given(goals, st.sampled_from(KEYS), values)
def test_a_goal_with_one_wrong_field_is_read_or_raises_value_error(goal: Goal, name: str, value: object) -> None:
    try:
        read = Goal.from_json({**goal.to_json(), name: value})
    except ValueError:
        assert name in {"id", "state"}
        return
    assert Goal.from_json(read.to_json()).to_json() == read.to_json()


@pytest.mark.parametrize(
    "value",
    [
        *(None, [], "4k7f-1", 7, {}, {"id": "4k7f-1"}, {"state": "ACTIVE"}),
        *({"id": goal_id, "state": "ACTIVE"} for goal_id in (1, "4k7f\x1b[31m")),
        *({"id": "4k7f-1", "state": state} for state in (1, "DANCING", "active", None)),
        {"id": "4k7f-1", "state": []},
    ],
)
def test_a_value_without_a_valid_id_and_state_is_not_a_goal(value: object) -> None:
    with pytest.raises(ValueError, match="goal"):
        Goal.from_json(value)


@given(values)
def test_any_json_value_is_read_as_a_sender(value: object) -> None:
    assert isinstance(Sender.from_json(value), Sender)


def test_by_names_a_goal_or_a_client_but_never_both() -> None:
    sender = Sender(pid=7, uid=1000, command="talk", parent="bash patrol.sh", name="patrol")
    assert By(goal="4k7f-2").to_json() == {"goal": "4k7f-2"}
    assert By(client=sender).to_json() == {
        "client": {"pid": 7, "uid": 1000, "command": "talk", "parent": "bash patrol.sh", "name": "patrol"}
    }
    assert By().to_json() is None
