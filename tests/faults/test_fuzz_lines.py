"""Mutated requests: a seed that never changes, and a slow one of today: half a minute in CI, else seconds."""

from __future__ import annotations

import datetime as dt
import os

import pytest

from tests.faults.fuzz_lines import fuzz

SECONDS = float(os.environ.get("TALK_TEST_FUZZ") or (30 if os.environ.get("CI") else 8))


@pytest.mark.parametrize("count", [2_000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_20000_mutated_lines_have_one_reply_each(count: int) -> None:
    report = fuzz(20, count=count)
    assert not report.failures, str(report)
    assert len(report.errors) > 8, f"hardly any errors: {report}"


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 300)
def test_mutated_lines_of_today_have_one_reply_each() -> None:
    report = fuzz(dt.datetime.now(dt.timezone.utc).toordinal(), seconds=SECONDS)
    print(report)
    assert not report.failures, str(report)
    assert report.lines > 200 * SECONDS
