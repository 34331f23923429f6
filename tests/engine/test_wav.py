"""The player "file:": sentences in one WAV file, which is valid at any time and never somebody else's."""

from __future__ import annotations

import os
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.players.base import CannotSpeak
from talkcli.engine.players.wav import WavPlayer, WavStreamPlayer
from tests.engine.spawned import Spawned

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def _write(path: Path, data: bytes, rate: int = 22050) -> None:
    file = WavPlayer(str(path), rate)
    assert file.offer(memoryview(data)) == len(data)
    file.close()
    assert file.ended()


def _read(path: Path) -> bytes:
    with wave.open(str(path), "rb") as file:
        assert (file.getnchannels(), file.getsampwidth(), file.getframerate()) == (1, 2, 22050)
        return file.readframes(file.getnframes())


def test_sentences_are_appended_to_an_empty_file_and_behind_them_rests_of_a_crash_are_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    path.touch()
    _write(path, b"one ")
    assert _read(path) == b"one "
    with path.open("ab") as file:
        file.write(b"torn!")
    _write(path, b"two ")
    assert _read(path) == b"one two "
    assert path.stat().st_size == 44 + 8


def test_a_killed_sentence_leaves_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    file = WavPlayer(str(path), 22050)
    file.offer(memoryview(b"one "))
    file.kill()
    file.kill()
    assert file.gone()
    assert _read(path) == b"one "


def _stereo(path: Path) -> None:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(2)
        file.setframerate(22050)
        file.writeframes(b"12345678")


def _with_a_chunk_behind(path: Path) -> None:
    _write(path, b"one ")
    data = bytearray(path.read_bytes() + b"LIST\x04\0\0\0INFO")
    data[4:8] = (len(data) - 8).to_bytes(4, "little")
    path.write_bytes(data)


def _cut_short(path: Path) -> None:
    _write(path, b"one two ")
    os.truncate(path, 46)


def _text(path: Path) -> None:
    path.write_text("my diary, which is a good deal longer than the header of a WAV file")


def _other_rate(path: Path) -> None:
    _write(path, b"one ", 16000)


def _of_unknown_length(path: Path) -> None:
    """Write as `say -o -` does."""
    with path.open("wb") as file:
        WavStreamPlayer(file.fileno(), 22050, first=True).offer(memoryview(b"one "))


@pytest.mark.parametrize("make", [_of_unknown_length, _stereo, _with_a_chunk_behind, _cut_short, _text, _other_rate])
def test_other_content_is_refused_and_left_alone(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "x.wav"
    make(path)
    before = path.read_bytes()
    with pytest.raises(CannotSpeak) as caught:
        WavPlayer(str(path), 22050)
    assert caught.value.reason == "audio_device"
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


def test_a_path_that_takes_no_samples_is_refused_and_no_descriptor_is_left(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    before = os.listdir("/proc/self/fd")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "missing" / "x.wav", "", "/dev/null", "/dev/full"):
        with pytest.raises(CannotSpeak) as caught:
            WavPlayer(str(path), 22050)
        assert caught.value.reason == "audio_device"
    assert os.listdir("/proc/self/fd") == before


def test_the_error_reaches_the_goal_and_a_stop_leaves_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "x.wav"
    with Spawned(f"file:{path}") as engine:
        ended = engine.spoken("yes", "g1")
        assert (ended.reason, ended.message) == ("audio_device", f"{path} cannot be written: No such file or directory")
        path.parent.mkdir()
        engine.say("one two three four five. " * 300, "g2")
        engine.until_word()
        engine.stop("g2")
        length = len(_read(path))
        assert length > 0
        assert path.stat().st_size == 44 + length
        ended = engine.spoken("yes", "g3")
        assert ended.duration is not None
        assert len(_read(path)) == length + round(ended.duration * 22050) * 2
