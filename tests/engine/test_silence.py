"""Tests for silence around sentences: lead-ins for slow devices, and cut silence between queued sentences."""

from __future__ import annotations

import itertools
import time
from array import array
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.child.playback import MAX_QUIET_LEVEL, SentenceSamples
from talkcli.engine.child.players import chooser
from talkcli.engine.child.players.chooser import MAX_CUT_S, MAX_HANDOVER_S, MAX_HANDOVERS, HandoverTimes
from tests.engine.process import FAST, SOON, Engine
from tests.engine.programs import SWALLOWS, Player
from tests.support.processes import children
from tests.support.reference import RATE, render, without_leading_zeros
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

TEXT = "battery low"
#: Lengths of two lead-ins in milliseconds.
LEAD_IN, OWN = 200, 150


def _silence(milliseconds: int) -> bytes:
    return bytes(milliseconds * RATE // 1000 * 2)


def _sentence() -> bytes:
    return without_leading_zeros(render([TEXT], rate=FAST)[0]).astype("<i2").tobytes()


def _idle_after(seconds: float) -> str:
    return f"from talkcli.engine.child.players import chooser\nchooser.IDLE_AFTER_S = {seconds}"


@pytest.mark.parametrize(
    ("server_lead_in", "idle_after", "own", "expected"),
    [
        (LEAD_IN, 10.0, [None, None], [LEAD_IN, 0]),
        (0, 10.0, [OWN, OWN, None], [OWN, OWN, 0]),
        (LEAD_IN, 0.0, [0, OWN, None], [0, OWN, LEAD_IN]),
    ],
    ids=["the first sentence", "the sentence's own", "instead of the server's"],
)
@limits()
def test_a_lead_in_delays_the_words_and_is_not_part_of_the_duration(
    player: Player, server_lead_in: int, idle_after: float, own: list[int | None], expected: list[int]
) -> None:
    texts = ["low", "yes", "yes"][: len(own)]
    sentences = [without_leading_zeros(samples).astype("<i2").tobytes() for samples in render(texts, rate=FAST)]
    with Engine(player.plays(), lead_in=server_lead_in, before=_idle_after(idle_after)) as engine:
        for number, (text, lead_in, sentence) in enumerate(zip(texts, own, sentences, strict=True)):
            started_at, lead = time.monotonic(), expected[number] / 1000
            engine.say(text, f"g{number}", lead_in=lead_in)
            first = engine.until_word().time
            elapsed = time.monotonic() - started_at
            assert first < 0.1
            assert elapsed >= lead + first - 0.02, "the word was reported before it was heard"
            assert_within(elapsed, lead + first + 0.25, "the first word")
            ended = engine.until(protocol.Ended)
            assert ended.outcome == protocol.OUTCOME_COMPLETED
            duration = len(sentence) / RATE / 2
            assert ended.duration == pytest.approx(duration, abs=1e-4)
            assert time.monotonic() - started_at >= duration + lead - 0.1
    samples = itertools.chain(*zip(map(_silence, expected), sentences, strict=True))
    assert player.heard.read_bytes() == b"".join(samples)


#: The lead-in of a sentence (None for the server's), the seconds until a device is idle, and the lead-in after a pause.
REPEATED = [(None, 0.3, LEAD_IN), (None, 10.0, 0), (OWN, 0.3, OWN), (OWN, 10.0, 0)]


def test_a_lead_in_is_repeated_after_a_pause_if_the_device_was_idle(tmp_path: Path) -> None:
    """The device counts as idle from the moment at which the paused sentence released it."""
    with ThreadPoolExecutor(len(REPEATED)) as pool:  # most of the time is spent waiting
        folders = [tmp_path / str(number) for number in range(len(REPEATED))]
        assert len(list(pool.map(_assert_repeated, folders, REPEATED))) == len(REPEATED)


def _assert_repeated(folder: Path, case: tuple[int | None, float, int]) -> None:
    own, idle_after, again = case
    folder.mkdir()
    player, constants = Player(folder), {"RELEASE_DELAY_S": 0.3}
    with Engine(
        player.plays(), lead_in=LEAD_IN, limits=constants, before=_idle_after(idle_after), alive_every=SOON
    ) as engine:
        engine.until(protocol.VoiceList)
        engine.say(TEXT, lead_in=own)
        engine.until_word()
        engine.pause()
        while children(engine.process.pid):
            assert isinstance(engine.event(), protocol.Alive)
        size = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    heard, sentence, first = player.heard.read_bytes(), _sentence(), len(_silence(LEAD_IN if own is None else own))
    assert heard[size:].startswith(_silence(again)), case
    rest = heard[size + len(_silence(again)) :]
    assert sentence.endswith(rest), case
    assert heard[first : first + len(sentence) - len(rest)] == sentence[: -len(rest)], case


#: A player that buffers 0.4 s of sound, as a Bluetooth output does, and writes it to a file.
SLOW_OUTPUT = """
import os, sys, time
tape = open(sys.argv[1], "ab", buffering=0)
started_at, read = None, 0
while data := os.read(0, 4096):
    started_at = started_at or time.monotonic()
    tape.write(data)
    read += len(data)
    time.sleep(max(0, started_at + read / 44100 - 0.4 - time.monotonic()))
time.sleep(max(0, (started_at or 0) + read / 44100 - time.monotonic()))
"""


def test_a_sentence_paused_early_in_its_lead_in_repeats_all_of_it(player: Player) -> None:
    with Engine(player.command(SLOW_OUTPUT)) as engine:
        engine.say(TEXT, lead_in=800)
        engine.until(protocol.Started)
        _await_size(player, 0.35)  # until most of the buffer is full, but little was heard
        engine.pause()
        size = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert player.heard.read_bytes()[size:] == _silence(800) + _sentence()


def test_a_pause_within_the_lead_in_loses_no_sample(player: Player) -> None:
    with Engine(player.plays(), lead_in=LEAD_IN) as engine:
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
        time.sleep(0.002)  # no event reports new samples


@limits()
def test_a_player_that_ends_within_the_lead_in_fails_the_sentence(player: Player) -> None:
    with Engine(player.command(SWALLOWS), lead_in=2000) as engine:
        started_at = time.monotonic()
        ended = engine.spoken("yes")
        assert_within(time.monotonic() - started_at, 1.5, "the end of the sentence")
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, "audio_lost")


def test_a_device_counts_as_idle_some_time_after_its_last_sound(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    players = chooser.PlayerChooser(protocol.Configure(0, None, "null", None, None, lead_in=400))
    assert players.lead_in_seconds() == 0.4
    players.silent_since = time.monotonic()
    now += chooser.IDLE_AFTER_S - 0.01
    assert players.lead_in_seconds() == 0.0
    now += 0.02
    assert players.lead_in_seconds() == 0.4
    assert chooser.PlayerChooser(protocol.Configure(0, None, "null", None, None)).lead_in_seconds() == 0.0


# -- from one sentence to the next


TEXTS = ["battery low", "coming home", "please help"]
#: The silence that some tests cut, in seconds and in bytes. Even a fast sentence ends with this much silence.
CUT_S = 0.02
CUT_BYTES = int(CUT_S * RATE) * 2
_CUTS = "from talkcli.engine.child.players import chooser\nchooser.HandoverTimes.silence_to_cut = lambda *_: {}"
_CUTS_SOME = _CUTS.format(CUT_S)


def _all_played(rate: int = FAST) -> list[bytes]:
    """Return the samples that are played for each sentence if nothing is cut."""
    first, *others = render(TEXTS, rate=rate)
    return [samples.tobytes() for samples in (without_leading_zeros(first), *others)]


def _record(times: HandoverTimes, seconds: float, player: str = "aplay", *, neural: bool = False) -> None:
    """Record a handover from one sentence to the next that took this number of seconds."""
    times.next_waits = True
    times.sentence_ended(player, 100.0)
    times.sentence_started(player, 100.0 + seconds, neural=neural)


# -- how much silence is cut


def test_the_silence_to_cut_is_the_median_of_the_last_handovers() -> None:
    times = HandoverTimes()
    times.sentence_started("aplay", 100.0)
    assert times.silence_to_cut("aplay") == 0.0
    for seconds in (0.03, 0.031, 0.09, 0.029, 0.032):
        _record(times, seconds)
    assert times.silence_to_cut("aplay") == pytest.approx(0.031)
    for _ in range(MAX_HANDOVERS):
        _record(times, 0.01)
    assert times.silence_to_cut("aplay") == pytest.approx(0.01)
    assert times.silence_to_cut("pacat") == 0.0
    _record(times, 0.4, "pacat")
    assert times.silence_to_cut("aplay") == pytest.approx(0.01)
    assert times.silence_to_cut("pacat") == MAX_CUT_S < 0.235 / 2 + 0.01, "more than half of the silence is cut"


def test_slow_handovers_to_neural_voices_count_only_for_neural_voices() -> None:
    times = HandoverTimes()
    _record(times, 0.03)
    _record(times, 0.1, neural=True)
    assert times.silence_to_cut("aplay") == pytest.approx(0.03)
    times.next_is_neural = True
    assert times.silence_to_cut("aplay") == pytest.approx(0.1)


def test_a_start_without_a_waiting_goal_is_not_a_handover() -> None:
    """No goal was waiting, the next one was sent much later, or another player was started."""
    times = HandoverTimes()
    times.sentence_ended("aplay", 100.0)
    times.sentence_started("aplay", 100.03)
    _record(times, MAX_HANDOVER_S + 0.1)
    times.sentence_started("aplay", 100.04)
    times.sentence_ended("aplay", 200.0)
    times.sentence_started("pacat", 200.1)
    assert times.silence_to_cut("aplay") == times.silence_to_cut("pacat") == 0.0


# -- which samples are cut


def test_trailing_silence_reaches_back_to_the_last_loud_sample() -> None:
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


def test_a_sentence_before_a_waiting_goal_is_shortened_only_by_silence(player: Player) -> None:
    first, second, _ = _all_played()
    with Engine(player.plays(), before=_CUTS_SOME) as engine:
        ended = [engine.spoken(text, text, next_waits=text == TEXTS[0]) for text in TEXTS[:2]]
    expected = [first[:-CUT_BYTES], second]
    assert [event.outcome for event in ended] == [protocol.OUTCOME_COMPLETED] * 2
    assert player.heard.read_bytes() == b"".join(expected)
    assert not any(first[-CUT_BYTES:])
    assert [event.duration for event in ended] == [pytest.approx(len(part) / 2 / RATE, abs=1e-4) for part in expected]


@pytest.mark.parametrize("waits", [True, False])
def test_silence_is_cut_if_a_goal_waits_at_the_end_of_the_sentence(player: Player, waits: bool) -> None:
    first = _all_played()[0]
    with Engine(player.plays(), before=_CUTS_SOME) as engine:
        engine.say(TEXTS[0], "g0", next_waits=not waits)
        engine.until(protocol.Word)
        engine.send(protocol.NextGoal("another", not waits))
        engine.send(protocol.NextGoal("g0", waits))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert player.heard.read_bytes() == (first[:-CUT_BYTES] if waits else first)


def test_no_audible_sample_is_cut(player: Player) -> None:
    all_is_loud = f"{_CUTS_SOME}\nfrom talkcli.engine.child import playback\nplayback.MAX_QUIET_LEVEL = -1"
    with Engine(player.plays(), before=all_is_loud) as engine:
        assert engine.spoken(TEXTS[0], next_waits=True).outcome == protocol.OUTCOME_COMPLETED
    assert player.heard.read_bytes() == _all_played()[0]


def test_a_file_gets_every_sample_and_no_lead_in(tmp_path: Path) -> None:
    target = tmp_path / "speech.wav"
    with Engine(f"file:{target}", before=_CUTS_SOME, lead_in=LEAD_IN) as engine:
        for number, text in enumerate(TEXTS):
            ended = engine.spoken(text, f"g{number}", next_waits=True, lead_in=LEAD_IN)
            assert ended.outcome == protocol.OUTCOME_COMPLETED
    assert target.read_bytes()[44:] == b"".join(samples.tobytes() for samples in render(TEXTS, rate=FAST))


def test_a_player_that_ends_early_is_noticed_although_silence_is_cut(player: Player) -> None:
    """The cut silence reduces the time by which a player may end early."""
    rate = 200  # the rate at which the silence at the end is long enough
    length = len(_all_played(rate)[0]) / 2 / RATE
    limits = {"EARLY_END_LIMIT_S": length - 0.2}
    with Engine(player.command(SWALLOWS), before=_CUTS.format(0.2), limits=limits) as engine:
        ended = engine.spoken(TEXTS[0], next_waits=True, rate=rate)
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, "audio_lost")


def test_a_pause_does_not_cut_more_silence(player: Player) -> None:
    first = _all_played()[0]
    with Engine(player.plays(), before=_CUTS_SOME) as engine:
        engine.say(TEXTS[0], "g0", next_waits=True)
        engine.until(protocol.Word)
        engine.pause("g0")
        engine.resume("g0")
        ended = engine.until(protocol.Ended)
        assert ended.outcome == protocol.OUTCOME_COMPLETED
        assert ended.duration == pytest.approx((len(first) - CUT_BYTES) / 2 / RATE, abs=1e-4)
    heard = player.heard.read_bytes()
    assert heard.endswith(first[-CUT_BYTES - 2000 : -CUT_BYTES])


def test_the_engine_measures_how_long_a_handover_takes(player: Player) -> None:
    sentences = _all_played()
    with Engine(player.plays()) as engine:
        for number, text in enumerate(TEXTS):
            assert engine.spoken(text, f"g{number}", next_waits=True).outcome == protocol.OUTCOME_COMPLETED
    cut = len(b"".join(sentences)) - player.heard.stat().st_size
    assert 0 < cut <= 2 * 2 * MAX_CUT_S * RATE
    assert player.heard.read_bytes().startswith(sentences[0])
