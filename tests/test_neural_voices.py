"""Neural voices through a server: listed, asked for, and found when they are put there while it runs."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.synthesizers.inference import NEEDED
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.support import tiny_voice
from tests.support.surroundings import needs_packages, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def env(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Return the environment of a server for which two voices are there."""
    needs_packages(*NEEDED)
    tiny_voice.put(tmp_path / "voices", "tiny")
    tiny_voice.put(tmp_path / "voices", "broken", b"no model")
    with short_directory() as home:
        os.mkdir(f"{home}/run", 0o700)
        yield environment(home, XDG_RUNTIME_DIR=f"{home}/run", TALK_VOICES=str(tmp_path / "voices"))


def test_goals_are_spoken_with_one_and_end_in_words_where_it_is_broken(env: dict[str, str], tmp_path: Path) -> None:
    with serving(env, "--rate", "450"):
        assert run([*TALK, "say", "--wait", "--voice", "piper/tiny", "hello"], env).code == 0
        done = run([*TALK, "say", "--wait", "--voice", "piper/broken", "hello"], env)
        assert done.code == 4
        assert f"{tmp_path}/voices/broken.onnx is no ONNX model: get the voice anew" in done.err
        goal = json.loads(run([*TALK, "--json", "log", "-n", "1"], env).out)
        assert (goal["state"], goal["reason"]) == ("ABORTED", "voice_failed")
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0


def test_one_that_is_put_there_later_is_listed_and_can_be_asked_for(env: dict[str, str], tmp_path: Path) -> None:
    with serving(env, "--rate", "450"):
        listed = run([*TALK, "voices"], env).out
        assert "piper/tiny" in listed
        for command in (["say", "--voice", "piper/late", "hello"], ["set", "--voice", "piper/late"]):
            done = run([*TALK, *command], env)
            assert done.code in {2, 5}
            assert 'unknown voice "piper/late"' in done.err
        tiny_voice.put(tmp_path / "voices", "late")
        assert run([*TALK, "set", "--voice", "piper/late"], env).code == 0
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0
        listed = run([*TALK, "voices"], env).out
        assert listed.index("+f3") < listed.index("piper/late")
        (tmp_path / "voices" / "late.onnx").unlink()
        assert "piper/late" not in run([*TALK, "voices"], env).out


def test_a_file_is_rendered_with_one(env: dict[str, str], tmp_path: Path) -> None:
    target = tmp_path / "x.wav"
    assert run([*TALK, "say", "-o", str(target), "--voice", "piper/tiny", "hello"], env).code == 0
    assert target.stat().st_size > 10_000
    done = run([*TALK, "say", "-o", str(target), "--voice", "piper/broken", "hello"], env)
    assert done.code == 4
    assert "get the voice anew" in done.err


def test_a_server_for_a_voice_that_is_not_there_ends_with_usage(env: dict[str, str]) -> None:
    done = run([*TALK, "serve", "--player", "null", "--voice", "piper/none"], env)
    assert done.code == 2
    assert 'unknown voice "piper/none"' in done.err
