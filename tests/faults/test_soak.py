"""The soak in its short form: a minute in CI, a few seconds elsewhere, and TALK_TEST_SOAK seconds where that is set."""

from __future__ import annotations

import os
import random

import pytest

from tests.faults.soak import soak

SECONDS = float(os.environ.get("TALK_TEST_SOAK") or (60 if os.environ.get("CI") else 15))


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 400)
def test_random_goals_with_a_fault_every_few_seconds() -> None:
    report = soak(SECONDS, seed=random.randrange(1 << 30), every=3, least=int(SECONDS / 12) + 1)
    print(report)
    assert not report.failures, str(report)
    assert report.goals > 5 * SECONDS
    assert report.faults.total() > SECONDS / 12
    assert report.heard_whole > SECONDS / 30


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 400)
def test_engines_that_are_killed_again_and_again_cost_no_more_than_a_goal_each() -> None:
    report = soak(SECONDS / 2, seed=random.randrange(1 << 30), every=None)
    print(report)
    assert not report.failures, str(report)
    assert report.goals > SECONDS / 2
    assert report.deaths
    assert report.lost <= report.deaths
