"""A sentence is cut to the width of the terminal while a word of it is lit, whatever its characters are."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from talkcli.terminal.text import MORE, Sentence, printable, width

LONG = "the quick brown fox jumps over the lazy dog"
#: Characters whose widths are hard to tell: wide, combining, joined or escaped.
ODD = st.text(st.sampled_from("ab .日本é\u0301👩\u200d💻❤\ufe0f🇩🇪\n\x1b\\\u202eﷺ"), max_size=80)


def word(text: str, view: str) -> tuple[int, int]:
    start = text.index(view)
    return start, start + len(view)


def test_a_sentence_that_fits_is_shown_whole() -> None:
    assert Sentence("battery low").view(8, 11, 11) == ("battery ", "low", "")
    assert Sentence("battery low").view(0, 7, 80) == ("", "battery", " low")
    assert Sentence("").view(0, 0, 80) == ("", "", "")


def test_a_long_text_is_cut_around_the_word() -> None:
    sentence = Sentence(LONG)
    assert sentence.view(*word(LONG, "the"), 20) == ("", "the", f" quick brown fox{MORE}")
    assert sentence.view(*word(LONG, "jumps"), 20) == (f"{MORE} fox ", "jumps", f" over th{MORE}")
    assert sentence.view(*word(LONG, "dog"), 20) == (f"{MORE}s over the lazy ", "dog", "")


def test_a_word_wider_than_the_terminal_shows_its_beginning() -> None:
    heard, lit, ahead = Sentence("a" * 50 + " " + "b" * 50).view(51, 101, 12)
    assert lit.startswith("bbb")
    assert ahead == MORE
    assert width(heard + lit + ahead) <= 12


def test_wide_characters_take_two_columns() -> None:
    assert [width(each) for each in ("a", "日", "ｱ", "Ａ", "👩", "e\u0301", "…")] == [1, 2, 1, 2, 2, 1, 1]
    assert width("❤\ufe0f") == width("🇩🇪") / 2 == 2  # drawn by some terminals in fewer, by none in more
    heard, lit, ahead = Sentence("日本語" * 10).view(12, 15, 11)
    assert width(heard + lit + ahead) <= 11
    assert lit == "日本語"


def test_control_and_bidi_characters_are_shown_escaped_and_still_lit_in_place() -> None:
    text = "a\x1b[31m \u202ered\nnext"
    assert Sentence(text).view(*word(text, "next"), 80)[:2] == ("a\\x1b[31m \\u202ered\\n", "next")


@given(text=ODD, start=st.integers(-3, 90), length=st.integers(-3, 30), columns=st.integers(-2, 60))
def test_never_wider_than_the_terminal_and_never_anything_raw(text: str, start: int, length: int, columns: int) -> None:
    sentence = Sentence(text)
    assert sentence.whole == printable(text)
    heard, lit, ahead = sentence.view(start, start + length, columns)
    shown = heard + lit + ahead
    assert width(shown) <= max(0, columns)
    assert shown.isprintable() or all(each.isprintable() or each in "\u0301\ufe0f" for each in shown)
    if width(sentence.whole) <= columns:
        assert shown == sentence.whole
    elif columns >= 15 and 0 <= start < len(text) and length > 0:
        assert lit
        assert shown.removeprefix(MORE).removesuffix(MORE) in sentence.whole


def test_a_sentence_is_split_after_the_words_that_were_heard() -> None:
    for heard in (0, 3, 7, 11, 99):
        assert Sentence("battery low").split(heard) == ("battery low"[:heard], "battery low"[heard:])
