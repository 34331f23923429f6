"""The engine process is killed, crashes or is frozen, whatever it does: its goal ends truly, the next is heard."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.protocol import START_LIMIT
from tests.conformance.hearing import LONG, LOW, PRECISION, assert_aborted, begin, engine_process, player_process, send
from tests.faults.broken import SLOW_START, await_end, began, nothing_left, python_path, told, write
from tests.support import census
from tests.support.compare import assert_begun, extent
from tests.support.reference import render
from tests.support.surroundings import MARK, command_line, needs, short_directory
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.recording import Recording
    from tests.support.sink import Sink

KILL, SEGV, STOP = signal.SIGKILL, signal.SIGSEGV, signal.SIGSTOP
#: Seconds from the signal to the first sample of the next goal.
CRASH, HANG = 0.5, 6.0
SIGNALS = {
    KILL: ("engine_crashed", "the engine crashed: it was killed by SIGKILL", CRASH),
    SEGV: ("engine_crashed", "the engine crashed: it was killed by SIGSEGV", CRASH),
    STOP: ("engine_hung", "the engine gave no sign of life for 3 s", HANG),
}
#: A player that takes a sentence sooner than it plays it: the synthesis ends while the pipes hold the rest of the
#: sound. If the engine process dies, only the server can end the processes that the shell has started.
DEEP = "sh -c 'cat | cat | cat | aplay -q -t raw -f S16_LE -c 1 -r {rate} --buffer-time=60000'"
#: The player for each activity of the engine process.
PLAYERS = {"idle": "pulse", "in synthesis": "aplay", "in playback": DEEP, "paused": "pulse"}
#: The signals for each of them in the default run; the others are slow, as the engine dies in the same way.
ALWAYS = [("idle", KILL), ("in synthesis", SEGV), ("in synthesis", STOP), ("in playback", KILL), ("paused", SEGV)]
ALL = [(activity, number) for activity in PLAYERS for number in SIGNALS]

#: Words per minute of the next goal, the fastest there are.
RATE = 450
#: Shortens the time in which an engine must be ready; behind `SLOW_START`.
IMPATIENT = """
from talkcli.engine import protocol
protocol.START_LIMIT = {limit}
"""


@pytest.mark.parametrize(
    ("activity", "number"),
    [*ALWAYS, *(pytest.param(*each, marks=pytest.mark.slow) for each in ALL if each not in ALWAYS)],
    ids=lambda each: each if isinstance(each, str) else signal.Signals(each).name,
)
def test_engine_process_is_signalled(make_talk: MakeTalk, sink: Sink, activity: str, number: signal.Signals) -> None:
    with limits():
        talk = make_talk("--player", PLAYERS[activity], sink=sink)
        with nothing_left(talk), sink.record() as recording:
            goal = _bring_to(talk, activity, recording)
            following = send(talk, LOW, rate=RATE) if goal else None
            engine, since = engine_process(talk), time.monotonic()
            os.kill(engine, number)
            if activity == "idle" and number is STOP:
                goal = send(talk, LONG)  # nothing shows that it is frozen before it is given a goal, which is lost
            elif activity == "idle":
                census.settled(talk.pid, lambda now: now.processes == 2 and engine_process(talk) != engine)
            following = following or send(talk, LOW, rate=RATE)
            if goal:
                spoken = _assert_lost(talk, goal, number)["spoken"]
                assert activity in {"idle", "in playback"} or "two three" in spoken != LONG
            if activity == "paused":
                assert talk.request("status")["server"]["paused"]
                assert talk.goal(following)["state"] == "PENDING"
                # While speech is held nothing may be heard: after a crash the limit counts from the resume.
                since = since if number is STOP else time.monotonic()
                talk.request("resume")
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        next_one = _assert_next(recording, since, SIGNALS[number][2], f"{number.name}, {activity}")
        if activity == "in synthesis":
            assert_begun(recording.between(0, next_one - PRECISION), render([LONG])[0])


def _bring_to(talk: Talk, activity: str, recording: Recording) -> str | None:
    """Bring the engine process to an activity; return the goal of that, None if idle."""
    if activity == "idle":
        return None
    if activity == "in playback":
        goal = send(talk, LONG)
        player = player_process(talk)
        end = time.monotonic() + 2
        while _feeding(talk, player):
            assert time.monotonic() < end, "the player does not take the whole sentence"
            time.sleep(0.005)  # the closing of a descriptor sends no event
        recording.wait_for_sound()
        return goal
    goal = begin(talk, LONG)
    if activity == "paused":
        assert talk.request("pause")["goal"]["id"] == goal
    else:
        assert _feeding(talk, player_process(talk)), "the synthesis goes on until the sentence is nearly over"
    return goal


@pytest.mark.parametrize("number", [KILL, pytest.param(SEGV, marks=pytest.mark.slow)])
def test_engine_process_signalled_in_its_start(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path, number: signal.Signals
) -> None:
    with limits():
        talk = make_talk(sink=sink, env=_slow_start(tmp_path))
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG, number=1)
            following, hit = _signal_the_next(talk, goal, tmp_path, number)
            # It was not given to the process that never got ready, so nothing of it was lost.
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        _assert_next(recording, hit, CRASH, f"{number.name} in its start")


@pytest.mark.parametrize("limit", [2.0, pytest.param(START_LIMIT, marks=pytest.mark.slow)])
def test_engine_process_frozen_in_its_start(make_talk: MakeTalk, sink: Sink, tmp_path: Path, limit: float) -> None:
    with limits():
        talk = make_talk(sink=sink, env=_slow_start(tmp_path, IMPATIENT.format(limit=limit)))
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG, number=1)
            before = time.monotonic()  # it starts after this and before it is hit, and the limit counts from its start
            following, hit = _signal_the_next(talk, goal, tmp_path, STOP)
            recording.wait_until_quiet(0.1)  # the rest of the lost sentence is heard
            lost = len(recording)
            assert await_end(talk, following, limit + HANG) == "SUCCEEDED"
            first = extent(recording.samples[lost:])
        talk.stop()
        assert first
        spoken = recording.time_of(lost + first[0])
        told("the next goal after SIGSTOP in its start", spoken - hit)
        assert spoken - before > limit
        assert_within(spoken - hit, limit + 2 * CRASH, "the next goal after SIGSTOP in its start")


#: A player whose sound is made by a process in a session of its own.
APART = "setsid -w aplay -q -t raw -f S16_LE -c 1 -r {rate} --buffer-time=60000"
#: A player that starts the sound server which it plays to.
STARTS_A_SERVER = """
unset {mark}
export PULSE_RUNTIME_PATH={folder} PULSE_STATE_PATH={folder} PULSE_COOKIE={folder}/cookie HOME={folder}
pulseaudio --check || pulseaudio -n --daemonize=yes --exit-idle-time=-1 -L module-null-sink \\
    -L 'module-native-protocol-unix auth-anonymous=1 socket={folder}/pulse' 2>{folder}/said
exec pacat --server=unix:{folder}/pulse --raw --format=s16le --channels=1 --rate=$1
"""


@pytest.mark.parametrize("ends", ["ABORTED", "PREEMPTED"])
def test_what_a_player_started_in_a_session_of_its_own_ends_with_it(make_talk: MakeTalk, sink: Sink, ends: str) -> None:
    needs("setsid")
    talk = make_talk("--player", APART, sink=sink)
    with nothing_left(talk):
        goal = begin(talk, LONG, number=1)
        playing = [pid for pid in census.descendants(talk.pid) if command_line(pid).startswith("aplay")]
        assert playing
        following = send(talk, LOW, rate=RATE)
        if ends == "ABORTED":
            os.kill(engine_process(talk), KILL)
        else:
            talk.request("cancel", ids=[goal])
        assert await_end(talk, goal, HANG) == ends
        assert not any("aplay" in command_line(pid) for pid in playing)
        assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"


def test_a_sound_server_that_a_player_has_started_is_left_alone(make_talk: MakeTalk, tmp_path: Path) -> None:
    needs("pulseaudio", "pacat")
    with short_directory() as folder:
        player = write(tmp_path / "player", STARTS_A_SERVER.format(folder=folder, mark=MARK))
        talk = make_talk("--player", f"sh {player} {{rate}}")
        goal = begin(talk, LONG, number=1)
        with open(f"{folder}/pid", encoding="ascii") as file:
            server = int(file.read())
        try:
            os.kill(engine_process(talk), KILL)
            _assert_lost(talk, goal, KILL)
            talk.stop()
            assert "pulseaudio" in command_line(server)
        finally:
            os.kill(server, signal.SIGTERM)
            while command_line(server) != "ended":
                time.sleep(0.005)  # it is no child of ours


#: A library that complains of each text, with an escape that would colour a terminal.
COMPLAINS = """
import sys
if "talkcli.engine.main" in "".join(sys.orig_argv):
    from pyttsx3.drivers import _espeak
    speak = _espeak.Synth
    def complain(text, *rest, **options):
        sys.stderr.write("cannot say \\x1b[31m" + text.decode() + "\\n")
        sys.stderr.flush()
        return speak(text, *rest, **options)
    _espeak.Synth = complain
"""


def test_complaints_of_the_engine_are_logged_fit_for_a_terminal(make_talk: MakeTalk, tmp_path: Path) -> None:
    write(tmp_path / "sitecustomize.py", COMPLAINS)
    talk = make_talk("--player", "null", env=python_path(tmp_path))
    assert talk.run("say", "--wait", "--", "yes").code == 0
    assert r"talk: engine: cannot say \x1b[31myes" in talk.log


def _slow_start(folder: Path, more: str = "") -> dict[str, str]:
    write(folder / "sitecustomize.py", SLOW_START.format(flag=str(folder / "starting")) + more)
    return python_path(folder)


def _signal_the_next(talk: Talk, goal: str, folder: Path, number: signal.Signals) -> tuple[str, float]:
    """Kill the engine and signal the next one while it starts; return the goal that waits for it, and the time."""
    flag = folder / "starting"
    flag.touch()
    os.kill(engine_process(talk), KILL)
    assert talk.watcher.wait_for_terminal(goal) == "ABORTED"
    following = send(talk, LOW, rate=RATE)
    census.settled(talk.pid, lambda now: now.processes == 2)
    (starting,) = census.descendants(talk.pid)
    while "talkcli.engine" not in command_line(starting):
        assert command_line(starting) != "ended"
        time.sleep(0.001)  # after the fork, the start of the program sends no event
    hit = time.monotonic()
    os.kill(starting, number)
    flag.unlink()
    return following, hit


def _feeding(talk: Talk, player: int) -> bool:
    """Return whether the engine still has samples for the player: it holds the other end of its standard input."""
    pipe = os.readlink(f"/proc/{player}/fd/0")
    return pipe in census.descriptors(engine_process(talk)).values()


def _assert_lost(talk: Talk, goal_id: str, number: signal.Signals) -> Message:
    """Assert that a goal was ABORTED as its engine got this signal, and return the goal."""
    reason, words, _ = SIGNALS[number]
    assert await_end(talk, goal_id, HANG) == "ABORTED"
    goal = talk.goal(goal_id)
    assert_aborted(goal, reason, words)
    return goal


def _assert_next(recording: Recording, hit: float, limit: float, what: str) -> float:
    """Assert that LOW was heard in time after the signal, and return when."""
    moment = began(recording, render([LOW], rate=RATE)[0])
    told(f"the next goal after {what}", moment - hit)
    assert_within(moment - hit, limit, f"the next goal after {what}")
    return moment
