"""What may be spoken: texts that are refused before they are queued, with the reason, and texts that are not."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals.text import fault

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
    "door open",
    "5",
    "-5",
    "?",
    "%",
    "é",
    "日",
    "🤖",
    "👩\u200d🚀",
    " a ",
    "\u200ba",
    "a\x01b",
    "e\u0301",
    "مرحبا",
    "<speak>hi</speak>",
    "[[h@'loU]]",
    '$(reboot); `id` "quoted"\nnext line',
    "\x1b[31mred",
]


@pytest.mark.parametrize("text", INVALID.values(), ids=INVALID.keys())
def test_text_without_anything_to_say_or_that_is_no_text_is_invalid(text: str) -> None:
    found = fault(text)
    assert found is not None
    assert found[0] == "invalid_text"
    assert found[1]


def test_what_is_wrong_is_counted_from_1() -> None:
    for text, place in (("\ud83d low", "character 1 of"), ("door \0", "character 6 of"), ("a\udc00", "character 2 of")):
        found = fault(text)
        assert found is not None
        assert found[1].startswith(place)


@pytest.mark.parametrize("text", SPOKEN)
def test_text_of_any_kind_is_taken(text: str) -> None:
    assert fault(text) is None


@pytest.mark.parametrize("character", ["a", "é", "日", "🤖"])
def test_ten_thousand_characters_are_the_longest_text(character: str) -> None:
    assert fault(character * 10_000) is None
    found = fault(character * 10_001)
    assert found is not None
    assert found[0] == "text_too_long"
    assert "10,001" in found[1]
    assert "10,000" in found[1]


def test_a_hundred_kilobytes_are_too_long() -> None:
    found = fault("a" * 100_000)
    assert found is not None
    assert found[0] == "text_too_long"


def test_forty_thousand_bytes_are_the_longest_text_whatever_the_limit_of_characters() -> None:
    assert fault("🤖" * 10_000, 50_000) is None
    assert fault("a" * 40_000, 50_000) is None
    for text in ("🤖" * 10_000 + "a", "a" * 40_001):
        found = fault(text, 50_000)
        assert found is not None
        assert found[0] == "text_too_long"
        assert "40,001" in found[1]


def test_the_limit_of_characters_is_the_servers_to_set() -> None:
    assert fault("a" * 5, 5) is None
    found = fault("a" * 6, 5)
    assert found is not None
    assert found[0] == "text_too_long"


@given(
    st.text(st.characters(exclude_categories=[])) | st.text(st.characters(categories=["Zs", "Cc", "Cf", "Cn", "Cs"]))
)
def test_any_text_is_taken_or_refused_with_reason_and_words(text: str) -> None:
    found = fault(text, 50)
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


@given(st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=40), st.sampled_from(INVALID["blanks"]))
def test_letters_and_digits_are_always_something_to_say(letters: str, blank: str) -> None:
    assert fault(blank + letters + blank) is None
