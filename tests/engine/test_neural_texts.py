"""Odd texts, spoken by a real neural voice: each ends once, with its words in order and a plausible duration.

A default run speaks a few texts, and the slow tests speak 100. To choose the number, run `TALK_TEST_NEURAL_TEXTS=2000
pytest -m slow -s tests/engine/test_neural_texts.py`. `TALK_TEST_SEED=N` makes other texts. Faults are printed.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.process import Engine
from tests.faults.test_text_bad import ENDLESS, MARKUP, RENDERED
from tests.support.real_voice import REAL_VOICE
from tests.tools.fuzz_texts import random_text

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MANY = int(os.environ.get("TALK_TEST_NEURAL_TEXTS") or 100)
SEED = int(os.environ.get("TALK_TEST_SEED") or 18)
#: The number of tests that share the texts, so that they can run in parallel.
PARTS = 4
#: The longest text in characters. There is no limit if the number of texts was chosen.
LONGEST = None if "TALK_TEST_NEURAL_TEXTS" in os.environ else 60
#: The most seconds of sound at 450 words per minute: for each character, and in addition for the text. A character may
#: be spoken as a sentence, such as the name of an emoji or of a letter in another script.
CHARACTER_S, TEXT_S = 2.5, 1.0
#: Texts that are odd in various ways.
ODD = [
    *MARKUP,
    *(text for _, text in RENDERED),
    *("\ud800 a", "a\udfff", "\ud83d", "\x00", "...", "\u0301" * 50, "a" + "\u0301" * 200, "😀" * 20),
    *("\x01s\x01100A b", "1,000,000.5", "7" * 60, "IV. XIX. 1/2 3°", "e.g. i.e. U.S.A. Dr. Mr. 5."),
    *("\ufffe\uffff", "\u202ea\u202c\u2067b\u2069"),
]
#: Long texts, which take many seconds each. All are spoken only if the number of texts was chosen.
LONG = {**ENDLESS, "one word": "x" * 3_000, "words of a letter": "a " * 1_500, "words": "word " * 2_000}
_CHOSEN = LONG if "TALK_TEST_NEURAL_TEXTS" in os.environ else ("digits", "accents", "one word", "words of a letter")


def _speak_all(texts: list[str], folder: Path, env: dict[str, str]) -> None:
    """Speak texts to a file, which is faster than real time, and assert that most were spoken, without any fault."""
    outcomes, faults = Counter[str](), list[str]()
    with Engine(f"file:{folder / 'out.wav'}", environment=env) as engine:
        for text in texts:
            ended = engine.spoken(text, voice=REAL_VOICE)
            outcomes[ended.reason or ended.outcome] += 1
            faults += _faults(text, ended, engine.words())
            engine.events.clear()
    print(outcomes, *faults, sep="\n")
    assert not faults
    assert outcomes[protocol.OUTCOME_COMPLETED] > len(texts) // 2


def _faults(text: str, ended: protocol.Ended, words: list[protocol.Word]) -> Iterator[str]:
    shown = f"{text[:200]!a} ({len(text)})"
    if ended.outcome == protocol.OUTCOME_FAILED:
        if ended.reason != "nothing_to_say" or words:
            yield f"{ended.reason}: {ended.message}: {shown}"
        return
    seconds = ended.duration or 0.0
    if not words:
        yield f"no words: {shown}"
    for word, after in pairwise(words):
        if not (word.end <= after.start and word.time <= after.time and after.number == word.number + 1):
            yield f"words out of order, {word} {after}: {shown}"
    if any(not 0 <= word.start < word.end <= len(text) or not 0 <= word.time <= seconds for word in words):
        yield f"words outside of the text: {shown}"
    if not 0 < seconds <= TEXT_S + CHARACTER_S * len(text):
        yield f"{seconds} s: {shown}"


def test_each_odd_text_ends_once(tmp_path: Path, real_voice_env: dict[str, str]) -> None:
    source = random.Random(SEED)
    _speak_all([text[:15] for text in (*ODD[::8], random_text(source))], tmp_path, real_voice_env)


@pytest.mark.slow
@pytest.mark.timeout(600 + MANY)
@pytest.mark.parametrize("part", range(PARTS))
def test_each_of_many_odd_texts_ends_once(tmp_path: Path, real_voice_env: dict[str, str], part: int) -> None:
    source = random.Random(SEED)
    texts = [*ODD, *(random_text(source)[:LONGEST] for _ in range(MANY - len(ODD)))][part::PARTS]
    _speak_all(texts, tmp_path, real_voice_env)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", _CHOSEN)
def test_a_text_of_thousands_of_characters_ends_once(tmp_path: Path, real_voice_env: dict[str, str], name: str) -> None:
    _speak_all([LONG[name]], tmp_path, real_voice_env)
