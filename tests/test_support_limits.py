"""A late result fails a time limit, unless the control was equally late."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.timing import assert_within, limits, process_start, take_unmeasured

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    MakeControl = Callable[..., Callable[[], float]]


@pytest.fixture
def control() -> Iterator[MakeControl]:
    """Return a function that makes controls. They take 10 ms before the block and `early` times in it, then longer."""

    def make(control_s: float, early: int = 0) -> Callable[[], float]:
        times = iter([0.01] * (5 + early))
        return lambda: next(times, control_s)

    yield make
    take_unmeasured()  # keep these out of the summary


def test_a_late_result_beside_a_late_control_is_not_measured(control: MakeControl) -> None:
    continued = False
    with limits(control(0.03, early=2)):  # it is timed again after the late result
        assert_within(0.25, 0.1, "it")
        continued = True
    assert continued
    (note,) = take_unmeasured()
    assert note.startswith("it took 0.250 s, the limit is 0.1 s; the control took 0.030 s, usually 0.010 s")
    with limits(control(0.03)):
        assert_within(0.149, 0.02, "it")
    assert len(take_unmeasured()) == 1


@pytest.mark.parametrize(
    ("control_s", "seconds", "limit"), [(0.01, 0.11, 0.1), (0.019, 0.11, 0.1), (0.03, 0.35, 0.1), (0.03, 0.151, 0.02)]
)
def test_an_unexplained_late_result_fails(control: MakeControl, control_s: float, seconds: float, limit: float) -> None:
    with pytest.raises(AssertionError, match="it took"), limits(control(control_s)):
        assert_within(seconds, limit, "it")
    assert take_unmeasured() == []


def test_a_late_control_excuses_only_late_results(control: MakeControl) -> None:
    def wrong() -> None:
        with limits(control(9.0)):
            assert_within(0.11, 0.1, "it")
            raise AssertionError("wrong")

    with pytest.raises(AssertionError, match="wrong"):
        wrong()
    assert take_unmeasured() == []


def test_a_limit_without_a_control_is_always_enforced() -> None:
    with pytest.raises(AssertionError, match=r"it took 0\.110 s, the limit is 0\.1 s"):
        assert_within(0.11, 0.1, "it")
    assert 0.001 < process_start() < 5
