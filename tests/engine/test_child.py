"""A player's process: how it is started, when, and that nothing of it is left."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.players import Command
from talkcli.engine.players import child as child_module
from talkcli.engine.players.child import Child
from talkcli.engine.players.program import ProgramPlayer
from tests.engine.spawned import FAST, Spawned
from tests.support import census
from tests.support.processes import children
from tests.support.reference import played, render

if TYPE_CHECKING:
    from pathlib import Path

    from tests.engine.programs import Player

#: Tells when a player is started, a text is looked at, and a process is forked: a line each.
_WATCHED = """
from talkcli.engine.synthesizers import guard
tell = lambda what: sys.stderr.write(what + "\\n")
sys.addaudithook(lambda name, _: name in ("os.posix_spawn", "os.fork", "subprocess.Popen") and tell(name))
guarded = guard.guarded
guard.guarded = lambda *text: (tell("text"), guarded(*text))[1]
"""


def _status(child: Child, seconds: float = 10.0) -> int:
    """Wait for a child's end, and return its status."""
    end = time.monotonic() + seconds
    while (status := child.status()) is None:
        assert time.monotonic() < end, "it has not ended"
        child.await_end(0.1)
    child.release()
    return status


def _run(script: str, *inherited: int) -> Child:
    return Child(("/bin/sh", "-c", script), inherited)


def test_the_holders_of_a_pipe_are_looked_for_no_longer_than_it_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    looked: list[str] = []

    def links(folder: str) -> list[str]:
        looked.append(folder)
        if len(looked) == 2:
            os.close(writing)
        return []

    monkeypatch.setattr(child_module, "_links", links)
    monkeypatch.setattr(child_module, "processes", lambda: [-1, -2, -3, -4])
    assert not child_module.kill_holders(reading)
    assert looked == ["/proc/-1/fd", "/proc/-2/fd"]
    os.close(reading)


# -- a child


@pytest.mark.parametrize(
    ("script", "status"),
    [
        ("exit 0", 0),
        ("exit 7", 7),
        ("kill -TERM $$", -signal.SIGTERM),
        # Python ignores SIGPIPE; a player that went on ignoring it would never end.
        ("kill -PIPE $$; exit 3", -signal.SIGPIPE),
    ],
)
def test_its_status_is_that_of_its_end(script: str, status: int) -> None:
    assert _status(_run(script)) == status


def test_a_failed_start_leaves_nothing_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # of folders that this user may enter: of others the error is theirs
    plain = tmp_path / "plain"
    plain.write_text("no program")
    before = os.listdir("/proc/self/fd")
    with pytest.raises(FileNotFoundError):
        Child(("no-such-program",))
    with pytest.raises(PermissionError):
        Child((str(plain),))
    assert os.listdir("/proc/self/fd") == before


def test_it_has_three_streams_the_inherited_descriptors_and_its_leash() -> None:
    reading, writing = os.pipe()
    before = census.descriptors(os.getpid())
    child = _run("kill -STOP $$", writing)
    # What a program opens while it is loaded is closed when it has stopped itself.
    os.waitid(os.P_PID, child.pid, os.WSTOPPED | os.WNOWAIT)
    its = census.descriptors(child.pid)
    assert its.pop(1) == os.devnull
    assert its.pop(writing) == os.readlink(f"/proc/self/fd/{writing}")
    ours = {os.readlink(f"/proc/self/fd/{each}") for each in (child.stdin, child.stderr, child._leash)}
    assert ours <= set(its.values())
    assert set(its.values()) - ours <= set(before.values()), "nothing else was opened for it"
    assert not os.get_inheritable(writing)
    child.kill()
    _status(child)
    assert census.descriptors(os.getpid()) == before
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize("ends", [True, False], ids=["ended by itself", "killed"])
def test_all_that_it_has_started_ends_with_it(ends: bool) -> None:
    reading, writing = os.pipe()
    child = _run(f"sleep 100 & echo . >&2; {'exit 7' if ends else 'wait'}", writing)
    os.close(writing)
    assert child.stderr is not None
    os.set_blocking(child.stderr, True)
    os.read(child.stderr, 1)
    if not ends:
        child.kill()
    assert _status(child) == (7 if ends else -signal.SIGKILL)
    assert select.select([reading], [], [], 0.1)[0], "somebody holds it"
    assert os.read(reading, 1) == b""
    os.close(reading)


#: Starts a process in a session of its own, and lives no longer itself.
_LEAVES = """
import os, sys, time
ready, begun = os.pipe()
if os.fork():
    os.close(begun)
    os.read(ready, 1)
    os._exit(0)
os.setsid()
{then}
time.sleep(100)
"""


def _leaving(then: str, *inherited: int) -> Child:
    return Child((sys.executable, "-S", "-c", _LEAVES.format(then=then)), inherited)


def test_a_process_that_left_its_session_is_killed_too_before_it_counts_as_ended() -> None:
    reading, writing = os.pipe()
    child = _leaving("os.write(begun, b'.')", writing)
    os.close(writing)
    assert _status(child) == 0
    # It closes one descriptor after the other, and this one last.
    assert select.select([reading], [], [], 5)[0], "somebody holds it"
    assert os.read(reading, 1) == b""
    os.close(reading)


def test_a_process_that_left_its_session_and_closed_its_descriptors_is_left_alone() -> None:
    reading, writing = os.pipe()
    child = _leaving(f"os.dup2({writing}, 1); os.closerange(2, 100); os.write(1, b'%d' % os.getpid())", writing)
    os.close(writing)
    assert _status(child) == 0
    stranger = int(os.read(reading, 10))
    os.set_blocking(reading, False)
    with pytest.raises(BlockingIOError):
        os.read(reading, 1)  # it lives, as it holds this
    os.kill(stranger, signal.SIGKILL)
    os.close(reading)


@pytest.mark.parametrize(("at_start", "pieces"), [(0, 1), (3528, 4), (2000, 3)])
def test_a_player_finds_enough_to_begin_and_then_a_piece_at_a_time(at_start: int, pieces: int) -> None:
    player = ProgramPlayer(Command("sleep", ("sleep", "100"), read_ahead=0, at_start=at_start))
    taken = []
    while size := player.offer(memoryview(bytes(882))):
        taken.append(size)
    assert (len(taken), sum(taken)) == (pieces, max(882, at_start))
    assert (player.consumed(), player.proven) == (0, False)
    player.kill()
    end = time.monotonic() + 10
    while not player.gone():
        assert time.monotonic() < end, "it has not ended"
        time.sleep(0.001)  # on a busy machine it is killed later than `kill` waits for


# -- in an engine process


def test_no_memory_is_copied_for_it_and_it_starts_before_the_text_is_read(player: Player) -> None:
    """A fork takes 3 ms, the synthesis 2, and the player itself 5 to 15: together, not one after the other."""
    with Spawned(player.plays(), before=_WATCHED) as engine:
        assert engine.spoken("battery low").outcome == protocol.COMPLETED
        engine.leave()
        assert engine.errors().split() == ["os.posix_spawn", "text"]


def test_a_text_without_a_sound_is_no_fault_of_the_player(player: Player) -> None:
    broken = player.program("")
    broken.write_text("#!/no/such/interpreter")
    with Spawned(str(broken)) as engine:
        silent, spoken = engine.spoken("...", "g1"), engine.spoken("battery low", "g2")
        assert (silent.reason, spoken.reason) == ("nothing_to_say", "no_player")
        assert children(engine.process.pid) == []


def test_a_player_for_another_rate_is_replaced_before_the_first_sample(player: Player) -> None:
    before = """
from talkcli.engine.synthesizers import espeak
load = espeak.load
espeak.load = lambda: (*load()[:2], 16_000)
"""
    rates = player.heard.with_name("rates")
    program = player.plays(f"open({str(rates)!r}, 'a').write(sys.argv[2] + ' ')")
    with Spawned(f"{program} {{rate}}", before=before) as engine:
        assert engine.spoken("battery low").outcome == protocol.COMPLETED
    assert set(rates.read_text().split()) == {"22050"}
    assert player.heard.read_bytes() == played(render(["battery low"], rate=FAST)[0]).tobytes()


def test_all_that_a_player_has_started_dies_with_a_killed_process(tmp_path: Path) -> None:
    """What a shell starts behind itself, too: it would go on with what it holds. Sound comes to one that is tied."""
    begun, script = tmp_path / "begun", tmp_path / "pipeline"
    os.mkfifo(begun)
    script.write_text(f"#!/bin/sh\nsleep 100 &\nhead -c 1 > /dev/null\necho > {begun}\nwait\n")
    script.chmod(0o755)
    with Spawned(str(script)) as engine:
        engine.say("one two three")
        begun.read_text()
        os.kill(engine.process.pid, signal.SIGKILL)
        assert engine.all_gone()
