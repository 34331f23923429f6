"""From one sentence to the next: what is left out of the silence between them, and what never is."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.players.choice import LONGEST, MOST, REMEMBERED, Gap
from talkcli.engine.stream import QUIET, Samples
from tests.engine.spawned import FAST, Spawned
from tests.support.reference import RATE, played, render

if TYPE_CHECKING:
    from pathlib import Path

    from tests.engine.programs import Player

TEXTS = ["battery low", "coming home", "please help"]
#: Seconds that are left out where a test says so, and what that is in bytes: even a fast sentence ends in as much.
LEFT_OUT = 0.02
_BYTES = int(LEFT_OUT * RATE) * 2
_SAYS_SO = f"from talkcli.engine.players.choice import Gap\nGap.allowance = lambda *_: {LEFT_OUT}"


def _sentences(rate: int = FAST) -> list[bytes]:
    """Return what is played of each: of those that follow another, all."""
    first, *others = render(TEXTS, rate=rate)
    return [each.tobytes() for each in (played(first), *others)]


def _changed(gap: Gap, took: float, player: str = "aplay", *, neural: bool = False) -> None:
    """Have one sentence follow another after so many seconds."""
    gap.followed = True
    gap.ended(player, 100.0)
    gap.began(player, 100.0 + took, neural=neural)


# -- how much


def test_it_is_what_the_last_changes_took_and_a_late_one_counts_for_no_more_than_another() -> None:
    gap = Gap()
    gap.began("aplay", 100.0)
    assert gap.allowance("aplay") == 0.0
    for took in (0.03, 0.031, 0.09, 0.029, 0.032):
        _changed(gap, took)
    assert gap.allowance("aplay") == pytest.approx(0.031)
    for _ in range(REMEMBERED):
        _changed(gap, 0.01)
    assert gap.allowance("aplay") == pytest.approx(0.01)
    _changed(gap, 0.4, "pacat")
    assert gap.allowance("pacat") == MOST < 0.235 / 2 + 0.01, "never more than half of the pause between sentences"


def test_each_player_has_its_own() -> None:
    gap = Gap()
    _changed(gap, 0.03)
    assert gap.allowance("pacat") == 0.0
    gap.ended("aplay", 200.0)
    gap.began("pacat", 200.1)
    assert gap.allowance("aplay") == pytest.approx(0.03)
    assert gap.allowance("pacat") == 0.0


def test_a_neural_voice_takes_longer_and_that_is_left_out_before_one_alone() -> None:
    gap = Gap()
    _changed(gap, 0.03)
    _changed(gap, 0.1, neural=True)
    assert gap.allowance("aplay") == pytest.approx(0.03)
    gap.by_neural = True
    assert gap.allowance("aplay") == pytest.approx(0.1)


def test_a_start_without_a_goal_that_waited_is_no_change() -> None:
    """Nobody waited; or the goal that waited was recalled, and another came much later."""
    gap = Gap()
    gap.ended("aplay", 100.0)
    gap.began("aplay", 100.03)
    _changed(gap, LONGEST + 0.1)
    gap.began("aplay", 100.04)
    assert gap.allowance("aplay") == 0.0


# -- of what


def test_silence_is_counted_from_the_end_to_the_last_sample_that_is_louder() -> None:
    samples = Samples()
    samples.add(array("h", [0] * 100 + [QUIET + 1] + [0, QUIET, -QUIET] * 10).tobytes())
    assert samples.quiet_end(1000) == 60
    assert samples.quiet_end(40) == 40
    samples.add(array("h", [0] * 5).tobytes())
    assert samples.quiet_end(1000) == 70
    samples.add(array("h", [-QUIET - 1]).tobytes())
    assert samples.quiet_end(1000) == 0
    samples.forget(260)
    samples.add(bytes(10))
    assert (samples.begin, samples.end, samples.quiet_end(1000)) == (260, 284, 10)


def test_a_sentence_behind_which_a_goal_waits_ends_sooner_by_silence_alone(player: Player) -> None:
    """The next one follows, whole, and the results say how long what was played is."""
    first, second, third = _sentences()
    with Spawned(player.plays(), before=_SAYS_SO) as engine:
        ended = []
        for number, text in enumerate(TEXTS):
            engine.say(text, f"g{number}", followed=number < 2)
            ended.append(engine.until(protocol.Ended))
    assert [each.outcome for each in ended] == [protocol.COMPLETED] * 3
    assert player.heard.read_bytes() == first[:-_BYTES] + second[:-_BYTES] + third
    assert not any(first[-_BYTES:] + second[-_BYTES:])
    seconds = [len(each) / 2 / RATE for each in (first[:-_BYTES], second[:-_BYTES], third)]
    assert [each.duration for each in ended] == [pytest.approx(each, abs=1e-4) for each in seconds]


@pytest.mark.parametrize("followed", [True, False])
def test_it_counts_what_is_so_at_the_end_of_a_sentence(player: Player, followed: bool) -> None:
    """A goal that comes while it is spoken waits behind it; one that is recalled does not."""
    first = _sentences()[0]
    with Spawned(player.plays(), before=_SAYS_SO) as engine:
        engine.say(TEXTS[0], "g0", followed=not followed)
        engine.until(protocol.Word)
        engine.send(protocol.Followed("another", not followed))
        engine.send(protocol.Followed("g0", followed))
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert player.heard.read_bytes() == (first[:-_BYTES] if followed else first)


def test_no_sample_that_is_sound_is_left_out(player: Player) -> None:
    louder_than_nothing = f"{_SAYS_SO}\nfrom talkcli.engine import stream\nstream.QUIET = -1"
    with Spawned(player.plays(), before=louder_than_nothing) as engine:
        engine.say(TEXTS[0], "g0", followed=True)
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert player.heard.read_bytes() == _sentences()[0]


def test_a_file_gets_every_sample(tmp_path: Path) -> None:
    target = tmp_path / "speech.wav"
    with Spawned(f"file:{target}", before=_SAYS_SO) as engine:
        for number, text in enumerate(TEXTS):
            engine.say(text, f"g{number}", followed=True)
            assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert target.read_bytes()[44:] == b"".join(each.tobytes() for each in render(TEXTS, rate=FAST))


def test_a_player_that_ends_too_early_is_seen_as_before(player: Player) -> None:
    """A sentence may not end sooner than so much before its whole length, what was left out of it included."""
    rate = 200  # at which the silence at the end is that long
    length = len(_sentences(rate)[0]) / 2 / RATE
    before = "from talkcli.engine.players.choice import Gap\nGap.allowance = lambda *_: 0.2"
    hurried = "import os\nwhile os.read(0, 65536): pass"  # it is over by what it gets, which is 0.2 s less
    with Spawned(player.command(hurried), before=before, limits={"EARLY_END": length - 0.2}) as engine:
        engine.say(TEXTS[0], "g0", followed=True, rate=rate)
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "audio_lost")


def test_a_sentence_that_is_held_and_goes_on_leaves_out_no_more(player: Player) -> None:
    first = _sentences()[0]
    with Spawned(player.plays(), before=_SAYS_SO) as engine:
        engine.say(TEXTS[0], "g0", followed=True)
        engine.until(protocol.Word)
        engine.pause("g0")
        engine.resume("g0")
        ended = engine.until(protocol.Ended)
        assert ended.outcome == protocol.COMPLETED
        assert ended.duration == pytest.approx((len(first) - _BYTES) / 2 / RATE, abs=1e-4)
    heard = player.heard.read_bytes()
    assert heard.endswith(first[-_BYTES - 2000 : -_BYTES])


def test_the_engine_measures_what_a_change_takes(player: Player) -> None:
    """The first two sentences are played whole; how long the change took is known from then on."""
    sentences = _sentences()
    with Spawned(player.plays()) as engine:
        for number, text in enumerate(TEXTS):
            engine.say(text, f"g{number}", followed=True)
            assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    left_out = len(b"".join(sentences)) - player.heard.stat().st_size
    assert 0 < left_out <= 2 * 2 * MOST * RATE
    assert player.heard.read_bytes().startswith(sentences[0])
