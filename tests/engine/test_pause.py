"""A sentence that is paused and goes on, as it is heard: nothing is lost, nothing is said twice, words stay in time."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from talkcli.engine import protocol
from tests.engine.spawned import FAST, Spawned
from tests.support import compare
from tests.support.processes import children
from tests.support.recording import LOUD
from tests.support.reference import RATE, render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.compare import Samples
    from tests.support.sink import Sink

#: It begins with a moment of silence, before its "b": the monitor drops some samples where a stream starts.
TEXT = "battery low, please bring this robot back to its charging station, it cannot move any more"
#: Seconds of a pause, longer than any silence in the sentence, and of silence after which no more of it is to come.
PAUSE = 0.6
QUIET = 0.2
#: Seconds of the whole sentence within which it must be silent after a pause.
SILENT_WITHIN = 0.15
#: Samples that may be said twice, or lost by the monitor, where a player had to be started anew in the middle.
TWICE = RATE // 20
#: Samples that the monitor may lose where a stream starts, up to 211 were seen to be, and where a player ran dry: up to
#: 216, and to 164 where aplay and pacat were given a whole file on a busy machine.
_LOST = 256
#: Samples by which a place in the sentence is known, fewer where it is held behind them, and among which it is sought.
_KEYS = (64, 16)
_NEAR = RATE // 2
#: Both players have to keep this; one of them is enough for most runs.
OTHER = pytest.mark.slow


@pytest.fixture(scope="module")
def reference() -> Samples:
    (samples,) = render([TEXT], rate=FAST)
    return samples


def _joins(samples: Samples, reference: Samples) -> list[tuple[float, int]]:
    """Assert that what was heard is the reference, sample for sample; return where the next one does not follow.

    These are the seconds of silence there and the samples that were lost in it, fewer than none if some came again.
    """
    whole, sound = compare.extent(reference), compare.extent(samples)
    assert whole is not None
    assert sound is not None, "nothing was heard"
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    heard, next_one = 0, whole[0]  # up to where it was compared, and what must come there
    joins: list[tuple[float, int]] = []
    while len(rest := loud[loud >= heard]):
        at = int(rest[0])
        place = _place(samples[at:], reference, next_one)
        assert place is not None, f"what was heard at {at / RATE:.3f} s is not the sentence, or not the next of it"
        after = _same(samples[at:], reference[place:])
        before = _same(samples[heard:at][::-1], reference[min(next_one, place) : place][::-1])
        joins.append(((at - before - heard) / RATE, place - before - next_one))
        heard, next_one = at + after, place + after
    assert next_one >= whole[1] - _LOST, f"{(whole[1] - next_one) / RATE:.3f} s at the end were not heard"
    return joins[1:] if joins[0][1] <= _LOST else joins


def _place(samples: Samples, reference: Samples, near: int) -> int | None:
    """Return where the reference has the first of these samples, near a place in it."""
    first = max(0, near - _NEAR)
    for length in _KEYS:
        windows = np.lib.stride_tricks.sliding_window_view(reference[first : near + _NEAR], length)
        found = first + np.flatnonzero((windows == samples[:length]).all(axis=1))
        if len(found):
            return int(min(found, key=lambda place: abs(place - near)))
    return None


def _same(one: Samples, other: Samples) -> int:
    """Return how many samples at the beginning are the same."""
    shorter = min(len(one), len(other))
    different = np.flatnonzero(one[:shorter] != other[:shorter])
    return int(different[0]) if len(different) else shorter


def _assert_held(samples: Samples, reference: Samples, pause: float, again: int = 0) -> None:
    """Assert that the reference was heard whole, but held once for at least so many seconds.

    Where it was held some samples may be missing, which the monitor drops, and so many come again. A player that ran
    dry is as short a silence elsewhere, after which the monitor drops some, too.
    """
    joins = _joins(samples, reference)
    assert joins, "it was not held"
    (held, missing), *dry = sorted(joins, reverse=True)
    assert held >= pause
    assert -again <= missing <= _LOST, f"{missing} samples are missing where it was held"
    assert all(seconds < pause and 0 <= dropped <= _LOST for seconds, dropped in dry), dry


def _speak_to_word(engine: Spawned, number: int) -> None:
    engine.until(protocol.Voices)
    engine.say(TEXT)
    while engine.until(protocol.Word).number < number:
        pass


@pytest.mark.parametrize("player", ["aplay", pytest.param("pacat", marks=OTHER)])
def test_a_pause_is_silent_in_time_and_the_sentence_goes_on_with_the_next_sample(
    sink: Sink, reference: Samples, player: str
) -> None:
    with limits(), Spawned(player, environment=sink.env) as engine, sink.record() as recording:
        _speak_to_word(engine, 6)
        asked = time.monotonic()
        took = engine.pause()
        recording.wait_until_quiet(PAUSE)
        last = recording.last_sound()
        assert last is not None
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
        recording.wait_until_quiet(QUIET)
        assert last - asked <= took, "it said that it was silent before it was"
        assert_within(took, SILENT_WITHIN, "the pause")
        _assert_held(recording.samples, reference, PAUSE)


def test_words_come_as_they_are_heard_after_a_pause(sink: Sink, reference: Samples) -> None:
    with limits(), Spawned("aplay", environment=sink.env) as engine, sink.record() as recording:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        arrived: list[float] = []
        before = 0
        while not isinstance(event := engine.event(), protocol.Ended):
            if not isinstance(event, protocol.Word):
                continue
            arrived.append(time.monotonic() - event.time)
            if event.number == 5:
                engine.pause()
                before = len(arrived)  # one more, if it came in the meantime, is not looked at
                last = recording.wait_until_quiet(PAUSE)
                engine.resume()
                assert last is not None
                held = recording.wait_for_sound() - last
        began = recording.first_sound()
        assert began is not None
        assert len(arrived) > 10
        behind = [moment - began for moment in arrived]
        assert_within(max(behind[:before]), 0.1, "a word before the pause")
        assert min(behind[before:]) > held - 0.03, "a word came before it was heard"
        assert_within(max(behind[before:]), held + 0.1, "a word after the pause")
        times = [word.time for word in engine.words()]
        assert times == sorted(times)
        assert times[-1] * RATE < len(reference)


@pytest.mark.parametrize("player", [pytest.param("aplay", marks=OTHER), "pacat"])
def test_a_long_pause_lets_go_of_the_device(sink: Sink, reference: Samples, player: str) -> None:
    with limits():
        constants = {"RELEASE_AFTER": 0.4}
        with Spawned(player, environment=sink.env, limits=constants) as engine, sink.record() as recording:
            _speak_to_word(engine, 6)
            engine.pause()
            assert len(children(engine.process.pid)) == 1
            _wait_for_no_player(engine)
            recording.wait_until_quiet(QUIET)
            engine.resume()
            assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
            recording.wait_until_quiet(QUIET)
            _assert_held(recording.samples, reference, QUIET, TWICE)
            assert [word.number for word in engine.words()] == list(range(1, len(engine.words()) + 1))


@pytest.mark.slow  # with a sound server of its own: a player that dies in a pause is always tested
def test_a_device_that_is_lost_during_a_pause_and_comes_back_is_no_error(
    private_sink: Callable[[], Sink], reference: Samples
) -> None:
    with limits():
        sink = private_sink()
        with Spawned("pacat", environment=sink.env) as engine, sink.record() as recording:
            _speak_to_word(engine, 6)
            engine.pause()
            recording.wait_until_quiet(QUIET)
            sink.unload()
            _wait_for_no_player(engine)
            heard = len(recording)
            sink.reload()
            tone = len(recording)
            engine.resume()
            assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
            recording.wait_until_quiet(QUIET)
            without_tone = np.concatenate([recording.samples[:heard], recording.samples[tone:]])
            _assert_held(without_tone, reference, QUIET, TWICE)


@pytest.mark.slow  # as above: one that can't be replaced, too
def test_a_device_that_stays_lost_fails_the_sentence_when_it_goes_on(private_sink: Callable[[], Sink]) -> None:
    sink = private_sink()
    with Spawned("aplay", environment=sink.env) as engine:
        _speak_to_word(engine, 3)
        engine.pause()
        sink.kill_server()
        _wait_for_no_player(engine)
        assert isinstance(engine.event(), protocol.Alive)
        engine.resume()
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "audio_device")


@pytest.mark.parametrize("release", [0.2, 10.0])
def test_a_stop_ends_a_paused_sentence_at_once(sink: Sink, release: float) -> None:
    with limits():
        constants = {"RELEASE_AFTER": release}
        with Spawned("aplay", environment=sink.env, limits=constants) as engine, sink.record() as recording:
            _speak_to_word(engine, 4)
            engine.pause()
            if release < 1:
                _wait_for_no_player(engine)
            heard = recording.wait_until_quiet(0.1)
            asked = time.monotonic()
            engine.send(protocol.Stop("g1"))
            assert engine.until(protocol.Ended) == protocol.Ended("g1", protocol.STOPPED)
            assert_within(time.monotonic() - asked, 0.02, "the stop")
            assert children(engine.process.pid) == []
            recording.wait_until_quiet(0.2)
            assert recording.last_sound() == pytest.approx(heard, abs=0.005)
            assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED


def test_a_pause_before_the_first_sound_holds_all_of_it(sink: Sink) -> None:
    text = "coming home"
    with limits(), Spawned("aplay", environment=sink.env) as engine, sink.record() as recording:
        engine.until(protocol.Voices)
        line = protocol.encode(protocol.Say("g1", text, FAST, 1.0, None, 50)) + protocol.encode(protocol.Pause("g1", 1))
        engine.send_raw(line)
        engine.until(protocol.Paused)
        assert children(engine.process.pid) == []
        recording.wait_until_quiet(0.5)
        compare.assert_silent(recording)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
        recording.wait_until_quiet(QUIET)
        joins = _joins(recording.samples, render([text], rate=FAST)[0])
        assert all(0 <= dropped <= _LOST for _, dropped in joins), joins


def _wait_for_no_player(engine: Spawned) -> None:
    end = time.monotonic() + 10
    while children(engine.process.pid):
        assert time.monotonic() < end, "the player is still there"
        time.sleep(0.01)  # the end of another process's child is no event
