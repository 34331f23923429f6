"""The guard's quick looks: they find all that its rules would change, and spare a long text the rules themselves."""

from __future__ import annotations

import sys

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
_ORDINARY = (
    "Please come home at 5. Mr. Smith of the U.S. office says so, e.g. today, and I'm stuck. Battery at 3.5 volts! "
)


@given(_TEXTS | st.text())
def test_a_text_without_suspected_initials_has_none_to_change(text: str) -> None:
    if not guard._may_have_long_initials(text):
        assert guard._without_long_initials(text) == text


@given(_TEXTS | st.text())
def test_words_are_ended_as_if_the_whole_text_had_been_gone_through(text: str) -> None:
    assert guard._without_long_words(text) == guard._WORD_OR_GAP.sub(guard._split_word, text)


@pytest.mark.parametrize(
    "text", ["a." * 85, "e.g. " * 60, "a." + "b" * 170, "a.b." * 3 + "가" * 17, "a " * 230 + "b.c"]
)
def test_a_text_that_kills_the_library_is_suspected(text: str) -> None:
    assert guard._may_have_long_initials(text)
    assert guard.guarded(text) != text


def test_a_long_ordinary_text_costs_as_little_as_its_dots(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first sound waits for it. So it is not gone through, and nothing is done for each of its characters."""
    text = (_ORDINARY * 100)[:10_000]
    calls = 0

    def count(_: object, event: str, __: object) -> None:
        nonlocal calls
        calls += event in {"call", "c_call"}

    monkeypatch.setattr(guard, "_without_long_initials", pytest.fail)
    sys.setprofile(count)
    try:
        assert guard.guarded(text) == text
    finally:
        sys.setprofile(None)
    assert calls < 50 * text.count(".")
