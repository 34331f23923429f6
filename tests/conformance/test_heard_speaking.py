"""Sentences that are spoken, with the sound of libespeak-ng; and goals without a player or a device (row 41)."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.players.choice import MOST
from tests.conformance import stopped
from tests.conformance.hearing import (
    HELP,
    HOME,
    LONG,
    LOW,
    assert_aborted,
    assert_same,
    heard,
    send,
)
from tests.conformance.voices import with_both
from tests.support.compare import assert_heard, assert_silent, extent
from tests.support.reference import RATE, played, render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    import pathlib

    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.processes import Finished, Talk
    from tests.support.sink import Sink

SPOKEN = ["PENDING", "ACTIVE", "SUCCEEDED"]
#: Seconds that the monitor may lose at the start of a stream.
LOST = 0.012


def test_row_01_a_goal_is_spoken_and_its_end_is_told(talk: Talk) -> None:
    done = talk.run("say", "--wait", "--", LOW)
    assert (done.code, done.err) == (0, "")
    goal = talk.goal(done.id)
    assert (goal["state"], goal["message"]) == ("SUCCEEDED", "Talk completed successfully")
    assert (goal["reason"], goal["spoken"]) == (None, LOW)
    assert talk.watcher.states(done.id) == SPOKEN
    (reference,) = render([LOW])
    assert goal["duration"] == pytest.approx(len(played(reference)) / RATE, abs=0.001)
    assert_heard(heard(talk), [reference])


@with_both
def test_row_23_goals_are_spoken_in_the_order_in_which_they_came(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    talk = voice.serve(make_talk, sink)
    texts = [HELP, LOW, HOME]
    sent = [talk.run("say", "--", text).id for text in texts]
    done = talk.run("wait", *sent)
    assert (done.code, done.err) == (0, "")
    for each in sent:
        assert talk.watcher.states(each) == SPOKEN
    assert_heard(heard(talk), voice.render(texts))


def test_row_18_a_pending_goal_that_is_cancelled_is_never_spoken(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    talk = voice.serve(make_talk, sink)
    texts = [LONG, LOW, "never to be heard", HOME]
    active, first, second, third = [send(talk, text) for text in texts]
    talk.watcher.wait_for_word(active)
    canceled = talk.run("cancel", second)
    assert (canceled.code, canceled.id, canceled.err) == (0, second, "")
    assert talk.goal(active)["state"] == "ACTIVE"
    assert talk.watcher.states(second) == ["PENDING", "RECALLED"]
    goal = talk.goal(second)
    assert (goal["state"], goal["reason"]) == ("RECALLED", "canceled")
    assert talk.watcher.wait_for_terminal(third, 10) == "SUCCEEDED"
    assert talk.watcher.states(active) == talk.watcher.states(first) == SPOKEN
    del texts[2]
    assert_heard(heard(talk), voice.render(texts))


def test_row_30_a_text_is_spoken_and_never_executed(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path, voice: Voice, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = [
        "$(touch x)",
        "`touch x`",
        "low; touch x | touch x & touch y",
        "it's \"touch x\" '; touch x; '",
        "one\ntouch x\ntwo",
        "hello \U0001f600 %s %n \\n",
        "-5",
    ]
    monkeypatch.chdir(tmp_path)  # server and clients run in this directory
    talk = voice.serve(make_talk, sink)
    refused = talk.run("say", "--wiat", LOW)
    assert (refused.code, refused.out, "talk say -- " in refused.err) == (2, "", True)
    said = [talk.run("say", "--", text) for text in texts]
    assert [(each.code, each.err) for each in said] == [(0, "")] * len(texts)
    assert talk.run("wait", *(each.id for each in said)).code == 0
    assert [talk.goal(each.id)["text"] for each in said] == texts
    assert talk.run("say", "--wait", *LOW.split()).code == 0  # words are joined
    assert_heard(heard(talk), voice.render([*texts, LOW]))
    assert os.listdir(tmp_path) == []


def test_the_wheels_library_speaks_if_the_system_has_none(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("espeakng_loader")
    # The loader finds this file first and can't load it. The reference rendering comes from the wheel then, too.
    (tmp_path / "libespeak-ng.so.1").touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    talk = make_talk(sink=sink)
    assert talk.run("say", "--wait", "--", LOW).code == 0
    assert "(espeakng-loader)" in talk.log
    assert_same(heard(talk), render([LOW])[0])


def test_only_silence_is_left_out_between_queued_sentences_and_never_too_much(talk: Talk) -> None:
    """The time that a change of goals takes is a matter of speed; that enough of the pause stays is not."""
    texts = [LOW, HOME, LOW]
    goals = [send(talk, text) for text in texts]
    assert talk.watcher.wait_for_terminal(goals[-1], 20) == "SUCCEEDED"
    references = render(texts)
    found = assert_heard(heard(talk), references)
    for number in range(len(texts) - 1):
        before, after = (extent(each) for each in references[number : number + 2])
        assert before is not None
        assert after is not None
        own = (len(references[number]) - before[1] + after[0]) / RATE
        pause = (found[number + 1].offset - found[number].offset) / RATE - found[number].expected
        assert pause > own - MOST - LOST
        whole = len(references[number]) / RATE
        assert whole - MOST <= talk.goal(goals[number])["duration"] <= whole + 0.001
    assert abs(talk.goal(goals[-1])["duration"] - len(references[-1]) / RATE) < 0.001


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
