"""The clock of a sentence's playback: how much has been heard, and which words have begun."""

from __future__ import annotations

import pytest

from talkcli.engine.words import TimedWord, WordClock


def test_the_clock_stands_until_it_is_started_and_is_held_back_by_the_player() -> None:
    clock = WordClock()
    first, second = TimedWord(0, 1, 0.0), TimedWord(2, 1, 0.5)
    clock.add(first)
    clock.add(second)
    assert clock.due(100.0) == []
    assert clock.next_due() is None
    clock.start(100.0)
    assert clock.due(100.0) == [first]
    assert clock.next_due() == 100.5
    clock.hold(100.4, 0.1)
    assert clock.elapsed(100.4) == pytest.approx(0.1)
    assert clock.due(100.6) == []
    assert clock.next_due() == pytest.approx(100.8)
    clock.hold(100.5, 10.0)
    assert clock.next_due() == pytest.approx(100.8)
    assert clock.rest() == [second]
    assert clock.due(200.0) == []


def test_silence_in_the_stream_moves_the_words_after_it_and_is_not_heard() -> None:
    clock = WordClock()
    before, at, after = TimedWord(0, 1, 0.4), TimedWord(2, 1, 0.5), TimedWord(4, 1, 1.0)
    clock.begin(0.0)
    clock.insert(0.0, 0.25)
    clock.start(100.0)
    clock.add(before)
    clock.add(at)
    assert clock.heard(100.125) == 0.0
    assert clock.heard(100.5) == 0.25
    assert clock.next_due() == pytest.approx(100.65)
    clock.insert(0.5, 1.0)
    clock.insert(0.5, 1.0)
    clock.add(after)
    assert clock.next_due() == pytest.approx(100.65)
    assert clock.due(102.5) == [before]
    assert clock.heard(102.5) == 0.5
    assert clock.next_due() == pytest.approx(102.75)
    assert clock.due(102.76) == [at]
    assert clock.heard(103.0) == pytest.approx(0.75)
    assert clock.next_due() == pytest.approx(103.25)


def test_another_stream_begins_where_the_audio_goes_on() -> None:
    clock = WordClock()
    missed, word = TimedWord(0, 1, 1.0), TimedWord(2, 1, 2.5)
    clock.start(100.0)
    clock.insert(0.5, 3.0)
    clock.begin(2.0)
    clock.add(missed)
    clock.add(word)
    assert clock.next_due() is None
    assert clock.heard(200.0) == 2.0
    clock.insert(2.0, 0.25)
    clock.start(200.0)
    assert clock.due(200.0) == [missed]
    assert clock.next_due() == pytest.approx(200.75)
    assert clock.heard(200.5) == pytest.approx(2.25)


def test_the_outputs_own_clock_stands_until_something_is_heard() -> None:
    clock = WordClock()
    clock.add(TimedWord(0, 1, 0.5))
    clock.start(100.0)
    clock.tell(100.2, 0.0)
    assert (clock.elapsed(100.2), clock.next_due()) == (0.0, None)
    clock.tell(100.4, 0.1)
    assert clock.elapsed(100.4) == pytest.approx(0.1)
    assert clock.next_due() == pytest.approx(100.8)


def test_words_in_zeros_that_are_left_out_begin_with_the_sound() -> None:
    clock = WordClock()
    for position in (0.0, 0.2):
        clock.add(TimedWord(0, 1, position))
    clock.leave_out(0.1)
    assert [each.position for each in clock.rest()] == [0.1, 0.2]
