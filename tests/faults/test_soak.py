"""Soak tests: short, or TALK_TEST_SOAK seconds if that is set."""

from __future__ import annotations

import os
import random

import pytest

from tests.tools.soak import soak

WARM_UP_GOALS = 200
SECONDS = float(os.environ.get("TALK_TEST_SOAK") or (60 if os.environ.get("CI") else 15))


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 400)
def test_random_goals_survive_a_fault_every_few_seconds() -> None:
    min_faults = int(SECONDS / 12) + 1
    report = soak(SECONDS, random.randrange(1 << 30), every=3, min_faults=min_faults, warm_up=WARM_UP_GOALS)
    print(report)
    assert report.ends.total() > 5 * SECONDS
    assert report.heard_whole > SECONDS / 30
    assert any(interrupted for _, interrupted in report.stories)


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 400)
def test_repeatedly_killed_engines_cost_at_most_one_goal_per_kill() -> None:
    report = soak(SECONDS / 2, random.randrange(1 << 30), every=None, warm_up=WARM_UP_GOALS)
    print(report)
    assert report.ends.total() > SECONDS / 2
    assert report.faults.total()
