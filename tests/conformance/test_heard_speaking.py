"""Spoken sentences and sounds, missing players and devices (row 41), and word events (row 42).

A word event must arrive when the word is heard. This is measured in the recorded sound.
"""

from __future__ import annotations

import os
import shutil
import statistics
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.conformance import stopped
from tests.conformance.hearing import HELP, HOME, LONG, LOW, assert_aborted, await_word, heard, send
from tests.conformance.voices import ESPEAK, with_both
from tests.support.compare import (
    EXTENT_TOLERANCE_S,
    assert_heard,
    assert_only_beginning,
    assert_silent,
    compare,
    extent,
    time_heard,
)
from tests.support.recording import LOUD
from tests.support.reference import RATE, Rendering, Sentence, render, without_leading_zeros
from tests.support.sink import DistantSink
from tests.support.timing import assert_within, limits
from tests.support.wav import pitch, write_tone

if TYPE_CHECKING:
    import pathlib

    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Finished, Talk
    from tests.support.sink import Sink

SPOKEN = ["PENDING", "ACTIVE", "SUCCEEDED"]


def test_row_01_a_goal_is_spoken_and_its_end_is_reported(talk: Talk) -> None:
    done = talk.run("say", "--wait", "--", LOW)
    assert (done.code, done.err) == (0, "")
    goal = talk.goal(done.id)
    assert (goal["state"], goal["message"]) == ("SUCCEEDED", "Talk completed successfully")
    assert (goal["reason"], goal["spoken"]) == (None, LOW)
    assert talk.watcher.states(done.id) == SPOKEN
    (reference,) = render([LOW])
    assert goal["duration"] == pytest.approx(len(without_leading_zeros(reference)) / RATE, abs=0.001)
    assert_heard(heard(talk), [reference])


@with_both
def test_row_23_goals_are_spoken_in_the_order_they_were_sent(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    talk = voice.serve(make_talk, sink)
    texts = [HELP, LOW, HOME]
    sent = [talk.run("say", "--", text).id for text in texts]
    done = talk.run("wait", *sent)
    assert (done.code, done.err) == (0, "")
    for goal_id in sent:
        assert talk.watcher.states(goal_id) == SPOKEN
    assert_heard(heard(talk), voice.render(texts))


def test_row_18_a_cancelled_pending_goal_is_never_spoken(make_talk: MakeTalk, sink: Sink) -> None:
    talk = ESPEAK.serve(make_talk, sink)
    active, first, second, third = [send(talk, text) for text in (LONG, LOW, "never to be heard", HOME)]
    talk.watcher.wait_for_word(active)
    canceled = talk.run("cancel", second)
    assert (canceled.code, canceled.id, canceled.err) == (0, second, "")
    assert talk.goal(active)["state"] == "ACTIVE"
    assert talk.watcher.states(second) == ["PENDING", "RECALLED"]
    assert talk.goal(second)["reason"] == "canceled"
    assert talk.watcher.wait_for_terminal(third, 10) == "SUCCEEDED"
    assert talk.watcher.states(active) == talk.watcher.states(first) == SPOKEN
    assert_heard(heard(talk), ESPEAK.render([LONG, LOW, HOME]))


def test_row_30_a_text_is_spoken_and_never_executed(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = ["$(touch x) `touch x`", "it's \"a\" '; touch x;\n\U0001f600", "-5"]
    monkeypatch.chdir(tmp_path)  # server and clients run in this directory
    talk = ESPEAK.serve(make_talk, sink)
    refused = talk.run("say", "--wiat", LOW)
    assert (refused.code, refused.out, "talk say -- " in refused.err) == (2, "", True)
    clients = [talk.run("say", "--", text) for text in texts]
    assert [(client.code, client.err) for client in clients] == [(0, "")] * len(texts)
    assert talk.run("wait", *(client.id for client in clients)).code == 0
    assert [talk.goal(client.id)["text"] for client in clients] == texts
    assert talk.run("say", "--wait", *LOW.split()).code == 0  # arguments are joined
    assert_heard(heard(talk), ESPEAK.render([*texts, LOW]))
    assert os.listdir(tmp_path) == []


def test_a_sound_is_heard_and_a_sentence_follows(make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path) -> None:
    write_tone(tmp_path / "tone.wav", 0.5, 44_100, channels=2, bits=24)
    talk = make_talk("--sounds", str(tmp_path), sink=sink)
    sound = talk.run("play", "tone").id
    assert talk.run("say", "--wait", "--", LOW).code == 0
    assert talk.watcher.states(sound) == ["PENDING", "ACTIVE", "SUCCEEDED"]
    goal = talk.goal(sound)
    assert (goal["format"], goal["text"], goal["message"]) == ("sound", "tone", "Talk completed successfully")
    assert (goal["spoken"], goal["spoken_end"], goal["voice"]) == (None, None, None)
    assert (goal["duration"], goal["heard"]) == pytest.approx((0.5, 0.5), abs=0.001)
    samples = heard(talk)
    loud = np.flatnonzero(np.abs(samples.astype(int)) > LOUD)
    end = loud[np.flatnonzero(np.diff(loud) > 0.1 * RATE)[0]] + 1
    tone = samples[loud[0] : end]
    assert len(tone) / RATE == pytest.approx(0.5, abs=0.02)
    assert pitch(tone, RATE) == pytest.approx(1_000, rel=0.01)
    assert_heard(samples[end:], render([LOW]))


#: ALSA settings for a card that does not exist.
NO_CARD = "pcm.!default { type hw card 31 }\nctl.!default { type hw card 31 }\n"


def test_row_41_goals_are_aborted_until_a_player_is_installed(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path
) -> None:
    env = {"PATH": str(tmp_path), "PULSE_SERVER": f"unix:{tmp_path}/none"}  # aplay does not use it here
    talk = ESPEAK.serve(make_talk, sink, env=env)
    _assert_aborted(talk, "no_player", "no player found; install alsa-utils (aplay)", "pulseaudio-utils (pacat)")
    aplay = shutil.which("aplay")
    assert aplay
    (tmp_path / "aplay").symlink_to(aplay)
    assert talk.run("say", "--wait", "--", HOME).code == 0
    stopped.assert_heard_after_stop(heard(talk), LOW, [HOME], first_heard=False)


def test_row_41_a_missing_device_is_reported_within_a_second(
    make_talk: MakeTalk, sink: Sink, tmp_path: pathlib.Path
) -> None:
    configuration = tmp_path / ".asoundrc"

    with limits():
        configuration.write_text(NO_CARD)
        env = {"HOME": str(tmp_path), "PULSE_SERVER": f"unix:{tmp_path}/none"}
        talk = ESPEAK.serve(make_talk, sink, env=env)
        done = _assert_aborted(talk, "audio_device", "aplay: audio open error: No such file or directory")
        shutil.copy(os.path.join(sink.directory, ".asoundrc"), configuration)
        assert talk.run("say", "--wait", "--", HOME).code == 0
        stopped.assert_heard_after_stop(heard(talk), LOW, [HOME], first_heard=False)
        assert_within(done.seconds, 1, "`say --wait` without a device")


@pytest.mark.parametrize(
    ("player", "line"),
    [
        ("aplay", "aplay: audio open error: No such file or directory"),
        ("pacat", "No such entity"),
        ("pulse", 'the sound server has no sink "nonesuch"; list them with: pactl list short sinks'),
    ],
)
def test_row_41_an_unknown_device_name_is_reported(make_talk: MakeTalk, sink: Sink, player: str, line: str) -> None:
    talk = make_talk("--player", player, "--device", "nonesuch", sink=sink)
    _assert_aborted(talk, "audio_device", line)
    assert_silent(heard(talk))


def _assert_aborted(talk: Talk, reason: str, *texts: str) -> Finished:
    """Assert that a goal is ABORTED before anything is heard, and that its client reports it."""
    done = talk.run("say", "--wait", "--", LOW)
    goal = talk.goal(done.id)
    assert (done.code, talk.watcher.states(done.id)) == (4, ["PENDING", "ACTIVE", "ABORTED"]), done
    assert goal["message"] in done.err, done
    assert_aborted(goal, reason, *texts)
    assert goal["spoken"] == ""
    return done


#: Limits in seconds between a word's event and its sound: for the median, and for the worst word.
MEDIAN, WORST = 0.03, 0.1
#: Minimum correlation of a sentence that came through a tunnel. Measured: 0.985, and 0.1 for another sentence.
ALIKE = 0.95
#: Ten words with characters of one to four bytes, which start with a short silence (see `hearing`). libespeak-ng speaks
#: "from the" and "this one" as one word, and reports 東京 several times.
TEN = "coming from the café 東京 is 😀 naïve, this one"


@dataclass(frozen=True)
class Measured:
    """The word events of a spoken sentence, and their delays in seconds after the words."""

    words: list[Message]
    received: list[float]  # as received by the watcher; empty if gaps made a measurement impossible
    stamped: list[float]  # from `at`, the server's clock

    def assert_in_time(self) -> None:
        """Assert that no event came too early or too late."""
        for name, late in (("received", self.received), ("stamped", self.stamped)) if self.received else ():
            median, worst = statistics.median(map(abs, late)), max(map(abs, late))
            print(f"{name}: median {median * 1000:.1f} ms, {min(late) * 1000:.1f} to {max(late) * 1000:.1f} ms")
            assert_within(median, MEDIAN, f"the median of words, as {name},")
            assert_within(worst, WORST, f"the worst of words, as {name},")


def measure(talk: Talk, text: str, rate: int, *, exact: bool = True) -> Measured:
    """Speak a server's first sentence, stop the server, and return the measurement.

    Args:
        exact: Whether the sink plays every sample unchanged, unlike a tunnel.
    """
    wall = time.time() - time.monotonic()
    done = talk.run("say", "--wait", "--", text, timeout=60)
    assert (done.code, done.err) == (0, "")
    samples = heard(talk)
    reference = ESPEAK.render_with_words(Sentence(text, rate))
    compared = compare(samples, reference.samples)
    words = talk.watcher.words(done.id)
    if compared.heard > compared.expected + EXTENT_TOLERANCE_S:
        assert_within(compared.heard - compared.expected, EXTENT_TOLERANCE_S, "the gaps in a sentence")
        return Measured(words, [], [])  # after a gap, every word is late
    assert compared.same or (not exact and compared.correlation > ALIKE), compared
    silence_s = (len(reference.samples) - len(without_leading_zeros(reference.samples))) / RATE
    offsets = [max(silence_s, position(reference, word["start"])) for word in words]
    moments = [time_heard(talk.recording, compared, reference.samples, offset) for offset in offsets]
    talk.stop()
    received = [talk.watcher.arrived(word) - moment for word, moment in zip(words, moments, strict=True)]
    stamped = [word["at"] - wall - moment for word, moment in zip(words, moments, strict=True)]
    return Measured(words, received, stamped)


def position(reference: Rendering, start: int) -> float:
    """Return the seconds from the start of the sound to a word, the first time if it is reported several times."""
    return next(seconds for offset, _, seconds in reference.words if offset == start)


def test_word_events_wait_for_an_output_with_high_latency(make_talk: MakeTalk, sink: Sink) -> None:
    """With the engine's own clock, the events would come 200 ms too early."""
    with limits(), DistantSink(sink) as distant:
        talk = make_talk("--rate", "350", sink=sink, env=distant.env)
        measure(talk, "coming home to the charger in the kitchen", 350, exact=False).assert_in_time()


@pytest.mark.parametrize("player", ["aplay", "pulse"])
def test_row_42_words_of_any_script_are_reported_when_they_are_heard(
    make_talk: MakeTalk, sink: Sink, player: str
) -> None:
    with limits():
        measured = measure(make_talk("--rate", "350", "--player", player, sink=sink), TEN, 350)
        measured.assert_in_time()
    words = measured.words
    assert [word["word"] for word in words] == ["coming", "from", "café", "東京", "is", "😀", "naïve", "this"]
    assert [word["start"] for word in words] == [TEN.index(word["word"]) for word in words]
    assert [word["end"] - word["start"] for word in words] == [len(word["word"]) for word in words]
    assert [word["number"] for word in words] == list(range(1, 9))
    times = [word["time"] for word in words]
    assert times[0] == 0
    assert times == sorted(times)


def test_row_42_a_stopped_goal_reports_the_words_that_were_heard(make_talk: MakeTalk, sink: Sink) -> None:
    reference = ESPEAK.render_with_words(Sentence(LONG))
    bounds = extent(reference.samples)
    assert bounds is not None

    with limits():
        talk = ESPEAK.serve(make_talk, sink, rate=200)
        goal_id = send(talk, LONG)
        await_word(talk, goal_id, 5)
        assert talk.request("cancel", ids=[goal_id])["ok"]
        goal = talk.goal(goal_id)
        assert (goal["state"], goal["message"]) == ("PREEMPTED", "Talk preempted: the goal was cancelled")
        last = talk.watcher.words(goal_id)[-1]
        assert last["number"] >= 5
        assert goal["spoken"] == LONG[: last["end"]]
        assert LONG[: goal["spoken_end"]] == LONG[: last["start"]].rstrip()
        heard(talk)
        # When the sound ended, the last reported word had started, and the next one had not.
        until = bounds[0] / RATE + assert_only_beginning(talk.recording, reference.samples)
        later = [seconds for start, _, seconds in reference.words if start > last["start"]]
        following = min(later, default=len(reference.samples) / RATE)
        talk.stop()
        assert_within(abs(goal["heard"] - until), WORST, "the end of the sound, as reported")
        assert_within(
            position(reference, last["start"]) - until, WORST, f"the word {last['word']!r}, before its sound,"
        )
        assert_within(until - following, WORST, f"the word after {last['word']!r}, heard but not reported,")
