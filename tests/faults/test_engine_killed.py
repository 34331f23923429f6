"""The engine or the server is killed, crashes or hangs. Its goal ends, and the next one is heard."""

from __future__ import annotations

import os
import random
import signal
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.child.playback import Playback
from talkcli.engine.child.players.base import CannotKillPlayer
from tests.conformance.hearing import (
    LONG,
    LOW,
    PRECISION,
    assert_aborted,
    await_word,
    engine_process,
    player_process,
    send,
    start_goal,
)
from tests.faults.broken import assert_heard_again, assert_heard_last, await_end, no_leaks, python_path, write
from tests.support import usage
from tests.support.compare import assert_only_beginning
from tests.support.reference import render
from tests.support.surroundings import command_line, needs
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.recording import Recording
    from tests.support.sink import Sink

KILL, SEGV, STOP = signal.SIGKILL, signal.SIGSEGV, signal.SIGSTOP
#: Limits in seconds from the signal to the first sample of the next goal.
CRASH, HANG = 0.5, 6.0
SIGNALS = {
    KILL: ("engine_crashed", "the engine crashed: it was killed by SIGKILL", CRASH),
    SEGV: ("engine_crashed", "the engine crashed: it was killed by SIGSEGV", CRASH),
    STOP: ("engine_hung", "the engine did not respond for 3 s", HANG),
}
#: A player with a large buffer: the synthesis finishes while the rest of the sound is still in the pipes. If the
#: engine process dies, only the server can kill the processes that the shell has started.
DEEP = "sh -c 'cat | cat | cat | aplay -q -t raw -f S16_LE -c 1 -r {rate} --buffer-time=60000'"
#: The player to use for each activity of the engine process.
PLAYERS = {"idle": "pulse", "in synthesis": "aplay", "in playback": DEEP, "paused": "pulse"}
CRASHES = [("idle", KILL), ("in synthesis", SEGV), ("in playback", KILL), ("paused", SEGV)]

#: Words per minute of the next goal, the maximum.
RATE = 450


@pytest.mark.parametrize(
    ("activity", "number"),
    [*CRASHES, *(pytest.param(name, STOP, marks=[pytest.mark.slow] * (name != "in synthesis")) for name in PLAYERS)],
    ids=lambda value: value if isinstance(value, str) else signal.Signals(value).name,
)
def test_a_killed_or_frozen_engine_loses_at_most_one_goal(
    make_talk: MakeTalk, sink: Sink, activity: str, number: signal.Signals
) -> None:
    with limits():
        talk = make_talk("--player", PLAYERS[activity], sink=sink)
        with no_leaks(talk), sink.record() as recording:
            goal = _bring_to(talk, activity, recording)
            following = send(talk, LOW, rate=RATE) if goal else None
            engine, since = engine_process(talk), time.monotonic()
            os.kill(engine, number)
            if activity == "idle" and number is STOP:
                goal = send(talk, LONG)  # only a goal reveals that it is frozen, and that goal is lost
            elif activity == "idle":
                usage.wait_until(talk.pid, lambda now: now.processes == 2 and engine_process(talk) != engine)
            following = following or send(talk, LOW, rate=RATE)
            if goal:
                reason, error, _ = SIGNALS[number]
                assert await_end(talk, goal, HANG) == "ABORTED"
                assert_aborted(talk.goal(goal), reason, error)
                spoken = talk.goal(goal)["spoken"]
                assert activity in {"idle", "in playback"} or "two three" in spoken != LONG
            if activity == "paused":
                assert talk.request("status")["server"]["paused"]
                assert talk.goal(following)["state"] == "PENDING"
                # Nothing may be heard while paused, so after a crash the limit counts from the resume.
                since = since if number is STOP else time.monotonic()
                talk.request("resume")
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        heard_at = assert_heard_last(recording, render([LOW], rate=RATE)[0])
        assert_within(heard_at - since, SIGNALS[number][2], f"the next goal after {number.name}, {activity}")
        if activity == "in synthesis":
            assert_only_beginning(recording.between(0, heard_at - PRECISION), render([LONG])[0])


def _bring_to(talk: Talk, activity: str, recording: Recording) -> str | None:
    """Bring the engine process to an activity, and return its goal; None if idle."""
    if activity == "idle":
        return None
    if activity == "in playback":
        goal = send(talk, LONG)
        player = player_process(talk)
        end = time.monotonic() + 2
        while _feeding(talk, player):
            assert time.monotonic() < end, "the player does not accept the whole sentence"
            time.sleep(0.005)  # the closing of a descriptor sends no event
        recording.wait_for_sound()
        return goal
    goal = start_goal(talk, LONG)
    if activity == "paused":
        assert talk.request("pause")["goal"]["id"] == goal
    else:
        assert _feeding(talk, player_process(talk)), "the synthesis ended before the sentence was nearly over"
    return goal


#: A player that runs in another session.
OTHER_SESSION = "setsid -w aplay -q -t raw -f S16_LE -c 1 -r {rate} --buffer-time=60000"


def test_processes_that_a_player_started_in_another_session_are_killed(make_talk: MakeTalk, sink: Sink) -> None:
    needs("setsid")
    talk = make_talk("--player", OTHER_SESSION, sink=sink)
    with limits(), no_leaks(talk):
        goal = start_goal(talk, LONG, number=1)
        playing = [pid for pid in usage.descendants(talk.pid) if command_line(pid).startswith("aplay")]
        assert playing
        following = send(talk, LOW, rate=RATE)
        os.kill(engine_process(talk), KILL)
        assert await_end(talk, goal, HANG) == "ABORTED"
        assert not any("aplay" in command_line(pid) for pid in playing)
        assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"


def _feeding(talk: Talk, player: int) -> bool:
    """Return whether the engine still has the other end of the player's standard input open."""
    pipe = os.readlink(f"/proc/{player}/fd/0")
    return pipe in usage.descriptors(engine_process(talk)).values()


#: Seconds for the watchdog thread to act and for the event to reach the watcher.
SLACK = 0.5
#: Seconds from a kill to the first sample of the next goal, including messages.
RESTART = 0.7
#: Limit in seconds for a synthesis without progress in this test. It is shorter than the real one.
STUCK_LIMIT_S = 1.0
#: A library that prints an error and never returns from a text with the word "forever".
STUCK_SYNTHESIS = f"""
from talkcli.engine import protocol
protocol.HANG_LIMIT_S = {STUCK_LIMIT_S}
import sys, time
if "talkcli.engine.child.main" in "".join(sys.orig_argv):
    from pyttsx3.drivers import _espeak
    speak = _espeak.Synth
    def wait(text, *rest, **options):
        while b"forever" in text:
            sys.stderr.write("stuck \\x1b[31m\\n")
            sys.stderr.flush()
            time.sleep(60)
        return speak(text, *rest, **options)
    _espeak.Synth = wait
"""


def test_a_synthesis_without_progress_is_aborted(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
    write(tmp_path / "sitecustomize.py", STUCK_SYNTHESIS)
    with limits():
        talk = make_talk(sink=sink, env=python_path(tmp_path))
        with no_leaks(talk), sink.record() as recording:
            sent_at = time.monotonic()
            goal = send(talk, "this takes forever")
            following = send(talk, LOW, rate=RATE)
            assert await_end(talk, goal, STUCK_LIMIT_S + SLACK + 2) == "ABORTED"
            assert_aborted(talk.goal(goal), "engine_hung", f"the engine did not respond for {STUCK_LIMIT_S:g} s")
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        seconds = assert_heard_last(recording, render([LOW], rate=RATE)[0]) - sent_at
        assert r"talk: engine: stuck \x1b[31m" in talk.log
        assert seconds > STUCK_LIMIT_S
        assert_within(seconds, STUCK_LIMIT_S + RESTART, "the next goal after a synthesis without progress")


def test_a_killed_player_that_does_not_exit_is_not_awaited_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """It may hang in a device driver. Then the engine process exits, and the server starts another one."""
    monkeypatch.setattr("talkcli.engine.child.playback.PLAYER_KILL_LIMIT_S", 0.05)
    player = SimpleNamespace(name="player", proven=False, kill=lambda: None, gone=lambda: False)
    playback = Playback.__new__(Playback)
    playback._feed = SimpleNamespace(player=player)  # type: ignore[assignment]
    playback._runner = SimpleNamespace(wait=lambda **_: None)  # type: ignore[assignment]
    with pytest.raises(CannotKillPlayer, match=r"player could not be stopped within 0\.05 s"):
        playback.release_player()


#: For a longer run: `TALK_TEST_KILLS=1000 pytest -s -m slow -k server_killed tests/faults/test_engine_killed.py`.
KILLS = int(os.environ.get("TALK_TEST_KILLS", "20"))
#: Limits in seconds: from the kill to the last sound and the last process's end, and from a start to the greeting.
SILENT, SERVES = 0.3, 1.0
#: First and last word of LONG at which the server is killed. Before the second word, there may be no sound yet.
WORDS = (2, 5)


@pytest.mark.timeout(60 + 10 * KILLS)
@pytest.mark.parametrize("kills", [1, pytest.param(KILLS, marks=pytest.mark.slow)])
def test_a_server_killed_in_mid_sentence_is_silent_and_starts_again(
    make_talk: MakeTalk, sink: Sink, kills: int
) -> None:
    talk = make_talk(sink=sink, forked=False)  # the start is timed
    chance = random.Random(kills)
    files = set(os.listdir(talk.directory))
    with limits():
        for _ in range(kills):
            with sink.record() as recording:
                await_word(talk, send(talk, LONG, rate=RATE), chance.randint(*WORDS))
                killed = time.monotonic()
                gone = talk.kill()
                last = recording.wait_until_quiet(0.2)
            assert last is not None
            started = time.monotonic()
            talk.start_server()
            assert_within(time.monotonic() - started, SERVES, "the start after the server was killed")
            assert_within(gone, SILENT, "the end of all processes after the server was killed")
            assert_within(last - killed, SILENT, "the silence after the server was killed")
    assert_heard_again(talk, sink)
    assert set(os.listdir(talk.directory)) == files
