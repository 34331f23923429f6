"""Tests for an engine process with talk's own driver, from its start to its exit, using the protocol."""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.process import FAST, Engine, SharedEngine
from tests.engine.programs import NEVER_READS
from tests.support.processes import children
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.engine.programs import Player

ALIVE_EVERY = 0.2
#: Modules that the process doesn't need. Each import takes milliseconds, and ten times as long on a Raspberry Pi.
_NOT_NEEDED = {
    *("typing", "dataclasses", "inspect", "subprocess", "threading", "selectors", "asyncio", "socket", "logging"),
}
#: Code that writes the names of all imported modules at the exit.
_REPORT_MODULES = """
import atexit
atexit.register(lambda: sys.stderr.write(" ".join(sys.modules)))
"""


@pytest.fixture(scope="module")
def shared() -> Iterator[SharedEngine]:
    with contextlib.closing(SharedEngine(lambda: Engine(alive_every=ALIVE_EVERY))) as shared:
        yield shared


def _duration(ended: protocol.Ended) -> float:
    assert ended.duration is not None, ended
    return ended.duration


# -- the start


def test_a_process_becomes_ready_and_lists_its_voices() -> None:
    with Engine(driver="espeak") as engine:
        ready = engine.until(protocol.Ready)
        assert (ready.driver, ready.player) == ("espeak", "null")
        assert ready.version is not None
        assert ready.version.startswith("eSpeak NG ")
        engine.say("yes")
        event = engine.event()
        assert isinstance(event, protocol.VoiceList)
        assert any(voice.language == "en-us" and voice.id == "gmw/en-US" for voice in event.voices)
        assert isinstance(engine.event(), protocol.Started)


def test_voices_that_the_server_knows_are_not_listed() -> None:
    with Engine(list_voices=False) as engine:
        assert engine.spoken("yes").outcome == protocol.OUTCOME_COMPLETED
        engine.leave()
        assert engine.event() is None
        assert not any(isinstance(event, protocol.VoiceList) for event in engine.events)


def test_a_process_imports_nothing_that_it_does_not_need(player: Player) -> None:
    """Imports delay the next sentence after a crash."""
    with Engine(player.plays(), before=_REPORT_MODULES) as engine:
        engine.spoken("battery low. Please")
        engine.spoken("...", "g2")
        engine.leave()
        imported = set(engine.errors().split())
    assert "talkcli.engine.child.playback" in imported
    assert not imported & _NOT_NEEDED


@pytest.mark.parametrize("less", [0, 1 << 20])
def test_a_process_gets_no_more_than_half_of_the_machines_memory(less: int) -> None:
    """The limit is at least 1 GiB. A lower limit that is already set remains."""
    limit = max(1 << 30, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    before = f"import resource\nresource.setrlimit(resource.RLIMIT_DATA, ({limit - less}, -1))" if less else ""
    with Engine(before=before) as engine:
        soft, _ = resource.prlimit(engine.process.pid, resource.RLIMIT_DATA)
    assert soft == limit - less


# -- sentences


@limits()
def test_words_are_reported_in_order_when_they_are_heard(engine: Engine) -> None:
    text = "this one é 日 😀 low."
    started_at, delays = time.monotonic(), []
    engine.say(text)
    while not isinstance(event := engine.event(), protocol.Ended):
        if isinstance(event, protocol.Word):
            delays.append(time.monotonic() - started_at - event.time)
    assert _duration(event) <= time.monotonic() - started_at < _duration(event) + 0.3
    words = engine.words()
    assert [text[word.start : word.end] for word in words][1:] == ["é", "日", "😀", "low"]
    assert [word.number for word in words] == list(range(1, len(words) + 1))
    assert all(first.end <= second.start for first, second in itertools.pairwise(words))
    assert_within(max(delays) - min(delays), 0.1, "a word after another")
    assert min(delays) >= 0


@limits()
def test_signs_of_life_are_sent_while_a_goal_is_spoken(engine: Engine) -> None:
    last = time.monotonic()
    engine.say("a.\n\n\n\na", rate=200)  # the second word comes after some `Alive` messages
    alive = 0
    while not isinstance(event := engine.event(), protocol.Ended):
        now = time.monotonic()
        assert_within(now - last, ALIVE_EVERY + 0.2, "a sign of life")
        last = now
        alive += isinstance(event, protocol.Alive)
    assert alive > 1


def test_a_text_without_words_fails_with_nothing_to_say(engine: Engine) -> None:
    for text in ("", "  \n", "...", "\x01\x02", "«»"):
        ended = engine.spoken(text, f"goal {text!a}")
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, "nothing_to_say")
    assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED


# -- stops


def test_a_stop_for_another_goal_is_ignored(engine: Engine) -> None:
    engine.send(protocol.Stop("g0"))
    engine.say("yes")
    engine.until(protocol.Started)
    engine.send(protocol.Stop("g0"))
    assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED


def test_a_stop_sent_together_with_the_sentence_is_obeyed(engine: Engine) -> None:
    engine.send(protocol.Speak("g1", "one two three four five", 200, 1.0, None, 50), protocol.Stop("g1"))
    assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_STOPPED
    assert engine.words() == []


# -- idle, and exit


def test_a_crash_leaves_no_core_dump(engine: Engine) -> None:
    soft, _ = resource.prlimit(engine.process.pid, resource.RLIMIT_CORE)
    assert soft in (0, 1)  # bytes; 0 if the hard limit is 0


def test_an_idle_process_does_not_wake_up(engine: Engine) -> None:
    assert engine.spoken("a").outcome == protocol.OUTCOME_COMPLETED
    time.sleep(0.05)  # until the process is idle, which no event reports
    before = _context_switches(engine.process.pid)
    time.sleep(2 * ALIVE_EVERY)  # the measured time
    assert _context_switches(engine.process.pid) == before


def _context_switches(pid: int) -> str:
    with open(f"/proc/{pid}/status") as file:
        return next(line for line in file if line.startswith("voluntary_ctxt_switches"))


def test_a_process_without_its_server_exits_at_once() -> None:
    with Engine(server=1) as engine:
        assert engine.event() is None
        assert engine.process.wait(5) == 0


def test_the_process_and_its_player_end_with_the_server(player: Player, tmp_path: Path) -> None:
    started = tmp_path / "started"
    os.mkfifo(started)
    with Engine(player.command(f"open({str(started)!r}, 'w').close()\n{NEVER_READS}")) as engine:
        engine.say("one two three")
        started.read_text()
        assert len(children(engine.process.pid)) == 1
        engine.hang_up()
        assert engine.all_gone()
        assert engine.process.wait(5) == 0


def test_the_end_of_the_connection_stops_the_sentence_and_ends_the_process() -> None:
    with Engine() as engine:
        engine.say("one two three four five", rate=FAST)
        engine.until_word()
        engine.leave()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_STOPPED
        assert engine.event() is None
        assert engine.process.wait(5) == 0
        assert engine.errors() == ""
