"""The sound is lost: goals end in time, none SUCCEEDED unheard, and the next ones are heard when it is back.

The sink is suspended or unloaded, the sound server frozen or killed: these are also row 41 of the conformance. A goal
is in mid-sentence at the fault, the next one comes while there is no sound, and the third is sent when there is sound
again. Most of it is waiting, so all faults happen side by side, each at a sound server of its own.

Or a player is broken: a shell script that misbehaves while a file exists, and plays with `aplay` after that.
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
    HOME,
    LONG,
    LOW,
    assert_aborted,
    assert_same,
    begin_with_client,
    heard,
    render_quick,
    send,
)
from tests.faults.broken import await_end, heard_again, nothing_left, write
from tests.support.compare import assert_heard, assert_only_beginning
from tests.support.reference import render
from tests.support.sink import Sink
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: Seconds from the return of the sink to the first sample of the next goal.
AGAIN = 10.0
#: Seconds from the fault, or the beginning of a goal, to its end: if the player is told that the sound is lost,
#: and the waits for a player that takes none, with the looks and messages in between.
TOLD = 1.0
STALLED = STALL_LIMIT_S + PROGRESS_CHECK_INTERVAL_S + 0.2
NEVER_TAKEN = FIRST_SOUND_LIMIT_S + PROGRESS_CHECK_INTERVAL_S + 0.2
SUSPENDED = SUSPENDED_LIMIT_S + 0.5
NO_ANSWER = READY_LIMIT_S + 0.2


class End(NamedTuple):
    """How a goal ends: its reason, its limit in seconds, and words of its message."""

    reason: str
    within: float
    words: str = ""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the sink, and the ends of a goal in mid-sentence and of one that comes meanwhile."""

    breaks: Callable[[Sink], None]
    mends: Callable[[Sink], None]
    programs: tuple[End, End]
    #: the same by the player "pulse", which the server tells more
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
        (End("audio_lost", TOLD, "error: "), End("audio_device", TOLD)),
        (End("audio_lost", TOLD, GONE), End("audio_device", TOLD)),
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
        (End("audio_lost", TOLD), End("audio_device", TOLD, "Connection refused")),
        (End("audio_lost", TOLD, GONE), End("no_player", TOLD)),
    ),
}
#: The player of each fault: programs, or the engine's own connection.
PLAYERS = [
    pytest.param(("pacat", "aplay", "aplay", "pacat"), id="programs"),
    pytest.param(("aplay", "pacat", "pacat", "aplay"), id="the other programs", marks=pytest.mark.slow),
    pytest.param(("pulse",) * len(FAULTS), id="pulse"),
]


@pytest.mark.parametrize("players", PLAYERS)
def test_row_41_goals_are_aborted_until_lost_sound_returns(make_talk: MakeTalk, players: tuple[str, ...]) -> None:
    with limits(), contextlib.ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(len(FAULTS)))
        sinks = list(pool.map(lambda _: stack.enter_context(Sink()), FAULTS))
        talks = [make_talk("--player", player, sink=sink) for player, sink in zip(players, sinks, strict=True)]
        with contextlib.ExitStack() as idle:  # counted together: they share memory
            for talk in talks:
                idle.enter_context(nothing_left(talk))
            times = list(pool.map(_lose, FAULTS.values(), players, talks, sinks))
        for name, player, talk, (lost, meanwhile, again) in zip(FAULTS, players, talks, times, strict=True):
            talk.stop()
            ends, case = FAULTS[name].ends(player), f"{name}, {player}"
            assert_within(lost, ends[0].within, f"the end of a goal, {case}")
            assert_within(meanwhile, ends[1].within, f"the end of a goal meanwhile, {case}")
            assert_within(again, AGAIN, f"the next goal, {case}")


def _lose(fault: Fault, player: str, talk: Talk, sink: Sink) -> tuple[float, float, float]:
    """Have a fault and mend it; return the seconds in which two goals ended, and one was heard again."""
    first, second = fault.ends(player)
    goal, client = begin_with_client(talk, LONG)
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
    return lost, meanwhile, heard_again(talk, sink) - returned


def _assert_ended(talk: Talk, goal_id: str, end: End, since: float) -> float:
    """Assert that a goal is ABORTED in this way, and return after how many seconds."""
    assert await_end(talk, goal_id, NEVER_TAKEN + 2) == "ABORTED"
    goal = talk.goal(goal_id)
    assert_aborted(goal, end.reason, end.words)
    assert goal["message"] != "speech failed: "
    return talk.watcher.arrived(talk.watcher.wait_for(goal_id, "ABORTED")) - since


def test_a_hanging_sound_server_does_not_delay_the_engines_start(make_talk: MakeTalk, tmp_path: Path) -> None:
    """libespeak-ng looks for PulseAudio when it is initialised, and would wait half a minute for a frozen one."""
    with socket.socket(socket.AF_UNIX) as frozen:
        frozen.bind(str(tmp_path / "s"))
        frozen.listen()
        talk = make_talk("--player", "null", env={"PULSE_SERVER": f"unix:{tmp_path / 's'}"})
        done = talk.run("say", "--wait", "--timeout", "8", LOW)
        assert (done.code, done.err) == (0, "")


@pytest.mark.parametrize("hangs", [False, True], ids=["absent", "hangs"])
def test_another_player_is_used_if_the_sound_server_takes_no_stream(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path, hangs: bool
) -> None:
    """ALSA has its own way to the device here."""
    with limits(), socket.socket(socket.AF_UNIX) as frozen:
        if hangs:
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
        assert_within(took - goal["duration"], READY_LIMIT_S * hangs + TOLD, "a sentence by the next player")


#: Seconds above a limit of the engine in which a goal's end is told.
SLACK = 0.5
#: Seconds of LOW.
LENGTH = 1.2

PLAY = "aplay -q -t raw -f S16_LE -c 1 -r 22050 --buffer-time=60000"


#: Broken players, and the ends of their goals.
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
    "never reads": (
        "exec sleep 100",
        End("audio_stalled", FIRST_SOUND_LIMIT_S + SLACK, "player accepted no sound for 5 s"),
    ),
    "reads a byte at a time": (
        "while dd bs=1 count=1 of=/dev/null; do sleep 0.3; done 2> /dev/null",
        End("audio_stalled", STALL_LIMIT_S + SLACK, "player accepted no sound for 3 s"),
    ),
    "hangs in drain": (
        f"{PLAY}; exec sleep 100",
        End("audio_stalled", LENGTH + DRAIN_LIMIT_S + SLACK, "player did not exit within 3 s after the sound"),
    ),
}
#: The slowest of the players. The others are tested side by side, as the engine waits for some until a limit.
LONGEST = "never reads"
OTHERS = [fault for fault in BROKEN if fault != LONGEST]


@pytest.mark.parametrize("faults", [OTHERS, pytest.param([LONGEST], marks=pytest.mark.slow)], ids=" and ".join)
def test_a_broken_player_aborts_its_goal_in_time(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path, faults: list[str]
) -> None:
    programs = {fault: _script(tmp_path / fault.replace(" ", "-"), BROKEN[fault][0]) for fault in faults}

    with limits(), contextlib.ExitStack() as idle:
        for path in programs.values():
            (path.parent / "broken").touch()
        talks = {fault: make_talk("--player", str(programs[fault]), sink=sink) for fault in faults}
        for talk in talks.values():
            idle.enter_context(nothing_left(talk))
        goals = {fault: (time.monotonic(), send(talk, LOW)) for fault, talk in talks.items()}
        for fault, talk in talks.items():
            (_, end), (sent_at, goal) = BROKEN[fault], goals[fault]
            assert_within(
                _assert_ended(talk, goal, end, sent_at), end.within, f"the end of a goal whose player {fault}"
            )
        for fault, talk in talks.items():
            (programs[fault].parent / "broken").unlink()
            heard_again(talk, sink)


def test_a_player_that_only_reports_underruns_is_not_an_error(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
    complains = "while echo 'underrun!!! (at least 1.234 ms long)'; do sleep 0.02; done"
    program = _script(tmp_path, f"({complains}) >&2 & sleep 100 & exec {PLAY}")
    (tmp_path / "broken").touch()
    talk = make_talk("--player", str(program), "--rate", "450", sink=sink)
    with nothing_left(talk):
        for text in (LOW, HOME):
            assert talk.run("say", "--wait", "--", text).code == 0
    talk.recording.wait_until_quiet(0.2)
    assert_heard(talk.recording, render([LOW, HOME], rate=450))
    talk.stop(gone_within=0.1)  # what the player had started went with it


def _script(folder: Path, does: str) -> Path:
    """Write a player that does something while the file "broken" is there, and plays otherwise."""
    folder.mkdir(exist_ok=True)
    text = f"#!/bin/sh\nif [ -e {folder}/broken ]; then\n:\n{does}\nexit\nfi\nexec {PLAY}\n"
    return write(folder / "player", text, 0o755)
