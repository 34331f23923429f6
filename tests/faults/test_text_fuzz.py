"""Mutated texts with all voices: each goal has one end, whatever it costs; and what the fuzzer found stays mended.

A minute in CI, some seconds elsewhere, as long as TALK_TEST_FUZZ says; `python -m tests.faults.fuzz_texts` by hand.
"""

from __future__ import annotations

import itertools
import os
import random

import pytest

from talkcli.engine.synthesizers.guard import guarded
from tests.faults.fuzz_texts import fuzz, list_voices, speak_all
from tests.faults.fuzz_texts_generator import Case, cases, crashers, dated

SECONDS = float(os.environ.get("TALK_TEST_FUZZ") or (30 if os.environ.get("CI") else 10))
#: Texts of each known kind that are made anew each day.
OF_TODAY = 12


@pytest.mark.parametrize("seconds", [2.0, pytest.param(SECONDS, marks=pytest.mark.slow)])
@pytest.mark.timeout(int(SECONDS) + 300)
def test_mutated_texts_have_one_end_each_and_none_overflows(seconds: float) -> None:
    before = len(os.listdir("/proc/self/fd"))
    tally = fuzz(7, seconds=seconds)
    print(tally, *tally.deaths, sep="\n")
    assert not tally.faults, tally.faults
    assert not tally.overflows, tally.overflows
    assert tally.texts > seconds
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_crashing_texts_of_today_are_spoken_with_the_guard() -> None:
    voices = list_voices()
    source = random.Random(dated())
    made = [
        Case(source.choice(voices) if voice is None else voice, text)
        for voice, text in itertools.islice(crashers(source), 5 * OF_TODAY)
    ]
    without = speak_all(made, guarded=False)
    print(f"without the guard: {without}")
    assert not without.faults, without.faults
    assert len(without.deaths) > len(made) // 2, "these texts need no guard, so they show nothing"
    with_it = speak_all(made, guarded=True)
    print(f"with it: {with_it}")
    assert not with_it.faults, with_it.faults
    assert not with_it.deaths, [str(each) for each in with_it.deaths]


def test_the_same_seed_makes_the_same_texts_and_another_one_others() -> None:
    first, again, other = (list(itertools.islice(cases(seed, ["a", "b", "c"]), 500)) for seed in (1, 1, 2))
    assert first == again
    assert first != other
    assert {each.voice for each in first} == {"a", "b", "c"}
    assert sum(guarded(each.text) == each.text for each in first) > 250, "the guard touches most of them"
