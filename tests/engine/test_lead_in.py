"""Silence before a sentence, for devices that wake up slowly: only if the device was idle, and never counted."""

from __future__ import annotations

import itertools
import time
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.players import choice
from tests.engine.programs import SWALLOWS, Player, sound
from tests.engine.spawned import FAST, SOON, Spawned
from tests.support.processes import children
from tests.support.reference import RATE, played, render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

TEXT, SECOND = "battery low", "thank you"
#: Milliseconds.
LEAD_IN, OWN = 300, 200


def _silence(milliseconds: int) -> bytes:
    return bytes(milliseconds * RATE // 1000 * 2)


def _sentence() -> bytes:
    return played(render([TEXT], rate=FAST)[0]).astype("<i2").tobytes()


def _idle_after(seconds: float) -> str:
    return f"from talkcli.engine.players import choice\nchoice.IDLE_AFTER = {seconds}"


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
def test_a_player_gets_it_uncounted_and_words_wait_for_it(
    player: Player, servers: int, idle_after: float, own: list[int | None], expected: list[int]
) -> None:
    texts = [TEXT, SECOND, SECOND][: len(own)]
    sentences = [played(each).astype("<i2").tobytes() for each in render(texts, rate=FAST)]
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
            assert ended.outcome == protocol.COMPLETED
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
def test_it_comes_again_after_a_pause_if_the_device_was_idle(
    player: Player, own: int | None, idle_after: float, again: int
) -> None:
    """The device is idle as soon as it was let go of, for as long as it has played silence."""
    before, constants = _idle_after(idle_after), {"RELEASE_AFTER": 0.3}
    with Spawned(player.plays(), lead_in=LEAD_IN, limits=constants, before=before, alive_every=SOON) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT, lead_in=own)
        engine.until_word()
        engine.pause()
        while children(engine.process.pid):
            assert isinstance(engine.event(), protocol.Alive)
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    heard, sentence, first = player.heard.read_bytes(), _sentence(), len(_silence(LEAD_IN if own is None else own))
    assert heard[held:].startswith(_silence(again))
    rest = heard[held + len(_silence(again)) :]
    assert sentence.endswith(rest)
    assert heard[first : first + len(sentence) - len(rest)] == sentence[: -len(rest)]


#: Holds 0.4 s of what it has read, as a Bluetooth output does, and keeps it.
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


def test_a_sentence_that_was_held_in_its_own_begins_with_all_of_it_again(player: Player) -> None:
    with Spawned(player.command(SLOW_OUTPUT)) as engine:
        engine.say(TEXT, lead_in=800)
        engine.until(protocol.Started)
        _await_size(player, 0.35)  # of which little was heard
        engine.pause()
        held = player.heard.stat().st_size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert player.heard.read_bytes()[held:] == _silence(800) + _sentence()


def test_a_pause_within_it_loses_nothing(player: Player) -> None:
    with Spawned(player.plays(), lead_in=LEAD_IN) as engine:
        engine.say(TEXT)
        engine.until(protocol.Started)
        _await_size(player, 0)
        engine.pause()
        assert engine.words() == []
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    heard, sentence = player.heard.read_bytes(), _sentence()
    assert heard.endswith(sentence)
    assert len(heard) > len(_silence(LEAD_IN) + sentence)
    assert not any(heard[: -len(sentence)])


def _await_size(player: Player, seconds: float) -> None:
    """Wait until the player has more than so many seconds of sound."""
    while not (player.heard.exists() and player.heard.stat().st_size > seconds * RATE * 2):
        time.sleep(0.002)  # what another process writes is no event


@limits()
def test_a_player_that_ends_within_it_did_not_say_the_sentence(player: Player) -> None:
    with Spawned(player.command(SWALLOWS), lead_in=2000) as engine:
        began = time.monotonic()
        ended = engine.spoken("yes")
        assert_within(time.monotonic() - began, 1.5, "the end of the sentence")
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "audio_lost")


def test_a_file_gets_none(tmp_path: Path) -> None:
    target = tmp_path / "speech.wav"
    with Spawned(f"file:{target}", lead_in=LEAD_IN) as engine:
        assert engine.spoken(TEXT, lead_in=LEAD_IN).outcome == protocol.COMPLETED
    with wave.open(str(target), "rb") as file:
        assert file.readframes(file.getnframes()) == sound(TEXT)


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
