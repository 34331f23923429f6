"""The guard's rules for words and initials."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.engine.child.synthesizers import guard

#: The matter of the rules, and its like: initials, stops, apostrophes, scripts of every kind, long words.
_PIECES = (
    *("a", "b", "A", "é", "ß", "ǅ", "1", "22", "word", "Word", "日", "本", "가", "각", "①", "⠁", "𝐀", "𝐚", "İ", "ª"),
    *("'", "’", ".", ". ", "..", ",", ", ", "! ", "? ", "…", "。", "\u3000", "\xa0", "\u200d", "\u0301", " ", "  "),
    *("-", "_", "(", ")", "\n", "\n\n", "a. ", "a.", "e.g. ", "U.S.A. ", "5. Then ", "x" * 40, "aB" * 30, "가" * 12),
)
_TEXTS = st.lists(st.sampled_from(_PIECES), max_size=12).flatmap(
    lambda pool: st.lists(st.sampled_from(pool or ["a"]), max_size=300).map("".join)
)


@given(_TEXTS | st.text())
def test_words_are_ended_as_if_the_whole_text_had_been_gone_through(text: str) -> None:
    assert guard._without_long_words(text) == guard._WORD_OR_GAP.sub(guard._split_word, text)


@pytest.mark.parametrize(
    "text", ["a." * 85, "e.g. " * 60, "a." + "b" * 170, "a.b." * 3 + "가" * 17, "a " * 230 + "b.c"]
)
def test_a_text_that_kills_the_library_is_changed(text: str) -> None:
    assert guard.guarded(text) != text
