"""The file of a history: its limits, its mode, and files that are removed, damaged or in use."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import time
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from talkcli.goals.goal import Goal
from talkcli.goals.states import State
from talkcli.history import file
from talkcli.history.file import HistoryError, HistoryWriter, search

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def goal(number: int, text: str = "door open", ended_at: float | None = None) -> Goal:
    return Goal(f"4k7f-{number}", State.SUCCEEDED, text, ended_at=time.time() if ended_at is None else ended_at)


def stored(path: str) -> list[str]:
    """Return the ids of the stored goals, oldest first."""
    return [row[0] for row in search(path, "1", [], 100_000, time.monotonic() + 10)]


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "state" / "talk" / "history#1?.db")


@pytest.fixture
def writer(path: str) -> Iterator[HistoryWriter]:
    writer = HistoryWriter(path)
    yield writer
    writer.close()


def test_only_the_owner_may_read_the_file_and_its_directory(path: str, writer: HistoryWriter) -> None:
    assert stored(path) == []  # there is no file yet
    writer.write([goal(1), goal(2)])
    assert stored(path) == ["4k7f-1", "4k7f-2"]
    files = [f"{path}{suffix}" for suffix in ("", "-wal", "-shm")]
    modes = [os.stat(each).st_mode & 0o777 for each in (os.path.dirname(path), *files)]
    assert modes == [0o700, 0o600, 0o600, 0o600]


def test_goals_are_deleted_after_90_days_by_a_clock_that_was_not_set(
    path: str, writer: HistoryWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot boots in 1970, and later ten years in the future."""
    day = 24 * 3600.0
    for number, (now, uptime, kept) in enumerate(
        (
            (1.8e9, 0.0, [0]),
            (100.0, 10.0, [0, 1]),
            (1.8e9 + 3650 * day, 20.0, [0, 1, 2]),
            (1.8e9 + 89 * day, 30.0, [0, 1, 2, 3]),
            (1.8e9 + 89.5 * day, 30.0 + day / 2, [0, 1, 2, 3, 4]),
            (1.8e9 + 91 * day, 30.0 + 2 * day, [3, 4, 5]),
        )
    ):
        monkeypatch.setattr(file, "time", SimpleNamespace(time=partial(float, now), monotonic=partial(float, uptime)))
        writer.write([goal(number, ended_at=now)])
        assert stored(path) == [f"4k7f-{each}" for each in kept]


def test_a_full_file_keeps_its_size_and_the_newest_goals(
    path: str, writer: HistoryWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Long texts follow on short ones, so more than a few short ones must be deleted."""
    monkeypatch.setattr(file, "MAX_CONTENT_BYTES", 2_000_000)
    texts = ["x" * 500] * 4_000 + ["\N{ROBOT FACE}" * 10_000] * 80
    for first in range(0, len(texts), 20):
        writer.write([goal(number, texts[number]) for number in range(first, first + 20)])
        assert os.stat(path).st_size < 2_000_000
        if first % 400 == 0:
            ids = [int(each.partition("-")[2]) for each in stored(path)]
            assert ids == list(range(first + 20 - len(ids), first + 20))
            assert len(ids) >= min(first + 20, 40)


def test_a_file_that_is_being_created_has_no_goals(path: str) -> None:
    os.makedirs(os.path.dirname(path))
    with open(path, "xb"):
        assert stored(path) == []


def test_a_removed_file_is_created_again(path: str, writer: HistoryWriter) -> None:
    writer.write([goal(1)])
    os.unlink(path)  # its WAL and its index of the WAL stay
    assert writer.write([goal(2)]) == f"{path} was removed or replaced, so a new history was started"
    assert writer.write([goal(3)]) is None
    assert stored(path) == ["4k7f-2", "4k7f-3"]


@pytest.mark.parametrize("is_open", [False, True])
def test_a_damaged_file_is_set_aside(path: str, writer: HistoryWriter, *, is_open: bool) -> None:
    """If the file is open, SQLite has the damaged pages in memory, so only a search finds the damage."""
    writer.write([goal(number) for number in range(500)])
    if not is_open:
        writer.close()
    with open(path, "r+b") as damaged:
        damaged.write(b"garbage " * (os.stat(path).st_size // 8))
    if is_open:
        os.truncate(f"{path}-wal", 0)
        with pytest.raises(HistoryError) as failed:
            stored(path)
    message = writer.write([goal(1)], failed.value.damaged_file if is_open else None)
    assert message == f"{path} was damaged; it was renamed to {path}.damaged, and a new history was started"
    if is_open:
        assert writer.write([], failed.value.damaged_file) is None  # another search has found the same damage
    assert stored(path) == ["4k7f-1"]
    with open(f"{path}.damaged", "rb") as kept:
        assert kept.read(8) == b"garbage "


def test_two_servers_may_use_the_same_file(path: str, writer: HistoryWriter) -> None:
    other = HistoryWriter(path)
    with contextlib.closing(other):
        for number in range(0, 20, 2):
            writer.write([goal(number)])
            other.write([goal(number + 1)])
        assert stored(path) == [f"4k7f-{number}" for number in range(20)]


def test_a_file_of_another_user_or_a_link_is_not_used(path: str, writer: HistoryWriter, tmp_path: Path) -> None:
    os.makedirs(os.path.dirname(path))
    (tmp_path / "other").touch()
    os.symlink(tmp_path / "other", path)
    with pytest.raises(HistoryError, match="must be a regular file that belongs"):
        writer.write([goal(1)])
    assert (tmp_path / "other").read_bytes() == b""


def test_a_reader_that_never_ends_does_not_let_the_files_grow(
    path: str, writer: HistoryWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file, "MAX_WAL_BYTES", 100_000)
    monkeypatch.setattr(file, "_LOCK_WAIT_S", 0.01)
    writer.write([goal(1)])
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT * FROM goals").fetchone()
        batches = [[goal(number, "x" * 4000)] for number in range(2, 200)]
        with pytest.raises(HistoryError, match="another program has been reading"):
            list(map(writer.write, batches))
        assert os.stat(f"{path}-wal").st_size < 200_000
    writer.write([goal(1_000)])
    assert stored(path)[-1] == "4k7f-1000"


def test_a_search_ends_at_its_time_limit(path: str, writer: HistoryWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file, "_STEPS_PER_CHECK", 10)
    writer.write([goal(number) for number in range(1_000)])
    with pytest.raises(HistoryError, match="the search took too long"):
        search(path, "instr(text, ?)", ["nothing"], 20, time.monotonic() - 1)
