"""The soak of a robot over a broker in its short form: 30 s in CI, less elsewhere, or TALK_TEST_SOAK seconds."""

from __future__ import annotations

import os
import random

import pytest

from tests.fleet.soak import soak
from tests.support.surroundings import needs, needs_packages

SECONDS = float(os.environ.get("TALK_TEST_SOAK") or (30 if os.environ.get("CI") else 20))


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 600)
def test_random_goals_over_a_broker_with_a_fault_every_few_seconds() -> None:
    needs("mosquitto")
    needs_packages("paho")
    report = soak(SECONDS, seed=random.randrange(1 << 30), every=4, warm_up=20)
    print(report)
    assert not report.failures, str(report)
    assert report.ledger.ended > SECONDS / 2
    assert report.faults.total() > SECONDS / 20
    assert report.ledger.ends["SUCCEEDED"]
