"""The player "file:": sentences in one WAV file, which is valid at any time and never somebody else's."""

from __future__ import annotations

import os
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.players.base import CannotSpeak
from talkcli.engine.players.wav import WavPlayer, WavStreamPlayer
from tests.engine.spawned import Spawned

if TYPE_CHECKING:
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


def test_sentences_are_appended(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    _write(path, b"one ")
    assert _read(path) == b"one "
    _write(path, b"two ")
    assert _read(path) == b"one two "


def test_a_killed_sentence_leaves_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    file = WavPlayer(str(path), 22050)
    file.offer(memoryview(b"one "))
    file.kill()
    file.kill()
    assert file.gone()
    assert _read(path) == b"one "


def test_what_a_crash_left_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    _write(path, b"one ")
    with path.open("ab") as file:
        file.write(b"torn!")
    _write(path, b"two ")
    assert _read(path) == b"one two "
    assert path.stat().st_size == 44 + 8


def test_an_empty_file_is_filled(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    path.touch()
    _write(path, b"one ")
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
    """What `say -o -` writes."""
    with path.open("wb") as file:
        WavStreamPlayer(file.fileno(), 22050, first=True).offer(memoryview(b"one "))


@pytest.mark.parametrize("make", [_of_unknown_length, _stereo, _with_a_chunk_behind, _cut_short, _text, _other_rate])
def test_other_content_is_refused_and_left_alone(tmp_path: Path, make: object) -> None:
    path = tmp_path / "x.wav"
    assert callable(make)
    make(path)
    before = path.read_bytes()
    with pytest.raises(CannotSpeak) as caught:
        WavPlayer(str(path), 22050)
    assert caught.value.reason == "audio_device"
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "missing" / "x.wav", "", "/dev/null"):
        with pytest.raises(CannotSpeak) as caught:
            WavPlayer(str(path), 22050)
        assert caught.value.reason == "audio_device"


def test_a_full_disk_is_an_error_and_no_descriptor_is_left() -> None:
    before = os.listdir("/proc/self/fd")
    with pytest.raises(CannotSpeak):
        WavPlayer("/dev/full", 22050)
    assert os.listdir("/proc/self/fd") == before


def test_the_error_reaches_the_goal(tmp_path: Path) -> None:
    with Spawned(f"file:{tmp_path / 'missing' / 'x.wav'}") as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken("yes")
        assert ended.reason == "audio_device"
        assert ended.message == f"{tmp_path / 'missing' / 'x.wav'} cannot be written: No such file or directory"
        (tmp_path / "missing").mkdir()
        assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED
        assert _read(tmp_path / "missing" / "x.wav")


def test_a_stop_while_writing_leaves_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    with Spawned(f"file:{path}") as engine:
        engine.until(protocol.Ready)
        engine.say("one two three four five. " * 300)
        engine.until(protocol.Word)
        engine.send(protocol.Stop("g1"))
        assert engine.until(protocol.Ended).outcome == protocol.STOPPED
        length = len(_read(path))
        assert length > 0
        assert path.stat().st_size == 44 + length
        ended = engine.spoken("yes", "g2")
        assert ended.duration is not None
        assert len(_read(path)) == length + round(ended.duration * 22050) * 2
