"""Odd texts through a real neural voice: each has one end, its words in order, and as much sound as it may have.

200 in the slow tests, some in the others; by hand as many as one likes: `TALK_TEST_NEURAL_TEXTS=2000 pytest -m slow -s
tests/engine/test_neural_texts.py`, with `TALK_TEST_SEED=N` for others. What a process dies of is printed.
"""

from __future__ import annotations

import os
import random
from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.spawned import Spawned
from tests.faults.test_text_bad import ENDLESS, LONGEST_WORDS, MARKUP, RIGHT_TO_LEFT
from tests.support.real_voice import REAL_VOICE
from tests.tools.fuzz_texts import made

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

MANY = int(os.environ.get("TALK_TEST_NEURAL_TEXTS") or 200)
SEED = int(os.environ.get("TALK_TEST_SEED") or 18)
#: … in a default run.
FEW = 5
#: Tests that run beside each other, each with a part of the texts; and characters of a text, unless many are asked for.
PARTS = 4
LONGEST = None if "TALK_TEST_NEURAL_TEXTS" in os.environ else 60
#: Seconds of sound that a character may make at 450 words per minute, and a text beside that: the name of a picture, or
#: of a letter of another script, is a sentence.
A_CHARACTER, BESIDE = 2.5, 1.0
#: Texts that are odd in a way of their own.
ODD = [
    *MARKUP,
    *LONGEST_WORDS.values(),
    *RIGHT_TO_LEFT.values(),
    *("\ud800 a", "a\udfff", "\ud83d", "\x00", "...", "\u0301" * 50, "a" + "\u0301" * 200, "😀" * 20),
    *("\x01s\x01100A b", "1,000,000.5", "7" * 60, "IV. XIX. 1/2 3°", "e.g. i.e. U.S.A. Dr. Mr. 5."),
    *("\ufffe\uffff", "\u202ea\u202c\u2067b\u2069"),
]
#: … and long ones, which take half a minute each: all of them if many texts are asked for.
LONG = {**ENDLESS, "one word": "x" * 10_000, "words of a letter": "a " * 5_000, "words": "word " * 2_000}
_CHOSEN = LONG if "TALK_TEST_NEURAL_TEXTS" in os.environ else ("digits", "accents", "one word", "words of a letter")


@dataclass
class Tally:
    """The ends of the texts."""

    outcomes: Counter[str] = field(default_factory=Counter)
    deaths: list[str] = field(default_factory=list)  # how a process ended, and of which text
    faults: list[str] = field(default_factory=list)  # what must not be at all

    def __str__(self) -> str:
        ended = ", ".join(f"{count} {name}" for name, count in sorted(self.outcomes.items()))
        return f"{ended}; {len(self.deaths)} deaths"


def _spoken(texts: Iterable[str], place: Path, env: dict[str, str]) -> Tally:
    """Speak texts into a file, which takes no time but that of computing, by engine processes that may die."""
    tally = Tally()
    left = deque(texts)
    while left:
        with Spawned(f"file:{place / 'out.wav'}", environment=env) as engine:
            while left:
                text = left.popleft()
                try:
                    ended = engine.spoken(text, voice=REAL_VOICE)
                except AssertionError as died:
                    engine.process.wait(20)
                    tally.deaths.append(f"{engine.process.returncode} {died}: {text!a}")
                    break
                _count(tally, text, ended, engine.words())
                engine.events.clear()
    return tally


def _count(tally: Tally, text: str, ended: protocol.Ended, words: list[protocol.Word]) -> None:
    shown = f"{text[:200]!a} ({len(text)})"
    tally.outcomes[ended.reason or ended.outcome] += 1
    if ended.outcome == protocol.OUTCOME_FAILED:
        if ended.reason != "nothing_to_say" or words:
            tally.faults.append(f"{ended.reason}: {ended.message}: {shown}")
        return
    seconds = ended.duration or 0.0
    if not words:
        tally.faults.append(f"no words: {shown}")
    for before, here in pairwise(words):
        if not (before.end <= here.start and before.time <= here.time and here.number == before.number + 1):
            tally.faults.append(f"words out of order, {before} {here}: {shown}")
    if any(not 0 <= each.start < each.end <= len(text) or not 0 <= each.time <= seconds for each in words):
        tally.faults.append(f"words outside of the text: {shown}")
    if not 0 < seconds <= BESIDE + A_CHARACTER * len(text):
        tally.faults.append(f"{seconds} s: {shown}")


def _assert_well(tally: Tally, texts: int) -> None:
    print(tally, *tally.deaths, *tally.faults, sep="\n")
    assert not tally.faults, tally.faults
    assert not tally.deaths, tally.deaths
    assert tally.outcomes.total() == texts
    assert tally.outcomes[protocol.OUTCOME_COMPLETED] > texts // 2


def test_odd_texts_have_one_end_each(tmp_path: Path, real: dict[str, str]) -> None:
    source = random.Random(SEED)
    texts = [each[:25] for each in (*ODD[::5], *(made(source) for _ in range(FEW)))]
    _assert_well(_spoken(texts, tmp_path, real), len(texts))


@pytest.mark.slow
@pytest.mark.timeout(600 + MANY)
@pytest.mark.parametrize("part", range(PARTS))
def test_many_odd_texts_have_one_end_each(tmp_path: Path, real: dict[str, str], part: int) -> None:
    source = random.Random(SEED)
    texts = [*ODD, *(made(source)[:LONGEST] for _ in range(MANY - len(ODD)))][part::PARTS]
    _assert_well(_spoken(texts, tmp_path, real), len(texts))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", _CHOSEN)
def test_texts_of_thousands_of_characters_have_one_end_each(tmp_path: Path, real: dict[str, str], name: str) -> None:
    _assert_well(_spoken([LONG[name]], tmp_path, real), 1)
