"""Characters that the guard replaces for libespeak-ng, and texts that it leaves unchanged."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.engine.child.synthesizers.guard import guarded

#: Ordinary texts. Each contains something that resembles a case of a rule.
ORDINARY = (
    "It's 10:30 on 2024-05-01; the U.S.A. and e.g. Mr. Smith's well-known e-mail: a.b@example.org.",
    "A. B. C. D. E. F. G. H. I. J. K. L. M. N. O. P. Q. R. S. T. U. V. W. X. Y. Z. 1. 2. 3. 4. 5. 6. 7. 8. 9. 10.",
    "А. Б. В. Г. Д. Е. Ё. Ж. З. И. Й. К. Л. М. Н. О. П. Р. С. Т. У. Ф. Х. Ц. Ч. Ш. Щ. Ъ. Ы. Ь. Э. Ю. Я.",
    "The address is https://www.example.org/a/b.c.d?e=f-g&h=1.2.3 or 192.168.1.10, version 1.2.3-rc.4.",
    "Pre- and post-war; the '-ing' form; U.S.-based, z. B.-Regel; x (-er) words; minus -5 - yes -- no.",
    "Donaudampfschifffahrtselektrizitätenhauptbetriebswerkbauunterbeamtengesellschaft",
    "Taumatawhakatangihangakoauauotamateaturipukakapikimaungahoronukupokaiwhenuakitanatahu",
    "L’homme « très bien » n'est-ce pas ? Dell'acqua c'è… ¿Qué? ¡Ay! “Old man’s” sea\tthen\nmore\r\n\r\nend",
    "बैटरी कम है, मैं वापस जा रहा हूँ। البطارية منخفضة، הסוללה חלשה. 电池电量低。バッテリー残量、배터리가 부족합니다.",
    "แบตเตอรี่อ่อน กำลังกลับฐาน e\u0301 n\u0303 👩‍🚀 🏳️‍🌈 ½ m² №5 50% €5 a_b foo/bar fooBar C++ #1 @x {y} [z] <w>",
    "one " * 2000 + "U.S.A.",
    "他说‘电池电量低正在返回充电站请您稍等一下我马上就回来了因为电池电量低正在返回充电站请您稍等一下我马上就回来’了",
)


@pytest.mark.parametrize("text", ORDINARY)
def test_ordinary_text_is_unchanged(text: str) -> None:
    assert guarded(text) == text


@pytest.mark.parametrize("code", [*range(1, 9), 0x0B, 0x0C, *range(0x0E, 0x20), 0x7F, 0x80, 0x85, 0x9F, 0xFFFD])
def test_a_control_or_replacement_character_becomes_a_blank(code: int) -> None:
    assert guarded(f"a{chr(code)}5Sb") == "a 5Sb"


def test_long_runs_of_dotted_letters_are_split() -> None:
    assert guarded("a." * 85) == "a." * 38 + "a " + "a." * 38 + "a " + "a." * 7
    assert guarded("e.g. " * 60).count("e.g. ") < 60
    assert guarded("http://" + "x." * 100).startswith("http://" + "x." * 38 + "x x.")
    for motif in ("я. ", "A.,B.;", "a..b..", "'a'.'b'.", "\u0301.\u0302.", "०.१.", "a.՞b.°", "Ⓐ.Ⓑ."):
        text = motif * 60
        changed = guarded(text)
        assert changed != text
        assert changed.replace(" ", "").replace(".", "") == text.replace(" ", "").replace(".", "")


def test_a_long_word_after_dotted_letters_is_separated_from_them() -> None:
    assert guarded("a.b." + "1" * 170) == "a.b " + "1" * 170
    assert guarded("I." + "'s" * 90).startswith("I 's's")
    assert guarded("a." + "한" * 20) == "a " + "한" * 20  # the library splits these into letters
    assert guarded("a." + "b" * 70) == "a." + "b" * 70


def test_dotted_letters_after_very_many_words_of_a_clause_are_split() -> None:
    assert guarded("a " * 225 + "U.S.A.") == "a " * 225 + "U S A."
    assert guarded("a " * 225 + "b. u.s.a.") == "a " * 225 + "b  u s a."
    assert guarded("a " * 225 + "b. U.S.A.") == "a " * 225 + "b. U.S.A."
    assert guarded("a " * 225 + "b, U.S.A.") == "a " * 225 + "b, U.S.A."


@pytest.mark.parametrize("sign", ["'", "(", ".", "…", "€", "№", "_", "--", "' '"])
def test_a_hyphen_after_a_sign_at_the_start_of_a_clause_becomes_a_blank(sign: str) -> None:
    assert guarded(f"{sign}-o") == f"{sign} o"
    assert guarded(f"yes, {sign}-o") == f"yes, {sign} o"
    assert guarded(f"yes! {sign}-ს") == f"yes! {sign} ს"
    assert guarded(f"yes {sign}-o") == f"yes {sign}-o"
    assert guarded(f"yes {sign} -o") == f"yes {sign} -o"


def test_a_very_long_word_is_split_without_losing_letters() -> None:
    for text in ("a" * 163 + "ing", "A" * 400, "é" * 200, "я" * 300):
        changed = guarded(text)
        assert changed != text
        assert changed.lower() == text.lower()
        parts = [word for word in _words(changed) if word]
        assert max(len(part.encode()) for part in parts) <= 160, parts
    # without capitals or words, no split is possible, and no crash was observed
    for text in ("अ" * 100, "中" * 100, "1" * 400):
        assert guarded(text) == text
    assert guarded("x" + "'s" * 70) == "x" + "'s" * 30 + " s" + "'s" * 30 + " s" + "'s" * 8


@given(st.text(st.characters() | st.sampled_from("a.- 'é\n\ud800"), max_size=300))
def test_any_text_keeps_its_length_and_a_second_pass_changes_nothing(text: str) -> None:
    changed = guarded(text)
    assert len(changed) == len(text)
    assert guarded(changed) == changed


@pytest.mark.parametrize("motif", ["a.", "a. ", "-'", "'-o", "... ", "a", "é", ".-", "한.", "\u0301", "\n"])
def test_the_longest_text_takes_less_than_half_a_second(motif: str) -> None:
    text = (motif * 10_000)[:10_000]
    guarded(text)
    started_at = time.thread_time()
    guarded(text)
    assert time.thread_time() - started_at < 0.5


def _words(text: str) -> list[str]:
    """Split a text as the library does: before a capital that follows a small letter."""
    words = [""]
    for before, here in zip(" " + text, text, strict=False):
        if before.islower() and here.isupper():
            words.append("")
        words[-1] += here
    return words


#: A voice, the characters that would crash it, and characters of its own and other languages that it can speak.
CRASHING = (
    ("gmw/en", "৩ ೬ ॰ ൟ ಌ ᇃ ᆀ ჻ ֏ \u0387", "ক ಕ क ക ᄀ 가 გ հ α", "٣ १ ๓ ՞ · 3"),
    ("inc/bn", "൧ ॰", "৩ ৳ ক", "१"),
    ("inc/pa", "৩", "੩ ૩", "१"),
    ("dra/ml+f3", "৩", "ൟ ൧ ൔ", ""),
    ("ko", "৩", "ᇃ ᆀ", ""),
    ("grk/el", "৩", "\u0387 \u0384", "·"),
    ("", "৩ ᇃ", "ক", ""),
)


@pytest.mark.parametrize(("voice", "blanked", "own", "others"), CRASHING)
def test_a_crashing_character_is_kept_only_for_voices_of_its_language(
    voice: str, blanked: str, own: str, others: str
) -> None:
    for character in blanked.split():
        assert guarded(f"one{character}two {character}", voice) == "one two  ", character
    assert guarded(f"{own} {others} low", voice) == f"{own} {others} low"


@pytest.mark.parametrize(
    ("voice", "text", "expected"),
    [
        ("sit/yue", "1234567890123 1,111,111,111,111", "123456⁷890123 1,111,11¹,111,111"),
        ("tai/shn+f2", "12345678901234.5", "1234567⁸901234.5"),
        ("sit/yue-Latn-jyutping", "123456789012 123456789012345 room 7", "123456789012 123456789012345 room 7"),
        ("sit/cmn", "1234567890123", "1234567890123"),
    ],
)
def test_a_number_of_a_crashing_length_is_split_only_for_some_voices(voice: str, text: str, expected: str) -> None:
    assert guarded(text, voice) == expected
    assert guarded(expected, voice) == expected
