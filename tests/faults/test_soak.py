"""Soak tests: short, or TALK_TEST_SOAK seconds if that is set."""

from __future__ import annotations

import os
import random

import pytest

from tests.tools.soak import soak

SECONDS = float(os.environ.get("TALK_TEST_SOAK") or (60 if os.environ.get("CI") else 15))


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 400)
def test_random_goals_survive_a_fault_every_few_seconds() -> None:
    report = soak(SECONDS, seed=random.randrange(1 << 30), every=3, min_faults=int(SECONDS / 12) + 1)
    print(report)
    assert report.ends.total() > 5 * SECONDS
    assert report.heard_whole > SECONDS / 30
    assert report.stories["SUCCEEDED", True] > SECONDS / 30


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 400)
def test_repeatedly_killed_engines_cost_at_most_one_goal_per_kill() -> None:
    report = soak(SECONDS / 2, seed=random.randrange(1 << 30), every=None)
    print(report)
    assert report.ends.total() > SECONDS / 2
    assert report.faults.total()
