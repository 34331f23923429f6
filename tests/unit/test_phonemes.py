"""Sounds and words are laid side by side, whichever way the library counts them, in pieces with a hard limit."""

from __future__ import annotations

import re
import time

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from talkcli.engine.child.synthesizers.phonemes import MAX_PART_PHONEMES, SpeechPart, split_text
from tests.support.timing import assert_within, limits

STOPS = {"。": ".", "？": "?", "，": ",", "…": ".", "؟": "?", ";": ";"}


class Spelt:
    """A language in which each letter is its sound, and a word is what blanks part; `joined` speaks two as one."""

    def __init__(self, joined: str = "", said: dict[str, str] | None = None) -> None:
        self._joined = joined
        self._said = said or {}

    def clauses(self, text: str) -> list[tuple[str, str]]:
        parts = re.findall(r"[^,.!?]*[,.!?]*\s*", text)[:-1]
        return [(each, self._sounds(each)) for each in parts]

    def word_positions(self, clause: str) -> list[tuple[int, int]]:
        return [(each.start(), len(each[0])) for each in re.finditer(r"[^\s,.!?]+", clause)]

    def ends_with_abbreviation(self, clause: str) -> bool:
        return clause.rstrip().endswith("mr.")

    def _sounds(self, clause: str) -> str:
        words = re.sub(r"[,.!?]", " ", clause).split()
        said = " ".join(self._said.get(each, each) for each in words)
        return said.replace(self._joined, self._joined.replace(" ", "")) if self._joined else said


def _shown(text: str, speller: Spelt | None = None) -> list[str]:
    return ["".join(each.phonemes) for each in split_text(speller or Spelt(), text)]


def _words(text: str, speller: Spelt | None = None) -> list[tuple[str, str]]:
    """Return each word of the text, and what is spoken from its beginning on."""
    found = []
    for piece in split_text(speller or Spelt(), text):
        for at, start, length in piece.words:
            found.append((text[start : start + length], "".join(piece.phonemes[at : at + 3])))
    return found


@pytest.mark.parametrize(
    ("text", "said", "shown"),
    [
        ("one, two. three? four", {}, ["one, two.", "three?", "four"]),
        # the stops of other scripts are those that voices know
        *((f"one{sign}", {f"one{sign}": "one"}, [f"one{mark}"]) for sign, mark in STOPS.items()),
        # a dot that belongs to its word ends nothing but the text
        ("one mr. two. mr.", {}, ["one mr two.", "mr."]),
        # accents are sounds of their own, and marks of languages are none
        ("x", {"x": "(en)\xf5(de)"}, ["o\u0303"]),
        *((text, {}, []) for text in ("", " ", "...", "!")),
    ],
)
def test_a_piece_is_a_sentence_with_its_stops(text: str, said: dict[str, str], shown: list[str]) -> None:
    assert _shown(text, Spelt(said=said)) == shown
    assert all(each.ends_sentence for each in split_text(Spelt(said=said), text))


@pytest.mark.parametrize(
    ("text", "speller", "words"),
    [
        ("one, two. three", Spelt(), [("one", "one"), ("two", "two"), ("three", "thr")]),
        # words that are spoken as one begin inside of it
        ("go in the red", Spelt("in the"), [("go", "go "), ("in", "int"), ("the", "the"), ("red", "red")]),
        # a word that is spoken as several begins with the first
        ("go 20 by", Spelt(said={"20": "twen ty"}), [("go", "go "), ("20", "twe"), ("by", "by")]),
    ],
)
def test_words_begin_where_they_stand_in_the_text(text: str, speller: Spelt, words: list[tuple[str, str]]) -> None:
    assert _words(text, speller) == words


def test_a_word_that_is_spelled_begins_once_and_those_behind_it_where_they_are() -> None:
    """The library tells the place of a word for each of its letters, and lengths that reach over the next one."""

    class Spelling(Spelt):
        def word_positions(self, clause: str) -> list[tuple[int, int]]:
            assert clause == "go abc bye now"
            return [(0, 7), *[(3, 6)] * 40, (0, 2), (7, 9), (11, 3)]

    words = [("go abc ", "go "), ("abc by", "ay "), ("bye now", "bye"), ("now", "now")]
    assert _words("go abc bye now", Spelling(said={"abc": "ay bee see"})) == words


def test_sounds_of_no_word_are_spoken() -> None:
    """Of some scripts the library names the letters, and tells no place."""

    class Placeless(Spelt):
        def word_positions(self, clause: str) -> list[tuple[int, int]]:
            assert clause == "go on"
            return []

    assert _shown("go on", Placeless()) == ["go on"]
    assert _words("go on", Placeless()) == []


@limits()
def test_sounds_without_number_are_laid_side_by_side_soon_in_order() -> None:
    """A number of 800 digits has ten times as many; to compare each with each would take seconds."""
    said = {"1": "one tausend " * 800, "a": "a tausend"}
    began = time.monotonic()
    found = _words("1 a a a", Spelt(said=said))
    assert_within(time.monotonic() - began, 0.3, "10,000 sounds")
    assert [word for word, _ in found] == ["1", "a", "a", "a"]


def test_a_long_sentence_is_parted_at_a_comma_and_without_a_pause() -> None:
    text = ", ".join(["word " * 12] * 6)
    found = list(split_text(Spelt(), text))
    assert [each.ends_sentence for each in found] == [False, True]
    assert found[0].phonemes[-1] == ","


@given(st.lists(st.sampled_from(["word", "a", "x" * 70, "y" * 600, "in the", "one,", "two.", "?"]), max_size=120))
@example(["y" * 104, "x" * 70, "x" * 70, "one,"])  # 250 sounds, and then a comma
def test_no_piece_is_longer_than_its_limit_and_nothing_is_lost(words: list[str]) -> None:
    text = " ".join(words)
    found = list(split_text(Spelt("in the"), text))
    assert all(0 < len(each.phonemes) <= MAX_PART_PHONEMES for each in found)
    spoken = re.sub(r"\W", "", text)
    assert re.sub(r"\W", "", "".join("".join(each.phonemes) for each in found)) == spoken
    _assert_in_order(found, text)


def _assert_in_order(found: list[SpeechPart], text: str) -> None:
    starts = []
    for piece in found:
        places = [at for at, _, _ in piece.words]
        assert places == sorted(places)
        assert all(0 <= at < len(piece.phonemes) for at in places)
        starts += [start for _, start, _ in piece.words]
    assert starts == [each.start() for each in re.finditer(r"[^\s,.!?]+", text)]
