"""Splitting a text into parts of limited length, and finding the phonemes of each word."""

from __future__ import annotations

import re
import time

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from talkcli.engine.child.synthesizers.phonemes import MAX_PART_PHONEMES, SpeechPart, split_text
from tests.support.timing import assert_within, limits

PUNCTUATION = {"。": ".", "？": "?", "，": ",", "…": ".", "؟": "?", ";": ";"}


class Speller:
    """A language whose letters are phonemes. It speaks `joined` as one word, and replaces the words in `spoken`."""

    def __init__(self, joined: str = "", spoken: dict[str, str] | None = None) -> None:
        self._joined = joined
        self._spoken = spoken or {}

    def clauses(self, text: str) -> list[tuple[str, str]]:
        parts = re.findall(r"[^,.!?]*[,.!?]*\s*", text)[:-1]
        return [(part, self._phonemes(part)) for part in parts]

    def word_positions(self, clause: str) -> list[tuple[int, int]]:
        return [(match.start(), len(match[0])) for match in re.finditer(r"[^\s,.!?]+", clause)]

    def ends_with_abbreviation(self, clause: str) -> bool:
        return clause.rstrip().endswith("mr.")

    def _phonemes(self, clause: str) -> str:
        words = re.sub(r"[,.!?]", " ", clause).split()
        sounds = " ".join(self._spoken.get(word, word) for word in words)
        return sounds.replace(self._joined, self._joined.replace(" ", "")) if self._joined else sounds


def _shown(text: str, speller: Speller | None = None) -> list[str]:
    return ["".join(part.phonemes) for part in split_text(speller or Speller(), text)]


def _words(text: str, speller: Speller | None = None) -> list[tuple[str, str]]:
    """Return each word of the text with the first three phonemes that are spoken for it."""
    words = []
    for part in split_text(speller or Speller(), text):
        for at, start, length in part.words:
            words.append((text[start : start + length], "".join(part.phonemes[at : at + 3])))
    return words


@pytest.mark.parametrize(
    ("text", "spoken", "shown"),
    [
        ("one, two. three? four", {}, ["one, two.", "three?", "four"]),
        # punctuation of other scripts is replaced by punctuation that voices know
        *((f"one{sign}", {f"one{sign}": "one"}, [f"one{mark}"]) for sign, mark in PUNCTUATION.items()),
        # the dot of an abbreviation ends a sentence only at the end of the text
        ("one mr. two. mr.", {}, ["one mr two.", "mr."]),
        # accents are separate phonemes, and language marks are left out
        ("x", {"x": "(en)\xf5(de)"}, ["o\u0303"]),
        *((text, {}, []) for text in ("", " ", "...", "!")),
    ],
)
def test_a_part_is_a_sentence_with_its_punctuation(text: str, spoken: dict[str, str], shown: list[str]) -> None:
    assert _shown(text, Speller(spoken=spoken)) == shown
    assert all(part.ends_sentence for part in split_text(Speller(spoken=spoken), text))


@pytest.mark.parametrize(
    ("text", "speller", "words"),
    [
        ("one, two. three", Speller(), [("one", "one"), ("two", "two"), ("three", "thr")]),
        # words that are spoken as one start inside it
        ("go in the red", Speller("in the"), [("go", "go "), ("in", "int"), ("the", "the"), ("red", "red")]),
        # a word that is spoken as several starts with the first
        ("go 20 by", Speller(spoken={"20": "twen ty"}), [("go", "go "), ("20", "twe"), ("by", "by")]),
    ],
)
def test_words_start_at_their_phonemes(text: str, speller: Speller, words: list[tuple[str, str]]) -> None:
    assert _words(text, speller) == words


def test_a_spelled_word_starts_once_and_later_words_are_not_shifted() -> None:
    """The library reports the position of such a word once per letter, and lengths that include the next word."""

    class Spelling(Speller):
        def word_positions(self, clause: str) -> list[tuple[int, int]]:
            assert clause == "go abc bye now"
            return [(0, 7), *[(3, 6)] * 40, (0, 2), (7, 9), (11, 3)]

    words = [("go abc ", "go "), ("abc by", "ay "), ("bye now", "bye"), ("now", "now")]
    assert _words("go abc bye now", Spelling(spoken={"abc": "ay bee see"})) == words


def test_phonemes_without_a_word_are_spoken() -> None:
    """For some scripts, the library speaks the names of letters without reporting a position."""

    class Placeless(Speller):
        def word_positions(self, clause: str) -> list[tuple[int, int]]:
            assert clause == "go on"
            return []

    assert _shown("go on", Placeless()) == ["go on"]
    assert _words("go on", Placeless()) == []


@limits()
def test_thousands_of_phonemes_are_aligned_quickly() -> None:
    """Comparing every phoneme with every other one would take seconds."""
    spoken = {"1": "one tausend " * 800, "a": "a tausend"}
    started_at = time.monotonic()
    words = _words("1 a a a", Speller(spoken=spoken))
    assert_within(time.monotonic() - started_at, 0.3, "10,000 phonemes")
    assert [word for word, _ in words] == ["1", "a", "a", "a"]


def test_a_long_sentence_is_split_at_a_comma_without_a_pause() -> None:
    text = ", ".join(["word " * 12] * 6)
    parts = list(split_text(Speller(), text))
    assert [part.ends_sentence for part in parts] == [False, True]
    assert parts[0].phonemes[-1] == ","


@given(st.lists(st.sampled_from(["word", "a", "x" * 70, "y" * 600, "in the", "one,", "two.", "?"]), max_size=120))
@example(["y" * 104, "x" * 70, "x" * 70, "one,"])  # 250 phonemes, and then a comma
def test_no_part_exceeds_the_limit_and_no_text_is_lost(words: list[str]) -> None:
    text = " ".join(words)
    parts = list(split_text(Speller("in the"), text))
    assert all(0 < len(part.phonemes) <= MAX_PART_PHONEMES for part in parts)
    spoken = re.sub(r"\W", "", text)
    assert re.sub(r"\W", "", "".join("".join(part.phonemes) for part in parts)) == spoken
    _assert_in_order(parts, text)


def _assert_in_order(parts: list[SpeechPart], text: str) -> None:
    starts = []
    for part in parts:
        places = [at for at, _, _ in part.words]
        assert places == sorted(places)
        assert all(0 <= at < len(part.phonemes) for at in places)
        starts += [start for _, start, _ in part.words]
    assert starts == [match.start() for match in re.finditer(r"[^\s,.!?]+", text)]
