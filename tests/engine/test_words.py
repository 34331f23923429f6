"""Tests for finding words in libespeak-ng's events, and for the clock that computes when they are heard."""

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
    """Return a C type with the layout of a 32-bit system, whose pointers have 4 bytes."""
    if not issubclass(kind, (ctypes.Structure, ctypes.Union)):
        return ctypes.c_uint32 if kind in (ctypes.c_char_p, ctypes.c_void_p) else kind
    fields = [(field[0], on_32_bits(field[1])) for field in kind._fields_]
    return type(kind.__name__, kind.__bases__, {"_fields_": fields})


def test_an_event_has_the_librarys_size_with_4_and_8_byte_pointers() -> None:
    """If the size differed from that of espeak_EVENT, all but the first word of a callback would be lost."""
    sizes = [ctypes.sizeof(kind) for kind in (on_32_bits(espeak._EspeakEvent), espeak._EspeakEvent)]
    assert sizes == [36, 40 if ctypes.sizeof(ctypes.c_void_p) == 8 else 36]


def find_words(text: str, positions: Iterable[tuple[int, int]]) -> list[str]:
    """Return the words that are found for these positions and lengths."""
    finder = WordFinder(text)
    words = [word for word in (finder.find(start, length) for start, length in positions) if word is not None]
    assert [number for _, _, number in words] == list(range(1, len(words) + 1))
    assert all(end <= start for (_, end, _), (start, _, _) in itertools.pairwise(words))
    return [text[start:end] for start, end, _ in words]


#: Voices, sentences, and the words that are reported for them.
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
def test_the_words_of_a_sentence_are_found_in_libespeaks_events(number: int) -> None:
    """All sentences are rendered together by one process, and the result is cached."""
    _, text, words = SENTENCES[number]
    rendering = render_with_words([Sentence(text, voice=voice) for voice, text, _ in SENTENCES])[number]
    positions = ((start, end - start or count_letters(text, start)) for start, end, _ in rendering.words)
    assert find_words(text, [(start, length) for start, length in positions if length > 0]) == words.split()


def test_a_word_without_a_length_extends_over_its_letters() -> None:
    assert [count_letters("«né» 日本e\u0301", start) for start in range(-1, 11)] == [0, 0, 2, 1, 0, 0, 4, 3, 2, 1, 0, 0]


def test_repeated_backward_and_outside_positions_are_ignored() -> None:
    text = "this one é 日本 😀 ! battery"
    positions = [(0, 4), (0, 4), (5, 0), (9, 1), (-1, 0), (-1, 5), (11, 2), (11, 2), (3, 2), (13, 1), (14, 1), (18, 99)]
    assert find_words(text, positions) == ["this", "é", "日本", "😀", "battery"]
    assert find_words("a", [(5, 3), (1, 1), (0, 50)]) == ["a"]


@given(st.text(max_size=40), st.lists(st.tuples(st.integers(-3, 45), st.integers(-1, 10)), max_size=30))
def test_words_stay_in_order_and_inside_the_text_for_any_positions(text: str, positions: list[tuple[int, int]]) -> None:
    finder = WordFinder(text)
    end = 0
    for position, length in positions:
        word = finder.find(position, length)
        if word is not None:
            last_end, (start, end, _) = end, word
            assert last_end <= start < end <= len(text)
            assert text[start:end].split() == [text[start:end]]


# -- the word clock


def test_the_clock_waits_for_its_start_and_for_the_player() -> None:
    clock = WordClock()
    first, second = TimedWord(0, 1, 1, 0.0), TimedWord(2, 3, 2, 0.5)
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


def test_inserted_silence_delays_later_words_and_does_not_count_as_heard() -> None:
    clock = WordClock()
    before, at, after = TimedWord(0, 1, 1, 0.4), TimedWord(2, 3, 2, 0.5), TimedWord(4, 5, 3, 1.0)
    clock.reset(0.0)
    clock.add_silence(0.0, 0.25)
    clock.start(100.0)
    clock.add(before)
    clock.add(at)
    assert clock.heard_seconds(100.125) == 0.0
    assert clock.heard_seconds(100.5) == 0.25
    assert clock.next_word_at() == pytest.approx(100.65)
    clock.add_silence(0.5, 1.0)
    clock.add_silence(0.5, 1.0)
    clock.add(after)
    assert clock.next_word_at() == pytest.approx(100.65)
    assert clock.pop_started(102.5) == [before]
    assert clock.heard_seconds(102.5) == 0.5
    assert clock.next_word_at() == pytest.approx(102.75)
    assert clock.pop_started(102.76) == [at]
    assert clock.heard_seconds(103.0) == pytest.approx(0.75)
    assert clock.next_word_at() == pytest.approx(103.25)


def test_a_new_stream_starts_at_its_position_in_the_sentence() -> None:
    clock = WordClock()
    missed, word = TimedWord(0, 1, 1, 1.0), TimedWord(2, 3, 2, 2.5)
    clock.start(100.0)
    clock.add_silence(0.5, 3.0)
    clock.reset(2.0)
    clock.add(missed)
    clock.add(word)
    assert clock.next_word_at() == NEVER
    assert clock.heard_seconds(200.0) == 2.0
    clock.add_silence(2.0, 0.25)
    clock.start(200.0)
    assert clock.pop_started(200.0) == [missed]
    assert clock.next_word_at() == pytest.approx(200.75)
    assert clock.heard_seconds(200.5) == pytest.approx(2.25)


def test_the_outputs_clock_starts_with_the_first_sound() -> None:
    clock = WordClock()
    clock.add(TimedWord(0, 1, 1, 0.5))
    clock.start(100.0)
    clock.set_elapsed(100.2, 0.0)
    assert (clock.elapsed(100.2), clock.next_word_at()) == (0.0, NEVER)
    clock.set_elapsed(100.4, 0.1)
    assert clock.elapsed(100.4) == pytest.approx(0.1)
    assert clock.next_word_at() == pytest.approx(100.8)


def test_words_in_skipped_silence_start_with_the_sound() -> None:
    clock = WordClock()
    for position in (0.0, 0.2):
        clock.add(TimedWord(0, 1, 1, position))
    clock.delay_words_until(0.1)
    assert [word.position for word in clock.pop_all()] == [0.1, 0.2]
