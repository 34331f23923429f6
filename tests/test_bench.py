"""The benchmark's rows measure something, and the documents show the same rows."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from tests.support.documents import BENCHMARK, README, tables
from tests.support.sink import PROGRAMS
from tests.support.surroundings import needs, needs_packages
from tests.tools.bench import fleet, growing, load, processes, sound
from tests.tools.bench.__main__ import GROUPS, NAMED, measure
from tests.tools.bench.harness import TALK, Harness, Options

if TYPE_CHECKING:
    from collections.abc import Iterator

TABLES = tables(BENCHMARK.text)


def without_numbers(name: str, goal: str) -> tuple[str, str]:
    """Return a row's goal, and its name without numbers, which differ in a short run."""
    return re.sub(r"[0-9][0-9,.]*", "#", name.replace("`", "")), goal


@pytest.fixture(scope="module")
def harness() -> Iterator[Harness]:
    needs(TALK, *PROGRAMS)
    with Harness(Options(rounds=1, idle=1)) as result:
        yield result


@pytest.mark.slow
@pytest.mark.parametrize("group", [*GROUPS, *NAMED])
def test_every_row_of_a_group_measures_something(harness: Harness, group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if group == "fleet":
        needs("mosquitto", "openssl")
        needs_packages("paho")
    for module, name, smaller in (
        (load, "GOALS", 200),
        *((module, "_MORE_ROUNDS", 1) for module in (fleet, growing, processes, sound)),
        (sound, "LONG_TEXT", sound.LONG_TEXT[:50]),
    ):
        monkeypatch.setattr(module, name, smaller)
    rows = measure(group, harness)
    assert [row.failure for row in rows if row.failure] == []
    assert all(len(row.cells()) == len(TABLES[0][0]) and row.values for row in rows)
    known = {without_numbers(row[0], row[7]) for table in TABLES for row in table[1:]}
    assert {without_numbers(row.name, row.goal) for row in rows} <= known, f"{BENCHMARK.name} is out of date"


def test_the_readme_quotes_numbers_from_the_table() -> None:
    figures = re.findall(r"\d[\d.,]* (?:ms|MB|%)", README.section("Speed"))
    assert len(figures) == 5
    assert set(figures) <= {cell for row in TABLES[0] for cell in row}
