"""Tests for paused sentences: no sample is lost or repeated, and words are reported on time.

`conformance/test_heard_pausing.py` tests how a pause sounds at a sound server.
"""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.process import FAST, SOON, Engine
from tests.engine.programs import NEVER_READS, Player, sound, without_silence
from tests.support.processes import children
from tests.support.reference import RATE, render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.sink import Sink

TEXT = "one two three four five"

#: A player that reads everything at once, plays it in real time, and writes it to a file.
DEEP = """
import os, sys, time
heard = open(f"{sys.argv[1]}.{os.getpid()}", "ab", buffering=0)
started_at, taken = time.monotonic(), 0
while data := os.read(0, 65536):
    taken += len(data)
    heard.write(data)
time.sleep(max(0, started_at + taken / 44100 - time.monotonic()))
"""


def _say_until_word(engine: Engine, number: int = 1) -> None:
    engine.until(protocol.VoiceList)
    engine.say(TEXT)
    engine.until_word(number)


def _resume_to_the_end(engine: Engine) -> protocol.Ended:
    engine.resume()
    ended = engine.until(protocol.Ended)
    assert ended.outcome == protocol.OUTCOME_COMPLETED
    return ended


@limits()
@pytest.mark.parametrize("program", [False, True])
def test_a_pause_delays_words_while_signs_of_life_continue(player: Player, program: bool) -> None:
    alive_every = 0.15
    command = player.plays() if program else "null"
    with Engine(command, limits={"RELEASE_DELAY_S": 10.0 if program else 0.3}, alive_every=alive_every) as engine:
        engine.until(protocol.VoiceList)
        engine.say(TEXT)
        late, before, paused = [], 0, 0.0
        while not isinstance(event := engine.event(), protocol.Ended):
            if not isinstance(event, protocol.Word):
                continue
            late.append(time.monotonic() - event.time)
            if event.number == 3:
                engine.pause()
                before, last = len(late), time.monotonic()  # ignore a word that arrived before the confirmation
                for _ in range(3):
                    assert isinstance(engine.event(), protocol.Alive), "a word was reported during the pause"
                    assert_within(time.monotonic() - last, alive_every + 0.2, "a sign of life")
                    paused, last = paused + time.monotonic() - last, time.monotonic()
                engine.resume()
        assert event.outcome == protocol.OUTCOME_COMPLETED
        assert min(late[before:]) > max(late[:before]) + paused - 0.05, "a word was reported before it was heard"
        assert_within(max(late[before:]), min(late[:before]) + paused + 0.3, "a word after the pause")
        times = [word.time for word in engine.words()]
        assert times == sorted(times)
        assert event.duration is not None
        assert times[-1] < event.duration


def test_a_second_pause_and_a_needless_resume_are_harmless(player: Player) -> None:
    with Engine(player.plays(), alive_every=SOON) as engine:
        engine.until(protocol.VoiceList)
        engine.resume()
        engine.say(TEXT)
        engine.resume()
        engine.until_word()
        engine.send(protocol.Hold("g0", 1))
        engine.pause()
        engine.send(protocol.Hold("g1", 1))
        engine.send(protocol.Continue("g0"))
        assert isinstance(engine.event(), protocol.Alive)
        engine.resume()
        _resume_to_the_end(engine)
        assert sum(isinstance(event, protocol.Held) for event in engine.events) == 1
        engine.send(protocol.Hold("g1", 1))
        assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED


def test_a_resume_before_silence_loses_no_sample(player: Player) -> None:
    with Engine(player.plays()) as engine:
        _say_until_word(engine)
        for _ in range(3):
            engine.until_word()
            engine.send(protocol.Hold("g1", 1), protocol.Continue("g1"))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert player.heard.read_bytes() == sound(TEXT)


@pytest.mark.parametrize("dies", [False, True])
def test_a_paused_player_gets_silence_and_is_replaced_if_it_dies(player: Player, dies: bool) -> None:
    alive_every = 0.15
    with Engine(player.plays(), alive_every=alive_every) as engine:
        _say_until_word(engine)
        engine.pause()
        if dies:
            (pid,) = children(engine.process.pid)
            os.kill(pid, signal.SIGKILL)
        assert isinstance(engine.event(), protocol.Alive)
        _resume_to_the_end(engine)
    heard, sentence = player.heard.read_bytes(), sound(TEXT)
    assert dies or len(heard) > len(sentence) + alive_every * 0.8 * RATE * 2
    assert without_silence(heard, sentence) == sentence


def test_a_sentence_fails_if_its_paused_player_cannot_be_replaced(player: Player) -> None:
    with Engine(player.plays(), alive_every=SOON) as engine:
        _say_until_word(engine)
        engine.pause()
        player.command("raise SystemExit('audio open error: Connection refused')")
        (pid,) = children(engine.process.pid)
        os.kill(pid, signal.SIGKILL)
        assert isinstance(engine.event(), protocol.Alive)
        assert children(engine.process.pid) == []
        engine.resume()
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, "audio_device")
        assert ended.message == "audio open error: Connection refused"


def test_a_pause_kills_a_player_with_a_large_buffer_and_resumes_in_place(player: Player) -> None:
    with limits(), Engine(player.command(DEEP)) as engine:
        _say_until_word(engine)
        words = [engine.until(protocol.Word) for _ in range(3)]
        assert_within(engine.pause(), 0.1, "the pause")
        assert children(engine.process.pid) == []
        _resume_to_the_end(engine)
        assert [word.number for word in engine.words()] == list(range(1, len(engine.words()) + 1))
    first, second = sorted(player.heard.parent.glob("heard.*"), key=lambda path: path.stat().st_mtime)
    sentence = sound(TEXT)
    assert sentence.startswith(first.read_bytes())
    rest = second.read_bytes()
    assert sentence.endswith(rest)
    resumed_from = (len(sentence) - len(rest)) / (RATE * 2)
    assert words[-1].time - 0.05 <= resumed_from <= words[-1].time + 0.1


def test_a_pause_kills_a_frozen_player(player: Player) -> None:
    with limits(), Engine(player.plays()) as engine:
        _say_until_word(engine, 2)
        (pid,) = children(engine.process.pid)
        os.kill(pid, signal.SIGSTOP)
        assert_within(engine.pause(), 0.2, "the pause")
        assert children(engine.process.pid) == []
        _resume_to_the_end(engine)


@pytest.mark.parametrize("together", [True, False], ids=["with the sentence", "before the player took anything"])
def test_a_pause_before_the_first_sound_delays_the_whole_sentence(player: Player, together: bool) -> None:
    with Engine(player.command(NEVER_READS), alive_every=SOON) as engine:
        engine.until(protocol.VoiceList)
        if together:
            engine.send(protocol.Speak("g1", TEXT, FAST, 1.0, None, 50), protocol.Hold("g1", 1))
            engine.until(protocol.Held)
        else:
            engine.say(TEXT)
            engine.until(protocol.Alive)
            engine.pause()
        assert children(engine.process.pid) == []
        player.plays()
        _resume_to_the_end(engine)
    assert player.heard.read_bytes() == sound(TEXT)


@pytest.mark.parametrize("release", [0.2, 10.0])
def test_a_stop_ends_a_paused_sentence_at_once(player: Player, release: float) -> None:
    with limits(), Engine(player.plays(), limits={"RELEASE_DELAY_S": release}, alive_every=SOON) as engine:
        _say_until_word(engine, 3)
        engine.pause()
        while release < 1 and children(engine.process.pid):
            assert isinstance(engine.event(), protocol.Alive)
        assert len(children(engine.process.pid)) == (release > 1)
        assert_within(engine.stop(), 0.02, "the stop")
        assert children(engine.process.pid) == []
        heard = player.heard.read_bytes().rstrip(b"\0")
        assert sound(TEXT).startswith(heard)
        assert len(heard) < len(sound(TEXT).rstrip(b"\0"))
        assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED


def test_a_pause_after_the_last_sample_lets_the_sentence_end(player: Player) -> None:
    mark = player.heard.with_name("drained")
    with Engine(player.plays(after=f"open({str(mark)!r}, 'w'); time.sleep(0.3)")) as engine:
        engine.say("yes")
        while not mark.exists():
            time.sleep(0.002)  # no event reports the end of the samples
        engine.send(protocol.Hold("g1", 1))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        assert not any(isinstance(event, protocol.Held) for event in engine.events)


@pytest.mark.parametrize("paused", ["before", "within"])
def test_a_pause_writes_no_silence_to_a_file(tmp_path: Path, paused: str) -> None:
    text, rate = TEXT if paused == "before" else " ".join([TEXT] * 60), 200  # the rate at which synthesis is fastest
    target = tmp_path / "paused.wav"
    with Engine(f"file:{target}", alive_every=SOON) as engine:
        engine.until(protocol.VoiceList)
        pause = protocol.Hold("g1", 1)
        engine.send(protocol.Speak("g1", text, rate, 1.0, None, 50), *([pause] if paused == "before" else []))
        if paused == "within":
            engine.until_word()
            engine.send(pause)
        engine.until(protocol.Held)
        assert target.exists() == (paused == "within")
        size = target.stat().st_size if target.exists() else 0
        assert isinstance(engine.event(), protocol.Alive)
        assert (target.stat().st_size if target.exists() else 0) == size
        _resume_to_the_end(engine)
    assert target.read_bytes()[44:] == render([text], rate=rate)[0].tobytes()


# -- resuming with another player

#: Limits that make a paused sentence release its player at once.
AT_ONCE = {"RELEASE_DELAY_S": 0.0}


def _pause_after_two_words(engine: Engine) -> list[protocol.OutputChanged]:
    """Start a sentence, pause it after its second word, and return the reported outputs."""
    engine.say(TEXT)
    engine.until_word(2)
    engine.pause()
    return _reported_outputs(engine)


def _reported_outputs(engine: Engine) -> list[protocol.OutputChanged]:
    return [event for event in engine.events if isinstance(event, protocol.OutputChanged)]


def test_a_partly_muted_sentence_remains_reported_as_muted(sink: Sink) -> None:
    sink.pactl("set-sink-mute", "null", "1")
    try:
        with Engine(None, environment=sink.env, limits=AT_ONCE) as engine:
            (reported,) = _pause_after_two_words(engine)
            assert reported.output == {"player": "pulse", "device": "null", "volume": 1.0, "muted": True}
            sink.pactl("set-sink-mute", "null", "0")
            engine.resume()
            assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
            assert _reported_outputs(engine) == [reported]
    finally:
        sink.pactl("set-sink-mute", "null", "0")


@pytest.mark.parametrize("alsa", [True, False])
def test_no_output_is_reported_if_a_program_continues_the_sentence(sink: Sink, tmp_path: Path, alsa: bool) -> None:
    """The sound server's socket is removed before the sentence continues. aplay can still play through `.asoundrc`."""
    path = tmp_path / "s"
    path.symlink_to(sink.socket)
    environment = {**sink.env, "PULSE_SERVER": f"unix:{path}", **({} if alsa else {"ALSA_CONFIG_PATH": os.devnull})}
    with Engine(None, environment=environment, limits=AT_ONCE) as engine:
        (reported,) = _pause_after_two_words(engine)
        assert reported.output is not None
        assert reported.output["player"] == "pulse"
        os.unlink(path)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == (protocol.OUTCOME_COMPLETED if alsa else protocol.OUTCOME_FAILED)
        assert [event.output for event in _reported_outputs(engine)[1:]] == ([None] if alsa else [])
