"""The engine process speaks through talk's own driver, as the server sees it."""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import signal
import subprocess
import time
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.spawned import FAST, Spawned
from tests.support.processes import children
from tests.support.surroundings import needs
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def test_a_process_gets_ready_and_lists_its_voices() -> None:
    with Spawned() as engine:
        ready = engine.until(protocol.Ready)
        assert ready.driver == "espeak"
        assert ready.version is not None
        assert ready.version.startswith("eSpeak NG ")
        assert ready.player == "null"
        engine.say("yes")
        told = engine.event()
        assert isinstance(told, protocol.Voices)
        assert any(voice.language == "en-us" and voice.id == "gmw/en-US" for voice in told.voices)
        assert isinstance(engine.event(), protocol.Started)


def test_voices_that_are_known_are_not_listed() -> None:
    with Spawned(list_voices=False) as engine:
        engine.until(protocol.Ready)
        assert engine.spoken("yes").outcome == protocol.COMPLETED
        assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED
        engine.leave()
        assert engine.event() is None
        assert not any(isinstance(event, protocol.Voices) for event in engine.events)


def test_a_sentence_lasts_as_long_as_its_audio() -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        began = time.monotonic()
        ended = engine.spoken("battery low")
        took = time.monotonic() - began
        assert ended.outcome == protocol.COMPLETED
        assert ended.duration is not None
        assert ended.duration <= took < ended.duration + 0.3


def test_words_come_as_they_are_heard_and_only_forward() -> None:
    text = "this one é 日本 😀 battery low, please."
    with limits(), Spawned() as engine:
        engine.until(protocol.Ready)
        began = time.monotonic()
        engine.say(text)
        late = []
        while not isinstance(event := engine.event(), protocol.Ended):
            if isinstance(event, protocol.Word):
                late.append(time.monotonic() - began - event.time)
        words = engine.words()
        assert [text[word.start : word.end] for word in words][1:] == ["é", "日本", "😀", "battery", "low", "please"]
        assert [word.number for word in words] == list(range(1, len(words) + 1))
        assert all(first.end <= second.start for first, second in itertools.pairwise(words))
        assert_within(max(late) - min(late), 0.1, "a word after another")
        assert min(late) >= 0


@pytest.mark.parametrize("goals", [1, 3])
def test_the_first_sentence_is_what_espeak_ng_makes(tmp_path: Path, goals: int) -> None:
    reference = tmp_path / "reference.wav"
    needs("espeak-ng")
    subprocess.run(["espeak-ng", "-s", str(FAST), "-w", str(reference), "battery low, please recharge"], check=True)
    target = tmp_path / "talk.wav"
    with Spawned(f"file:{target}") as engine:
        engine.until(protocol.Ready)
        for number in range(goals):
            assert engine.spoken("battery low, please recharge", f"g{number}").outcome == protocol.COMPLETED
    expected = _samples(reference)
    assert _samples(target)[: len(expected)] == expected
    assert (len(_samples(target)) == len(expected)) == (goals == 1)


def test_a_stop_is_silent_within_20_ms_and_the_next_sentence_is_spoken() -> None:
    with limits(), Spawned() as engine:
        engine.until(protocol.Ready)
        for number in range(5):
            engine.say("one two three four five six seven eight nine ten", f"g{number}")
            engine.until(protocol.Word)
            asked = time.monotonic()
            engine.send(protocol.Stop(f"g{number}"))
            ended = engine.until(protocol.Ended)
            assert_within(time.monotonic() - asked, 0.02, "the stop")
            assert ended == protocol.Ended(f"g{number}", protocol.STOPPED)
        assert engine.spoken("yes", "last").outcome == protocol.COMPLETED


def test_a_stop_for_another_goal_is_ignored() -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        engine.send(protocol.Stop("g0"))
        engine.say("yes")
        engine.until(protocol.Started)
        engine.send(protocol.Stop("g0"))
        assert engine.until(protocol.Ended).outcome == protocol.COMPLETED


def test_a_goal_in_hand_is_told_to_be_alive() -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        last = time.monotonic()
        engine.say("aaaaaah.\n\n\n\nwell", rate=120)  # a word, and the next one three signs of life later
        while not isinstance(engine.event(), protocol.Ended):
            now = time.monotonic()
            assert now - last < protocol.ALIVE_EVERY + 0.2
            last = now


@pytest.mark.parametrize("text", ["", "  \n", "...", "\x01\x02", "«»"])
def test_what_cannot_be_spoken_ends_with_nothing_to_say(text: str) -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken(text)
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "nothing_to_say")
        assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED


def test_control_characters_are_no_commands_and_keep_the_offsets(tmp_path: Path) -> None:
    with Spawned(f"file:{tmp_path / 'x.wav'}") as engine:
        engine.until(protocol.Ready)
        plain = engine.spoken("a    b one two", "g1").duration
        assert engine.spoken("a \x01\x00\x1bb one two", "g2").outcome == protocol.COMPLETED
        assert engine.words("g1")[-1].start == engine.words("g2")[-1].start == len("a    b one ")
        # 0x01 would have made it speak at 80 words per minute
        loud = engine.spoken("a \x0180Sb one two", "g3").duration
        assert plain is not None
        assert loud is not None
        assert loud < plain * 2.5


def test_settings_belong_to_their_goal(tmp_path: Path) -> None:
    with Spawned(f"file:{tmp_path / 'x.wav'}") as engine:
        engine.until(protocol.Ready)
        text = "the battery is low, please come home"
        fast = engine.spoken(text, "g1", rate=400).duration
        slow = engine.spoken(text, "g2", rate=100, voice="en-us").duration
        again = engine.spoken(text, "g3", rate=400).duration
        assert fast is not None
        assert slow is not None
        assert again is not None
        assert slow > 2 * fast
        assert abs(again - fast) < 0.15


def test_an_unknown_voice_fails_with_near_matches_and_the_next_goal_is_spoken() -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken("yes", voice="en-uss")
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "unknown_voice")
        assert ended.message is not None
        assert "'en-us'" in ended.message
        assert "talk voices" in ended.message
        assert engine.spoken("yes", "g2", voice="en-us").outcome == protocol.COMPLETED


def test_an_orphan_ends_before_it_starts() -> None:
    with Spawned(server=1) as engine:
        assert engine.event() is None
        assert engine.process.wait(5) == 0


def test_the_process_ends_with_its_server(tmp_path: Path) -> None:
    with _speaking(tmp_path) as engine:
        engine.hang_up()
        assert engine.all_gone()
        assert engine.process.wait(5) == 0


def test_the_player_dies_with_a_killed_process(tmp_path: Path) -> None:
    with _speaking(tmp_path) as engine:
        os.kill(engine.process.pid, signal.SIGKILL)
        assert engine.all_gone()


def test_a_stop_that_comes_with_the_sentence_is_obeyed() -> None:
    with Spawned() as engine:
        engine.until(protocol.Voices)
        say = protocol.encode(protocol.Say("g1", "one two three four five", 200, 1.0, None, 50))
        engine.send_raw(say + protocol.encode(protocol.Stop("g1")))
        assert engine.until(protocol.Ended).outcome == protocol.STOPPED
        assert engine.words() == []


def test_the_end_of_the_connection_stops_the_sentence_and_ends_the_process() -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        engine.say("one two three four five")
        engine.until(protocol.Word)
        engine.leave()
        assert engine.until(protocol.Ended).outcome == protocol.STOPPED
        assert engine.event() is None
        assert engine.process.wait(5) == 0
        assert engine.errors() == ""


def test_a_crash_leaves_no_core() -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        soft, _ = resource.prlimit(engine.process.pid, resource.RLIMIT_CORE)
        assert soft in (0, 1)  # bytes; 0 where it may not have more


def test_an_idle_process_does_not_wake_up() -> None:
    with Spawned() as engine:
        engine.until(protocol.Ready)
        engine.until(protocol.Voices)
        time.sleep(0.05)  # it goes to rest, and says nowhere when it has
        before = _switches(engine.process.pid)
        time.sleep(1)  # the time that is looked at
        assert _switches(engine.process.pid) == before


@contextlib.contextmanager
def _speaking(folder: Path) -> Iterator[Spawned]:
    """Give a process with a goal in hand and a player that runs, takes nothing and never ends."""
    begun, script = folder / "begun", folder / "sleeper"
    os.mkfifo(begun)
    script.write_text(f"#!/bin/sh\necho > {begun}\nexec sleep 100\n")
    script.chmod(0o755)
    with Spawned(str(script)) as engine:
        engine.until(protocol.Ready)
        engine.say("one two three")
        begun.read_text()
        # What is killed before its player is on the leash leaves one that was given nothing, and ends with its input;
        # this one does not.
        (player,) = children(engine.process.pid)
        while not _on_a_leash(player):
            time.sleep(0.001)  # the kernel tells nobody
        yield engine


def _on_a_leash(pid: int) -> bool:
    """Return whether a process has inherited a descriptor that asks for signals."""
    for each in os.listdir(f"/proc/{pid}/fdinfo"):
        with contextlib.suppress(FileNotFoundError), open(f"/proc/{pid}/fdinfo/{each}") as file:
            if int(file.read().split("flags:")[1].split()[0], 8) & os.O_ASYNC:
                return True
    return False


def _switches(pid: int) -> str:
    with open(f"/proc/{pid}/status") as file:
        return next(line for line in file if line.startswith("voluntary_ctxt_switches"))


def _samples(path: Path) -> bytes:
    with wave.open(str(path), "rb") as file:
        return file.readframes(file.getnframes())
