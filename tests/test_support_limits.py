"""Limits beside a control: what is late fails, unless the control was late by as much."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.timing import assert_within, limits, process_start, take_unmeasured

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    MakeControl = Callable[[float], Callable[[], float]]


@pytest.fixture
def control() -> Iterator[MakeControl]:
    """Makes a control that takes 10 ms while it is quiet and, from then on, as long as is said."""

    def make(beside: float) -> Callable[[], float]:
        times = iter([0.01] * 5)
        return lambda: next(times, beside)

    yield make
    take_unmeasured()  # so that these are not listed themselves


def test_what_is_in_time_is_measured(control: MakeControl) -> None:
    with limits(control(0.09)):
        assert_within(0.1, 0.1, "it")
    assert take_unmeasured() == []


def test_what_is_late_beside_a_late_control_is_not_measured(control: MakeControl) -> None:
    went_on = False
    with limits(control(0.03)):
        assert_within(0.25, 0.1, "it")
        went_on = True
    assert went_on
    (told,) = take_unmeasured()
    assert told.startswith("it took 0.250 s, the limit is 0.1 s; the control took 0.030 s, usually 0.010 s")


def test_what_has_a_limit_of_milliseconds_waits_as_long_as_three_controls(control: MakeControl) -> None:
    with limits(control(0.03)):
        assert_within(0.089, 0.02, "it")
    assert len(take_unmeasured()) == 1
    with pytest.raises(AssertionError, match="it took"), limits(control(0.03)):
        assert_within(0.091, 0.02, "it")


@pytest.mark.parametrize(("beside", "seconds"), [(0.01, 0.11), (0.019, 0.11), (0.03, 0.35)])
def test_what_a_control_does_not_explain_fails(control: MakeControl, beside: float, seconds: float) -> None:
    with pytest.raises(AssertionError, match="it took"), limits(control(beside)):
        assert_within(seconds, 0.1, "it")
    assert take_unmeasured() == []


def test_a_late_control_excuses_nothing_but_time(control: MakeControl) -> None:
    def wrong() -> None:
        with limits(control(9.0)):
            assert_within(0.11, 0.1, "it")
            raise AssertionError("wrong")

    with pytest.raises(AssertionError, match="wrong"):
        wrong()
    assert take_unmeasured() == []


def test_without_a_control_a_limit_is_a_limit() -> None:
    with pytest.raises(AssertionError, match=r"it took 0\.110 s, the limit is 0\.1 s"):
        assert_within(0.11, 0.1, "it")


def test_a_bare_process_start_takes_time() -> None:
    assert 0.001 < process_start() < 5
