"""A sentence that is paused and goes on, as it is heard: nothing is lost, nothing is said twice, words stay in time."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from talkcli.engine import protocol
from tests.engine.spawned import Spawned, children
from tests.support import compare
from tests.support.recording import LOUD
from tests.support.reference import RATE, render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.compare import Samples
    from tests.support.recording import Recording
    from tests.support.sink import Sink

#: It begins with a moment of silence, before its "b": the monitor drops some samples where a stream starts.
TEXT = "battery low, please bring this robot back to its charging station, it cannot move any more"
#: Seconds of the whole sentence within which it must be silent after a pause.
SILENT_WITHIN = 0.15
#: Seconds that may be said twice where a player had to be started anew in the middle of its sound.
TWICE = 0.05
#: Samples of a stream's start, among which the monitor may drop some.
_STARTED = RATE // 20


@pytest.fixture(scope="module")
def reference() -> Samples:
    (samples,) = render([TEXT])
    return samples


def _assert_resumed(recording: Recording, reference: Samples, pause: float, twice: float = 0.0) -> float:
    """Assert that the sound with its longest silence cut out is the reference; return that silence's seconds."""
    samples = recording.samples
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    found = compare.extent(reference)
    assert found is not None
    assert len(loud) > 1, "nothing was heard"
    wanted = reference[found[0] : found[1]]
    gap = int(np.argmax(np.diff(loud)))
    first, second = samples[loud[0] : loud[gap] + 1], samples[loud[gap + 1] : loud[-1] + 1]
    missing = wanted[len(first) : len(wanted) - len(second)]
    exact = np.array_equal(first, wanted[: len(first)]) and np.array_equal(second, wanted[-len(second) :])
    if exact and compare.extent(missing) is None and len(first) + len(second) <= len(wanted):
        held = int(loud[gap + 1] - loud[gap]) / RATE
        assert held >= pause
        return held
    return compare.assert_resumed(recording, reference, pause, twice)  # the monitor dropped some, or it is wrong


def _assert_restarted(first: Samples, second: Samples, reference: Samples) -> None:
    """Assert that two recordings are the reference, but for what the monitor drops where the second stream starts."""
    begin, end, whole = (compare.extent(each) for each in (first, second, reference))
    assert begin is not None
    assert end is not None
    assert whole is not None
    wanted = reference[whole[0] : whole[1]]
    first, second = first[begin[0] : begin[1]], second[end[0] : end[1]]
    assert abs(len(first) + len(second) - len(wanted)) <= TWICE * RATE
    assert np.array_equal(first[_STARTED:], wanted[: len(first)][_STARTED:])
    assert np.array_equal(second[_STARTED:], wanted[-len(second) :][_STARTED:])


def _speak_to_word(engine: Spawned, number: int) -> None:
    engine.until(protocol.Voices)
    engine.say(TEXT)
    while engine.until(protocol.Word).number < number:
        pass


@pytest.mark.parametrize("player", ["aplay", "pacat"])
def test_a_pause_is_silent_in_time_and_the_sentence_goes_on_with_the_next_sample(
    sink: Sink, reference: Samples, player: str
) -> None:
    with limits(), Spawned(player, environment=sink.env) as engine, sink.record() as recording:
        _speak_to_word(engine, 6)
        asked = time.monotonic()
        took = engine.pause()
        recording.wait_until_quiet(2)
        last = recording.last_sound()
        assert last is not None
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
        recording.wait_until_quiet()
        assert last - asked <= took, "it said that it was silent before it was"
        assert_within(took, SILENT_WITHIN, "the pause")
        _assert_resumed(recording, reference, 2.0)


def test_words_come_as_they_are_heard_after_a_pause(sink: Sink) -> None:
    with limits(), Spawned("aplay", environment=sink.env) as engine, sink.record() as recording:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        arrived = []
        while not isinstance(event := engine.event(), protocol.Ended):
            if not isinstance(event, protocol.Word):
                continue
            arrived.append(time.monotonic() - event.time)
            if event.number == 5:
                engine.pause()
                last = recording.wait_until_quiet(1)
                engine.resume()
                assert last is not None
                held = recording.wait_for_sound() - last
        began = recording.first_sound()
        assert began is not None
        assert len(arrived) > 10
        behind = [moment - began for moment in arrived]
        assert_within(max(behind[:5]), 0.1, "a word before the pause")
        assert min(behind[6:]) > held - 0.03, "a word came before it was heard"
        assert_within(max(behind[6:]), held + 0.1, "a word after the pause")
        times = [word.time for word in engine.words()]
        assert times == sorted(times)
        assert times[-1] * RATE < len(render([TEXT])[0])


@pytest.mark.parametrize("player", ["aplay", "pacat"])
def test_a_long_pause_lets_go_of_the_device(sink: Sink, reference: Samples, player: str) -> None:
    with limits():
        constants = {"RELEASE_AFTER": 0.4}
        with Spawned(player, environment=sink.env, limits=constants) as engine, sink.record() as recording:
            _speak_to_word(engine, 6)
            engine.pause()
            assert len(children(engine.process.pid)) == 1
            _wait_for_no_player(engine)
            recording.wait_until_quiet(0.5)
            heard = len(recording)
            engine.resume()
            assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
            recording.wait_until_quiet()
            _assert_restarted(recording.samples[:heard], recording.samples[heard:], reference)
            assert [word.number for word in engine.words()] == list(range(1, len(engine.words()) + 1))


def test_a_device_that_is_lost_during_a_pause_and_comes_back_is_no_error(
    private_sink: Callable[[], Sink], reference: Samples
) -> None:
    with limits():
        sink = private_sink()
        with Spawned("pacat", environment=sink.env) as engine, sink.record() as recording:
            _speak_to_word(engine, 6)
            engine.pause()
            recording.wait_until_quiet(0.3)
            sink.unload()
            _wait_for_no_player(engine)
            heard = len(recording)
            sink.reload()
            tone = len(recording)
            engine.resume()
            assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
            recording.wait_until_quiet()
            _assert_restarted(recording.samples[:heard], recording.samples[tone:], reference)


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


def test_a_pause_before_the_first_sound_holds_all_of_it(sink: Sink, reference: Samples) -> None:
    with limits(), Spawned("aplay", environment=sink.env) as engine, sink.record() as recording:
        engine.until(protocol.Voices)
        line = protocol.encode(protocol.Say("g1", TEXT, 200, 1.0, None, 50)) + protocol.encode(protocol.Pause("g1", 1))
        engine.send_raw(line)
        engine.until(protocol.Paused)
        assert children(engine.process.pid) == []
        recording.wait_until_quiet(0.5)
        compare.assert_silent(recording)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
        recording.wait_until_quiet()
        compare.assert_heard(recording, [reference])


def _wait_for_no_player(engine: Spawned) -> None:
    end = time.monotonic() + 10
    while children(engine.process.pid):
        assert time.monotonic() < end, "the player is still there"
        time.sleep(0.01)  # the end of another process's child is no event
