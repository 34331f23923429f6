"""The benchmark's arithmetic, on numbers and on synthetic sound where what must come out is known."""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.bench.arithmetic import (
    beyond_own_pause,
    edges,
    first_sound,
    last_sound,
    median,
    percentile,
    ratio,
    silences,
)
from tests.support.recording import LOUD

if TYPE_CHECKING:
    from tests.bench.arithmetic import Samples


def sound(*parts: tuple[int, int]) -> Samples:
    """Return samples: each part is so many of an amplitude, with changing sign."""
    pieces = [amplitude * np.resize([1, -1], length) for length, amplitude in parts]
    samples: Samples = np.concatenate(pieces).astype(np.int16)
    return samples


@pytest.mark.parametrize(
    ("values", "part", "expected"),
    [
        ([7.0], 99, 7.0),
        ([3, 1, 2], 99, 3),
        ([3, 1, 2], 50, 2),
        (range(1, 101), 99, 99),
        (range(1, 201), 99, 198),
        (range(1, 101), 100, 100),
        (range(1, 101), 0, 1),
    ],
)
def test_a_percentile_is_a_value_that_was_measured(values: list[float], part: float, expected: float) -> None:
    shuffled = list(values)
    random.Random(1).shuffle(shuffled)
    assert percentile(shuffled, part) == expected


def test_the_median_of_two_is_between_them() -> None:
    assert median([4, 1]) == 2.5
    assert median([9, 1, 2]) == 2


def test_the_ratio_to_nothing_is_infinite() -> None:
    assert ratio(3, 2) == 1.5
    assert ratio(3, 0) == math.inf


def test_sound_begins_and_ends_with_samples_above_the_level_of_either_sign() -> None:
    samples = sound((100, 0), (10, LOUD), (1, -(LOUD + 1)), (50, 9000), (1, LOUD + 1), (30, LOUD), (20, 0))
    assert (first_sound(samples), last_sound(samples)) == (110, 161)
    assert (first_sound(samples, 0), last_sound(samples, 0)) == (100, 191)
    assert edges(samples) == (110, 50)


def test_the_lowest_sample_of_16_bits_is_loud() -> None:
    samples = np.array([0, -32768, 0], np.int16)
    assert (first_sound(samples), last_sound(samples)) == (1, 1)


def test_in_silence_there_is_no_sound() -> None:
    silence = sound((100, LOUD))
    assert first_sound(silence) is last_sound(silence) is None
    assert silences(silence, 1) == []
    with pytest.raises(ValueError, match="no sound"):
        edges(silence)


def test_silences_are_between_sounds_and_long_enough() -> None:
    samples = sound((40, 0), (30, 900), (5, 0), (30, 900), (6, LOUD), (30, 900), (60, 0))
    assert silences(samples, 5) == [(70, 75), (105, 111)]
    assert silences(samples, 6) == [(105, 111)]
    assert silences(samples, 5, 0) == [(70, 75)]


def test_a_gap_counts_above_the_pause_that_the_sentences_make_themselves() -> None:
    sentences = [sound((5, 0), (100, 900), (40, 3)), sound((10, 0), (80, 900), (30, 0)), sound((90, 900), (20, 0))]
    heard = np.concatenate([sound((77, 0)), sentences[0], sound((12, 0)), sentences[1], sentences[2], sound((500, 0))])
    assert beyond_own_pause(heard, sentences, 25) == [12, 0]


def test_a_pause_that_was_cut_counts_below_nothing() -> None:
    first, second = sound((100, 900), (60, 0)), sound((100, 900), (60, 0))
    heard = np.concatenate([first[:-20], second])
    assert beyond_own_pause(heard, [first, second], 30) == [-20]


def test_a_sentence_that_was_not_heard_gives_no_gap() -> None:
    sentence = sound((100, 900), (60, 0))
    with pytest.raises(ValueError, match="1 sentences are heard, 2 were said"):
        beyond_own_pause(sentence, [sentence, sentence], 30)
