"""Tests for players that fail, and for their processes: the sentence fails, nothing hangs, and no process remains."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.child.players.program import PlayerProcess, ProgramPlayer
from talkcli.engine.players import PlayerCommand
from tests.engine.process import FAST, SOON, Engine
from tests.engine.programs import NEVER_READS, PLAYS, SWALLOWS, Player
from tests.support import usage
from tests.support.processes import children
from tests.support.reference import render, without_leading_zeros
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

TEXT = "battery low"
NO_MIXER = """
import sys
sys.stderr.write("ALSA lib pcm.c:2660:(snd_pcm_open_noupdate) Unknown PCM cards.pcm.default\\n")
sys.stderr.write("aplay: main:831: audio open error: No such file or directory\\n")
sys.exit("ACCESS: RW_INTERLEAVED\\nBUFFER_SIZE: [1 2]")
"""
UNDERRUNS = """
    print("underrun!!! (at least 0.1 ms long)" * 50, file=sys.stderr)
    if taken > 8000:
        sys.exit("aplay: pcm_write:2061: write error: No such device")
"""


def _plays(during: str = "pass", after: str = "") -> str:
    return PLAYS.format(during=during, after=after)


#: Players that close their input, or stop reading, in mid-sentence.
CLOSES = "if taken > 8000: os.close(0); time.sleep(100)"
STALLS = _plays("if taken > 8000: time.sleep(100)")


def _failure(command: str, **limits: float) -> tuple[str | None, str | None]:
    with Engine(command, limits=limits) as engine:
        ended = engine.spoken("battery low, please come home")  # long enough for a player to end too early
        assert ended.outcome == protocol.OUTCOME_FAILED
        assert children(engine.process.pid) == []
        return ended.reason, ended.message


def _assert_all_accepted(player: Player, ended: protocol.Ended) -> None:
    assert ended.outcome == protocol.OUTCOME_COMPLETED
    assert ended.duration is not None
    assert player.heard.stat().st_size == round(ended.duration * 22050) * 2


@pytest.mark.parametrize("during", ["pass", 'print("underrun!!! (at least 0.1 ms long)", file=sys.stderr)'])
def test_a_player_gets_every_sample_and_an_underrun_is_not_an_error(player: Player, during: str) -> None:
    with Engine(player.plays(during)) as engine:
        _assert_all_accepted(player, engine.spoken(TEXT))
        assert len(engine.words()) == 2


#: Code of failing players, the changed limit, and the expected reason and message.
FAILING: list[tuple[str, str | None, str, str]] = [
    ("raise SystemExit(1)", None, "audio_device", "player exited with status 1"),
    (NO_MIXER, None, "audio_device", "aplay: audio open error: No such file or directory"),
    ("", None, "audio_lost", "player exited too early"),
    (_plays("if taken > 8000: sys.exit(0)"), None, "audio_lost", "player exited too early"),
    (_plays("if taken > 8000: sys.exit(3)"), None, "audio_lost", "player exited with status 3"),
    (_plays("if taken > 8000: os.kill(os.getpid(), 9)"), None, "audio_lost", "player was killed by SIGKILL"),
    (_plays(UNDERRUNS), None, "audio_lost", "aplay: write error: No such device"),
    (SWALLOWS, None, "audio_lost", r"player ended \d\.\d s before the end of the sound"),
    (_plays(after='sys.exit("drain failed: Broken pipe")'), None, "audio_lost", "drain failed: Broken pipe"),
    (_plays(CLOSES), None, "audio_lost", "player closed its input too early"),
    (NEVER_READS, "FIRST_SOUND_LIMIT_S", "audio_stalled", "player accepted no sound for 0.4 s"),
    (STALLS, "STALL_LIMIT_S", "audio_stalled", "player accepted no sound for 0.4 s"),
]


def test_a_failing_player_fails_the_sentence_with_a_readable_message(tmp_path: Path) -> None:
    def fail(number: int) -> tuple[str | None, str | None]:
        code, limit, _, _ = FAILING[number]
        (tmp_path / str(number)).mkdir()
        return _failure(Player(tmp_path / str(number)).command(code), **({limit: 0.4} if limit else {}))

    with ThreadPoolExecutor(4) as pool:  # most of the time is spent waiting
        for (code, _, reason, message), actual in zip(FAILING, pool.map(fail, range(len(FAILING))), strict=True):
            assert actual[0] == reason, (code, actual)
            assert re.fullmatch(message, actual[1] or ""), (code, actual)


def test_a_player_that_hangs_after_the_sound_fails_the_sentence(player: Player) -> None:
    reason, message = _failure(player.plays(after="time.sleep(100)"), DRAIN_LIMIT_S=0.3)
    assert (reason, message) == ("audio_stalled", "player did not exit within 0.3 s after the sound")


#: Code that reports a busy device, for the given number of tries.
BUSY = """
import os, sys
with open("{tries}", "a") as tries:
    tries.write(".")
if os.path.getsize("{tries}") <= {times}:
    sys.exit("aplay: main:831: audio open error: Device or resource busy")
"""


def test_a_busy_device_is_tried_again_for_a_limited_time(player: Player, tmp_path: Path) -> None:
    tries = tmp_path / "tries"
    limit = {"DEVICE_BUSY_LIMIT_S": 0.6}
    with Engine(player.command(BUSY.format(tries=tries, times=4) + _plays())) as engine:
        _assert_all_accepted(player, engine.spoken(TEXT))
    command = player.command(BUSY.format(tries=tries, times=1000))
    with limits(), Engine(command, alive_every=SOON, limits=limit) as engine:
        before, started_at = tries.stat().st_size, time.monotonic()
        ended = engine.spoken(TEXT, "g1")
        assert (ended.reason, ended.message) == ("audio_device", "aplay: audio open error: Device or resource busy")
        elapsed = time.monotonic() - started_at
        assert elapsed >= 0.6
        assert_within(elapsed, 0.6 + 1, "the end of a goal whose device is busy")
        assert tries.stat().st_size > before + 1
        engine.say(TEXT, "g2")
        engine.until(protocol.Alive)
        engine.stop("g2")


def test_a_stop_leaves_no_player_process(player: Player) -> None:
    with limits(), Engine(player.plays(), alive_every=SOON) as engine:
        for goal in ("plays", "plays again", "never reads"):
            if goal == "never reads":
                player.command(NEVER_READS)
            engine.say("one two three four five six seven eight", goal)
            if goal == "never reads":
                engine.until(protocol.Alive)
            else:
                engine.until_word()
            assert_within(engine.stop(goal), 0.02, "the stop")
            assert children(engine.process.pid) == []
        assert engine.words("never reads") == []


def test_no_word_is_reported_while_the_player_stalls(player: Player) -> None:
    stall = 0.4
    with Engine(player.plays(f"if 13000 < taken < 13900: time.sleep({stall}); started_at += {stall}")) as engine:
        started_at = time.monotonic()
        engine.say("one two three four five")
        delays = {}
        while not isinstance(event := engine.event(), protocol.Ended):
            if isinstance(event, protocol.Word):
                delays[event.time] = time.monotonic() - started_at - event.time
        before = [delay for position, delay in delays.items() if position < 0.2]
        after = [delay for position, delay in delays.items() if position > 0.35]
        assert before
        assert after
        assert max(before) + stall - 0.15 < min(after)


def test_the_error_names_a_program_that_cannot_be_run(tmp_path: Path) -> None:
    path = tmp_path / "garbage"
    path.write_bytes(b"\x7fELF garbage")
    path.chmod(0o755)
    reason, message = _failure(str(path))
    assert reason == "no_player"
    assert message is not None
    assert message.startswith("garbage could not be started: ")


# -- players that are found on the PATH

HOST_IS_DOWN = "import sys\nsys.exit('aplay: main:831: audio open error: Host is down')"


def _on_path(folder: Path) -> Engine:
    return Engine(None, environment={"PATH": str(folder)})


def test_if_a_player_fails_the_next_one_gets_the_whole_sentence(player: Player, tmp_path: Path) -> None:
    player.program(HOST_IS_DOWN, "aplay")
    player.program(_plays().replace("sys.argv[1]", repr(str(player.heard))), "pacat")
    with _on_path(tmp_path) as engine:
        assert engine.until(protocol.Ready).player == "aplay"
        ended = engine.spoken(TEXT)
        _assert_all_accepted(player, ended)
        assert len(engine.words()) == 2
        assert ended.player == "pacat"
        # pacat worked, so it is tried first the next time. aplay would leave a mark.
        player.program(f"open({str(tmp_path / 'mark')!r}, 'w')", "aplay")
        assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED
        assert not (tmp_path / "mark").exists()


def test_if_all_players_fail_the_error_of_the_first_is_reported(player: Player, tmp_path: Path) -> None:
    player.program(HOST_IS_DOWN, "aplay")
    player.program("import sys\nsys.exit('Connection failure: Connection refused')", "pacat")
    with _on_path(tmp_path) as engine:
        ended = engine.spoken(TEXT)
        assert (ended.reason, ended.message) == ("audio_device", "aplay: audio open error: Host is down")


def test_a_player_that_accepted_sound_is_not_replaced(player: Player, tmp_path: Path) -> None:
    code = _plays("if taken > 8000: sys.exit('write error: No such device')")
    player.program(code.replace("sys.argv[1]", repr(str(player.heard))), "aplay")
    player.program(f"open({str(tmp_path / 'mark')!r}, 'w')", "pacat")
    with _on_path(tmp_path) as engine:
        ended = engine.spoken(TEXT)
        assert (ended.reason, ended.message) == ("audio_lost", "write error: No such device")
        assert not (tmp_path / "mark").exists()


# -- a player's process


#: Code that writes a line when a player is started, when a process is forked, and when the text is read.
_WATCHED = """
from talkcli.engine.child.synthesizers import guard
log = lambda event: sys.stderr.write(event + "\\n")
sys.addaudithook(lambda name, _: name in ("os.posix_spawn", "os.fork", "subprocess.Popen") and log(name))
guarded = guard.guarded
guard.guarded = lambda *text: (log("text"), guarded(*text))[1]
"""


def _status(child: PlayerProcess, seconds: float = 10.0) -> int:
    """Wait for the end of a child, and return its status."""
    end = time.monotonic() + seconds
    while (status := child.poll()) is None:
        assert time.monotonic() < end, "the child has not ended"
        child.await_exit(0.1)
    child.release()
    return status


def _run(script: str, *inherited: int) -> PlayerProcess:
    return PlayerProcess(("/bin/sh", "-c", script), inherited)


# -- a child


@pytest.mark.parametrize(
    ("script", "status"),
    [
        ("exit 0", 0),
        ("exit 7", 7),
        ("kill -TERM $$", -signal.SIGTERM),
        # Python ignores SIGPIPE. A player that inherits this would never end.
        ("kill -PIPE $$; exit 3", -signal.SIGPIPE),
    ],
)
def test_a_child_reports_its_exit_status(script: str, status: int) -> None:
    assert _status(_run(script)) == status


def test_a_failed_start_leaves_no_descriptor_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # a folder that this user can't enter would cause a different error
    plain = tmp_path / "plain"
    plain.write_text("no program")
    before = os.listdir("/proc/self/fd")
    with pytest.raises(FileNotFoundError):
        PlayerProcess(("no-such-program",))
    with pytest.raises(PermissionError):
        PlayerProcess((str(plain),))
    assert os.listdir("/proc/self/fd") == before


def test_killing_a_child_while_the_interpreter_exits_causes_no_error() -> None:
    """pyttsx3 stops its driver at that time. An error would hide the one that ended the process."""
    script = """
import sys
from talkcli.engine.child.players.program import ProgramPlayer
from talkcli.engine.players import PlayerCommand
class Driver:
    player = ProgramPlayer(PlayerCommand("sleep", ("sleep", "100")))
    def __del__(self):
        self.player.kill()
sys.modules["driver"] = Driver()
"""
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=True).stderr == b""


def test_a_child_gets_only_its_streams_leash_and_inherited_descriptors() -> None:
    reading, writing = os.pipe()
    before = usage.descriptors(os.getpid())
    child = _run("kill -STOP $$", writing)
    # Once the shell has stopped itself, the files that the loader opened are closed.
    os.waitid(os.P_PID, child.pid, os.WSTOPPED | os.WNOWAIT)
    descriptors = usage.descriptors(child.pid)
    assert descriptors.pop(1) == os.devnull
    assert descriptors.pop(writing) == os.readlink(f"/proc/self/fd/{writing}")
    shared = {os.readlink(f"/proc/self/fd/{file.fileno()}") for file in (child.stdin, child.stderr, child._leash)}
    assert shared <= set(descriptors.values())
    assert set(descriptors.values()) - shared <= set(before.values()), "the child got other descriptors"
    assert not os.get_inheritable(writing)
    child.kill()
    _status(child)
    assert usage.descriptors(os.getpid()) == before
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize("exits", [True, False], ids=["exits", "is killed"])
def test_processes_that_a_child_started_end_with_it(exits: bool) -> None:
    reading, writing = os.pipe()
    child = _run(f"sleep 100 & echo . >&2; {'exit 7' if exits else 'wait'}", writing)
    os.close(writing)
    os.set_blocking(child.stderr.fileno(), True)
    child.stderr.read(1)
    if not exits:
        child.kill()
    assert _status(child) == (7 if exits else -signal.SIGKILL)
    assert select.select([reading], [], [], 0.1)[0], "a process still has the pipe open"
    assert os.read(reading, 1) == b""
    os.close(reading)


#: A program that starts a process in another session, and exits when that process is ready.
_LEAVES = """
import os, sys, time
ready, started = os.pipe()
if os.fork():
    os.close(started)
    os.read(ready, 1)
    os._exit(0)
os.setsid()
{then}
time.sleep(100)
"""


def _leaving(then: str, *inherited: int) -> PlayerProcess:
    return PlayerProcess((sys.executable, "-S", "-c", _LEAVES.format(then=then)), inherited)


def test_a_process_that_left_the_session_is_killed_before_the_child_ends() -> None:
    reading, writing = os.pipe()
    child = _leaving("os.write(started, b'.')", writing)
    os.close(writing)
    assert _status(child) == 0
    # The dying process closes its descriptors one by one, and the pipe last.
    assert select.select([reading], [], [], 5)[0], "a process still has the pipe open"
    assert os.read(reading, 1) == b""
    os.close(reading)


def test_a_process_that_closed_its_inherited_descriptors_is_not_killed() -> None:
    reading, writing = os.pipe()
    child = _leaving(f"os.dup2({writing}, 1); os.closerange(2, 100); os.write(1, b'%d' % os.getpid())", writing)
    os.close(writing)
    assert _status(child) == 0
    survivor = int(os.read(reading, 10))
    os.set_blocking(reading, False)
    with pytest.raises(BlockingIOError):
        os.read(reading, 1)  # the process is alive, because the pipe is open
    os.kill(survivor, signal.SIGKILL)
    os.close(reading)


def test_a_program_gets_one_piece_at_a_time() -> None:
    player = ProgramPlayer(PlayerCommand("sleep", ("sleep", "100"), read_ahead=0))
    assert [player.offer(memoryview(bytes(882))) for _ in range(2)] == [882, 0]
    assert (player.consumed(), player.proven) == (0, False)
    player.kill()
    end = time.monotonic() + 10
    while not player.gone():
        assert time.monotonic() < end, "the player has not ended"
        time.sleep(0.001)  # on a busy machine, `kill` returns before the player is dead


# -- in an engine process


def test_a_player_is_spawned_without_a_fork_before_the_text_is_read(player: Player) -> None:
    """A fork would take 3 ms. The player takes 5 to 15 ms to start, while the text is synthesized in 2 ms."""
    with Engine(player.plays(), before=_WATCHED) as engine:
        assert engine.spoken("battery low").outcome == protocol.OUTCOME_COMPLETED
        engine.leave()
        assert engine.errors().split() == ["os.posix_spawn", "text"]


def test_a_text_without_sound_is_not_reported_as_a_player_error(player: Player) -> None:
    broken = player.program("")
    broken.write_text("#!/no/such/interpreter")
    with Engine(str(broken)) as engine:
        silent, spoken = engine.spoken("...", "g1"), engine.spoken("battery low", "g2")
        assert (silent.reason, spoken.reason) == ("nothing_to_say", "no_player")
        assert children(engine.process.pid) == []


def test_a_player_with_a_wrong_rate_is_replaced_before_the_first_sample(player: Player) -> None:
    before = """
from talkcli.engine.child.synthesizers import espeak
load_library = espeak.load_library
espeak.load_library = lambda: (*load_library()[:2], 16_000)
"""
    rates = player.heard.with_name("rates")
    program = player.plays(f"open({str(rates)!r}, 'a').write(sys.argv[2] + ' ')")
    with Engine(f"{program} {{rate}}", before=before) as engine:
        assert engine.spoken("battery low").outcome == protocol.OUTCOME_COMPLETED
    assert set(rates.read_text().split()) == {"22050"}
    assert player.heard.read_bytes() == without_leading_zeros(render(["battery low"], rate=FAST)[0]).tobytes()


def test_processes_that_a_player_started_die_with_a_killed_engine(tmp_path: Path) -> None:
    """The player is a shell script with a background process. It reports its start once it has got sound."""
    started, script = tmp_path / "started", tmp_path / "pipeline"
    os.mkfifo(started)
    script.write_text(f"#!/bin/sh\nsleep 100 &\nhead -c 1 > /dev/null\necho > {started}\nwait\n")
    script.chmod(0o755)
    with Engine(str(script)) as engine:
        engine.say("one two three")
        started.read_text()
        os.kill(engine.process.pid, signal.SIGKILL)
        assert engine.all_gone()
