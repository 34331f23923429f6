"""The sink is suspended or unloaded, the sound server frozen or killed: goals end in time, and are heard again.

A private PulseAudio each, with `aplay` and with `pacat` as players. A goal is in mid-sentence when it happens, the next
one comes while there is no sound, and the third is sent when there is sound again.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.playback import FIRST_WITHIN, LOOK_EVERY, STALLED_AFTER
from tests.conformance.hearing import LONG, LOW, assert_aborted, begin, send
from tests.faults.broken import await_end, heard_again, nothing_left, told
from tests.support.sink import Sink
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: Seconds from the return of the sink to the first sample of the next goal.
AGAIN = 10.0
#: Seconds from the fault, or the beginning of a goal, to its end: where a player is told that there is no sound any
#: more, and how long what takes none is waited for, with the looks and messages in between.
TOLD = 1.0
STALLED = STALLED_AFTER + LOOK_EVERY + 0.2
NEVER_TAKEN = FIRST_WITHIN + LOOK_EVERY + 0.2


@dataclass(frozen=True, slots=True)
class Fault:
    """What happens to the sink, and how a goal ends that is in mid-sentence, and one that comes meanwhile."""

    breaks: Callable[[Sink], None]
    mends: Callable[[Sink], None]
    lost: tuple[str, float]
    meanwhile: tuple[str, float]


def _reload(sink: Sink) -> None:
    sink.reload(warm=False)


def _restart(sink: Sink) -> None:
    sink.start_server(warm=False)


FAULTS = {
    "sink suspended": Fault(Sink.suspend, Sink.resume, ("audio_stalled", STALLED), ("audio_stalled", NEVER_TAKEN)),
    "sink unloaded": Fault(Sink.unload, _reload, ("audio_lost", TOLD), ("audio_device", TOLD)),
    "sound server SIGSTOP": Fault(Sink.freeze, Sink.thaw, ("audio_stalled", STALLED), ("audio_stalled", NEVER_TAKEN)),
    "sound server SIGKILL": Fault(Sink.kill_server, _restart, ("audio_lost", TOLD), ("audio_device", TOLD)),
}


@pytest.fixture(scope="module")
def sinks() -> Iterator[list[Sink]]:
    """Sound servers that were mended, each for the next test to break again: a start of one takes seconds."""
    found: list[Sink] = []
    yield found
    for each in found:
        each.close()


@pytest.mark.parametrize("player", ["aplay", "pacat"])
@pytest.mark.parametrize("what", FAULTS)
def test_sound_is_lost_and_comes_back(make_talk: MakeTalk, sinks: list[Sink], what: str, player: str) -> None:
    fault = FAULTS[what]
    sink = sinks.pop() if sinks else Sink()

    with limits():
        talk = make_talk("--player", player, sink=sink)
        with nothing_left(talk):
            goal = begin(talk, LONG)
            broken = time.monotonic()
            fault.breaks(sink)
            lost = _ends(talk, goal, fault.lost[0], broken)
            meanwhile = _ends(talk, send(talk, LOW), fault.meanwhile[0], time.monotonic())
            fault.mends(sink)
            returned = time.monotonic()
            again = heard_again(talk, sink) - returned
        talk.stop()
        told(f"{what}, {player}: lost after, ended meanwhile after {lost:.3f}, {meanwhile:.3f} s; heard again", again)
        assert_within(lost, fault.lost[1], f"the end of a goal, {what}, {player}")
        assert_within(meanwhile, fault.meanwhile[1], f"the end of a goal meanwhile, {what}, {player}")
        assert_within(again, AGAIN, f"the next goal, {what}, {player}")

    with contextlib.ExitStack() as stack:
        stack.callback(sink.close)
        stack.pop_all()
        sinks.append(sink)  # whole again, as it was heard


def _ends(talk: Talk, goal_id: str, reason: str, since: float) -> float:
    """Assert that a goal is ABORTED, with its reason, and return after how many seconds."""
    assert await_end(talk, goal_id, NEVER_TAKEN + 2) == "ABORTED"
    event = talk.watcher.wait_for(goal_id, "ABORTED")
    goal = talk.goal(goal_id)
    assert_aborted(goal, reason)
    assert goal["message"] != "Talk aborted: "
    return talk.watcher.arrived(event) - since


def test_sound_server_that_hangs_while_the_engine_starts(make_talk: MakeTalk) -> None:
    """libespeak-ng looks for PulseAudio when it is initialised, and would wait half a minute for one that hangs."""
    with Sink() as sink:
        sink.freeze()
        try:
            talk = make_talk("--player", "null", sink=sink)
            done = talk.run("say", "--wait", "--timeout", "8", LOW)
            assert (done.code, done.err) == (0, "")
        finally:
            sink.thaw()
