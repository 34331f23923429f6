"""Tests for the words that are found in libespeak-ng's events, and for the clock that computes when they are heard."""

from __future__ import annotations

import ctypes
import itertools
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.engine.child.synthesizers import espeak
from talkcli.engine.child.words import TimedWord, WordClock, WordFinder, count_letters
from talkcli.polling import NEVER
from tests.support.reference import Sentence, render_with_words

if TYPE_CHECKING:
    from collections.abc import Iterable


def on_32_bits(kind: type) -> type:
    """Return a C type with the layout of a 32-bit system, which has pointers of 4 bytes."""
    if not issubclass(kind, (ctypes.Structure, ctypes.Union)):
        return ctypes.c_uint32 if kind in (ctypes.c_char_p, ctypes.c_void_p) else kind
    fields = [(each[0], on_32_bits(each[1])) for each in kind._fields_]
    return type(kind.__name__, kind.__bases__, {"_fields_": fields})


def test_an_event_has_the_size_of_the_librarys_with_pointers_of_4_and_8_bytes() -> None:
    """Compare with espeak_EVENT in speak_lib.h. If ours is shorter, all but the first word of a callback are lost."""
    sizes = [ctypes.sizeof(each) for each in (on_32_bits(espeak._EspeakEvent), espeak._EspeakEvent)]
    assert sizes == [36, 40 if ctypes.sizeof(ctypes.c_void_p) == 8 else 36]


def reported(text: str, places: Iterable[tuple[int, int]]) -> list[str]:
    words = WordFinder(text)
    found = [each for each in (words.find(start, length) for start, length in places) if each is not None]
    assert [number for _, _, number in found] == list(range(1, len(found) + 1))
    assert all(end <= start for (_, end, _), (start, _, _) in itertools.pairwise(found))
    return [text[start:end] for start, end, _ in found]


#: Languages, sentences, and the words that are reported for them.
SENTENCES = [
    ("gmw/en", "battery low, please!", "battery low please"),
    ("gmw/en", "is in the kitchen", "is in kitchen"),
    ("gmw/en", "I go. this one is. the box. of the man. end", "I go this is the box of man end"),
    ("gmw/en", "it's don’t they're", "it's don’t they're"),
    ("gmw/en", "well-known e-mail, state-of-the-art", "well-known e-mail state-of-the-art"),
    ("gmw/en", "3.14 1,000 10:30 12345 50% 2-3 next", "3.14 1,000 10 30 12345 50 % 2 - 3 next"),
    ("gmw/en", "in the U.S.A. today", "in U.S.A today"),
    ("gmw/en", "café 日本 é 😀 now 😀. then 😀", "café 日本 é 😀 now 😀 then 😀"),
    ("gmw/en", "foo_bar foo/bar fooBar v1.2", "foo _bar foo / bar foo Bar v 1.2"),
    ("gmw/en", "привет мир", "привет мир"),
    ("gmw/en", "one\ttwo\n three\n\nfour", "one two three four"),
    ("gmw/en", "say «hello» now", "say hello now"),
    ("gmw/en", "„Hallo“ and “the old man’s” sea", "Hallo and the old man’s sea"),
    ("gmw/en", "a «it's» or «U.S.A.» b — c x—y", "a it's or U.S.A b c x y"),
    ("roa/fr", "l'homme est là", "l'homme est là"),
    ("roa/it", "dell'acqua c'è", "dell'acqua c'è"),
    ("sit/cmn", "世界、人", "世 界 人"),
    ("sit/cmn", "「世界」人", "世 界 人"),
    ("zle/ru", "«привет мир» да", "привет мир да"),
    ("inc/hi", "«मैं जा» रहा", "मैं जा रहा"),
]


@pytest.mark.parametrize("number", range(len(SENTENCES)))
def test_the_words_of_a_sentence_are_those_that_libespeak_itself_tells(number: int) -> None:
    """All are rendered in one process, whose words are the same each time."""
    _, text, words = SENTENCES[number]
    rendering = render_with_words([Sentence(text, voice=voice) for voice, text, _ in SENTENCES])[number]
    places = ((start, end - start or count_letters(text, start)) for start, end, _ in rendering.words)
    assert reported(text, [(start, length) for start, length in places if length > 0]) == words.split()


def test_a_word_without_a_length_goes_as_far_as_its_letters() -> None:
    assert [count_letters("«né» 日本e\u0301", place) for place in range(-1, 11)] == [0, 0, 2, 1, 0, 0, 4, 3, 2, 1, 0, 0]


def test_a_place_that_is_repeated_behind_or_outside_is_none() -> None:
    text = "this one é 日本 😀 ! battery"
    places = [(0, 4), (0, 4), (5, 0), (9, 1), (-1, 0), (-1, 5), (11, 2), (11, 2), (3, 2), (13, 1), (14, 1), (18, 99)]
    assert reported(text, places) == ["this", "é", "日本", "😀", "battery"]
    assert reported("a", [(5, 3), (1, 1), (0, 50)]) == ["a"]


@given(st.text(max_size=40), st.lists(st.tuples(st.integers(-3, 45), st.integers(-1, 10)), max_size=30))
def test_words_go_forward_within_the_text_whatever_is_reported(text: str, places: list[tuple[int, int]]) -> None:
    words = WordFinder(text)
    end = 0
    for location, length in places:
        found = words.find(location, length)
        if found is not None:
            before, (start, end, _) = end, found
            assert before <= start < end <= len(text)
            assert text[start:end].split() == [text[start:end]]


# -- the word clock


def test_the_clock_stands_until_it_is_started_and_is_held_back_by_the_player() -> None:
    clock = WordClock()
    first, second = TimedWord(0, 1, 0.0), TimedWord(2, 1, 0.5)
    clock.add(first)
    clock.add(second)
    assert clock.pop_started(100.0) == []
    assert clock.next_word_at() == NEVER
    clock.start(100.0)
    assert clock.pop_started(100.0) == [first]
    assert clock.next_word_at() == 100.5
    clock.limit_elapsed(100.4, 0.1)
    assert clock.elapsed(100.4) == pytest.approx(0.1)
    assert clock.pop_started(100.6) == []
    assert clock.next_word_at() == pytest.approx(100.8)
    clock.limit_elapsed(100.5, 10.0)
    assert clock.next_word_at() == pytest.approx(100.8)
    assert clock.pop_all() == [second]
    assert clock.pop_started(200.0) == []


def test_silence_in_the_stream_moves_the_words_after_it_and_is_not_heard() -> None:
    clock = WordClock()
    before, at, after = TimedWord(0, 1, 0.4), TimedWord(2, 1, 0.5), TimedWord(4, 1, 1.0)
    clock.reset(0.0)
    clock.add_silence(0.0, 0.25)
    clock.start(100.0)
    clock.add(before)
    clock.add(at)
    assert clock.heard_position(100.125) == 0.0
    assert clock.heard_position(100.5) == 0.25
    assert clock.next_word_at() == pytest.approx(100.65)
    clock.add_silence(0.5, 1.0)
    clock.add_silence(0.5, 1.0)
    clock.add(after)
    assert clock.next_word_at() == pytest.approx(100.65)
    assert clock.pop_started(102.5) == [before]
    assert clock.heard_position(102.5) == 0.5
    assert clock.next_word_at() == pytest.approx(102.75)
    assert clock.pop_started(102.76) == [at]
    assert clock.heard_position(103.0) == pytest.approx(0.75)
    assert clock.next_word_at() == pytest.approx(103.25)


def test_another_stream_begins_where_the_audio_goes_on() -> None:
    clock = WordClock()
    missed, word = TimedWord(0, 1, 1.0), TimedWord(2, 1, 2.5)
    clock.start(100.0)
    clock.add_silence(0.5, 3.0)
    clock.reset(2.0)
    clock.add(missed)
    clock.add(word)
    assert clock.next_word_at() == NEVER
    assert clock.heard_position(200.0) == 2.0
    clock.add_silence(2.0, 0.25)
    clock.start(200.0)
    assert clock.pop_started(200.0) == [missed]
    assert clock.next_word_at() == pytest.approx(200.75)
    assert clock.heard_position(200.5) == pytest.approx(2.25)


def test_the_outputs_own_clock_stands_until_something_is_heard() -> None:
    clock = WordClock()
    clock.add(TimedWord(0, 1, 0.5))
    clock.start(100.0)
    clock.set_elapsed(100.2, 0.0)
    assert (clock.elapsed(100.2), clock.next_word_at()) == (0.0, NEVER)
    clock.set_elapsed(100.4, 0.1)
    assert clock.elapsed(100.4) == pytest.approx(0.1)
    assert clock.next_word_at() == pytest.approx(100.8)


def test_words_in_zeros_that_are_left_out_begin_with_the_sound() -> None:
    clock = WordClock()
    for position in (0.0, 0.2):
        clock.add(TimedWord(0, 1, position))
    clock.skip_until(0.1)
    assert [each.position for each in clock.pop_all()] == [0.1, 0.2]
