"""Each row of the benchmark measures something: a short run of all of them, with no peers, whatever the figures are."""

from __future__ import annotations

import os
import re
import sys
from typing import TYPE_CHECKING

import pytest

from tests.bench import crowd, queueing, throughput
from tests.bench.failure import FailedError
from tests.bench.groups import GROUPS, measure
from tests.bench.stage import Options, Stage
from tests.support.documents import README, SPEED, tables
from tests.support.surroundings import needs

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.bench.table import Row

#: How many rows a group has.
ROWS = {"onset": 6, "at-once": 2, "connection": 2, "commands": 13, "idle": 3, "throughput": 4, "queue": 4}


def _form(name: str, goal: str) -> tuple[str, str]:
    """Return a row's name without its numbers, as a short run has others, and its goal."""
    return re.sub(r"[0-9][0-9,.]*", "#", name.replace("`", "")), goal


#: The table of the last benchmark.
TABLE = tables(SPEED.text)[0]
#: What was measured, and its goal, of each of its rows.
KNOWN = {_form(row[0], row[7]) for row in TABLE[1:]}


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    if not os.path.exists(f"{sys.prefix}/bin/talk"):
        reason = f"needs talk installed in {sys.prefix}"
        pytest.fail(reason, pytrace=False) if os.environ.get("CI") else pytest.skip(reason)
    needs("pulseaudio", "pactl", "parec", "pacat", "aplay")
    with Stage(Options(rounds=1, idle=1, peers=False, venv=sys.prefix, refresh=False)) as found:
        yield found


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_a_row_measures_something(stage: Stage, group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, less in (
        (throughput, "GOALS", 200),
        (throughput, "_FIRST", 50),
        (queueing, "FEW", 50),
        (queueing, "MANY", 200),
        (queueing, "PENDING", 300),
        (crowd, "CLIENTS", 20),
    ):
        monkeypatch.setattr(module, name, less)
    rows = measure(group, stage)
    assert_measured(rows, ROWS.get(group, 1))
    for row in rows:
        assert _form(row.name, row.goal) in KNOWN, f"the table in {SPEED.name} is of an older benchmark"


def assert_measured(rows: list[Row], many: int) -> None:
    """Assert that there are so many rows, and that each has values in its unit."""
    assert [each.failure for each in rows if each.failure] == []
    assert len(rows) == many
    for row in rows:
        assert row.values
        assert row.cells()[2].endswith(row.unit)


def test_readme_tells_what_the_table_has() -> None:
    told = re.findall(r"\d[\d.,]* (?:ms|MB|%)", README.section("Speed"))
    assert len(told) > 8
    assert set(told) <= {cell for row in TABLE for cell in row}


def test_a_group_that_fails_has_a_reason_in_the_place_of_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Stage) -> list[Row]:
        raise FailedError("it was not heard")

    monkeypatch.setitem(GROUPS, "onset", fail)
    (row,) = measure("onset", Stage(Options()))
    assert row.failure == "FailedError: it was not heard"
    assert row.cells()[2].startswith("FAILED")
