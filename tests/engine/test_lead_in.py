"""Silence before a sentence, for devices that wake up slowly: only where the device was idle, and never counted."""

from __future__ import annotations

import time
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.players import choice
from tests.engine.spawned import FAST, SOON, Spawned
from tests.engine.test_player_faults import Player, player
from tests.support import compare
from tests.support.processes import children
from tests.support.reference import RATE, played, render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.sink import Sink

__all__ = ["player"]

TEXTS = ["battery low, please come home", "thank you very much"]
#: Milliseconds, and the bytes of that.
LEAD_IN = 400
_LEAD = LEAD_IN * RATE // 1000 * 2


def _bytes(texts: list[str] = TEXTS) -> list[bytes]:
    return [played(samples).astype("<i2").tobytes() for samples in render(texts, rate=FAST)]


def test_it_is_heard_before_the_first_sentence_and_not_before_the_next(sink: Sink) -> None:
    with limits(), Spawned("aplay", environment=sink.env, lead_in=LEAD_IN) as engine:
        engine.until(protocol.Voices)
        onsets = []
        with sink.record() as recording:
            for number, text in enumerate(TEXTS):
                goal = f"g{number}"
                asked = time.monotonic()
                engine.say(text, goal)
                word = engine.until(protocol.Word)
                heard = time.monotonic()
                onset = recording.wait_for_sound()
                onsets.append(onset - asked)
                assert word.time < 0.1
                assert_within(abs(onset - (heard - word.time)), 0.1, "the word, beside its sound,")
                ended = engine.until(protocol.Ended)
                assert ended.outcome == protocol.COMPLETED
                recording.wait_until_quiet(0.1)
        compare.assert_heard(recording, [played(each) for each in render(TEXTS, rate=FAST)])
        assert onsets[0] > LEAD_IN / 1000
        assert_within(onsets[0], LEAD_IN / 1000 + 0.2, "the first sentence")
        assert_within(onsets[1], 0.2, "the second sentence")


def test_a_player_gets_it_once_and_it_does_not_count(player: Player) -> None:
    sentences = _bytes()
    with Spawned(player.plays(), lead_in=LEAD_IN) as engine:
        engine.until(protocol.Voices)
        began = time.monotonic()
        for number, text in enumerate(TEXTS):
            ended = engine.spoken(text, f"g{number}")
            assert ended.outcome == protocol.COMPLETED
            duration = len(sentences[number]) / RATE / 2
            assert ended.duration == pytest.approx(duration, abs=1e-4)
            if number == 0:
                assert time.monotonic() - began >= duration + LEAD_IN / 1000 - 0.1
    assert player.heard.read_bytes() == bytes(_LEAD) + sentences[0] + sentences[1]


def test_a_device_that_was_idle_gets_it_again(player: Player) -> None:
    sentences = _bytes()
    before = "from talkcli.engine.players import choice\nchoice.IDLE_AFTER = 0.0"
    with Spawned(player.plays(), lead_in=LEAD_IN, before=before) as engine:
        engine.until(protocol.Voices)
        for number, text in enumerate(TEXTS):
            assert engine.spoken(text, f"g{number}").outcome == protocol.COMPLETED
    assert player.heard.read_bytes() == bytes(_LEAD) + sentences[0] + bytes(_LEAD) + sentences[1]


def test_a_player_after_a_long_pause_gets_it_again(player: Player) -> None:
    before = "from talkcli.engine.players import choice\nchoice.IDLE_AFTER = 0.2"
    constants = {"RELEASE_AFTER": 0.1}
    with Spawned(player.plays(), lead_in=LEAD_IN, limits=constants, before=before, alive_every=0.3) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXTS[0])
        engine.until(protocol.Word)
        engine.pause()
        assert isinstance(engine.event(), protocol.Alive)
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    heard = player.heard.read_bytes()
    assert heard[held : held + _LEAD] == bytes(_LEAD)
    sentence = _bytes()[0]
    rest = heard[held + _LEAD :]
    assert sentence.endswith(rest)
    assert heard[_LEAD : len(sentence) - len(rest) + _LEAD] == sentence[: -len(rest)]


def test_a_sentence_that_goes_on_as_soon_as_the_device_was_let_go_of_gets_it_again(player: Player) -> None:
    before, constants = "from talkcli.engine.players import choice\nchoice.IDLE_AFTER = 0.3", {"RELEASE_AFTER": 0.3}
    with Spawned(player.plays(), lead_in=LEAD_IN, limits=constants, before=before, alive_every=SOON) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXTS[0])
        engine.until(protocol.Word)
        engine.pause()
        while children(engine.process.pid):
            assert isinstance(engine.event(), protocol.Alive)
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    heard = player.heard.read_bytes()
    assert heard[held : held + _LEAD] == bytes(_LEAD)
    assert _bytes()[0].endswith(heard[held + _LEAD :])


def test_a_sentence_s_own_comes_before_it_wherever_the_output_is(player: Player) -> None:
    sentences = _bytes([*TEXTS, TEXTS[1]])
    with Spawned(player.plays()) as engine:
        engine.until(protocol.Voices)
        for number, (text, lead_in) in enumerate([(TEXTS[0], LEAD_IN), (TEXTS[1], LEAD_IN), (TEXTS[1], None)]):
            ended = engine.spoken(text, f"g{number}", lead_in=lead_in)
            assert ended.outcome == protocol.COMPLETED
            assert ended.duration == pytest.approx(len(sentences[number]) / RATE / 2, abs=1e-4)
    assert player.heard.read_bytes() == bytes(_LEAD) + sentences[0] + bytes(_LEAD) + sentences[1] + sentences[2]


def test_a_sentence_s_own_stands_for_the_server_s_and_0_is_none(player: Player) -> None:
    sentences = _bytes([*TEXTS, TEXTS[1]])
    before = "from talkcli.engine.players import choice\nchoice.IDLE_AFTER = 0.0"
    with Spawned(player.plays(), lead_in=LEAD_IN, before=before) as engine:
        engine.until(protocol.Voices)
        assert engine.spoken(TEXTS[0], "g1", lead_in=0).outcome == protocol.COMPLETED
        assert engine.spoken(TEXTS[1], "g2", lead_in=LEAD_IN // 2).outcome == protocol.COMPLETED
        assert engine.spoken(TEXTS[1], "g3").outcome == protocol.COMPLETED
    heard = player.heard.read_bytes()
    assert heard == sentences[0] + bytes(_LEAD // 2) + sentences[1] + bytes(_LEAD) + sentences[2]


@pytest.mark.parametrize(("idle", "again"), [(0.2, _LEAD // 2), (10.0, 0)], ids=["idle", "not idle"])
def test_a_sentence_s_own_comes_again_after_a_pause_only_where_the_device_was_idle(
    player: Player, idle: float, again: int
) -> None:
    before = f"from talkcli.engine.players import choice\nchoice.IDLE_AFTER = {idle}"
    with Spawned(
        player.plays(), lead_in=LEAD_IN, limits={"RELEASE_AFTER": 0.1}, before=before, alive_every=0.3
    ) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXTS[0], lead_in=LEAD_IN // 2)
        engine.until(protocol.Word)
        engine.pause()
        assert isinstance(engine.event(), protocol.Alive)
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    rest = player.heard.read_bytes()[held:]
    assert rest[:again] == bytes(again)
    assert _bytes()[0].endswith(rest[again:])


#: Holds 0.4 s of what it has read, as a Bluetooth output does, and keeps it.
SLOW_OUTPUT = """
import os, time
began, read = None, 0
while data := os.read(0, 4096):
    began = began or time.monotonic()
    os.write(tape, data)
    read += len(data)
    time.sleep(max(0, began + read / 44100 - 0.4 - time.monotonic()))
time.sleep(max(0, (began or 0) + read / 44100 - time.monotonic()))
"""


def test_a_sentence_that_was_held_in_its_own_begins_with_all_of_it_again(player: Player) -> None:
    command = player.command(
        f"import os\ntape = os.open({str(player.heard)!r}, os.O_WRONLY | os.O_CREAT | os.O_APPEND)\n{SLOW_OUTPUT}"
    )
    with Spawned(command) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXTS[0], lead_in=800)
        engine.until(protocol.Started)
        while not (
            player.heard.exists() and player.heard.stat().st_size > 0.35 * RATE * 2
        ):  # of which little was heard
            time.sleep(0.002)  # what another process writes is no event
        engine.pause()
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert player.heard.read_bytes()[held:] == bytes(2 * _LEAD) + _bytes()[0]


def test_a_driver_that_plays_by_itself_can_have_none() -> None:
    with Spawned(driver="dummy") as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken(TEXTS[0], "g1", lead_in=LEAD_IN)
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "bad_option")
        assert ended.message == "this driver plays by itself: it can't be given a lead-in"
        assert engine.spoken(TEXTS[0], "g2", lead_in=0).outcome == protocol.COMPLETED


def test_a_short_pause_in_which_the_device_was_let_go_of_gets_none(player: Player) -> None:
    with Spawned(player.plays(), lead_in=LEAD_IN, limits={"RELEASE_AFTER": 0.1}) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXTS[0])
        engine.until(protocol.Word)
        engine.pause()
        while children(engine.process.pid):
            time.sleep(0.01)  # that it is gone is no event for others
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert _bytes()[0].endswith(player.heard.read_bytes()[held:])


def test_a_pause_within_it_loses_nothing(player: Player) -> None:
    with Spawned(player.plays(), lead_in=LEAD_IN) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXTS[0])
        engine.until(protocol.Started)
        while not (player.heard.exists() and player.heard.stat().st_size):
            time.sleep(0.002)  # what another process writes is no event
        engine.pause()
        assert engine.words() == []
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    heard, sentence = player.heard.read_bytes(), _bytes()[0]
    assert heard.endswith(sentence)
    assert len(heard) > _LEAD + len(sentence)
    assert not any(heard[: -len(sentence)])


@limits()
def test_a_player_that_ends_within_it_did_not_say_the_sentence(player: Player) -> None:
    with Spawned(player.command("import os\nwhile os.read(0, 65536): pass"), lead_in=2000) as engine:
        engine.until(protocol.Voices)
        began = time.monotonic()
        ended = engine.spoken("yes")
        assert_within(time.monotonic() - began, 1.5, "the end of the sentence")
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "audio_lost")


def test_a_file_gets_none(tmp_path: Path) -> None:
    target = tmp_path / "speech.wav"
    with Spawned(f"file:{target}", lead_in=LEAD_IN) as engine:
        engine.until(protocol.Ready)
        assert engine.spoken(TEXTS[0], lead_in=LEAD_IN).outcome == protocol.COMPLETED
    with wave.open(str(target), "rb") as file:
        assert file.readframes(file.getnframes()) == render(TEXTS, rate=FAST)[0].astype("<i2").tobytes()


def test_a_device_is_idle_some_time_after_it_was_let_go_of(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    found = choice.Players(protocol.Configure(0, None, "null", None, None, lead_in=400))
    assert found.lead_in() == 0.4
    found.let_go()
    now += choice.IDLE_AFTER - 0.01
    assert found.lead_in() == 0.0
    now += 0.02
    assert found.lead_in() == 0.4
    assert choice.Players(protocol.Configure(0, None, "null", None, None)).lead_in() == 0.0
