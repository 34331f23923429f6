"""Tests that run several at a time: many in company, one alone, and whoever wants to be alone gets there."""

from __future__ import annotations

import contextlib
import threading
from typing import TYPE_CHECKING

import pytest

from tests.support import timing
from tests.support.company import Company
from tests.support.timing import LateError, retry_if_late

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    MakeNeighbour = Callable[[Callable[[Company], None]], "Neighbour"]

#: Seconds in which what may happen has happened, and in which what must not would have.
SOON = 10.0
MEANWHILE = 0.2

Files = tuple[str, str]


class Neighbour:
    """Another test, with descriptors of its own, as another process would have."""

    def __init__(self, files: Files, enter: Callable[[Company], None]) -> None:
        self._files = files
        self._enter = enter
        self.is_in = threading.Event()
        self._may_leave = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with Company(self._files) as place:
            self._enter(place)
            self.is_in.set()
            self._may_leave.wait(SOON)
            place.leave()

    def leave(self) -> None:
        self._may_leave.set()
        self._thread.join()


@pytest.fixture
def files(tmp_path: Path) -> Files:
    paths = tmp_path / "door", tmp_path / "room"
    for each in paths:
        each.touch()
    return str(paths[0]), str(paths[1])


@pytest.fixture
def neighbour(files: Files) -> Iterator[MakeNeighbour]:
    with contextlib.ExitStack() as stack:

        def make(enter: Callable[[Company], None]) -> Neighbour:
            result = Neighbour(files, enter)
            stack.callback(result.leave)
            return result

        yield make


def test_in_company_many_run_and_none_that_is_alone(files: Files, neighbour: MakeNeighbour) -> None:
    with Company(files) as place:
        place.join()
        assert not place.alone
        assert neighbour(Company.join).is_in.wait(SOON)
        lonely = neighbour(Company.stay_alone)
        assert not lonely.is_in.wait(MEANWHILE)


def test_who_wants_to_be_alone_is_not_kept_out_by_those_who_come_later(neighbour: MakeNeighbour) -> None:
    first = neighbour(Company.join)
    assert first.is_in.wait(SOON)
    lonely = neighbour(Company.stay_alone)
    assert not lonely.is_in.wait(MEANWHILE)
    late = neighbour(Company.join)
    assert not late.is_in.wait(MEANWHILE)
    first.leave()
    assert lonely.is_in.wait(SOON)
    assert not late.is_in.wait(MEANWHILE)
    lonely.leave()
    assert late.is_in.wait(SOON)


def test_one_test_at_a_time_waits_for_nobody() -> None:
    place = Company(None)
    for step in (place.join, place.stay_alone, place.leave):
        step()
        assert place.alone


def test_what_is_late_in_company_is_tried_again_alone(files: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    with Company(files) as place:
        monkeypatch.setattr(timing, "company", place)
        place.join()
        seen: list[bool] = []

        def attempt() -> None:
            seen.append(place.alone)
            if len(seen) < 2:
                raise LateError("late")

        assert [each.late for each in retry_if_late(attempt, lambda: 0.0, 1.0)] == [None]
        assert seen == [False, True]


def test_what_is_late_alone_while_the_control_is_in_time_fails(files: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    with Company(files) as place:
        monkeypatch.setattr(timing, "company", place)
        place.join()

        def attempt() -> None:
            raise LateError("late")

        with pytest.raises(AssertionError, match="the control was in time"):
            retry_if_late(attempt, lambda: 0.0, 1.0)
        assert place.alone
