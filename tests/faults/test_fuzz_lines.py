"""Mutated requests: with a fixed seed, and in the slow run with a new seed every day."""

from __future__ import annotations

import os

import pytest

from tests.tools.fuzz_lines import fuzz
from tests.tools.fuzz_texts import daily_seed

SECONDS = float(os.environ.get("TALK_TEST_FUZZ") or (30 if os.environ.get("CI") else 8))


@pytest.mark.parametrize("count", [2_000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_every_mutated_line_gets_one_reply(count: int) -> None:
    replies = fuzz(20, count=count)
    assert len(replies) > 8, f"hardly any errors: {replies}"


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 300)
def test_every_line_mutated_with_todays_seed_gets_one_reply() -> None:
    assert fuzz(daily_seed(), seconds=SECONDS).total() > 400 * SECONDS
