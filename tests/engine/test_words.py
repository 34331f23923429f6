"""The words of a text as libespeak-ng tells them: each once, forward, with its own place."""

from __future__ import annotations

import ctypes
import itertools
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.engine.synthesizers import espeak
from talkcli.engine.words import Words, letters
from tests.support.reference import Sentence, render_with_words

if TYPE_CHECKING:
    from collections.abc import Iterable


def on_32_bits(kind: type) -> type:
    """Return a C type as a 32-bit system lays it out, where a pointer has 4 bytes."""
    if not issubclass(kind, (ctypes.Structure, ctypes.Union)):
        return ctypes.c_uint32 if kind in (ctypes.c_char_p, ctypes.c_void_p) else kind
    fields = [(each[0], on_32_bits(each[1])) for each in kind._fields_]
    return type(kind.__name__, kind.__bases__, {"_fields_": fields})


def test_an_event_has_the_size_of_the_librarys_with_pointers_of_4_and_8_bytes() -> None:
    """The sizes of espeak_EVENT in speak_lib.h. If ours is shorter, all words but the first of a callback are lost."""
    sizes = [ctypes.sizeof(each) for each in (on_32_bits(espeak._EspeakEvent), espeak._EspeakEvent)]
    assert sizes == [36, 40 if ctypes.sizeof(ctypes.c_void_p) == 8 else 36]


def reported(text: str, places: Iterable[tuple[int, int]]) -> list[str]:
    words = Words(text)
    found = [each for each in (words.next(start, length) for start, length in places) if each is not None]
    assert [number for _, _, number in found] == list(range(1, len(found) + 1))
    assert all(end <= start for (_, end, _), (start, _, _) in itertools.pairwise(found))
    return [text[start:end] for start, end, _ in found]


def spoken(text: str, voice: str = "gmw/en") -> list[str]:
    """Return the words of what libespeak-ng itself tells."""
    (rendering,) = render_with_words([Sentence(text, voice=voice)])
    places = ((start, end - start or letters(text, start)) for start, end, _ in rendering.words)
    return reported(text, [(start, length) for start, length in places if length > 0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("battery low, please!", "battery low please"),
        ("is in the kitchen", "is in kitchen"),
        ("I go. this one is. the box. of the man. end", "I go this is the box of man end"),
        ("it's don’t they're", "it's don’t they're"),
        ("well-known e-mail, state-of-the-art", "well-known e-mail state-of-the-art"),
        ("3.14 1,000 10:30 12345 50% 2-3 next", "3.14 1,000 10 30 12345 50 % 2 - 3 next"),
        ("in the U.S.A. today", "in U.S.A today"),
        ("café 日本 é 😀 now 😀. then 😀", "café 日本 é 😀 now 😀 then 😀"),
        ("foo_bar foo/bar fooBar v1.2", "foo _bar foo / bar foo Bar v 1.2"),
        ("привет мир", "привет мир"),
        ("one\ttwo\n three\n\nfour", "one two three four"),
        ("say «hello» now", "say hello now"),
        ("„Hallo“ and “the old man’s” sea", "Hallo and the old man’s sea"),
        ("a «it's» or «U.S.A.» b — c x—y", "a it's or U.S.A b c x y"),
    ],
)
def test_the_words_of_a_sentence(text: str, words: str) -> None:
    assert spoken(text) == words.split()


def test_the_words_of_other_languages() -> None:
    assert spoken("l'homme est là", "roa/fr") == ["l'homme", "est", "là"]
    assert spoken("dell'acqua c'è", "roa/it") == ["dell'acqua", "c'è"]
    assert spoken("世界、人", "sit/cmn") == ["世", "界", "人"]
    assert spoken("「世界」人", "sit/cmn") == ["世", "界", "人"]
    assert spoken("«привет мир» да", "zle/ru") == ["привет", "мир", "да"]
    assert spoken("«मैं जा» रहा", "inc/hi") == ["मैं", "जा", "रहा"]


def test_a_word_without_a_length_goes_as_far_as_its_letters() -> None:
    assert [letters("«né» 日本e\u0301", place) for place in range(-1, 11)] == [0, 0, 2, 1, 0, 0, 4, 3, 2, 1, 0, 0]


def test_what_is_repeated_behind_or_outside_is_none() -> None:
    text = "this one é 日本 😀 ! battery"
    places = [(0, 4), (0, 4), (5, 0), (9, 1), (-1, 0), (-1, 5), (11, 2), (11, 2), (3, 2), (13, 1), (14, 1), (18, 99)]
    assert reported(text, places) == ["this", "é", "日本", "😀", "battery"]
    assert reported("a", [(5, 3), (1, 1), (0, 50)]) == ["a"]


@given(st.text(max_size=40), st.lists(st.tuples(st.integers(-3, 45), st.integers(-1, 10)), max_size=30))
def test_whatever_is_reported_words_go_forward_within_the_text(text: str, places: list[tuple[int, int]]) -> None:
    words = Words(text)
    end = 0
    for location, length in places:
        found = words.next(location, length)
        if found is not None:
            before, (start, end, _) = end, found
            assert before <= start < end <= len(text)
            assert text[start:end].split() == [text[start:end]]


def test_words_only_move_forward() -> None:
    words = Words("this one é 日本 😀 ! battery")
    reported = [(0, 4), (0, 4), (5, 0), (9, 1), (-1, 0), (11, 2), (11, 2), (3, 2), (13, 1), (14, 1), (16, 11), (18, 7)]
    found = [words.next(*place) for place in reported]
    assert [word for word in found if word] == [
        (0, 4, 1),
        (9, 10, 2),
        (11, 13, 3),
        (14, 15, 4),
        (16, 17, 5),
        (18, 25, 6),
    ]


def test_a_word_beyond_the_text_is_none() -> None:
    words = Words("a")
    assert words.next(5, 3) is None
    assert words.next(0, 50) is not None
