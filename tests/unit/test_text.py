"""Texts that are refused before they are queued, each with the reason, and texts that are accepted."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals.options import bad_text

INVALID = {
    "empty": "",
    "blank": " ",
    "blanks": " \t\r\n\v\f ",
    "no-break space": "\u00a0",
    "ideographic space": "\u3000",
    "line and paragraph separators": "\u2028\u2029",
    "zero-width space": "\u200b",
    "zero-width joiners": "\u200b\u200c\u200d\u2060\ufeff",
    "direction marks": "\u200e\u200f\u202e",
    "controls": "\x01\x1b\x7f",
    "NUL": "\0",
    "NUL within words": "door\0open",
    "half of a surrogate pair": "\ud83d",
    "other half": "door \udc00 open",
    "private use": "\ue000",
}
SPOKEN = [
    *("door open", "5", "-5", "?", "%", "é", "日", "🤖", "👩\u200d🚀", " a ", "\u200ba", "a\x01b", "e\u0301", "مرحبا"),
    *("<speak>hi</speak>", "[[h@'loU]]", '$(reboot); `id` "quoted"\nnext line', "\x1b[31mred"),
]


@pytest.mark.parametrize("text", INVALID.values(), ids=INVALID.keys())
def test_a_text_without_anything_to_say_is_invalid_whatever_its_length(text: str) -> None:
    for most in (10_000, None):
        found = bad_text(text, most)
        assert found is not None
        assert found[0] == "invalid_text"
        assert found[1]


@pytest.mark.parametrize("text", SPOKEN)
def test_a_text_of_any_kind_is_taken(text: str) -> None:
    assert bad_text(text) is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the text is empty"),
        (" \t", "the text is empty"),
        ("\u200b", "the text has no visible characters"),
        (" \u200b", "the text has no visible characters"),
        ("\ud83d low", "the text is not valid Unicode: character 1 is half of a surrogate pair"),
        ("a\udc00", "the text is not valid Unicode: character 2 is half of a surrogate pair"),
        ("door \0", "the text contains a NUL character (character 6)"),
    ],
)
def test_the_words_say_what_is_wrong_and_count_from_1(text: str, words: str) -> None:
    assert bad_text(text) == ("invalid_text", words)


@pytest.mark.parametrize(
    ("longest", "most", "words"),
    [
        *((each * 10_000, 10_000, "the text is too long: 10,001 characters (at most 10,000)") for each in "aé日🤖"),
        ("a" * 5, 5, "the text is too long: 6 characters (at most 5)"),
        ("🤖" * 10_000, 50_000, "the text is too long: 40,001 bytes (at most 40,000)"),
        ("a" * 40_000, 50_000, "the text is too long: 40,001 bytes (at most 40,000)"),
    ],
    ids=lambda each: f"{each[:1]}{len(each)}" if isinstance(each, str) else str(each),
)
def test_a_text_has_a_longest_number_of_characters_and_of_bytes(longest: str, most: int, words: str) -> None:
    assert bad_text(longest, most) is None
    assert bad_text(f"{longest}{longest[0] if most == 10_000 else 'a'}", most) == ("text_too_long", words)
    assert bad_text(f"{longest}a", None) is None, "a text that is no goal may have any length"


def test_ten_thousand_characters_are_the_longest_text() -> None:
    assert bad_text("a" * 10_000) is None
    assert bad_text("a" * 10_001) == ("text_too_long", "the text is too long: 10,001 characters (at most 10,000)")


@given(
    st.text(st.characters(exclude_categories=[])) | st.text(st.characters(categories=["Zs", "Cc", "Cf", "Cn", "Cs"]))
)
def test_any_text_is_taken_or_refused_with_reason_and_words(text: str) -> None:
    found = bad_text(text, 50)
    if found is None:
        assert 0 < len(text) <= 50
        assert "\0" not in text
        assert text.strip()
        text.encode()
    else:
        reason, words = found
        assert reason in {"invalid_text", "text_too_long"}
        assert words
        words.encode()
