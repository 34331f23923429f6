"""The comparison of recorded sound accepts only the right sentence."""

from __future__ import annotations

import subprocess
import wave
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.conformance import stopped
from tests.conformance.hearing import LONG, QUICK
from tests.conformance.hearing import LOW as BATTERY
from tests.support.compare import (
    assert_heard,
    assert_only_beginning,
    assert_resumed,
    assert_silent,
    compare,
    extent,
    similarity,
)
from tests.support.reference import RATE, Sentence, render
from tests.support.surroundings import needs
from tests.tools.soak_clients import MIN_SIMILARITY

if TYPE_CHECKING:
    import pathlib

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]

LOW = "The battery is low, please charge me."
LOW_IT = "The battery is low, please charge it."
LEFT = "Please move the arm to the left."
RIGHT = "Please move the arm to the right."


def zeros(count: int) -> Samples:
    return np.zeros(count, np.int16)


SILENCE, PAUSE = zeros(RATE // 4), zeros(2 * RATE)


def recorded(*parts: Samples) -> Samples:
    return np.concatenate([SILENCE, *parts, SILENCE])


def without_end(samples: Samples, seconds: float) -> Samples:
    _, end = extent(samples) or (0, 0)
    return np.concatenate([samples[: end - round(seconds * RATE)], zeros(round(seconds * RATE))])


@pytest.fixture(scope="module")
def low() -> Samples:
    return render([LOW])[0]


def test_the_reference_equals_the_output_of_espeak_ng_bit_for_bit(low: Samples, tmp_path: pathlib.Path) -> None:
    needs("espeak-ng")
    out = str(tmp_path / "out.wav")
    subprocess.run(["espeak-ng", "-s", "200", "-w", out, LOW], check=True, capture_output=True)
    with wave.open(out) as file:
        assert (file.getframerate(), file.getnchannels(), file.getsampwidth()) == (RATE, 1, 2)
        assert np.array_equal(low, np.frombuffer(file.readframes(file.getnframes()), dtype="<i2"))


def test_a_sentence_is_recognised_despite_gaps_and_lost_samples(low: Samples) -> None:
    """If a player runs dry, it inserts silence, and the monitor loses some samples."""
    (result,) = assert_heard(recorded(low), [low])
    assert result.correlation > 0.999
    assert result.heard == result.expected
    heard = [low, (low // 2).astype(np.int16), np.delete(low, slice(9000, 9041)), np.delete(low, slice(9000, 9072))]
    for at, lost in ((9000, 0), (9000, 41), (27000, 0), (27000, 41)):
        first_part = np.concatenate([low[:at], zeros(1500), low[at + lost : at + 6000], zeros(700)])
        heard.append(np.concatenate([first_part, low[at + 6000 :]]))
        for wrong in (low[at + 9000 :], low[at + 5000 :]):
            with pytest.raises(AssertionError):
                assert_heard(recorded(first_part, wrong), [low])
    for samples in heard:
        assert compare(recorded(samples), low).same
        assert_heard(recorded(samples), [low])
    assert_heard(recorded(heard[-1], SILENCE, low), [low, low])


def test_a_wrong_sentence_is_detected(low: Samples) -> None:
    left, right, low_it = render([LEFT])[0], render([RIGHT])[0], render([LOW_IT])[0]
    cut = [without_end(low, seconds) for seconds in (0.03, 0.1, 0.3)]
    stutter = np.concatenate([low[:12000], low[11000:]])
    gap = np.concatenate([low[:9000], zeros(3000), low[12000:]])
    lost = np.delete(low, slice(9000, 9240))
    twice = np.delete(low, [*range(9000, 9072), *range(15000, 15072)])
    wrong = [(samples, low) for samples in (*cut, gap, stutter, lost, twice, low_it)]
    for heard, expected in [*wrong, (right, left)]:
        with pytest.raises(AssertionError, match="not heard correctly"):
            assert_heard(recorded(heard), [expected])
    for heard, expected in ((cut[0], low), (low_it, low), (right, left)):
        assert not compare(recorded(heard), expected).same
    dropped = np.concatenate([low[at : at + 2008] for at in range(0, len(low), 2048)])
    worn = np.concatenate([part for at in range(0, len(low), 2048) for part in (low[at : at + 1798], zeros(40))])
    for heard in (np.concatenate([low[:12000], zeros(3 * RATE), low[12000:]]), dropped, worn):
        with pytest.raises(AssertionError):
            assert_heard(recorded(heard), [low])


def test_silence_is_not_a_sentence_and_an_empty_recording_is_not_silence(low: Samples) -> None:
    assert compare(SILENCE, low).correlation == 0
    with pytest.raises(AssertionError, match="was not heard"):
        assert_heard(SILENCE, [low])
    assert_silent(SILENCE)
    with pytest.raises(AssertionError, match="nothing was recorded"):
        assert_silent(SILENCE[:0])


def test_sentences_must_be_heard_once_and_in_order(low: Samples) -> None:
    with pytest.raises(AssertionError, match="more was heard"):
        assert_heard(recorded(low, low), [low])
    with pytest.raises(AssertionError, match="not heard correctly"):
        assert_heard(recorded(*render([LOW, LOW])), render([LOW, LEFT]))
    first, second, third = references = render([LOW, LEFT, LOW_IT])
    assert_heard(recorded(*references), references)
    _, end = extent(first) or (0, 0)
    assert_heard(recorded(first[: end + 100], second, SILENCE, third), references)  # the pause at the end may be cut
    click = np.full(40, 5000, np.int16)
    for wrong in [
        *((second, first, third), (first, third), (first, second), (first, second, third, third)),
        (first, SILENCE, click, SILENCE, second, third),
    ]:
        with pytest.raises(AssertionError):
            assert_heard(recorded(*wrong), references)


def test_a_sentence_is_found_directly_after_a_stopped_one() -> None:
    (beginning,) = render([LONG], rate=QUICK)
    first, _ = extent(beginning) or (0, 0)
    (following,) = stopped._render_after_stop((LONG, BATTERY), QUICK)[11]
    behind, last = extent(following) or (0, 0)
    heard = recorded(beginning[first : first + 4000], zeros(63), following[behind:last])
    stopped.assert_heard_after_stop(heard, LONG, [BATTERY])
    with pytest.raises(AssertionError):
        stopped.assert_heard_after_stop(np.delete(heard, slice(len(heard) // 2, -RATE // 4)), LONG, [BATTERY])


@pytest.mark.parametrize("dry", [None, 12000])
def test_a_stopped_or_paused_sentence_is_recognised_despite_a_gap(low: Samples, dry: int | None) -> None:
    (left,) = render([LEFT])
    gap, dry = zeros(900 if dry else 0), dry or 0
    first_part = np.concatenate([low[:dry], gap, low[dry:20000]])
    assert assert_only_beginning(recorded(first_part), low) == pytest.approx(20000 / RATE, abs=0.1)
    for wrong in ([low[:dry], gap, left[dry:20000]], [first_part, low[-20000:]]):
        with pytest.raises(AssertionError):
            assert_only_beginning(recorded(*wrong), low)
    with pytest.raises(AssertionError, match="nothing was heard"):
        assert_only_beginning(SILENCE, low)
    at = 16000 - len(gap)
    paused_s = assert_resumed(recorded(first_part[:16000], PAUSE, low[at:]), low, 1.9)
    assert paused_s == pytest.approx(2, abs=0.3)
    assert_resumed(recorded(first_part[:16000], PAUSE, low[at - 800 :]), low, 1.9, repeated=0.05)
    for pause, rest in (
        *((PAUSE, low[at + 900 :]), (PAUSE, low[at - 1100 :]), (PAUSE, low[:0]), (PAUSE[:RATE], low[at:])),
        *((low[:0], low[at:]), (PAUSE, without_end(low, 0.1)[at:])),
    ):
        with pytest.raises(AssertionError):
            assert_resumed(recorded(first_part[:16000], pause, rest), low, 1.9)


def test_similarity_distinguishes_sentences_whose_samples_vary() -> None:
    """One process speaks the sentence a fifth time, with a gap because the player ran dry."""
    low, left, right = (Sentence(text, rate=450) for text in (LOW, LEFT, RIGHT))
    first, *_, again = render([low, left, right, left, low])
    gap = zeros(RATE // 40)
    for at in (4_000, 13_000):
        assert similarity(recorded(again[:at], gap, again[at:]), first) > MIN_SIMILARITY
        assert similarity(recorded(first[:at], gap, first[at:]), first) > 0.8
        for other in render([left, right]):
            assert similarity(recorded(other[:at], gap, other[at:]), first) < MIN_SIMILARITY
    assert similarity(SILENCE, first) == 0.0
