"""The records of ended goals in memory, which are limited by number and by the size of the texts."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals import memory as module
from talkcli.goals.goal import Sender
from talkcli.goals.memory import RecentGoals
from talkcli.goals.options import Say
from talkcli.goals.reasons import Reason
from talkcli.goals.record import Record
from talkcli.goals.states import State


def ended(number: int, state: State = State.SUCCEEDED, text: str = "door open") -> Record:
    record = Record(f"4k7f-{number}", number, Say(text), Sender(), 1.0)
    record.state = state
    record.reason = Reason.CANCELED
    return record


@pytest.mark.parametrize(
    ("state", "limit"), [(State.REJECTED, 200), (State.RECALLED, 1_000), (State.SUCCEEDED, 1_000)], ids=str
)
def test_many_goals_of_one_state_do_not_displace_goals_of_another(state: State, limit: int) -> None:
    recent = RecentGoals()
    others = [
        ended(number, other) for number, other in enumerate({State.REJECTED, State.RECALLED, State.SUCCEEDED} - {state})
    ]
    alike = [ended(number, state) for number in range(10, 2_000)]
    for record in (*others, *alike):
        recent.add(record)
    kept = [record for record in (*others, *alike) if recent.find(record.id)]
    assert kept == [*others, *alike[-limit:]]


def test_goals_are_listed_by_end_time_with_or_without_rejected_ones() -> None:
    recent = RecentGoals()
    states = [State.ABORTED, State.REJECTED, State.RECALLED, State.SUCCEEDED, State.REJECTED, State.RECALLED]
    for number, state in zip((9, 1, 4, 0, 3, 5), states, strict=True):
        recent.add(ended(number, state))
    for count in (0, 2, 10):
        assert [record.number for record in recent.latest(count, include_rejected=True)] == [5, 3, 0, 4, 1, 9][:count][
            ::-1
        ]
        assert [record.number for record in recent.latest(count, include_rejected=False)] == [5, 0, 4, 9][:count][::-1]


def test_a_forgotten_id_may_be_used_again() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MAX_SPOKEN_GOALS", 2)
        recent = RecentGoals()
        for number in (1, 2, 3, 1):
            recent.add(ended(number))
        assert [record.number for record in recent.latest(5, include_rejected=True)] == [3, 1]


def test_texts_are_limited_to_8_mib_and_the_oldest_is_dropped_first() -> None:
    recent = RecentGoals()
    half = "a" * (4 * 1024 * 1024)
    first, second, third = (ended(number, text=half) for number in range(3))
    recent.add(first)
    recent.add(second)
    assert (first.snapshot().text, second.snapshot().text) == (half, half)
    recent.add(third)
    assert (first.snapshot().text, second.snapshot().text, third.snapshot().text) == (None, half, half)
    kept = recent.find(first.id)
    assert kept is first
    assert (kept.state, kept.reason, kept.snapshot().text) == (State.SUCCEEDED, "canceled", None)


def test_the_limit_of_texts_counts_bytes_not_characters() -> None:
    recent = RecentGoals()
    first, second = ended(1, text="🤖" * (1024 * 1024)), ended(2, text="a" * (4 * 1024 * 1024 + 1))
    recent.add(first)
    recent.add(second)
    assert (first.snapshot().text, second.snapshot().text is None) == (None, False)


def test_dropping_a_text_also_drops_the_spoken_part() -> None:
    record = ended(1)
    record.started_at, record.begun_end = 2.0, 4
    assert record.snapshot().spoken == "door"
    record.drop_text()
    assert (record.snapshot().text, record.snapshot().spoken) == (None, None)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 12)), max_size=60))
def test_limits_hold_after_any_goals_and_only_the_oldest_texts_are_dropped(goals: list[tuple[bool, int]]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MAX_SPOKEN_GOALS", 7)
        patch.setattr(module, "MAX_REJECTED_GOALS", 3)
        patch.setattr(module, "MAX_KEPT_TEXT_BYTES", 40)
        recent = RecentGoals()
        records = []
        for number, (rejected, size) in enumerate(goals):
            records.append(ended(number, State.REJECTED if rejected else State.SUCCEEDED, "é" * size))
            recent.add(records[-1])
    kept = [record for record in records if recent.find(record.id) is not None]
    assert [record for record in kept if record.state is State.REJECTED] == [
        record for record in records if record.state is State.REJECTED
    ][-3:]
    assert [record for record in kept if record.state is State.SUCCEEDED] == [
        record for record in records if record.state is State.SUCCEEDED
    ][-7:]
    assert recent.latest(100, include_rejected=True) == kept
    assert sum(len(record.say.text.encode()) for record in kept) <= 40
    with_text = [record.snapshot().text is not None for record in kept]
    assert with_text == sorted(with_text), "a newer text was dropped before an older one"
    assert not kept or kept[-1].snapshot().text is not None
