"""The sink and the reference: what they are trusted with elsewhere is shown here."""

from __future__ import annotations

import os
import subprocess
import time
import wave
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.support.compare import (
    assert_begun,
    assert_heard,
    assert_silent,
    compare,
    extent,
    loudness,
    time_heard,
)
from tests.support.reference import RATE, Sentence, render, render_with_words
from tests.support.surroundings import clean_environment, dying_with_parent, needs
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    import pathlib
    from collections.abc import Callable

    import numpy.typing as npt

    from tests.support.sink import Sink

    Samples = npt.NDArray[np.int16]

LOW = "The battery is low, please charge me."
#: Begins with a moment of silence, for what the monitor drops where a stream starts.
SHORT = "battery low"
LEFT = "Please move the arm to the left."


@pytest.fixture(scope="module")
def low() -> Samples:
    return render([LOW])[0]


@pytest.fixture(scope="module")
def short() -> Samples:
    return render([SHORT])[0]


@pytest.mark.parametrize("text", [LOW, LEFT])
def test_first_rendering_is_espeak_ngs_own_bit_for_bit(text: str, tmp_path: pathlib.Path) -> None:
    needs("espeak-ng")
    out = str(tmp_path / "out.wav")
    subprocess.run(["espeak-ng", "-s", "200", "-w", out, text], check=True, capture_output=True)
    with wave.open(out) as file:
        assert (file.getframerate(), file.getnchannels(), file.getsampwidth()) == (RATE, 1, 2)
        theirs = np.frombuffer(file.readframes(file.getnframes()), dtype="<i2")
    assert np.array_equal(render([text])[0], theirs)


def test_fresh_processes_render_the_same_sequence() -> None:
    first, second = render([LOW, LEFT, LOW]), render([LOW, LEFT, LOW])
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_settings_are_obeyed() -> None:
    plain, slow, soft, high = render([LOW, Sentence(LOW, rate=100), Sentence(LOW, volume=0.5), Sentence(LOW, pitch=90)])
    assert 1.5 < len(slow) / len(plain) < 2.5
    assert 0.4 < loudness(soft) / loudness(plain) < 0.6
    assert not compare(high, plain).same


def test_words_have_their_places_in_text_and_sound() -> None:
    text = "Grüße, the 日 battery is low."
    (rendering,) = render_with_words([text])
    assert np.array_equal(rendering.samples, render([text])[0])
    assert [text[start:end] for start, end, _ in rendering.words][-3:] == ["battery", "is", "low"]
    times = [at for _, _, at in rendering.words]
    assert times == sorted(times)
    assert 0 <= times[0] < times[-1] < len(rendering.samples) / RATE


def test_the_time_of_a_word_is_known(sink: Sink) -> None:
    (rendering,) = render_with_words([SHORT])
    with sink.record() as recording:
        sink.play(rendering.samples)
    (compared,) = assert_heard(recording, [rendering.samples])
    first, last = recording.first_sound(), recording.last_sound()
    assert first is not None
    assert last is not None
    times = [time_heard(recording, compared, rendering.samples, at) for _, _, at in rendering.words]
    found = extent(rendering.samples)
    assert found
    assert times[0] == pytest.approx(first + rendering.words[0][2] - found[0] / RATE, abs=0.02)
    assert times[-1] - times[0] == pytest.approx(rendering.words[-1][2] - rendering.words[0][2], abs=0.02)


#: With a buffer that does not run dry where the machine is busy: each time that it does, samples are lost.
PLAYERS = {
    "aplay": ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", str(RATE), "-c", "1", "-"],
    "pacat": ["pacat", "--raw", "--format=s16le", f"--rate={RATE}", "--channels=1", "--latency-msec=500"],
}


@pytest.mark.parametrize("player", PLAYERS)
def test_what_a_player_plays_is_recorded_sample_for_sample(sink: Sink, short: Samples, player: str) -> None:
    with sink.record() as recording:
        began = time.monotonic()
        environment = clean_environment(sink.directory, sink.env)
        subprocess.run(PLAYERS[player], env=environment, input=short.tobytes(), check=True, timeout=60)
        ended = time.monotonic()
    (result,) = assert_heard(recording, [short])
    assert result.correlation > 0.999
    first, last = recording.first_sound(), recording.last_sound()
    assert first is not None
    assert last is not None
    assert began < first < last < ended
    assert last - first == pytest.approx(result.expected, abs=0.05)


@limits()
def test_a_killed_player_is_silent_at_once(sink: Sink, low: Samples, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "raw"
    file.write_bytes(low.tobytes())
    command = ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", str(RATE), str(file)]
    with sink.record() as recording:
        player = subprocess.Popen(command, env=clean_environment(sink.directory, sink.env))
        began = recording.wait_for_sound()
        recording.wait_until(began + 0.8)
        player.kill()
        killed = time.monotonic()
        player.wait()
        last = recording.wait_until_quiet()
    assert last is not None
    assert_within(last - killed, 0.1, "the silence")
    assert 0.6 < assert_begun(recording, low) < 1.2
    assert_silent(recording.between(killed + 0.1, killed + 0.4))


def test_what_is_not_recorded_is_not_in_the_recording(sink: Sink, short: Samples) -> None:
    with sink.record() as before:
        before.wait_until_quiet(0.1)
    sink.play(short)
    with sink.record() as after:
        after.wait_until_quiet(0.1)
    assert_silent(before)
    assert_silent(after)
    assert len(before) == pytest.approx(0.13 * RATE, abs=0.1 * RATE)


def test_times_are_known_from_before_the_recording_to_its_end(sink: Sink) -> None:
    with sink.record() as recording:
        recording.wait_until_quiet(0.2)
    last = len(recording) - 1
    assert recording.time_of(last) - recording.time_of(0) == pytest.approx(last / RATE, abs=0.02)
    assert recording.time_of(0) - recording.time_of(-RATE) == pytest.approx(1, abs=0.02)
    assert recording.sample_at(recording.time_of(last) + 1) == len(recording)
    with pytest.raises(IndexError):
        recording.time_of(last + 1)


def test_waiting_ends(sink: Sink) -> None:
    with sink.record() as recording:
        with pytest.raises(TimeoutError, match="nothing was heard"):
            recording.wait_for_sound(0.05)
        with pytest.raises(TimeoutError, match="not quiet"):
            recording.wait_until_quiet(10, timeout=0.05)
    assert recording.first_sound() is None
    assert recording.last_sound() is None


@pytest.mark.slow
def test_a_sink_can_be_broken_and_mended(private_sink: Callable[[], Sink], low: Samples) -> None:
    sink = private_sink()
    directory = sink.directory
    with sink.record() as recording:
        _suspend(sink, low)
        sink.unload()
        with pytest.raises(subprocess.CalledProcessError):
            sink.play(low)
        sink.reload()
        sink.kill_server()
        with pytest.raises(subprocess.CalledProcessError):
            sink.play(low)
        sink.start_server()
        mended = time.monotonic()
        sink.play(low)
    assert_heard(recording.between(mended, time.monotonic()), [low])
    sink.freeze()
    sink.thaw()
    sink.freeze()
    server = sink.pid
    sink.close()
    assert not os.path.exists(directory)
    assert not os.path.exists(f"/proc/{server}")


def _suspend(sink: Sink, low: Samples) -> None:
    command = ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", str(RATE), "-"]
    with sink.record() as recording:
        environment = clean_environment(sink.directory, sink.env)
        player = subprocess.Popen(dying_with_parent(command), env=environment, stdin=subprocess.PIPE)
        assert player.stdin
        player.stdin.write(low.tobytes())
        recording.wait_for_sound()
        sink.suspend()
        heard = len(recording)
        assert not recording.wait_until(time.monotonic() + 0.3, timeout=0.6)
        assert len(recording) - heard < 0.1 * RATE
        sink.resume()
        player.stdin.close()
        assert player.wait(10) == 0
        recording.wait_until_quiet(0.2)
    times = [recording.time_of(each) for each in range(0, len(recording), 100)]
    assert max(np.diff(times)) > 0.5, "the time in which nothing was played is missing"
