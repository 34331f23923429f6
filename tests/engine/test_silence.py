"""Tests for silence around sentences: lead-ins for slow devices, and shorter silence between queued sentences."""

from __future__ import annotations

import itertools
import time
from array import array
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.child.playback import MAX_QUIET_LEVEL, SentenceSamples
from talkcli.engine.child.players import chooser
from talkcli.engine.child.players.chooser import MAX_CUT_S, MAX_HANDOVER_S, MAX_HANDOVERS, HandoverTimes
from tests.engine.programs import SWALLOWS, Player
from tests.engine.spawned import FAST, SOON, Spawned
from tests.support.processes import children
from tests.support.reference import RATE, render, without_leading_zeros
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.engine.programs import Player

TEXT, SECOND = "battery low", "thank you"
#: Lengths of two lead-ins in milliseconds.
LEAD_IN, OWN = 300, 200


def _silence(milliseconds: int) -> bytes:
    return bytes(milliseconds * RATE // 1000 * 2)


def _sentence() -> bytes:
    return without_leading_zeros(render([TEXT], rate=FAST)[0]).astype("<i2").tobytes()


def _idle_after(seconds: float) -> str:
    return f"from talkcli.engine.child.players import chooser\nchooser.IDLE_AFTER_S = {seconds}"


@pytest.mark.parametrize(
    ("servers", "idle_after", "own", "expected"),
    [
        (LEAD_IN, 10.0, [None, None], [LEAD_IN, 0]),
        (LEAD_IN, 0.0, [None, None], [LEAD_IN, LEAD_IN]),
        (0, 10.0, [OWN, OWN, None], [OWN, OWN, 0]),
        (LEAD_IN, 0.0, [0, OWN, None], [0, OWN, LEAD_IN]),
    ],
    ids=["the first sentence", "idle again", "the sentence's own", "instead of the server's"],
)
@limits()
def test_a_player_gets_the_lead_in_uncounted_and_words_wait_for_it(
    player: Player, servers: int, idle_after: float, own: list[int | None], expected: list[int]
) -> None:
    texts = [TEXT, SECOND, SECOND][: len(own)]
    sentences = [without_leading_zeros(each).astype("<i2").tobytes() for each in render(texts, rate=FAST)]
    with Spawned(player.plays(), lead_in=servers, before=_idle_after(idle_after)) as engine:
        for number, (text, lead_in, sentence) in enumerate(zip(texts, own, sentences, strict=True)):
            began, lead = time.monotonic(), expected[number] / 1000
            engine.say(text, f"g{number}", lead_in=lead_in)
            first = engine.until_word().time
            told = time.monotonic() - began
            assert first < 0.1
            assert told >= lead + first - 0.02, "the word is told before it is heard"
            assert_within(told, lead + first + 0.25, "the first word")
            ended = engine.until(protocol.Ended)
            assert ended.outcome == protocol.OUTCOME_COMPLETED
            duration = len(sentence) / RATE / 2
            assert ended.duration == pytest.approx(duration, abs=1e-4)
            assert time.monotonic() - began >= duration + lead - 0.1
    wanted = itertools.chain(*zip(map(_silence, expected), sentences, strict=True))
    assert player.heard.read_bytes() == b"".join(wanted)


@pytest.mark.parametrize(
    ("own", "idle_after", "again"),
    [(None, 0.3, LEAD_IN), (None, 10.0, 0), (OWN, 0.3, OWN), (OWN, 10.0, 0)],
    ids=["idle", "not idle", "own, idle", "own, not idle"],
)
def test_a_lead_in_comes_again_after_a_pause_if_the_device_was_idle(
    player: Player, own: int | None, idle_after: float, again: int
) -> None:
    """When a held sentence releases the device, its silence counts as idle time."""
    before, constants = _idle_after(idle_after), {"RELEASE_DELAY_S": 0.3}
    with Spawned(player.plays(), lead_in=LEAD_IN, limits=constants, before=before, alive_every=SOON) as engine:
        engine.until(protocol.VoiceList)
        engine.say(TEXT, lead_in=own)
        engine.until_word()
        engine.pause()
        while children(engine.process.pid):
            assert isinstance(engine.event(), protocol.Alive)
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    heard, sentence, first = player.heard.read_bytes(), _sentence(), len(_silence(LEAD_IN if own is None else own))
    assert heard[held:].startswith(_silence(again))
    rest = heard[held + len(_silence(again)) :]
    assert sentence.endswith(rest)
    assert heard[first : first + len(sentence) - len(rest)] == sentence[: -len(rest)]


#: A player that buffers 0.4 s of sound, as a Bluetooth output does, and records it.
SLOW_OUTPUT = """
import os, sys, time
tape = open(sys.argv[1], "ab", buffering=0)
began, read = None, 0
while data := os.read(0, 4096):
    began = began or time.monotonic()
    tape.write(data)
    read += len(data)
    time.sleep(max(0, began + read / 44100 - 0.4 - time.monotonic()))
time.sleep(max(0, (began or 0) + read / 44100 - time.monotonic()))
"""


def test_a_sentence_held_in_its_lead_in_begins_with_all_of_it_again(player: Player) -> None:
    with Spawned(player.command(SLOW_OUTPUT)) as engine:
        engine.say(TEXT, lead_in=800)
        engine.until(protocol.Started)
        _await_size(player, 0.35)  # little of it was heard
        engine.pause()
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert player.heard.read_bytes()[held:] == _silence(800) + _sentence()


def test_a_pause_within_the_lead_in_loses_nothing(player: Player) -> None:
    with Spawned(player.plays(), lead_in=LEAD_IN) as engine:
        engine.say(TEXT)
        engine.until(protocol.Started)
        _await_size(player, 0)
        engine.pause()
        assert engine.words() == []
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    heard, sentence = player.heard.read_bytes(), _sentence()
    assert heard.endswith(sentence)
    assert len(heard) > len(_silence(LEAD_IN) + sentence)
    assert not any(heard[: -len(sentence)])


def _await_size(player: Player, seconds: float) -> None:
    """Wait until the player has received more than this number of seconds of sound."""
    while not (player.heard.exists() and player.heard.stat().st_size > seconds * RATE * 2):
        time.sleep(0.002)  # no event reports what another process writes


@limits()
def test_a_player_that_ends_within_the_lead_in_did_not_say_the_sentence(player: Player) -> None:
    with Spawned(player.command(SWALLOWS), lead_in=2000) as engine:
        began = time.monotonic()
        ended = engine.spoken("yes")
        assert_within(time.monotonic() - began, 1.5, "the end of the sentence")
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, "audio_lost")


def test_a_device_is_idle_some_time_after_it_was_let_go_of(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    found = chooser.PlayerChooser(protocol.Configure(0, None, "null", None, None, lead_in=400))
    assert found.lead_in_seconds() == 0.4
    found.silent_since = time.monotonic()
    now += chooser.IDLE_AFTER_S - 0.01
    assert found.lead_in_seconds() == 0.0
    now += 0.02
    assert found.lead_in_seconds() == 0.4
    assert chooser.PlayerChooser(protocol.Configure(0, None, "null", None, None)).lead_in_seconds() == 0.0


# -- from one sentence to the next


TEXTS = ["battery low", "coming home", "please help"]
#: Length of the silence that some tests cut, in seconds and in bytes. Even a fast sentence ends with this much silence.
LEFT_OUT = 0.02
_BYTES = int(LEFT_OUT * RATE) * 2
_CUTS = "from talkcli.engine.child.players import chooser\nchooser.HandoverTimes.silence_to_cut = lambda *_: {}"
_SAYS_SO = _CUTS.format(LEFT_OUT)


def _all_played(rate: int = FAST) -> list[bytes]:
    """Return the samples played of each sentence if nothing is cut."""
    first, *others = render(TEXTS, rate=rate)
    return [each.tobytes() for each in (without_leading_zeros(first), *others)]


def _changed(gap: HandoverTimes, took: float, player: str = "aplay", *, neural: bool = False) -> None:
    """Record that one sentence followed another after this number of seconds."""
    gap.next_waits = True
    gap.sentence_ended(player, 100.0)
    gap.sentence_started(player, 100.0 + took, neural=neural)


# -- how much silence is cut


def test_as_much_is_left_out_as_the_last_changes_took_in_their_median() -> None:
    gap = HandoverTimes()
    gap.sentence_started("aplay", 100.0)
    assert gap.silence_to_cut("aplay") == 0.0
    for took in (0.03, 0.031, 0.09, 0.029, 0.032):
        _changed(gap, took)
    assert gap.silence_to_cut("aplay") == pytest.approx(0.031)
    for _ in range(MAX_HANDOVERS):
        _changed(gap, 0.01)
    assert gap.silence_to_cut("aplay") == pytest.approx(0.01)
    _changed(gap, 0.4, "pacat")
    assert gap.silence_to_cut("pacat") == MAX_CUT_S < 0.235 / 2 + 0.01, (
        "never more than half of the pause between sentences"
    )


def test_each_player_has_changes_of_its_own() -> None:
    gap = HandoverTimes()
    _changed(gap, 0.03)
    assert gap.silence_to_cut("pacat") == 0.0
    gap.sentence_ended("aplay", 200.0)
    gap.sentence_started("pacat", 200.1)
    assert gap.silence_to_cut("aplay") == pytest.approx(0.03)
    assert gap.silence_to_cut("pacat") == 0.0


def test_the_longer_change_to_a_neural_voice_counts_for_neural_voices_alone() -> None:
    gap = HandoverTimes()
    _changed(gap, 0.03)
    _changed(gap, 0.1, neural=True)
    assert gap.silence_to_cut("aplay") == pytest.approx(0.03)
    gap.next_is_neural = True
    assert gap.silence_to_cut("aplay") == pytest.approx(0.1)


def test_a_start_without_a_goal_that_waited_is_no_change() -> None:
    """Either no goal was waiting, or the waiting goal was canceled and another one came much later."""
    gap = HandoverTimes()
    gap.sentence_ended("aplay", 100.0)
    gap.sentence_started("aplay", 100.03)
    _changed(gap, MAX_HANDOVER_S + 0.1)
    gap.sentence_started("aplay", 100.04)
    assert gap.silence_to_cut("aplay") == 0.0


# -- which samples are cut


def test_silence_is_counted_from_the_end_to_the_last_sample_that_is_louder() -> None:
    samples = SentenceSamples()
    samples.add(array("h", [0] * 100 + [MAX_QUIET_LEVEL + 1] + [0, MAX_QUIET_LEVEL, -MAX_QUIET_LEVEL] * 10).tobytes())
    assert samples.trailing_silence(1000) == 60
    assert samples.trailing_silence(40) == 40
    samples.add(array("h", [0] * 5).tobytes())
    assert samples.trailing_silence(1000) == 70
    samples.add(array("h", [-MAX_QUIET_LEVEL - 1]).tobytes())
    assert samples.trailing_silence(1000) == 0
    samples.drop_until(260)
    samples.add(bytes(10))
    assert (samples.begin, samples.end, samples.trailing_silence(1000)) == (260, 284, 10)


def test_a_sentence_behind_which_a_goal_waits_ends_sooner_by_silence_alone(player: Player) -> None:
    """The next sentence is played completely. Each `Ended` has the length that was played."""
    first, second, third = _all_played()
    with Spawned(player.plays(), before=_SAYS_SO) as engine:
        ended = []
        for number, text in enumerate(TEXTS):
            ended.append(engine.spoken(text, f"g{number}", next_waits=number < 2))
    assert [each.outcome for each in ended] == [protocol.OUTCOME_COMPLETED] * 3
    assert player.heard.read_bytes() == first[:-_BYTES] + second[:-_BYTES] + third
    assert not any(first[-_BYTES:] + second[-_BYTES:])
    seconds = [len(each) / 2 / RATE for each in (first[:-_BYTES], second[:-_BYTES], third)]
    assert [each.duration for each in ended] == [pytest.approx(each, abs=1e-4) for each in seconds]


@pytest.mark.parametrize("followed", [True, False])
def test_a_goal_that_waits_counts_if_it_does_at_the_end_of_a_sentence(player: Player, followed: bool) -> None:
    """A goal counts if it arrives during the sentence, but not if it is canceled."""
    first = _all_played()[0]
    with Spawned(player.plays(), before=_SAYS_SO) as engine:
        engine.say(TEXTS[0], "g0", next_waits=not followed)
        engine.until(protocol.Word)
        engine.send(protocol.NextGoal("another", not followed))
        engine.send(protocol.NextGoal("g0", followed))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert player.heard.read_bytes() == (first[:-_BYTES] if followed else first)


def test_no_sample_that_is_sound_is_left_out(player: Player) -> None:
    louder_than_nothing = f"{_SAYS_SO}\nfrom talkcli.engine.child import playback\nplayback.MAX_QUIET_LEVEL = -1"
    with Spawned(player.plays(), before=louder_than_nothing) as engine:
        assert engine.spoken(TEXTS[0], next_waits=True).outcome == protocol.OUTCOME_COMPLETED
    assert player.heard.read_bytes() == _all_played()[0]


def test_a_file_gets_every_sample_and_no_lead_in(tmp_path: Path) -> None:
    target = tmp_path / "speech.wav"
    with Spawned(f"file:{target}", before=_SAYS_SO, lead_in=LEAD_IN) as engine:
        for number, text in enumerate(TEXTS):
            ended = engine.spoken(text, f"g{number}", next_waits=True, lead_in=LEAD_IN)
            assert ended.outcome == protocol.OUTCOME_COMPLETED
    assert target.read_bytes()[44:] == b"".join(each.tobytes() for each in render(TEXTS, rate=FAST))


def test_a_player_that_ends_too_early_is_seen_if_silence_is_left_out(player: Player) -> None:
    """A sentence may end only a little earlier than its length including the cut silence."""
    rate = 200  # the rate at which the silence at the end is long enough
    length = len(_all_played(rate)[0]) / 2 / RATE
    before = (
        "from talkcli.engine.child.players.chooser import HandoverTimes\nHandoverTimes.silence_to_cut = lambda *_: 0.2"
    )
    with Spawned(player.command(SWALLOWS), before=before, limits={"EARLY_END_LIMIT_S": length - 0.2}) as engine:
        ended = engine.spoken(TEXTS[0], next_waits=True, rate=rate)
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, "audio_lost")


def test_a_sentence_that_is_held_and_goes_on_leaves_out_no_more(player: Player) -> None:
    first = _all_played()[0]
    with Spawned(player.plays(), before=_SAYS_SO) as engine:
        engine.say(TEXTS[0], "g0", next_waits=True)
        engine.until(protocol.Word)
        engine.pause("g0")
        engine.resume("g0")
        ended = engine.until(protocol.Ended)
        assert ended.outcome == protocol.OUTCOME_COMPLETED
        assert ended.duration == pytest.approx((len(first) - _BYTES) / 2 / RATE, abs=1e-4)
    heard = player.heard.read_bytes()
    assert heard.endswith(first[-_BYTES - 2000 : -_BYTES])


def test_the_engine_measures_what_a_change_takes(player: Player) -> None:
    """The first two sentences are played completely, and the time between them is measured."""
    sentences = _all_played()
    with Spawned(player.plays()) as engine:
        for number, text in enumerate(TEXTS):
            assert engine.spoken(text, f"g{number}", next_waits=True).outcome == protocol.OUTCOME_COMPLETED
    left_out = len(b"".join(sentences)) - player.heard.stat().st_size
    assert 0 < left_out <= 2 * 2 * MAX_CUT_S * RATE
    assert player.heard.read_bytes().startswith(sentences[0])
