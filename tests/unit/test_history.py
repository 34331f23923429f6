"""The history of ended goals, which is limited by number and by the size of the texts."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals import history as module
from talkcli.goals.goal import Sender
from talkcli.goals.history import History
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
def test_many_goals_that_end_alike_drive_out_no_other(state: State, limit: int) -> None:
    history = History()
    others = [
        ended(number, each) for number, each in enumerate({State.REJECTED, State.RECALLED, State.SUCCEEDED} - {state})
    ]
    alike = [ended(number, state) for number in range(10, 2_000)]
    for record in (*others, *alike):
        history.add(record)
    kept = [each for each in (*others, *alike) if history.find(each.id)]
    assert kept == [*others, *alike[-limit:]]


def test_the_newest_end_comes_last_and_rejected_goals_can_be_left_out() -> None:
    history = History()
    states = [State.ABORTED, State.REJECTED, State.RECALLED, State.SUCCEEDED, State.REJECTED, State.RECALLED]
    for number, state in zip((9, 1, 4, 0, 3, 5), states, strict=True):
        history.add(ended(number, state))
    for count in (0, 2, 10):
        assert [each.number for each in history.latest(count, rejected=True)] == [5, 3, 0, 4, 1, 9][:count][::-1]
        assert [each.number for each in history.latest(count, rejected=False)] == [5, 0, 4, 9][:count][::-1]


def test_an_id_that_was_forgotten_may_come_again() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MAX_SPOKEN_GOALS", 2)
        history = History()
        for number in (1, 2, 3, 1):
            history.add(ended(number))
        assert [each.number for each in history.latest(5, rejected=True)] == [3, 1]


def test_texts_take_eight_mebibytes_and_the_oldest_goes_first_but_its_result_stays() -> None:
    history = History()
    half = "a" * (4 * 1024 * 1024)
    first, second, third = (ended(number, text=half) for number in range(3))
    history.add(first)
    history.add(second)
    assert (first.snapshot().text, second.snapshot().text) == (half, half)
    history.add(third)
    assert (first.snapshot().text, second.snapshot().text, third.snapshot().text) == (None, half, half)
    kept = history.find(first.id)
    assert kept is first
    assert (kept.state, kept.reason, kept.snapshot().text) == (State.SUCCEEDED, "canceled", None)


def test_bytes_count_not_characters() -> None:
    history = History()
    first, second = ended(1, text="🤖" * (1024 * 1024)), ended(2, text="a" * (4 * 1024 * 1024 + 1))
    history.add(first)
    history.add(second)
    assert (first.snapshot().text, second.snapshot().text is None) == (None, False)


def test_a_text_without_words_spoken_is_forgotten_with_them() -> None:
    record = ended(1)
    record.started_at, record.begun_end = 2.0, 4
    assert record.snapshot().spoken == "door"
    record.drop_text()
    assert (record.snapshot().text, record.snapshot().spoken) == (None, None)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 12)), max_size=60))
def test_limits_hold_after_any_goals_and_only_the_oldest_texts_are_gone(goals: list[tuple[bool, int]]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MAX_SPOKEN_GOALS", 7)
        patch.setattr(module, "MAX_REJECTED_GOALS", 3)
        patch.setattr(module, "MAX_KEPT_TEXT_BYTES", 40)
        history = History()
        records = []
        for number, (rejected, size) in enumerate(goals):
            records.append(ended(number, State.REJECTED if rejected else State.SUCCEEDED, "é" * size))
            history.add(records[-1])
    kept = [each for each in records if history.find(each.id) is not None]
    assert [each for each in kept if each.state is State.REJECTED] == [
        each for each in records if each.state is State.REJECTED
    ][-3:]
    assert [each for each in kept if each.state is State.SUCCEEDED] == [
        each for each in records if each.state is State.SUCCEEDED
    ][-7:]
    assert history.latest(100, rejected=True) == kept
    assert sum(len(each.say.text.encode()) for each in kept) <= 40
    with_text = [each.snapshot().text is not None for each in kept]
    assert with_text == sorted(with_text), "a newer text went before an older one"
    assert not kept or kept[-1].snapshot().text is not None
