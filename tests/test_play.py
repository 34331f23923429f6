"""The command `talk play`, and the option --sounds of `talk serve`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from tests.conformance.bareserve import TALK, environment, run
from tests.support.wav import write_tone

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk


def test_a_sound_is_shown_as_a_sound(make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True)
    done = talk.run("play", "-w", "--volume", "0.5", "chirp")
    assert (done.code, done.err) == (0, "")
    assert 'sound "chirp"' in talk.run("log").out
    assert 'sound "chirp"' in talk.run("status").out
    details = talk.run("status", done.id).out
    assert 'sound    "chirp"' in details
    assert "spoken" not in details
    assert f'{done.id} SUCCEEDED after 0.1 s: sound "chirp" from ' in talk.log


def test_the_directory_of_sounds_may_have_any_name(make_talk: MakeTalk, tmp_path: Path) -> None:
    directory = tmp_path / os.fsdecode(b"a \xff b")
    directory.mkdir()
    (directory / "song.mp3").write_bytes(b"ID3")
    write_tone(directory / "horn.wav", 0.05, 22_050)
    talk = make_talk("--player", "null", "--sounds", str(directory))
    assert talk.run("play", "-w", "horn").code == 0
    done = talk.run("play", "song")
    assert (done.code, "is not a WAV file, but MP3" in done.err) == (5, True), done


def test_a_missing_directory_of_sounds_is_a_usage_error(tmp_path: Path) -> None:
    done = run([*TALK, "serve", "--sounds", "nowhere"], environment(str(tmp_path)))
    assert (done.code, done.out) == (2, "")
    assert done.err == f"talk: --sounds: {os.getcwd()}/nowhere is not a readable directory\n"
    done = run([*TALK, "serve", "--sounds", "nowhere", "--print-unit", "user"], environment(str(tmp_path)))
    assert f"--sounds={os.getcwd()}/nowhere" in done.out
