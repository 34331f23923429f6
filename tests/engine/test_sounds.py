"""Tests for sounds: which files can be played, how they are heard, and that bad files do no harm."""

from __future__ import annotations

import os
from array import array
from contextlib import suppress
from typing import TYPE_CHECKING
from unittest.mock import Mock

import numpy as np
import pytest

from talkcli.engine import protocol, sounds
from talkcli.engine.child.players.base import Stopped
from talkcli.engine.child.players.builtin import WavPlayer
from talkcli.engine.child.sounds import play_sound, resample
from talkcli.engine.sounds import SoundLibrary
from tests.engine.process import Engine
from tests.engine.programs import NEVER_READS, without_silence
from tests.support.reference import RATE
from tests.support.timing import assert_within, limits
from tests.support.wav import FLOAT, pitch, tone, wav, write_tone

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import Any

    from tests.engine.programs import Player

#: Seconds of silence after a sound.
PAUSE_S = 0.26
#: Forms that can be played, with the rate at which the player gets the samples.
FORMS: dict[str, tuple[int, int, dict[str, Any]]] = {
    "8 bits": (22_050, 22_050, {"bits": 8}),
    "8 bits stereo": (48_000, 48_000, {"bits": 8, "channels": 2}),
    "12 bits": (22_050, 22_050, {"bits": 12}),
    "16 bits": (44_100, 44_100, {}),
    "24 bits stereo": (48_000, 48_000, {"bits": 24, "channels": 2}),
    "extensible": (96_000, 96_000, {"bits": 24, "extensible": True}),
    "32 bits": (192_000, 192_000, {"bits": 32}),
    "float": (44_100, 44_100, {"bits": 32, "number": FLOAT}),
    "float stereo extensible": (32_000, 32_000, {"bits": 32, "number": FLOAT, "channels": 2, "extensible": True}),
    "a stream": (22_050, 22_050, {"length": 0xFFFFFFFF}),
    "4 kHz": (4_000, 24_000, {}),
    "11 kHz": (11_025, 22_050, {}),
}
#: Reads at the rate of a sound, and writes everything to the file named by its argument.
SAVES = (
    "import os, sys\nheard = open(sys.argv[1], 'ab', buffering=0)\nwhile data := os.read(0, 65536): heard.write(data)"
)


def started(engine: Engine) -> Engine:
    engine.until(protocol.VoiceList)
    return engine


def completed(engine: Engine, name: str, goal: str = "g1", **options: Any) -> float | None:
    """Play a sound to its end, and return its length in seconds."""
    engine.play(name, goal, **options)
    ended = engine.until(protocol.Ended)
    assert (ended.outcome, ended.message) == (protocol.OUTCOME_COMPLETED, None)
    assert ended.heard == ended.duration
    return ended.duration


@pytest.mark.parametrize(("rate", "player_rate", "form"), FORMS.values(), ids=FORMS)
def test_each_form_is_heard_with_its_length_and_pitch(
    player: Player, tmp_path: Path, rate: int, player_rate: int, form: dict[str, Any]
) -> None:
    write_tone(tmp_path / "a.wav", 0.3, rate, **form)
    command = f"{player.command(SAVES)} {{rate}}"
    with Engine(command, sounds=str(tmp_path), limits={"EARLY_END_LIMIT_S": 9.0}) as engine:
        assert completed(started(engine), "a") == pytest.approx(0.3, abs=0.001)
    samples = np.fromfile(player.heard, "<i2")
    heard = samples[: np.flatnonzero(samples)[-1] + 1]
    assert len(heard) / player_rate == pytest.approx(0.3, abs=0.002)
    assert len(samples) / player_rate == pytest.approx(0.3 + PAUSE_S, abs=0.002)
    assert pitch(heard, player_rate) == pytest.approx(1_000, rel=0.01)
    loudest = 0.25 if form.get("channels") == 2 else 0.5  # the second channel is silent
    assert np.abs(heard).max() / 32_768 == pytest.approx(loudest, rel=0.02)


def noise(seconds: float, rate: int = RATE) -> np.ndarray[Any, np.dtype[np.int16]]:
    """Return random samples after a silence of 50 ms."""
    samples = np.random.default_rng(1).integers(1, 9_000, int(seconds * rate)).astype("<i2")
    samples[: rate // 20] = 0
    return samples


def test_a_pause_loses_and_repeats_no_sample(player: Player, tmp_path: Path) -> None:
    rate, player_rate = 8_000, 24_000
    (tmp_path / "a.wav").write_bytes(wav(noise(0.5, rate) / 32_767, rate))
    samples = array("h", (tmp_path / "a.wav").read_bytes()[-2 * int(0.5 * rate) :])
    exact = b"".join(each.tobytes() for each in resample([samples], rate, player_rate))
    with Engine(f"{player.plays()} {{rate}}", sounds=str(tmp_path), alive_every=0.1) as engine:
        started(engine).play("a")
        for _ in range(2):
            engine.until(protocol.Alive)  # the sound is played for some time between the pauses
            engine.pause()
            engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    heard = player.heard.read_bytes()
    for _ in range(2):
        heard = without_silence(heard, exact)
    assert heard[: len(exact)] == exact
    assert heard[len(exact) :].strip(b"\0") == b""


def test_an_interrupted_sound_continues_with_the_next_sample(player: Player, tmp_path: Path) -> None:
    soon = "from talkcli.engine.child import runner; runner.WORD_END_LIMIT_S = 0.2"
    samples = noise(1.0)
    (tmp_path / "a.wav").write_bytes(wav(samples / 32_767, RATE))
    exact = np.fromfile(tmp_path / "a.wav", "<i2")[-len(samples) :]
    with Engine(player.plays(), sounds=str(tmp_path), alive_every=0.1, before=soon) as engine:
        started(engine).play("a")
        engine.until(protocol.Alive)
        engine.send(protocol.Interrupt("g1"))
        ended = engine.until(protocol.Ended)
        assert ended.outcome == protocol.OUTCOME_INTERRUPTED
        first = np.fromfile(player.heard, "<i2")
        assert ended.rest is not None
        assert np.array_equal(first[: ended.rest], exact[: ended.rest])
        assert 0 < len(first) - ended.rest <= 0.005 * RATE  # the sound fades out, and the faded part is repeated
        assert first[-1] == 0
        duration = completed(engine, "a", start=ended.rest, heard=ended.heard)
    assert duration == pytest.approx(1.0, abs=0.02)
    rest = np.fromfile(player.heard, "<i2")[len(first) :]
    assert np.array_equal(rest[: len(exact) - ended.rest], exact[ended.rest :])


def test_a_short_sound_ends_before_an_interruption(tmp_path: Path) -> None:
    write_tone(tmp_path / "a.wav", 0.5, RATE)
    with Engine(sounds=str(tmp_path), alive_every=0.05) as engine:
        started(engine).play("a")
        engine.until(protocol.Alive)
        engine.send(protocol.Interrupt("g1"))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED


@limits()
def test_a_sound_stops_at_once(player: Player, tmp_path: Path) -> None:
    write_tone(tmp_path / "a.wav", 30, 48_000, channels=2, bits=24)
    for command in (player.plays(), player.command(NEVER_READS)):
        with Engine(command, sounds=str(tmp_path), alive_every=0.1) as engine:
            started(engine).play("a")
            engine.until(protocol.Alive)
            assert_within(engine.stop(), 0.02, "the stop")


def test_a_silent_sound_is_played(tmp_path: Path) -> None:
    (tmp_path / "a.wav").write_bytes(wav(np.zeros(RATE // 10), RATE))
    with Engine(f"file:{tmp_path}/said.wav", sounds=str(tmp_path)) as engine:
        assert completed(started(engine), "a") == pytest.approx(0.1, abs=0.001)


def test_a_player_that_ends_early_cuts_off_nothing_audible(player: Player, tmp_path: Path) -> None:
    write_tone(tmp_path / "a.wav", 0.3, RATE)
    ends_early = (
        "import os, time\nn = 0\nwhile data := os.read(0, 882): n += len(data)\ntime.sleep(n / 44100 - {} - 0.1)"
    )
    for early, outcome in ((0.1, protocol.OUTCOME_COMPLETED), (0.35, protocol.OUTCOME_FAILED)):
        with Engine(player.command(ends_early.format(early)), sounds=str(tmp_path)) as engine:
            started(engine).play("a")
            assert engine.until(protocol.Ended).outcome == outcome


def test_the_built_in_sounds_are_short_and_different(tmp_path: Path) -> None:
    with Engine(f"file:{tmp_path}/said.wav") as engine:
        lengths = [
            completed(started(engine) if not number else engine, name) for number, name in enumerate(sounds.BUILT_IN)
        ]
    assert all(length and 0.1 < length < 0.6 for length in lengths)
    assert len({*lengths}) == len(lengths)


@pytest.mark.parametrize("rates", [(48_000, 11_025), (22_050, 16_000), (8_000, 22_050)])
def test_a_sound_is_resampled_alike_in_pieces_of_any_length(rates: tuple[int, int]) -> None:
    whole = array("h", (tone(0.1, rates[0]) * 32_767).astype("<i2").tobytes())
    pieces = [whole[start : start + 7] for start in range(0, len(whole), 7)]
    found, expected = (np.concatenate([*resample(some, *rates)]).astype(int) for some in (pieces, [whole]))
    assert len(found) == len(expected) == pytest.approx(0.1 * rates[1], abs=1)
    assert np.abs(found - expected).max() <= 1


def test_the_file_of_a_sound_is_closed_however_it_ends(tmp_path: Path) -> None:
    write_tone(tmp_path / "a.wav", 0.1, RATE)
    command, library = protocol.Speak("g", "a", 200, 1.0, None, 50, format="sound"), SoundLibrary(str(tmp_path))
    for side_effect in (None, Stopped):
        playback = Mock(**{"write.side_effect": side_effect})
        open_before = os.listdir("/dev/fd")
        with suppress(Stopped):
            play_sound(library, command, playback, None)
        assert playback.write.called
        assert len(os.listdir("/dev/fd")) == len(open_before)


@pytest.mark.parametrize("rate", [16_000, 44_100])
def test_sounds_get_the_rate_of_an_existing_wav_file(tmp_path: Path, rate: int) -> None:
    output = tmp_path / "said.wav"
    WavPlayer(str(output), rate).close()
    with Engine(f"file:{output}") as engine:
        assert completed(engine, "chirp") == pytest.approx(0.14, abs=0.001)
    assert output.stat().st_size == pytest.approx(44 + (0.14 + PAUSE_S) * rate * 2, abs=8)


@pytest.mark.parametrize("first", ["say", "play"])
def test_sounds_are_converted_to_the_rate_of_a_voice_in_a_wav_file(tmp_path: Path, first: str) -> None:
    for rate in (8_000, 44_100, 96_000):
        write_tone(tmp_path / f"{rate}.wav", 0.5, rate)
    output = tmp_path / "said.wav"
    with Engine(f"file:{output}", sounds=str(tmp_path)) as engine:
        started(engine)
        if first == "say":
            assert engine.spoken("hello").outcome == protocol.OUTCOME_COMPLETED
        start = output.stat().st_size if first == "say" else 44
        for rate in (8_000, 44_100, 96_000):
            assert completed(engine, str(rate), f"g{rate}", volume=0.5) == pytest.approx(0.5, abs=0.001)
        if first == "play":
            assert engine.spoken("hello", "g2").outcome == protocol.OUTCOME_COMPLETED
    samples = np.frombuffer(output.read_bytes()[start:], "<i2")
    for number in range(3):
        begin = round(number * (0.5 + PAUSE_S) * RATE)
        heard = samples[begin + 20 : begin + RATE // 2 - 20]
        assert pitch(heard, RATE) == pytest.approx(1_000, rel=0.01)
        assert np.abs(heard).max() / 32_768 == pytest.approx(0.25, rel=0.05)
        assert not samples[begin + RATE // 2 + 20 : begin + RATE // 2 + 2_000].any()


def test_a_sound_that_changes_while_it_is_played_fails(player: Player, tmp_path: Path) -> None:
    write_tone(tmp_path / "a.wav", 30, RATE)
    with Engine(player.plays(), sounds=str(tmp_path), alive_every=0.1) as engine:
        started(engine).play("a")
        engine.until(protocol.Alive)
        os.truncate(tmp_path / "a.wav", 4_000)
        ended = engine.until(protocol.Ended)
        assert (ended.reason, ended.message) == ("bad_sound", f"{tmp_path}/a.wav became shorter while it was played")
        engine.play("b", "g2")
        assert engine.until(protocol.Ended).reason == "unknown_sound"
        assert completed(engine, "chirp", "g3")


def test_a_third_party_driver_cannot_play_sounds() -> None:
    with Engine(driver="dummy") as engine:
        started(engine).play("chirp")
        assert engine.until(protocol.Ended).message == "this driver can only speak, so it can't play sounds"


# -- files that can't be played


def _sparse(path: Path, header: bytes = b"") -> None:
    path.write_bytes(header)
    os.truncate(path, 1 << 40)


def _file(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


def _tone(seconds: float = 1, rate: int = RATE, **form: int) -> Callable[[Path], object]:
    return lambda path: write_tone(path, seconds, rate, **form)


HEADER = wav(tone(0, RATE), RATE)
ENDLESS_HEADER = wav(tone(0, RATE), RATE, length=0xFFFFFFFF)
#: What makes each file, the extension of the file, and a part of its error message.
BAD_FILES: dict[str, tuple[Callable[[Path], object], str, str]] = {
    "truncated": (_file(wav(tone(1, RATE), RATE)[:-100]), ".wav", "44,000 bytes of sound, but its header says 44,100;"),
    "lying": (_tone(length=0xFFFFFFF0), ".wav", "but its header says 4,294,967,280; copy it again"),
    "no samples": (_file(HEADER[:-8]), ".wav", "no samples; copy it again"),
    "no format": (_file(HEADER[:12] + HEADER[-8:] + bytes(99)), ".wav", "no samples; copy it again"),
    "zero samples": (_tone(0), ".wav", "contains no sound; use another file"),
    "endless chunks": (_file(HEADER[:12] + b"LIST\0\0\0\0" * 100 + HEADER[12:]), ".wav", "no samples; copy it again"),
    "too long": (lambda path: _sparse(path, ENDLESS_HEADER), ".wav", "at most 1,451 s at 22,050 samples per second"),
    "1 TB": (_sparse, ".wav", "is not a WAV file; convert it with: ffmpeg -i "),
    "empty": (_file(b""), ".wav", "is empty; copy it again"),
    "text": (_file(b"hello"), "", "is not a WAV file; convert it with: ffmpeg -i "),
    "MP3": (_file(b"ID3\4"), ".mp3", "is not a WAV file, but MP3; convert it with: ffmpeg -i "),
    "MP3 frame": (_file(b"\xff\xfb\x90"), ".wav", "is not a WAV file, but MP3; convert it with: ffmpeg -i "),
    "Ogg": (_file(b"OggS"), ".ogg", "is not a WAV file, but Ogg; convert it with: ffmpeg -i "),
    "FLAC": (_file(b"fLaC"), ".flac", "is not a WAV file, but FLAC; convert it with: ffmpeg -i "),
    "MP4": (_file(bytes(4) + b"ftyp"), ".m4a", "is not a WAV file, but MP4; convert it with: ffmpeg -i "),
    "A-law": (_tone(bits=8, number=6), ".wav", "is a WAV file with 8-bit A-law samples; convert it with: ffmpeg -i "),
    "64 bits": (_tone(bits=64), ".wav", "64-bit integer samples; convert it with: ffmpeg -i "),
    "64-bit float": (_tone(bits=64, number=FLOAT), ".wav", "64-bit floating-point samples; convert it with: ffmpeg"),
    "unknown": (_tone(number=99), ".wav", "16-bit unknown (99) samples; convert it with: ffmpeg -i "),
    "padding": (_file(HEADER[:32] + b"\4\0" + HEADER[34:] + bytes(99)), ".wav", "4 bytes for 1 samples of 16 bits;"),
    "six channels": (_tone(channels=6), ".wav", "has 6 channels instead of 1 or 2; convert it with: ffmpeg -i "),
    "1 kHz": (_tone(rate=1_000), ".wav", "1,000 samples per second instead of 4,000 to 192,000; convert it"),
    "directory": (lambda path: path.mkdir(), ".wav", "is a directory; use a WAV file"),
    "pipe": (os.mkfifo, ".wav", "is not a regular file; use a WAV file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), ".wav", "is a link to a file outside of "),
    "link": (lambda path: path.symlink_to("/etc/passwd"), ".wav", "is a link to a file outside of "),
    "broken link": (lambda path: path.symlink_to("nothing"), ".wav", "can't be read: No such file or directory"),
    "circular link": (lambda path: path.symlink_to(path.name), ".wav", "is not a regular file"),
}


@pytest.mark.parametrize(("make", "extension", "words"), BAD_FILES.values(), ids=BAD_FILES)
def test_a_bad_file_is_refused_with_advice(
    tmp_path: Path, make: Callable[[Path], object], extension: str, words: str
) -> None:
    path = tmp_path / f"bad{extension}"
    make(path)
    open_before = os.listdir("/dev/fd")
    refused = SoundLibrary(str(tmp_path)).refusal("bad")
    assert refused
    assert refused[0] == "bad_sound"
    assert refused[1].startswith(f"{path} ")
    assert words in refused[1]
    assert len(os.listdir("/dev/fd")) == len(open_before)


def test_the_conversion_command_names_the_files(tmp_path: Path) -> None:
    (tmp_path / "my horn.mp3").write_bytes(b"ID3")
    (tmp_path / "bell.wav").write_bytes(b"OggS")
    library = SoundLibrary(str(tmp_path))
    commands = [
        str(refused[1]).partition("with: ")[2] for name in ("my horn", "bell") if (refused := library.refusal(name))
    ]
    assert commands == [
        f"ffmpeg -i '{tmp_path}/my horn.mp3' -ac 1 -ar 44100 '{tmp_path}/my horn.wav'",
        f"ffmpeg -i {tmp_path}/bell.wav -ac 1 -ar 44100 new.wav && mv new.wav {tmp_path}/bell.wav",
    ]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("horn", "unknown sound 'horn'; the sounds are bell, chirp, error, warning"),
        ("chirp.wav", "put the file into {}, and run: talk play chirp"),
        ("/tmp/my horn.mp3", "put the file into {}, and run: talk play 'my horn'"),
        ("../secret", "put the file into {}, and run: talk play secret"),
        ("horn.wav", "put the file into {}, and run: talk play horn"),
        ("a\0b", "unknown sound 'a\\x00b'; the sounds"),
        ("\ud800", "unknown sound '\\ud800'; the sounds"),
        ("a" * 5_000, f"unknown sound '{'a' * 60}'; the sounds"),
        ("..", "unknown sound '..'; the sounds"),
    ],
)
def test_an_unknown_name_is_refused_with_advice(tmp_path: Path, name: str, words: str) -> None:
    write_tone(tmp_path / "bell.wav", 0.1, RATE)
    for directory, where in (
        (str(tmp_path), str(tmp_path)),
        (None, "a directory DIR, start the server with: talk serve --sounds DIR"),
    ):
        refused = SoundLibrary(directory).refusal(name)
        assert refused
        assert refused[0] == "unknown_sound"
        expected = words.format(where)
        assert expected in refused[1] or (directory is None and "bell" in words)


def test_the_names_are_those_of_wav_files_and_built_in_sounds(tmp_path: Path) -> None:
    for name in ("bell.xyz", "chirp.mp3", "error.log", "warning", "horn.mp3", "horn.txt"):
        (tmp_path / name).touch()
    open_before = os.listdir("/dev/fd")
    for name in ("bell.wav", "horn.WAV", "chirp.wav", "a b.wav", "bad\n.wav"):
        write_tone(tmp_path / name, 0.02, RATE)
    library = SoundLibrary(str(tmp_path))
    assert library.names() == ["a b", "bell", "chirp", "error", "horn", "warning"]
    assert [library.refusal(name) for name in library.names()] == [None] * 6
    assert len(os.listdir("/dev/fd")) == len(open_before)
    with Engine(sounds=str(tmp_path)) as engine:  # a file replaces the built-in sound of its name
        assert completed(started(engine), "chirp") == pytest.approx(0.02, abs=0.001)
    assert SoundLibrary(f"{tmp_path}/gone").names() == ["chirp", "error", "warning"]
