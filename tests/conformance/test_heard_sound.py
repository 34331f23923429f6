"""No player, no device, a device that is lost or frozen: never SUCCEEDED, always the error, heard when it is back."""

from __future__ import annotations

import os
import shutil
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.players.pulse import SUSPENDED_FOR
from tests.conformance import stopped
from tests.conformance.hearing import (
    HOME,
    LONG,
    LOW,
    assert_aborted,
    begin_with_client,
    heard,
)
from tests.support.compare import assert_begun, assert_silent
from tests.support.sink import Sink
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    import pathlib
    from collections.abc import Callable, Iterator

    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Finished, Process, Talk

ABORTED = ["PENDING", "ACTIVE", "ABORTED"]
#: Where ALSA finds no card.
NO_CARD = "pcm.!default { type hw card 31 }\nctl.!default { type hw card 31 }\n"


#: What is said of a sink that is gone in mid-sentence, and of a sound server that is.
LOST = {
    "aplay": ("aplay: ", "error: Input/output error"),
    "pulse": ("the sound server ended the stream",),
}
each_player = pytest.mark.parametrize("player", LOST)


@pytest.fixture(scope="module")
def broken() -> Iterator[list[Sink]]:
    """Sound servers that tests of this module have broken and brought back."""
    found: list[Sink] = []
    yield found
    for each in found:
        each.close()


@pytest.fixture
def breakable(broken: list[Sink]) -> Sink:
    """A sound server for a test that breaks it and brings it back: the one of the test before, if that did."""
    if broken:
        with broken[-1].record() as recording:
            if recording.wait_until(time.monotonic() + 0.1):
                return broken[-1]
    broken.append(Sink())
    return broken[-1]


def test_row_41_without_a_player_a_goal_is_aborted_until_one_is_installed(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path, voice: Voice
) -> None:
    env = {"PATH": str(tmp_path), "PULSE_SERVER": f"unix:{tmp_path}/none"}  # which aplay does not go by here
    talk = voice.serve(make_talk, sink, env=env)
    goal = _aborted(talk, talk.run("say", "--wait", "--", LOW))
    assert_aborted(goal, "no_player", "no player found: install alsa-utils (aplay)", "pulseaudio-utils (pacat)")
    assert goal["spoken"] == ""
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
        done = talk.run("say", "--wait", "--", LOW)
        goal = _aborted(talk, done)
        assert_aborted(goal, "audio_device", "aplay: audio open error: No such file or directory")
        assert goal["spoken"] == ""
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
def test_row_41_a_device_of_another_name_is_told(
    make_talk: MakeTalk, sink: Sink, player: str, line: str, voice: Voice
) -> None:
    talk = voice.serve(make_talk, sink, "--player", player, "--device", "nonesuch")
    assert_aborted(_aborted(talk, talk.run("say", "--wait", "--", LOW)), "audio_device", line)
    assert_silent(heard(talk))


@each_player
def test_row_41_a_device_that_is_lost_in_mid_sentence(
    make_talk: MakeTalk, breakable: Sink, player: str, voice: Voice
) -> None:
    sink = breakable
    talk = voice.serve(make_talk, sink, "--player", player)
    _, client = begin_with_client(talk, LONG, number=5)
    sink.unload()
    _lost(talk, client, *LOST[player], voice=voice)
    sink.reload()
    _heard_again(talk, sink, LONG, voice)


@pytest.mark.slow
@each_player
def test_row_41_a_sound_server_that_is_killed_in_mid_sentence(
    make_talk: MakeTalk, breakable: Sink, player: str, voice: Voice
) -> None:
    sink = breakable
    talk = voice.serve(make_talk, sink, "--player", player)
    _, client = begin_with_client(talk, LONG, number=5)
    sink.kill_server()
    _lost(talk, client, *LOST[player], voice=voice)
    without = voice.serve(make_talk, sink)
    goal = _aborted(without, without.run("say", "--wait", "--", LOW))
    assert_aborted(goal, "audio_device", "aplay: audio open error: Connection refused")
    sink.start_server()
    _heard_again(talk, sink, LONG, voice)
    _heard_again(without, sink, LOW, voice)


@each_player
@pytest.mark.parametrize(
    ("hold", "let_go"),
    [
        pytest.param(Sink.suspend, Sink.resume, marks=pytest.mark.slow, id="suspended"),
        pytest.param(Sink.freeze, Sink.thaw, id="frozen"),
    ],
)
def test_row_41_a_sink_that_takes_no_sound_in_mid_sentence(
    make_talk: MakeTalk,
    breakable: Sink,
    hold: Callable[[Sink], None],
    let_go: Callable[[Sink], None],
    player: str,
    voice: Voice,
) -> None:
    sink = breakable

    with limits():
        talk = voice.serve(make_talk, sink, "--player", player)
        _, client = begin_with_client(talk, LONG, number=5)
        hold(sink)
        held = time.monotonic()
        done = talk.finish(client)
        ended = time.monotonic()
        let_go(sink)
        goal = _aborted(talk, done)
        told = player == "pulse" and hold is Sink.suspend
        assert_aborted(goal, "audio_stalled", "has suspended null" if told else f"{player} took no sound for 3 s")
        assert goal["spoken"].startswith("two three")
        assert goal["spoken"] != LONG
        assert talk.run("say", "--wait", "--", HOME).code == 0
        # What the sound server had when it was frozen is heard when it goes on, so all of it is looked at here.
        stopped.assert_heard_after_stop(heard(talk), LONG, [HOME], voice=voice)
        # 3 s after it took something the last time, which the engine sees within a tenth; and the end of the client.
        # A sound server that suspends its sink says so to its own clients.
        limit = SUSPENDED_FOR + 0.3 if told else 3.3
        assert_within(ended - held, limit, "the end of a goal whose sink takes no sound")


def _aborted(talk: Talk, done: Finished) -> Message:
    """Assert that a client's goal was ABORTED and that the client told so; return the goal."""
    goal = talk.goal(done.id)
    assert (done.code, talk.watcher.states(done.id)) == (4, ABORTED), done
    assert goal["message"] in done.err, done
    return goal


def _lost(talk: Talk, client: Process, *words: str, voice: Voice) -> None:
    """Assert of a client whose goal, the server's first, was LONG: it ended in mid-sentence, as the sound did."""
    goal = _aborted(talk, talk.finish(client))
    assert_aborted(goal, "audio_lost", *words)
    assert goal["spoken"].startswith("two three")
    assert goal["spoken"] != LONG
    assert_begun(talk.recording, voice.render([LONG])[0], shortest=0.2)


def _heard_again(talk: Talk, sink: Sink, failed: str, voice: Voice) -> None:
    """Assert that the next goal is heard whole, after the first one of a server failed."""
    with sink.record() as recording:
        assert talk.run("say", "--wait", "--", HOME).code == 0
    stopped.assert_heard_after_stop(recording, failed, [HOME], begun=False, voice=voice)
