"""The comparison of what was heard: it passes what is right, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.conformance import stopped
from tests.conformance.hearing import LONG, QUICK
from tests.conformance.hearing import LOW as BATTERY
from tests.faults.soak_clients import ALIKE
from tests.support.compare import (
    alike,
    assert_begun,
    assert_heard,
    assert_resumed,
    assert_silent,
    compare,
    extent,
)
from tests.support.recording import LOUD
from tests.support.reference import RATE, Sentence, render

if TYPE_CHECKING:
    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]

LOW = "The battery is low, please charge me."
LOW_IT = "The battery is low, please charge it."
LEFT = "Please move the arm to the left."
RIGHT = "Please move the arm to the right."
SILENCE = np.zeros(RATE // 4, np.int16)


def recorded(*parts: Samples) -> Samples:
    return np.concatenate([SILENCE, *parts, SILENCE])


def without_end(samples: Samples, seconds: float) -> Samples:
    found = extent(samples)
    assert found
    result: Samples = samples.copy()
    result[found[1] - round(seconds * RATE) :] = 0
    return result


@pytest.fixture(scope="module")
def low() -> Samples:
    return render([LOW])[0]


def test_the_right_sentence_is_recognised(low: Samples) -> None:
    (result,) = assert_heard(recorded(low), [low])
    assert result.correlation > 0.999
    assert result.heard == result.expected
    assert compare(recorded(low), low).same


def test_what_the_monitor_drops_is_forgiven(low: Samples) -> None:
    assert_heard(recorded(np.delete(low, slice(9000, 9041))), [low])


@pytest.mark.parametrize("at", [9000, 12000, 27000])
@pytest.mark.parametrize("lost", [0, 41])
def test_a_player_that_ran_dry_in_a_sentence_is_forgiven(low: Samples, at: int, lost: int) -> None:
    """What was put between two samples is silence, and no sample of the sentence is missing."""
    dry = np.concatenate([low[:at], np.zeros(1500, np.int16), low[at + lost : at + 6000], np.zeros(700, np.int16)])
    heard = recorded(dry, low[at + 6000 :])
    (result,) = assert_heard(heard, [low])
    assert result.correlation > 0.99
    assert compare(heard, low).same
    assert_heard(recorded(dry, low[at + 6000 :], SILENCE, low), [low, low])
    with pytest.raises(AssertionError):
        assert_heard(recorded(dry, low[at + 9000 :]), [low])
    with pytest.raises(AssertionError):
        assert_heard(recorded(dry, low[at + 5000 :]), [low])


def test_more_than_a_busy_machine_does_to_a_sentence_is_noticed(low: Samples) -> None:
    hole = np.zeros(3 * RATE, np.int16)
    dropped = np.concatenate([low[at : at + 2008] for at in range(0, len(low), 2048)])
    zeros = np.zeros(40, np.int16)
    worn = np.concatenate([part for at in range(0, len(low), 2048) for part in (low[at : at + 1798], zeros)])
    for heard in (np.concatenate([low[:12000], hole, low[12000:]]), dropped, worn):
        with pytest.raises(AssertionError):
            assert_heard(recorded(heard), [low])


def test_what_the_monitor_loses_without_a_sign_is_forgiven_once_and_no_more_than_it_does(low: Samples) -> None:
    def without(lost: int, *places: int) -> Samples:
        starts = [0, *(each + lost for each in places)]
        return np.concatenate([low[a:b] for a, b in zip(starts, [*places, len(low)], strict=True)])

    assert_heard(recorded(without(72, 9000)), [low])
    for heard in (without(240, 9000), without(72, 9000, 15000)):
        with pytest.raises(AssertionError, match="not heard as it should"):
            assert_heard(recorded(heard), [low])


def test_half_the_volume_is_the_same_sentence(low: Samples) -> None:
    assert_heard(recorded((low // 2).astype(np.int16)), [low])


@pytest.mark.parametrize("seconds", [0.03, 0.1, 0.3])
def test_a_cut_end_is_noticed(low: Samples, seconds: float) -> None:
    heard = recorded(without_end(low, seconds))
    assert not compare(heard, low).same
    with pytest.raises(AssertionError, match="not heard as it should"):
        assert_heard(heard, [low])


def test_a_gap_in_the_middle_is_noticed(low: Samples) -> None:
    gap = low.copy()
    gap[9000:12000] = 0
    with pytest.raises(AssertionError, match="not heard as it should"):
        assert_heard(recorded(gap), [low])


def test_a_stutter_is_noticed(low: Samples) -> None:
    with pytest.raises(AssertionError, match="not heard as it should"):
        assert_heard(recorded(low[:12000], low[11000:]), [low])


@pytest.mark.parametrize(("right", "wrong"), [(LOW, LOW_IT), (LEFT, RIGHT)])
def test_one_other_word_is_noticed(right: str, wrong: str) -> None:
    reference, heard = render([right])[0], recorded(render([wrong])[0])
    assert not compare(heard, reference).same
    with pytest.raises(AssertionError, match="not heard as it should"):
        assert_heard(heard, [reference])


def test_nothing_heard_is_noticed(low: Samples) -> None:
    assert compare(SILENCE, low).correlation == 0
    with pytest.raises(AssertionError, match="was not heard"):
        assert_heard(SILENCE, [low])
    assert_silent(SILENCE)


def test_silence_without_a_recording_is_no_silence() -> None:
    with pytest.raises(AssertionError, match="nothing was recorded"):
        assert_silent(SILENCE[:0])


def test_a_sentence_heard_twice_is_noticed(low: Samples) -> None:
    with pytest.raises(AssertionError, match="more was heard"):
        assert_heard(recorded(low, low), [low])
    with pytest.raises(AssertionError, match="not heard as it should"):
        assert_heard(recorded(*render([LOW, LOW])), render([LOW, LEFT]))


def test_sentences_are_recognised_in_order_and_only_so() -> None:
    first, second, third = references = render([LOW, LEFT, LOW_IT])
    assert_heard(recorded(*references), references)
    # A pause that ends a sentence may be cut, nothing else.
    found = extent(first)
    assert found
    assert_heard(recorded(first[: found[1] + 100], second, SILENCE, third), references)
    for wrong in [(second, first, third), (first, third), (first, second), (first, second, third, third)]:
        with pytest.raises(AssertionError):
            assert_heard(recorded(*wrong), references)


def test_a_click_between_sentences_is_noticed() -> None:
    first, second = references = render([LOW, LEFT])
    click = np.full(40, 5000, np.int16)
    with pytest.raises(AssertionError):
        assert_heard(recorded(first, SILENCE, click, SILENCE, second), references)


def test_a_stopped_sentence_is_recognised_by_its_beginning(low: Samples) -> None:
    assert assert_begun(recorded(low[:20000]), low) == pytest.approx(20000 / RATE, abs=0.1)
    with pytest.raises(AssertionError):
        assert_begun(recorded(render([LEFT])[0][:20000]), low)
    with pytest.raises(AssertionError):
        assert_begun(recorded(low[:20000], low[-20000:]), low)
    with pytest.raises(AssertionError, match="nothing was heard"):
        assert_begun(SILENCE, low)


@pytest.mark.parametrize("silence", [0, 4, 63, 240])
def test_a_sentence_is_found_behind_one_that_was_stopped_however_little_silence_is_between(silence: int) -> None:
    (beginning,) = render([LONG], rate=QUICK)
    first, _ = extent(beginning) or (0, 0)
    for (following,) in stopped._render_after_stop((LONG, BATTERY), QUICK)[10:13]:
        behind, last = extent(following) or (0, 0)
        heard = recorded(beginning[first : first + 4000], np.zeros(silence, np.int16), following[behind:last])
        stopped.assert_heard_after_stop(heard, LONG, [BATTERY])
        with pytest.raises(AssertionError):
            stopped.assert_heard_after_stop(np.delete(heard, slice(len(heard) // 2, -RATE // 4)), LONG, [BATTERY])


@pytest.mark.parametrize("dry", [5000, 12000])
def test_a_player_that_ran_dry_changes_nothing_about_a_sentence_that_was_stopped_or_held(
    low: Samples, dry: int
) -> None:
    gap = np.zeros(900, np.int16)
    begun = np.concatenate([low[:dry], gap, low[dry:20000]])
    assert assert_begun(recorded(begun), low) == pytest.approx(20000 / RATE, abs=0.1)
    with pytest.raises(AssertionError):
        assert_begun(recorded(low[:dry], gap, render([LEFT])[0][dry:20000]), low)
    pause = np.zeros(2 * RATE, np.int16)
    assert_resumed(recorded(begun[:16000], pause, low[15100:]), low, 1.9)
    for wrong in (low[16000:], low[14000:]):
        with pytest.raises(AssertionError):
            assert_resumed(recorded(begun[:16000], pause, wrong), low, 1.9)


def test_what_is_quiet_beside_a_pause_is_the_sentences_own() -> None:
    """A sentence with zeros of its own, between sounds that are hardly any, is held there; and it ran dry before."""
    (sentence,) = render([Sentence("two three four five six seven eight nine ten", rate=450)])
    sounds = np.flatnonzero(sentence)
    places = [int(sounds[each]) for each in np.flatnonzero(np.diff(sounds) > 200)]
    gap, pause = np.zeros(900, np.int16), np.zeros(2 * RATE, np.int16)
    quiet = [place for place in places if np.abs(sentence[place - 8 : place + 1]).max() < LOUD and place > 9000]
    assert quiet
    for place in quiet:
        for at in (place + 1, place + 100):
            begun = np.concatenate([sentence[:5000], gap, sentence[5000:at]])
            assert_resumed(recorded(begun, pause, sentence[at:]), sentence, 1.9)
            assert_resumed(recorded(begun, pause, sentence[at - 800 :]), sentence, 1.9, twice=0.05)
            for wrong in (sentence[at + 1500 :], sentence[at - 1500 :]):
                with pytest.raises(AssertionError):
                    assert_resumed(recorded(begun, pause, wrong), sentence, 1.9, twice=0.05)


def test_a_sentence_that_was_held_is_recognised_by_its_parts(low: Samples) -> None:
    found = extent(low)
    assert found
    pause = np.zeros(2 * RATE, np.int16)
    for at in (9000, 15000, 27000):
        assert assert_resumed(recorded(low[:at], pause, low[at:]), low, 2.0) == pytest.approx(2, abs=0.3)
        assert_resumed(recorded(low[:at], pause, low[at - 800 :]), low, 2.0, twice=0.05)
    for wrong in [
        recorded(low),
        recorded(low[:9000], pause[:RATE], low[9000:]),
        recorded(low[:9000], pause, low[10000:]),
        recorded(low[:9000], pause, low[8000:]),
        recorded(low[:9000], pause),
        recorded(low[:9000], pause, without_end(low, 0.1)[9000:]),
    ]:
        with pytest.raises(AssertionError):
            assert_resumed(wrong, low, 1.9)


def test_a_sentence_that_is_not_repeated_to_the_sample_is_told_from_others() -> None:
    """Spoken a fifth time by one process, and with a gap where the player ran dry."""
    low, left, right = (Sentence(each, rate=450) for each in (LOW, LEFT, RIGHT))
    first, *_, again = render([low, left, right, left, low])
    for at in (4_000, 9_000, 13_000):
        gap = np.zeros(RATE // 40, np.int16)
        assert alike(recorded(again[:at], gap, again[at:]), first) > ALIKE
        assert alike(recorded(first[:at], gap, first[at:]), first) > 0.8
        for other in render([left, right]):
            assert alike(recorded(other[:at], gap, other[at:]), first) < ALIKE
    assert alike(SILENCE, first) == 0.0
