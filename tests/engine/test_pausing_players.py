"""A pause with players that are no sound server's: silent ones, files, deep ones, frozen ones, ones that die."""

from __future__ import annotations

import os
import signal
import subprocess
import time
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.spawned import FAST, SOON, Spawned
from tests.engine.test_player_faults import Player, player
from tests.support.processes import children
from tests.support.reference import RATE, render
from tests.support.surroundings import needs
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["player"]

TEXT = "one two three four five six seven"

#: A player that takes all it gets at once, plays it in real time, and writes what it got to a file of its own.
DEEP = """
import os, sys, time
heard = open(f"{sys.argv[1]}.{os.getpid()}", "ab", buffering=0)
began, taken = time.monotonic(), 0
while data := os.read(0, 65536):
    taken += len(data)
    heard.write(data)
time.sleep(max(0, began + taken / 44100 - time.monotonic()))
"""


def _bytes(text: str) -> bytes:
    return render([text], rate=FAST)[0].astype("<i2").tobytes()


def without_silence(heard: bytes, sentence: bytes) -> bytes:
    """Return what was heard without the longest run of zeros."""
    same = (pair[0] == pair[1] for pair in zip(heard, sentence, strict=False))
    begin = next((at for at, each in enumerate(same) if not each), len(sentence)) // 2 * 2
    end = begin
    while heard[end : end + 2] == b"\0\0":
        end += 2
    return heard[:begin] + heard[end:]


def test_null_stands_still() -> None:
    with Spawned(alive_every=0.3) as engine:
        engine.until(protocol.Voices)
        began = time.monotonic()
        engine.say(TEXT)
        while engine.until(protocol.Word).number < 4:
            pass
        engine.pause()
        assert isinstance(engine.event(), protocol.Alive), "a word was heard while it was paused"
        held = time.monotonic()
        engine.resume()
        ended = engine.until(protocol.Ended)
        assert ended.outcome == protocol.COMPLETED
        assert ended.duration is not None
        after = [word for word in engine.words() if word.number > 5]
        assert after
        assert time.monotonic() - began >= ended.duration + 0.3 - 0.1
        assert time.monotonic() - held >= ended.duration - after[0].time


def test_a_paused_sentence_is_told_to_be_alive_for_as_long_as_it_takes() -> None:
    alive_every = 0.2
    with Spawned(limits={"RELEASE_AFTER": 0.3}, alive_every=alive_every) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        engine.until(protocol.Word)
        engine.pause()
        last = time.monotonic()
        for _ in range(5):
            assert isinstance(engine.event(), protocol.Alive)
            now = time.monotonic()
            assert now - last < alive_every + 0.2
            last = now
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED


def test_pausing_twice_and_resuming_for_nothing_is_harmless(player: Player) -> None:
    with Spawned(player.plays(), alive_every=SOON) as engine:
        engine.until(protocol.Voices)
        engine.resume()
        engine.say(TEXT)
        engine.resume()
        engine.until(protocol.Word)
        engine.send(protocol.Pause("g0", 1))
        engine.pause()
        engine.send(protocol.Pause("g1", 1))
        engine.send(protocol.Resume("g0"))
        assert isinstance(engine.event(), protocol.Alive)
        engine.resume()
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
        assert sum(isinstance(event, protocol.Paused) for event in engine.events) == 1
        engine.send(protocol.Pause("g1", 1))
        assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED


def test_resuming_before_it_is_silent_loses_nothing(player: Player) -> None:
    with Spawned(player.plays()) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        engine.until(protocol.Word)
        for _ in range(3):
            engine.until(protocol.Word)
            engine.send_raw(protocol.encode(protocol.Pause("g1", 1)) + protocol.encode(protocol.Resume("g1")))
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert player.heard.read_bytes() == _bytes(TEXT)


def test_a_player_gets_silence_in_a_pause_and_then_the_next_sample(player: Player) -> None:
    alive_every = 0.3
    with Spawned(player.plays(), alive_every=alive_every) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        engine.until(protocol.Word)
        engine.pause()
        assert isinstance(engine.event(), protocol.Alive)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    heard, sentence = player.heard.read_bytes(), _bytes(TEXT)
    assert len(heard) > len(sentence) + alive_every * 0.8 * RATE * 2
    assert without_silence(heard, sentence) == sentence


def test_a_player_that_dies_in_a_pause_is_replaced(player: Player) -> None:
    with Spawned(player.plays(), alive_every=SOON) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        engine.until(protocol.Word)
        engine.pause()
        (pid,) = children(engine.process.pid)
        os.kill(pid, signal.SIGKILL)
        assert isinstance(engine.event(), protocol.Alive)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    sentence = _bytes(TEXT)
    assert without_silence(player.heard.read_bytes(), sentence) == sentence


def test_a_player_that_dies_in_a_pause_and_cannot_be_replaced_fails_the_sentence_when_it_goes_on(
    player: Player,
) -> None:
    with Spawned(player.plays(), alive_every=SOON) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        engine.until(protocol.Word)
        engine.pause()
        player.command("raise SystemExit('audio open error: Connection refused')")
        (pid,) = children(engine.process.pid)
        os.kill(pid, signal.SIGKILL)
        assert isinstance(engine.event(), protocol.Alive)
        assert children(engine.process.pid) == []
        engine.resume()
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "audio_device")
        assert ended.message == "audio open error: Connection refused"


def test_a_player_that_holds_too_much_is_ended_and_the_rest_is_said_again(player: Player) -> None:
    with Spawned(player.command(DEEP)) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        words = [engine.until(protocol.Word) for _ in range(4)]
        engine.pause()
        assert children(engine.process.pid) == []
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
        assert [word.number for word in engine.words()] == list(range(1, len(engine.words()) + 1))
    first, second = sorted(player.heard.parent.glob("heard.*"), key=lambda path: path.stat().st_mtime)
    sentence = _bytes(TEXT)
    assert sentence.startswith(first.read_bytes())
    rest = second.read_bytes()
    assert sentence.endswith(rest)
    began = (len(sentence) - len(rest)) / (RATE * 2)
    assert words[-1].time - 0.05 <= began <= words[-1].time + 0.1


def test_a_frozen_player_is_ended_by_a_pause(player: Player) -> None:
    with limits(), Spawned(player.plays()) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        engine.until(protocol.Word)
        engine.until(protocol.Word)
        (pid,) = children(engine.process.pid)
        os.kill(pid, signal.SIGSTOP)
        assert_within(engine.pause(), 0.2, "the pause")
        assert children(engine.process.pid) == []
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED


def test_a_pause_before_the_player_took_anything_holds_the_whole_sentence(player: Player) -> None:
    with Spawned(player.command("import time\ntime.sleep(100)"), alive_every=SOON) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        engine.until(protocol.Alive)
        engine.pause()
        assert children(engine.process.pid) == []
        player.plays()
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    assert player.heard.read_bytes() == _bytes(TEXT)


def test_a_pause_when_only_the_end_is_left_lets_it_end(player: Player) -> None:
    mark = player.heard.with_name("drained")
    with Spawned(player.plays(after=f"open({str(mark)!r}, 'w'); time.sleep(0.3)")) as engine:
        engine.until(protocol.Voices)
        engine.say(TEXT)
        while not mark.exists():
            time.sleep(0.002)  # what another process does is no event
        engine.send(protocol.Pause("g1", 1))
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
        assert not any(isinstance(event, protocol.Paused) for event in engine.events)


@pytest.mark.parametrize("held", ["before", "within"])
def test_no_silence_is_written_to_a_file(tmp_path: Path, held: str) -> None:
    text, rate = TEXT if held == "before" else " ".join([TEXT] * 150), 200  # at which it is made the quickest
    plain, target = tmp_path / "plain.wav", tmp_path / "paused.wav"
    needs("espeak-ng")
    subprocess.run(["espeak-ng", "-s", str(rate), "-w", str(plain), text], check=True)
    with Spawned(f"file:{target}", alive_every=SOON) as engine:
        engine.until(protocol.Voices)
        pause = protocol.encode(protocol.Pause("g1", 1))
        engine.send_raw(protocol.encode(protocol.Say("g1", text, rate, 1.0, None, 50)) + pause * (held == "before"))
        if held == "within":
            engine.until(protocol.Word)
            engine.send_raw(pause)
        engine.until(protocol.Paused)
        assert target.exists() == (held == "within")
        size = target.stat().st_size if target.exists() else 0
        assert isinstance(engine.event(), protocol.Alive)
        assert (target.stat().st_size if target.exists() else 0) == size
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
    with wave.open(str(plain), "rb") as one, wave.open(str(target), "rb") as other:
        assert one.readframes(one.getnframes()) == other.readframes(other.getnframes())
