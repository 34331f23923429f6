"""Lost sound and broken players: goals are aborted in time, and later goals are heard.

Row 41 of the conformance tests: the sink is suspended or unloaded, or the sound server is frozen or killed. The fault
interrupts the first goal. The second goal is sent during the fault, and the third after it. Because most of the time
is spent waiting, faults happen in parallel, each with its own sound server.

A broken player is a shell script that misbehaves while a file exists, and otherwise plays with `aplay`.
"""

from __future__ import annotations

import contextlib
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import pytest

from talkcli.engine.child.playback import DRAIN_LIMIT_S, FIRST_SOUND_LIMIT_S, PROGRESS_CHECK_INTERVAL_S, STALL_LIMIT_S
from talkcli.engine.child.players.pulse import READY_LIMIT_S, SUSPENDED_LIMIT_S
from tests.conformance.hearing import (
    LONG,
    LOW,
    assert_aborted,
    assert_same,
    heard,
    render_quick,
    send,
    start_goal_with_client,
)
from tests.faults.broken import assert_heard_again, await_end, no_leaks, write
from tests.support.compare import assert_only_beginning
from tests.support.reference import render
from tests.support.sink import Sink
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: Limit in seconds from the return of the sink to the first sample of the next goal.
RETURNED = 10.0
#: Limits in seconds for a goal's end after the fault or the goal's start: if the sound server reports the loss, and
#: if the player accepts no sound. They include the interval of checks, and the messages.
REPORTED = 1.0
STALLED = STALL_LIMIT_S + PROGRESS_CHECK_INTERVAL_S + 0.2
NEVER_TAKEN = FIRST_SOUND_LIMIT_S + PROGRESS_CHECK_INTERVAL_S + 0.2
SUSPENDED = SUSPENDED_LIMIT_S + 0.5
NO_ANSWER = READY_LIMIT_S + 0.2


class End(NamedTuple):
    """The expected end of a goal: its reason, the limit in seconds, and a part of its message."""

    reason: str
    within: float
    message: str = ""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the sink, and the ends of the interrupted goal and of one sent during the fault."""

    breaks: Callable[[Sink], None]
    mends: Callable[[Sink], None]
    programs: tuple[End, End]
    #: the ends with the player "pulse", to which the sound server reports more
    pulse: tuple[End, End]

    def ends(self, player: str) -> tuple[End, End]:
        return self.pulse if player == "pulse" else self.programs


GONE = "the sound server ended the stream"
FAULTS = {
    "sink suspended": Fault(
        Sink.suspend,
        Sink.resume,
        (End("audio_stalled", STALLED, "accepted no sound for 3 s"), End("audio_stalled", NEVER_TAKEN)),
        (End("audio_stalled", SUSPENDED, "has suspended null"), End("audio_stalled", SUSPENDED)),
    ),
    "sink unloaded": Fault(
        Sink.unload,
        lambda sink: sink.reload(warm=False),
        (End("audio_lost", REPORTED, "error: "), End("audio_device", REPORTED)),
        (End("audio_lost", REPORTED, GONE), End("audio_device", REPORTED)),
    ),
    "sound server SIGSTOP": Fault(
        Sink.freeze,
        Sink.thaw,
        (End("audio_stalled", STALLED, "accepted no sound for 3 s"), End("audio_stalled", NEVER_TAKEN)),
        (End("audio_stalled", STALLED, "pulse accepted no sound for 3 s"), End("audio_device", NO_ANSWER)),
    ),
    "sound server SIGKILL": Fault(
        Sink.kill_server,
        lambda sink: sink.start_server(warm=False),
        (End("audio_lost", REPORTED), End("audio_device", REPORTED, "Connection refused")),
        (End("audio_lost", REPORTED, GONE), End("no_player", REPORTED)),
    ),
}


#: The faults with their players: the engine's own connection, or a program. A program either accepts no more sound or
#: exits.
PULSE = [*((name, "pulse") for name in FAULTS), ("sound server SIGKILL", "aplay")]
PROGRAMS = [(name, player) for name in FAULTS for player in ("aplay", "pacat")]


@pytest.mark.parametrize(
    "cases",
    [pytest.param(PULSE, id="pulse"), pytest.param(PROGRAMS[:-2], id="programs", marks=pytest.mark.slow)],
)
def test_row_41_goals_are_aborted_until_lost_sound_returns(make_talk: MakeTalk, cases: list[tuple[str, str]]) -> None:
    with limits(), contextlib.ExitStack() as stack:
        faults, players = [FAULTS[name] for name, _ in cases], [player for _, player in cases]
        pool = stack.enter_context(ThreadPoolExecutor(len(cases)))
        sinks = list(pool.map(lambda _: stack.enter_context(Sink()), cases))
        talks = [make_talk("--player", player, sink=sink) for player, sink in zip(players, sinks, strict=True)]
        with contextlib.ExitStack() as idle:  # together, because the servers share memory
            for talk in talks:
                idle.enter_context(no_leaks(talk))
            times = list(pool.map(_lose, faults, players, talks, sinks))
        for (name, player), talk, (lost, meanwhile, again) in zip(cases, talks, times, strict=True):
            talk.stop()
            ends, case = FAULTS[name].ends(player), f"{name}, {player}"
            assert_within(lost, ends[0].within, f"the end of a goal, {case}")
            assert_within(meanwhile, ends[1].within, f"the end of a goal during the fault, {case}")
            assert_within(again, RETURNED, f"the next goal, {case}")


def _lose(fault: Fault, player: str, talk: Talk, sink: Sink) -> tuple[float, float, float]:
    """Cause a fault and end it; return the seconds until two goals ended and one was heard again."""
    first, second = fault.ends(player)
    goal, client = start_goal_with_client(talk, LONG)
    broken = time.monotonic()
    fault.breaks(sink)
    lost = _assert_ended(talk, goal, first, broken)
    done = talk.finish(client)
    assert (done.code, talk.goal(goal)["message"] in done.err) == (4, True), done
    assert "two three" in talk.goal(goal)["spoken"] != LONG
    if first.reason == "audio_lost":
        assert_only_beginning(talk.recording, render([LONG])[0], shortest=0.2)
    meanwhile = _assert_ended(talk, send(talk, LOW), second, time.monotonic())
    fault.mends(sink)
    returned = time.monotonic()
    return lost, meanwhile, assert_heard_again(talk, sink) - returned


def _assert_ended(talk: Talk, goal_id: str, end: End, since: float) -> float:
    """Assert that a goal is ABORTED as expected, and return the seconds until its end."""
    assert await_end(talk, goal_id, NEVER_TAKEN + 2) == "ABORTED"
    goal = talk.goal(goal_id)
    assert_aborted(goal, end.reason, end.message)
    assert goal["message"] != "speech failed: "
    return talk.watcher.arrived(talk.watcher.wait_for(goal_id, "ABORTED")) - since


def test_a_hanging_sound_server_does_not_delay_the_engines_start(make_talk: MakeTalk, tmp_path: Path) -> None:
    """libespeak-ng connects to PulseAudio when it is initialised, and would wait 30 s for a frozen one."""
    with socket.socket(socket.AF_UNIX) as frozen:
        frozen.bind(str(tmp_path / "s"))
        frozen.listen()
        talk = make_talk("--player", "null", env={"PULSE_SERVER": f"unix:{tmp_path / 's'}"})
        done = talk.run("say", "--wait", "--timeout", "8", LOW)
        assert (done.code, done.err) == (0, "")


def test_another_player_is_used_if_the_sound_server_takes_no_stream(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path
) -> None:
    """In this test, ALSA reaches the device without the sound server."""
    with limits(), socket.socket(socket.AF_UNIX) as frozen:
        frozen.bind(str(tmp_path / "s"))
        frozen.listen()
        env = {"PULSE_SERVER": f"unix:{tmp_path / 's'}", "ALSA_CONFIG_PATH": f"{sink.directory}/.asoundrc"}
        talk = make_talk(sink=sink, env=env)
        assert talk.run("voices").code == 0  # the engine is ready
        started_at = time.monotonic()
        done = talk.run("say", "--wait", "--rate", "450", "--", LOW)
        took = time.monotonic() - started_at
        goal = talk.goal(done.id)
        assert (done.code, goal["output"]) == (0, None)
        assert_same(heard(talk), render_quick([LOW])[0])
        assert_within(took - goal["duration"], READY_LIMIT_S + REPORTED, "a sentence by the next player")


#: Seconds between a limit of the engine and the event of a goal's end.
SLACK = 0.5
#: Duration of LOW in seconds.
LENGTH = 1.2

PLAY = "aplay -q -t raw -f S16_LE -c 1 -r 22050 --buffer-time=60000"


#: Broken players, and the expected ends of their goals.
BROKEN = {
    "exits 1 at once": (
        "echo 'player: main:831: audio open error: No such device' >&2; exit 1",
        End("audio_device", SLACK, "player: audio open error: No such device"),
    ),
    "is killed in mid-sentence": (
        f"(sleep 0.6; kill -KILL $$) & exec {PLAY}",
        End("audio_lost", LENGTH + SLACK, "player was killed by SIGKILL"),
    ),
    "exits 0 too early": ("cat > /dev/null", End("audio_lost", SLACK, " s before the end of the sound")),
    "reads a byte at a time": (
        "while dd bs=1 count=1 of=/dev/null; do sleep 0.3; done 2> /dev/null",
        End("audio_stalled", STALL_LIMIT_S + SLACK, "player accepted no sound for 3 s"),
    ),
    "hangs in drain": (
        f"{PLAY}; exec sleep 100",
        End("audio_stalled", LENGTH + DRAIN_LIMIT_S + SLACK, "player did not exit within 3 s after the sound"),
    ),
}


def test_a_broken_player_aborts_its_goal(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
    """The players are tested in parallel, because some of them last until a limit of the engine."""
    programs = {case: _script(tmp_path / case.replace(" ", "-"), BROKEN[case][0]) for case in BROKEN}

    with limits(), contextlib.ExitStack() as idle:
        talks = {case: make_talk("--player", str(program), sink=sink) for case, program in programs.items()}
        for talk in talks.values():
            idle.enter_context(no_leaks(talk))
        goals = {case: (time.monotonic(), send(talk, LOW)) for case, talk in talks.items()}
        for case, talk in talks.items():
            (_, end), (sent_at, goal) = BROKEN[case], goals[case]
            assert_within(_assert_ended(talk, goal, end, sent_at), end.within, f"the end of a goal whose player {case}")
        for path in programs.values():
            (path.parent / "broken").unlink()
        first, *others = talks.values()
        clients = [talk.start("say", "--wait", "--rate", "450", "yes") for talk in others]
        assert [talk.finish(client).code for talk, client in zip(others, clients, strict=True)] == [0] * len(others)
        assert_heard_again(first, sink)


def _script(folder: Path, commands: str) -> Path:
    """Write a player that runs these commands until the file "broken" is removed, and plays from then on."""
    folder.mkdir()
    (folder / "broken").touch()
    text = f"#!/bin/sh\nif [ -e {folder}/broken ]; then\n:\n{commands}\nexit\nfi\nexec {PLAY}\n"
    return write(folder / "player", text, 0o755)
