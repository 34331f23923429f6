"""No player or no device (row 41): never SUCCEEDED, always the error, and heard as soon as it is installed.

`tests/faults/test_sound_server.py` tests a device that is lost or frozen in mid-sentence.
"""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

import pytest

from tests.conformance import stopped
from tests.conformance.hearing import HOME, LOW, assert_aborted, heard
from tests.support.compare import assert_silent
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    import pathlib

    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.processes import Finished, Talk
    from tests.support.sink import Sink

#: Settings of ALSA for a card that there is not.
NO_CARD = "pcm.!default { type hw card 31 }\nctl.!default { type hw card 31 }\n"


def test_row_41_without_a_player_a_goal_is_aborted_until_one_is_installed(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path, voice: Voice
) -> None:
    env = {"PATH": str(tmp_path), "PULSE_SERVER": f"unix:{tmp_path}/none"}  # aplay does not use it here
    talk = voice.serve(make_talk, sink, env=env)
    _assert_aborted(talk, "no_player", "no player found: install alsa-utils (aplay)", "pulseaudio-utils (pacat)")
    aplay = shutil.which("aplay")
    assert aplay
    (tmp_path / "aplay").symlink_to(aplay)
    assert talk.run("say", "--wait", "--", HOME).code == 0
    stopped.assert_heard_after_stop(heard(talk), LOW, [HOME], begun=False, voice=voice)


def test_row_41_without_a_device_the_players_line_is_told_within_a_second(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path, voice: Voice
) -> None:
    configuration = tmp_path / ".asoundrc"

    with limits():
        configuration.write_text(NO_CARD)
        env = {"HOME": str(tmp_path), "PULSE_SERVER": f"unix:{tmp_path}/none"}
        talk = voice.serve(make_talk, sink, env=env)
        done = _assert_aborted(talk, "audio_device", "aplay: audio open error: No such file or directory")
        shutil.copy(os.path.join(sink.directory, ".asoundrc"), configuration)
        assert talk.run("say", "--wait", "--", HOME).code == 0
        stopped.assert_heard_after_stop(heard(talk), LOW, [HOME], begun=False, voice=voice)
        assert_within(done.seconds, 1, "`say --wait` without a device")


@pytest.mark.parametrize(
    ("player", "line"),
    [
        ("aplay", "aplay: audio open error: No such file or directory"),
        ("pacat", "No such entity"),
        ("pulse", 'the sound server has no sink "nonesuch": see pactl list short sinks'),
    ],
)
def test_row_41_a_device_of_another_name_is_told(make_talk: MakeTalk, sink: Sink, player: str, line: str) -> None:
    talk = make_talk("--player", player, "--device", "nonesuch", sink=sink)
    _assert_aborted(talk, "audio_device", line)
    assert_silent(heard(talk))


def _assert_aborted(talk: Talk, reason: str, *words: str) -> Finished:
    """Assert that a goal is ABORTED before anything is heard, and that its client says so."""
    done = talk.run("say", "--wait", "--", LOW)
    goal = talk.goal(done.id)
    assert (done.code, talk.watcher.states(done.id)) == (4, ["PENDING", "ACTIVE", "ABORTED"]), done
    assert goal["message"] in done.err, done
    assert_aborted(goal, reason, *words)
    assert goal["spoken"] == ""
    return done
