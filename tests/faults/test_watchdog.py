"""What the engine thread's watchdog must see, each as it happens to the real engine at a real sink.

The rest is elsewhere: a player that takes nothing, a drain that does not end and an end that comes too early in
`test_player_broken`, a process that hangs in its start in `test_engine_killed`, one that ignores a stop in row 6.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.limits import HANG_AFTER, SILENCE_LIMIT, STOP_LIMIT
from talkcli.engine.playback import GONE_WITHIN, STALLED_AFTER
from tests.conformance.hearing import LONG, LOW, assert_aborted, begin, engine_process, player_process, send
from tests.faults import trapped
from tests.faults.broken import (
    await_end,
    began,
    heard_again,
    nothing_left,
    python_path,
    sound,
    told,
    write,
)
from tests.support import census
from tests.support.reference import render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

__all__ = ["sound"]

#: Seconds in which the thread acts and the watcher is told.
SLACK = 0.5
#: Seconds from a kill to the first sample of the next goal, the messages before included.
RESTART = 0.7
#: Seconds in which `cancel` is answered, whatever happens.
CANCEL = 2.0
#: Seconds for which a killed player cannot be reaped here, longer than anything waits for it.
HELD = 20.0

#: A library that never comes back from a sentence with a certain word in it, and never calls back either.
SPINNING = """
import sys
if "talkcli.engine.process" in "".join(sys.orig_argv):
    from pyttsx3.drivers import _espeak
    speak = _espeak.Synth
    def spin(text, *rest, **options):
        while b"forever" in text:
            pass
        return speak(text, *rest, **options)
    _espeak.Synth = spin
"""

#: What happens to a goal whose player cannot be reaped once it is killed; how it ends, after how many seconds.
STUCK: dict[str, tuple[Callable[[Talk], object], float]] = {
    "stopped": (lambda talk: talk.request("cancel"), CANCEL),
    "its player killed": (
        lambda talk: os.kill(player_process(talk), signal.SIGKILL),
        STALLED_AFTER + GONE_WITHIN + SILENCE_LIMIT + SLACK,
    ),
    "its engine killed": (lambda talk: os.kill(engine_process(talk), signal.SIGKILL), SILENCE_LIMIT + SLACK),
}


def test_synthesis_without_progress(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
    write(tmp_path / "sitecustomize.py", SPINNING)

    with limits():
        talk = make_talk(sink=sink, env=python_path(tmp_path))
        with nothing_left(talk), sink.record() as recording:
            asked = time.monotonic()
            goal = send(talk, "this takes forever")
            following = send(talk, LOW)
            assert await_end(talk, goal, HANG_AFTER + SLACK + 2) == "ABORTED"
            assert_aborted(talk.goal(goal), "engine_hung", "the engine gave no sign of life for 3 s")
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        seconds = began(recording, render([LOW])[0]) - asked
        told("the next goal after a synthesis without progress", seconds)
        assert_within(seconds, HANG_AFTER + RESTART, "the next goal after a synthesis without progress")


def test_stop_that_is_not_confirmed(talk: Talk, sink: Sink) -> None:
    with limits():
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG)
            following = send(talk, LOW)
            os.kill(engine_process(talk), signal.SIGSTOP)
            asked = time.monotonic()
            assert talk.request("cancel", ids=[goal])["ok"]
            answered = time.monotonic()
            assert talk.goal(goal)["state"] == "PREEMPTED"
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        seconds = began(recording, render([LOW])[0]) - asked
        told("the next goal after a stop that was not confirmed", seconds)
        assert_within(answered - asked, CANCEL, "`cancel`")
        assert_within(seconds, STOP_LIMIT + RESTART, "the next goal after a stop that was not confirmed")


@pytest.mark.parametrize("what", STUCK)
def test_process_that_cannot_be_reaped(make_talk: MakeTalk, sound: Sink, tmp_path: Path, what: str) -> None:
    if not trapped.is_possible():
        pytest.skip("this system does not let a killed process be held: ptrace is forbidden")
    happens, limit = STUCK[what]
    play = "aplay -q -t raw -f S16_LE -r 22050 -c 1 --buffer-time=60000"
    program = f"#!/bin/sh\nexec {sys.executable} -S {trapped.__file__} {HELD} {play}\n"
    command = str(write(tmp_path / "player", program, 0o755))

    with limits():
        talk = make_talk("--player", command, sink=sound)
        with nothing_left(talk):
            goal = begin(talk, LONG)
            player = player_process(talk)
            hit = time.monotonic()
            happens(talk)
            assert await_end(talk, goal, limit + 2) == "ABORTED"
            ended = talk.watcher.arrived(talk.watcher.wait_for(goal, "ABORTED")) - hit
            assert_aborted(talk.goal(goal), "not_silent", "could not be")
            assert os.path.exists(f"/proc/{player}"), "it could be reaped, so nothing was tested"
            heard_again(talk, sound)
            assert os.path.exists(f"/proc/{player}"), "the next goal waited for it"
            for tracer in census.descendants(player):
                os.kill(tracer, signal.SIGKILL)  # which lets go of it
        talk.stop()
        told(f"the end of a goal that was {what}, with a player that cannot be reaped", ended)
        assert_within(ended, limit, f"the end of a goal that was {what}")
