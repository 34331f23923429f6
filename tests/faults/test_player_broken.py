"""Players that are missing, fail, hang or lie: no goal SUCCEEDED unheard, none hangs, the next is heard.

Each player is a shell script that misbehaves in its own way while a file is there, and plays with `aplay` after that.
"""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, NamedTuple

import pytest

from talkcli.engine.playback import DRAIN_WITHIN, FIRST_WITHIN, STALLED_AFTER
from tests.conformance.hearing import HOME, LOW, assert_aborted, send
from tests.faults.broken import await_end, heard_again, nothing_left, write
from tests.support.compare import assert_heard
from tests.support.reference import render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds above a limit of the engine in which a goal's end is told.
SLACK = 0.5
#: Seconds of LOW.
LENGTH = 1.2

PLAY = "aplay -q -t raw -f S16_LE -c 1 -r 22050 --buffer-time=60000"


class Player(NamedTuple):
    """A player, and how its goal ends: the reason, words of the message, the seconds it may take."""

    does: str
    reason: str
    words: str
    within: float


BROKEN = {
    "exits 1 at once": Player(
        "echo 'player: main:831: audio open error: No such device' >&2; exit 1",
        "audio_device",
        "player: audio open error: No such device",
        0,
    ),
    "is killed in mid-sentence": Player(
        f"(sleep 0.6; kill -KILL $$) & exec {PLAY}", "audio_lost", "player was killed by SIGKILL", LENGTH
    ),
    "exits 0 too early": Player("cat > /dev/null", "audio_lost", " s before the sound did", 0),
    "never reads": Player("exec sleep 100", "audio_stalled", "player took no sound for 5 s", FIRST_WITHIN),
    "reads a byte at a time": Player(
        "while dd bs=1 count=1 of=/dev/null; do sleep 0.3; done 2> /dev/null",
        "audio_stalled",
        "player took no sound for 3 s",
        STALLED_AFTER,
    ),
    "hangs in drain": Player(
        f"{PLAY}; exec sleep 100", "audio_stalled", "player did not end 3 s after the sound", LENGTH + DRAIN_WITHIN
    ),
}


#: The slowest of the players. The others are tested side by side, as the engine waits for some until a limit.
LONGEST = "never reads"
OTHERS = [each for each in BROKEN if each != LONGEST]


@pytest.mark.parametrize("whats", [OTHERS, pytest.param([LONGEST], marks=pytest.mark.slow)], ids=" and ".join)
def test_player_is_broken(make_talk: MakeTalk, sink: Sink, tmp_path: Path, whats: list[str]) -> None:
    program = {what: _script(tmp_path / what.replace(" ", "-"), BROKEN[what].does) for what in whats}

    with limits(), contextlib.ExitStack() as idle:
        for each in program.values():
            (each.parent / "broken").touch()
        talks = {what: make_talk("--player", str(program[what]), sink=sink) for what in whats}
        for talk in talks.values():
            idle.enter_context(nothing_left(talk))
        goals = {what: (time.monotonic(), send(talk, LOW)) for what, talk in talks.items()}
        for what, talk in talks.items():
            player, (began, goal) = BROKEN[what], goals[what]
            ended = _aborted(talk, goal, player.reason, player.words) - began
            assert_within(ended, player.within + SLACK, f"the end of a goal whose player {what}")
        for what, talk in talks.items():
            (program[what].parent / "broken").unlink()
            if what == whats[0]:
                heard_again(talk, sink)
            else:
                assert talk.run("say", "--wait", "--rate", "450", "--", LOW).code == 0


def test_player_that_writes_underrun_and_goes_on_is_no_error(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
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


def _aborted(talk: Talk, goal_id: str, reason: str, words: str) -> float:
    """Assert that a goal is ABORTED with a reason and the line that names the error; return when."""
    assert await_end(talk, goal_id, 15) == "ABORTED"
    assert_aborted(talk.goal(goal_id), reason, words)
    return talk.watcher.arrived(talk.watcher.wait_for(goal_id, "ABORTED"))
