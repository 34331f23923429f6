"""Mutated texts in all voices: for some seconds, or TALK_TEST_FUZZ seconds if that is set."""

from __future__ import annotations

import itertools
import os

import pytest

from tests.tools.fuzz_texts import cases, list_voices, speak_all

SECONDS = float(os.environ.get("TALK_TEST_FUZZ") or (30 if os.environ.get("CI") else 5))


@pytest.mark.parametrize("growing", [False, True], ids=["whole", "growing"])
@pytest.mark.parametrize("count", [25, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.timeout(int(SECONDS) + 300)
def test_mutated_texts_end_once_and_never_overflow_a_buffer(count: int | None, growing: bool) -> None:
    before = len(os.listdir("/proc/self/fd"))
    texts = itertools.islice(cases(7, list_voices()), count)
    tally = speak_all(texts, guarded=True, seconds=SECONDS, growing=growing)
    print(tally, *tally.deaths, sep="\n")
    assert not tally.faults, tally.faults
    assert not tally.overflows, tally.overflows
    assert tally.texts > (20 if count else SECONDS)
    assert len(os.listdir("/proc/self/fd")) == before
