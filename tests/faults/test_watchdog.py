"""The faults that the engine thread's watchdog must see, each at the real engine and a real sink.

`test_player_broken` and `test_engine_killed` hold the others, row 6 an engine that ignores a stop.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.playback import GONE_WITHIN, STALLED_AFTER
from talkcli.engine.protocol import HANG_AFTER, SILENCE_LIMIT, STOP_LIMIT
from tests.conformance.hearing import LONG, LOW, assert_aborted, await_word, begin, engine_process, player_process, send
from tests.faults import trapped
from tests.faults.broken import await_end, began, heard_again, nothing_left, python_path, told, write
from tests.support import census
from tests.support.reference import render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds in which the thread acts and the watcher is told.
SLACK = 0.5
#: Seconds from a kill to the first sample of the next goal, the messages before included.
RESTART = 0.7
#: Seconds in which `cancel` is answered, whatever happens.
CANCEL = 2.0
#: Words per minute of the next goal, the fastest there are.
RATE = 450
#: Seconds for which a killed player cannot be reaped here, longer than anything waits for it.
HELD = 20.0

#: A library that never comes back from a sentence with a certain word in it, and a shorter limit for that.
STUCK_SYNTHESIS = """
from talkcli.engine import protocol
protocol.HANG_AFTER = {limit}
import sys, time
if "talkcli.engine.main" in "".join(sys.orig_argv):
    from pyttsx3.drivers import _espeak
    speak = _espeak.Synth
    def wait(text, *rest, **options):
        while b"forever" in text:
            time.sleep(1)
        return speak(text, *rest, **options)
    _espeak.Synth = wait
"""

#: What happens to a goal whose player cannot be reaped once it is killed, and the limit for its end in seconds.
STUCK: dict[str, tuple[Callable[[Talk], object], float]] = {
    "its engine killed": (lambda talk: os.kill(engine_process(talk), signal.SIGKILL), SILENCE_LIMIT + SLACK),
    "stopped": (lambda talk: talk.request("cancel"), CANCEL),
    "its player killed": (
        lambda talk: os.kill(player_process(talk), signal.SIGKILL),
        STALLED_AFTER + GONE_WITHIN + SILENCE_LIMIT + SLACK,
    ),
}


@pytest.mark.parametrize("limit", [1.5, pytest.param(HANG_AFTER, marks=pytest.mark.slow)])
def test_synthesis_without_progress(make_talk: MakeTalk, sink: Sink, tmp_path: Path, limit: float) -> None:
    write(tmp_path / "sitecustomize.py", STUCK_SYNTHESIS.format(limit=limit))

    with limits():
        talk = make_talk(sink=sink, env=python_path(tmp_path))
        with nothing_left(talk), sink.record() as recording:
            asked = time.monotonic()
            goal = send(talk, "this takes forever")
            following = send(talk, LOW, rate=RATE)
            assert await_end(talk, goal, limit + SLACK + 2) == "ABORTED"
            assert_aborted(talk.goal(goal), "engine_hung", f"the engine gave no sign of life for {limit:g} s")
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        seconds = began(recording, render([LOW], rate=RATE)[0]) - asked
        told("the next goal after a synthesis without progress", seconds)
        assert seconds > limit
        assert_within(seconds, limit + RESTART, "the next goal after a synthesis without progress")


def test_stop_that_is_not_confirmed(talk: Talk, sink: Sink) -> None:
    with limits():
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG, number=1)
            following = send(talk, LOW, rate=RATE)
            os.kill(engine_process(talk), signal.SIGSTOP)
            asked = time.monotonic()
            assert talk.request("cancel", ids=[goal])["ok"]
            answered = time.monotonic()
            ended = talk.goal(goal)
            assert (ended["state"], ended["reason"]) == ("PREEMPTED", "canceled")
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        seconds = began(recording, render([LOW], rate=RATE)[0]) - asked
        told("the next goal after a stop that was not confirmed", seconds)
        assert_within(answered - asked, CANCEL, "`cancel`")
        assert_within(seconds, STOP_LIMIT + RESTART, "the next goal after a stop that was not confirmed")


@pytest.mark.parametrize(
    "whats",
    [["its engine killed", "stopped"], pytest.param(["its player killed"], marks=pytest.mark.slow)],
    ids=" and ".join,
)
def test_process_that_cannot_be_reaped(make_talk: MakeTalk, sink: Sink, tmp_path: Path, whats: list[str]) -> None:
    if not trapped.is_possible():
        pytest.skip("this system does not let a killed process be held: ptrace is forbidden")
    play = "aplay -q -t raw -f S16_LE -r 22050 -c 1 --buffer-time=60000"
    program = f"#!/bin/sh\nexec {sys.executable} -S {trapped.__file__} {HELD} {play}\n"
    command = str(write(tmp_path / "player", program, 0o755))

    with limits(), contextlib.ExitStack() as idle:
        talks = {what: make_talk("--player", command, sink=sink) for what in whats}
        for talk in talks.values():
            idle.enter_context(nothing_left(talk))
        goals = {what: send(talk, LONG) for what, talk in talks.items()}
        players, hits = {}, {}
        for what, talk in talks.items():
            await_word(talk, goals[what])
            players[what] = player_process(talk)
        for what, talk in talks.items():
            hits[what] = time.monotonic()
            STUCK[what][0](talk)
        for what in whats:
            talk, goal, limit = talks[what], goals[what], STUCK[what][1]
            assert await_end(talk, goal, limit + 2) == "ABORTED"
            ended = talk.watcher.arrived(talk.watcher.wait_for(goal, "ABORTED")) - hits[what]
            assert_aborted(talk.goal(goal), "not_silent", "could not be")
            told(f"the end of a goal that was {what}, with a player that cannot be reaped", ended)
            assert_within(ended, limit, f"the end of a goal that was {what}")
        for what, talk in talks.items():
            player = players[what]
            assert os.path.exists(f"/proc/{player}"), "it could be reaped, so nothing was tested"
            heard_again(talk, sink)
            assert os.path.exists(f"/proc/{player}"), "the next goal waited for it"
        for player in players.values():
            for tracer in census.descendants(player):
                os.kill(tracer, signal.SIGKILL)  # which lets go of it
