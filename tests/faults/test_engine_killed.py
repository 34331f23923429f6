"""The engine process is killed, crashes or is frozen, whatever it was doing: its goal ends truly, the next is heard."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.protocol import START_LIMIT
from tests.conformance.hearing import LONG, LOW, assert_aborted, begin, engine_process, player_process, send
from tests.faults.broken import (
    SLOW_START,
    await_end,
    began,
    nothing_left,
    python_path,
    told,
    write,
)
from tests.support import census
from tests.support.compare import extent
from tests.support.reference import render
from tests.support.surroundings import MARK, command_line, needs, short_directory
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.recording import Recording
    from tests.support.sink import Sink

#: Seconds from the signal to the first sample of the next goal.
CRASH, HANG = 0.5, 6.0
SIGNALS = {
    signal.SIGKILL: ("engine_crashed", "the engine crashed: it was killed by SIGKILL", CRASH),
    signal.SIGSEGV: ("engine_crashed", "the engine crashed: it was killed by SIGSEGV", CRASH),
    signal.SIGSTOP: ("engine_hung", "the engine gave no sign of life for 3 s", HANG),
}
#: A player that takes a sentence sooner than it plays it: the synthesis is over while it is heard, the pipes hold what
#: is left. When the engine process dies, nobody but the server can end what the shell has started.
DEEP = "sh -c 'cat | cat | cat | aplay -q -t raw -f S16_LE -c 1 -r {rate} --buffer-time=60000'"

#: Words per minute of the next goal, the fastest there are.
RATE = 450
#: Shortens the time in which an engine must be ready; behind `SLOW_START`.
IMPATIENT = """
from talkcli.engine import protocol
protocol.START_LIMIT = {limit}
"""


def signals(*always: signal.Signals) -> pytest.MarkDecorator:
    """Give each of the signals, all but these in the slow run alone: an engine dies as it dies, whatever it does."""
    numbers = [each if each in always else pytest.param(each, marks=pytest.mark.slow) for each in SIGNALS]
    return pytest.mark.parametrize("number", numbers, ids=lambda number: signal.Signals(number).name)


@signals(signal.SIGKILL)
def test_engine_process_signalled_while_idle(talk: Talk, sink: Sink, number: signal.Signals) -> None:
    with limits():
        with nothing_left(talk), sink.record() as recording:
            engine, hit = engine_process(talk), time.monotonic()
            os.kill(engine, number)
            if number is signal.SIGSTOP:
                # Nobody can know of one that is frozen before it is given a goal, which is lost then.
                lost = send(talk, LONG)
            else:
                lost = None
                census.settled(talk.pid, lambda now: now.processes == 2 and engine_process(talk) != engine)
            following = send(talk, LOW, rate=RATE)
            if lost:
                _assert_lost(talk, lost, number)
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        _assert_next(recording, hit, SIGNALS[number][2], f"{number.name} while idle")


@signals(signal.SIGSEGV, signal.SIGSTOP)
def test_engine_process_signalled_in_synthesis(make_talk: MakeTalk, sink: Sink, number: signal.Signals) -> None:
    talk = make_talk("--player", "aplay", sink=sink)
    with limits():
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG)
            following = send(talk, LOW, rate=RATE)
            assert _feeding(talk, player_process(talk)), "the synthesis goes on until the sentence is nearly over"
            hit = time.monotonic()
            os.kill(engine_process(talk), number)
            _assert_lost(talk, goal, number)
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        _assert_next(recording, hit, SIGNALS[number][2], f"{number.name} in synthesis")


@signals(signal.SIGKILL)
def test_engine_process_signalled_in_playback(make_talk: MakeTalk, sink: Sink, number: signal.Signals) -> None:
    with limits():
        talk = make_talk("--player", DEEP, sink=sink)
        with nothing_left(talk), sink.record() as recording:
            goal = send(talk, LONG)
            player = player_process(talk)
            end = time.monotonic() + 2
            while _feeding(talk, player):
                assert time.monotonic() < end, "the player does not take the whole sentence"
                time.sleep(0.005)  # that a descriptor is closed is no event for others
            recording.wait_for_sound()
            following = send(talk, LOW, rate=RATE)
            hit = time.monotonic()
            os.kill(engine_process(talk), number)
            _assert_lost(talk, goal, number)
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        _assert_next(recording, hit, SIGNALS[number][2], f"{number.name} in playback")


@signals(signal.SIGSEGV)
def test_engine_process_signalled_while_paused(talk: Talk, sink: Sink, number: signal.Signals) -> None:
    with limits():
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG)
            assert talk.request("pause")["goal"]["id"] == goal
            following = send(talk, LOW, rate=RATE)
            hit = time.monotonic()
            os.kill(engine_process(talk), number)
            _assert_lost(talk, goal, number)
            assert talk.request("status")["server"]["paused"]
            assert talk.goal(following)["state"] == "PENDING"
            resumed = time.monotonic()
            talk.request("resume")
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        # While speech is held nothing may be heard: after a crash the limit begins with the end of that.
        begins, limit = (hit, HANG) if number is signal.SIGSTOP else (resumed, CRASH)
        _assert_next(recording, begins, limit, f"{number.name} while paused")


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, pytest.param(signal.SIGSEGV, marks=pytest.mark.slow)],
    ids=lambda number: signal.Signals(number).name,
)
def test_engine_process_signalled_in_its_start(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path, number: signal.Signals
) -> None:
    with limits():
        talk = make_talk(sink=sink, env=_slow_start(tmp_path))
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG)
            following, hit = _signal_the_next(talk, goal, tmp_path, number)
            # It was not given to the one that never got ready, so nothing of it was lost.
            assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
        talk.stop()
        _assert_next(recording, hit, CRASH, f"{number.name} in its start")


@pytest.mark.parametrize("limit", [2.0, pytest.param(START_LIMIT, marks=pytest.mark.slow)])
def test_engine_process_frozen_in_its_start(make_talk: MakeTalk, sink: Sink, tmp_path: Path, limit: float) -> None:
    with limits():
        talk = make_talk(sink=sink, env=_slow_start(tmp_path, IMPATIENT.format(limit=limit)))
        with nothing_left(talk), sink.record() as recording:
            goal = begin(talk, LONG)
            before = time.monotonic()  # it starts between then and when it is hit, and the limit counts from its start
            following, hit = _signal_the_next(talk, goal, tmp_path, signal.SIGSTOP)
            recording.wait_until_quiet(0.1)  # the rest of what was lost is heard
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


@pytest.mark.parametrize("ends", ["engine", "cancel"])
def test_what_a_player_started_in_a_session_of_its_own_ends_with_it(make_talk: MakeTalk, sink: Sink, ends: str) -> None:
    needs("setsid")
    talk = make_talk("--player", APART, sink=sink)
    with nothing_left(talk):
        goal = begin(talk, LONG)
        playing = [pid for pid in census.descendants(talk.pid) if command_line(pid).startswith("aplay")]
        assert playing
        following = send(talk, LOW, rate=RATE)
        if ends == "engine":
            os.kill(engine_process(talk), signal.SIGKILL)
        else:
            talk.request("cancel", ids=[goal])
        assert await_end(talk, goal, HANG) == ("ABORTED" if ends == "engine" else "PREEMPTED")
        assert not any("aplay" in command_line(pid) for pid in playing)
        assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
    if ends == "engine":
        assert_aborted(talk.goal(goal), *SIGNALS[signal.SIGKILL][:2])


def test_a_sound_server_that_a_player_has_started_is_left_alone(make_talk: MakeTalk, tmp_path: Path) -> None:
    needs("pulseaudio", "pacat")
    with short_directory() as folder:
        player = write(tmp_path / "player", STARTS_A_SERVER.format(folder=folder, mark=MARK))
        talk = make_talk("--player", f"sh {player} {{rate}}")
        goal = begin(talk, LONG, number=1)
        with open(f"{folder}/pid", encoding="ascii") as file:
            server = int(file.read())
        try:
            os.kill(engine_process(talk), signal.SIGKILL)
            _assert_lost(talk, goal, signal.SIGKILL)
            talk.stop()
            assert "pulseaudio" in command_line(server)
        finally:
            os.kill(server, signal.SIGTERM)
            while command_line(server) != "ended":
                time.sleep(0.005)  # it is nobody's child


def _slow_start(folder: Path, more: str = "") -> dict[str, str]:
    write(folder / "sitecustomize.py", SLOW_START.format(flag=str(folder / "starting")) + more)
    return python_path(folder)


def _signal_the_next(talk: Talk, goal: str, folder: Path, number: signal.Signals) -> tuple[str, float]:
    """Kill the engine and signal the next one while it starts; return the goal that waits for it, and when it was."""
    flag = folder / "starting"
    flag.touch()
    os.kill(engine_process(talk), signal.SIGKILL)
    assert talk.watcher.wait_for_terminal(goal) == "ABORTED"
    following = send(talk, LOW, rate=RATE)
    census.settled(talk.pid, lambda now: now.processes == 2)
    (starting,) = census.descendants(talk.pid)
    while "talkcli.engine" not in command_line(starting):
        assert command_line(starting) != "ended"
        time.sleep(0.001)  # it is forked, and not the engine yet: nobody is told when it is
    hit = time.monotonic()
    os.kill(starting, number)
    flag.unlink()
    return following, hit


def _feeding(talk: Talk, player: int) -> bool:
    """Whether the engine still has samples for the player: it holds the other end of its standard input."""
    pipe = os.readlink(f"/proc/{player}/fd/0")
    engine = engine_process(talk)
    return pipe in census.descriptors(engine).values()


def _assert_lost(talk: Talk, goal: str, number: signal.Signals) -> None:
    reason, words, _ = SIGNALS[number]
    assert await_end(talk, goal, HANG) == "ABORTED"
    assert_aborted(talk.goal(goal), reason, words)


def _assert_next(recording: Recording, hit: float, limit: float, what: str) -> None:
    seconds = began(recording, render([LOW], rate=RATE)[0]) - hit
    told(f"the next goal after {what}", seconds)
    assert_within(seconds, limit, f"the next goal after {what}")
