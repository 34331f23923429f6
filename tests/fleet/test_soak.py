"""A short soak test of a fleet. TALK_TEST_SOAK sets another duration in seconds."""

from __future__ import annotations

import os
import random

import pytest

from tests.support.surroundings import needs, needs_packages
from tests.tools.fleet_soak import soak

SECONDS = float(os.environ.get("TALK_TEST_SOAK") or (30 if os.environ.get("CI") else 20))


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 600)
def test_random_goals_end_despite_a_fault_every_few_seconds() -> None:
    needs("mosquitto")
    needs_packages("paho")
    report = soak(SECONDS, seed=random.randrange(1 << 30), every=4, warm_up=20)
    print(report)
    assert report.ends.total() > SECONDS / 2
    assert report.faults.total() > SECONDS / 20
    assert report.ends["SUCCEEDED", None]
