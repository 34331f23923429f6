"""Each row of the fleet's benchmark measures something: a short run of all, whatever the figures are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.bench.fleet import GROUPS, measure
from tests.bench.fleet_stage import FleetOptions, FleetStage
from tests.bench.test_bench_rows import assert_measured
from tests.support.surroundings import needs, needs_packages

if TYPE_CHECKING:
    from collections.abc import Iterator

#: How many rows a group has.
ROWS = {"idle": 3, "tls": 2}


@pytest.fixture(scope="module")
def stage() -> Iterator[FleetStage]:
    needs("mosquitto", "openssl")
    needs_packages("paho")
    with FleetStage(FleetOptions(rounds=2, idle=1)) as found:
        yield found


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_a_row_measures_something(stage: FleetStage, group: str) -> None:
    rows = measure(group, stage)
    assert_measured(rows, ROWS.get(group, 1))
    for row in rows:
        assert row.goal or row.peer or row.name.startswith("…")  # which says more of the one before it
