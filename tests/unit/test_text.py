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
    "the other half": "door \udc00 open",
    "private use": "\ue000",
}
SPOKEN = [
    *("door open", "5", "-5", "?", "%", "é", "日", "🤖", "👩\u200d🚀", " a ", "\u200ba", "a\x01b", "e\u0301", "مرحبا"),
    *("<speak>hi</speak>", "[[h@'loU]]", '$(reboot); `id` "quoted"\nnext line', "\x1b[31mred"),
]


@pytest.mark.parametrize("text", INVALID.values(), ids=INVALID.keys())
def test_a_text_without_anything_to_say_is_invalid(text: str) -> None:
    for limit in (10_000, None):
        refusal = bad_text(text, limit)
        assert refusal is not None
        assert refusal[0] == "invalid_text"
        assert refusal[1]


@pytest.mark.parametrize("text", SPOKEN)
def test_a_text_of_any_kind_is_accepted(text: str) -> None:
    assert bad_text(text) is None


@pytest.mark.parametrize(
    ("text", "message"),
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
def test_the_message_names_the_fault_and_counts_from_1(text: str, message: str) -> None:
    assert bad_text(text) == ("invalid_text", message)


@pytest.mark.parametrize(
    ("longest", "limit", "message"),
    [
        *((sign * 10_000, 10_000, "the text is too long: 10,001 characters (at most 10,000)") for sign in "aé日🤖"),
        ("a" * 5, 5, "the text is too long: 6 characters (at most 5)"),
        ("🤖" * 10_000, 50_000, "the text is too long: 40,001 bytes (at most 40,000)"),
        ("a" * 40_000, 50_000, "the text is too long: 40,001 bytes (at most 40,000)"),
    ],
    ids=lambda value: f"{value[:1]}{len(value)}" if isinstance(value, str) else str(value),
)
def test_a_text_is_limited_in_characters_and_in_bytes(longest: str, limit: int, message: str) -> None:
    assert bad_text(longest, limit) is None
    assert bad_text(f"{longest}{longest[0] if limit == 10_000 else 'a'}", limit) == ("text_too_long", message)
    assert bad_text(f"{longest}a", None) is None, "without a limit, a text may have any length"


def test_a_text_has_at_most_ten_thousand_characters() -> None:
    assert bad_text("a" * 10_000) is None
    assert bad_text("a" * 10_001) == ("text_too_long", "the text is too long: 10,001 characters (at most 10,000)")


@given(
    st.text(st.characters(exclude_categories=[])) | st.text(st.characters(categories=["Zs", "Cc", "Cf", "Cn", "Cs"]))
)
def test_any_text_is_accepted_or_refused_with_reason_and_message(text: str) -> None:
    refusal = bad_text(text, 50)
    if refusal is None:
        assert 0 < len(text) <= 50
        assert "\0" not in text
        assert text.strip()
        text.encode()
    else:
        reason, message = refusal
        assert reason in {"invalid_text", "text_too_long"}
        assert message
        message.encode()
