"""Players that fail, and their processes: never a sentence that counts as spoken, never a hang, nothing left."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import processes
from talkcli.engine import protocol
from talkcli.engine.child import playback
from talkcli.engine.child.players.program import PlayerProcess, ProgramPlayer
from talkcli.engine.players import PlayerCommand
from tests.engine.programs import NEVER_READS, PLAYS, SWALLOWS, Player
from tests.engine.spawned import FAST, SOON, Spawned
from tests.support import usage
from tests.support.processes import children
from tests.support.reference import render, without_leading_zeros
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.engine.programs import Player

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


def _failure(command: str, **limits: float) -> tuple[str | None, str | None]:
    with Spawned(command, limits=limits) as engine:
        ended = engine.spoken("battery low, please come home")  # so long that its end can be too early
        assert ended.outcome == protocol.OUTCOME_FAILED
        assert children(engine.process.pid) == []
        return ended.reason, ended.message


def _assert_all_taken(player: Player, ended: protocol.Ended) -> None:
    assert ended.outcome == protocol.OUTCOME_COMPLETED
    assert ended.duration is not None
    assert player.heard.stat().st_size == round(ended.duration * 22050) * 2


@pytest.mark.parametrize("during", ["pass", 'print("underrun!!! (at least 0.1 ms long)", file=sys.stderr)'])
def test_a_good_player_gets_every_sample_and_underruns_are_no_error(player: Player, during: str) -> None:
    with Spawned(player.plays(during)) as engine:
        _assert_all_taken(player, engine.spoken(TEXT))
        assert len(engine.words()) == 2


@pytest.mark.parametrize(
    ("code", "limit", "reason", "message"),
    [
        ("raise SystemExit(1)", None, "audio_device", "player exited with status 1"),
        (NO_MIXER, None, "audio_device", "aplay: audio open error: No such file or directory"),
        ("", None, "audio_lost", "player exited too early"),
        (_plays("if taken > 8000: sys.exit(0)"), None, "audio_lost", "player exited too early"),
        (_plays("if taken > 8000: sys.exit(3)"), None, "audio_lost", "player exited with status 3"),
        (_plays("if taken > 8000: os.kill(os.getpid(), 9)"), None, "audio_lost", "player was killed by SIGKILL"),
        (_plays(UNDERRUNS), None, "audio_lost", "aplay: write error: No such device"),
        (SWALLOWS, None, "audio_lost", r"player ended \d\.\d s before the end of the sound"),
        (_plays(after='sys.exit("drain failed: Broken pipe")'), None, "audio_lost", "drain failed: Broken pipe"),
        (
            _plays("if taken > 8000: os.close(0); time.sleep(100)"),
            *(None, "audio_lost", "player closed its input too early"),
        ),
        (NEVER_READS, "FIRST_SOUND_LIMIT_S", "audio_stalled", "player accepted no sound for 0.4 s"),
        (
            _plays("if taken > 8000: time.sleep(100)"),
            *("STALL_LIMIT_S", "audio_stalled", "player accepted no sound for 0.4 s"),
        ),
    ],
)
def test_a_player_that_fails_fails_the_sentence_in_words(
    player: Player, code: str, limit: str | None, reason: str, message: str
) -> None:
    told, words = _failure(player.command(code), **({limit: 0.4} if limit else {}))
    assert told == reason
    assert re.fullmatch(message, words or ""), words


def test_hangs_in_drain(player: Player) -> None:
    reason, message = _failure(player.plays(after="time.sleep(100)"), DRAIN_LIMIT_S=0.3)
    assert (reason, message) == ("audio_stalled", "player did not exit within 0.3 s after the sound")


#: Finds the device held by another, so many times.
BUSY = """
import os, sys
with open("{tries}", "a") as tries:
    tries.write(".")
if os.path.getsize("{tries}") <= {times}:
    sys.exit("aplay: main:831: audio open error: Device or resource busy")
"""


def test_a_device_that_is_busy_is_tried_again_for_a_while(player: Player, tmp_path: Path) -> None:
    tries = tmp_path / "tries"
    with Spawned(player.command(BUSY.format(tries=tries, times=4) + _plays())) as engine:
        _assert_all_taken(player, engine.spoken(TEXT))
    command = player.command(BUSY.format(tries=tries, times=1000))
    with limits(), Spawned(command, alive_every=SOON) as engine:
        before, began = tries.stat().st_size, time.monotonic()
        ended = engine.spoken(TEXT, "g1")
        assert (ended.reason, ended.message) == ("audio_device", "aplay: audio open error: Device or resource busy")
        assert time.monotonic() - began >= playback.DEVICE_BUSY_LIMIT_S
        assert_within(
            time.monotonic() - began, playback.DEVICE_BUSY_LIMIT_S + 1, "the end of a goal whose device is held"
        )
        assert tries.stat().st_size > before + 2
        engine.say(TEXT, "g2")
        engine.until(protocol.Alive)
        engine.stop("g2")


def test_a_stop_leaves_no_process_of_a_player_that_plays_or_never_reads(player: Player) -> None:
    with limits(), Spawned(player.plays(), alive_every=SOON) as engine:
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


def test_no_word_is_reported_while_the_player_stands_still(player: Player) -> None:
    stall = 0.5
    with Spawned(player.plays(f"if 13000 < taken < 13900: time.sleep({stall}); began += {stall}")) as engine:
        began = time.monotonic()
        engine.say("one two three four five six seven")
        late = {}
        while not isinstance(event := engine.event(), protocol.Ended):
            if isinstance(event, protocol.Word):
                late[event.time] = time.monotonic() - began - event.time
        before = [value for position, value in late.items() if position < 0.2]
        after = [value for position, value in late.items() if position > 0.35]
        assert before
        assert after
        assert max(before) + stall - 0.15 < min(after)


def test_a_program_that_cannot_be_run_is_named(tmp_path: Path) -> None:
    assert _failure("/nonexistent/player --rate {rate}") == ("no_player", 'player "/nonexistent/player" not found')
    assert _failure("'unbalanced") == ("no_player", 'invalid player command "\'unbalanced": no closing quotation')
    path = tmp_path / "garbage"
    path.write_bytes(b"\x7fELF garbage")
    path.chmod(0o755)
    reason, message = _failure(str(path))
    assert reason == "no_player"
    assert message is not None
    assert message.startswith("garbage could not be started: ")


def test_rate_and_device_reach_the_command(player: Player) -> None:
    code = f"import sys\nopen({str(player.heard)!r}, 'w').write(' '.join(sys.argv[1:]))"
    with Spawned(f"{player.program(code)} {{rate}} --dev={{device}}", device="hw:1") as engine:
        engine.spoken(TEXT)
    assert player.heard.read_text() == "22050 --dev=hw:1"


# -- the players that are found on the PATH

HOST_IS_DOWN = "import sys\nsys.exit('aplay: main:831: audio open error: Host is down')"


def _on_path(folder: Path) -> Spawned:
    return Spawned(None, environment={"PATH": str(folder)})


def test_the_next_player_is_tried_with_the_whole_sentence(player: Player, tmp_path: Path) -> None:
    player.program(HOST_IS_DOWN, "aplay")
    player.program(_plays().replace("sys.argv[1]", repr(str(player.heard))), "pacat")
    with _on_path(tmp_path) as engine:
        assert engine.until(protocol.Ready).player == "aplay"
        ended = engine.spoken(TEXT)
        _assert_all_taken(player, ended)
        assert len(engine.words()) == 2
        assert ended.player == "pacat"
        # It worked, so it is the first next time: the failing one would have left a mark.
        player.program(f"open({str(tmp_path / 'mark')!r}, 'w')", "aplay")
        assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED
        assert not (tmp_path / "mark").exists()


def test_if_all_players_fail_the_first_one_is_quoted(player: Player, tmp_path: Path) -> None:
    player.program(HOST_IS_DOWN, "aplay")
    player.program("import sys\nsys.exit('Connection failure: Connection refused')", "pacat")
    with _on_path(tmp_path) as engine:
        ended = engine.spoken(TEXT)
        assert (ended.reason, ended.message) == ("audio_device", "aplay: audio open error: Host is down")


def test_a_player_that_took_sound_is_not_replaced(player: Player, tmp_path: Path) -> None:
    code = _plays("if taken > 8000: sys.exit('write error: No such device')")
    player.program(code.replace("sys.argv[1]", repr(str(player.heard))), "aplay")
    player.program(f"open({str(tmp_path / 'mark')!r}, 'w')", "pacat")
    with _on_path(tmp_path) as engine:
        ended = engine.spoken(TEXT)
        assert (ended.reason, ended.message) == ("audio_lost", "write error: No such device")
        assert not (tmp_path / "mark").exists()


def test_no_player_at_all_says_what_to_install(tmp_path: Path) -> None:
    with _on_path(tmp_path) as engine:
        assert engine.until(protocol.Ready).player is None
        ended = engine.spoken(TEXT)
        assert ended.reason == "no_player"
        wanted = "no player found; install alsa-utils (aplay), pulseaudio-utils (pacat) or pipewire-bin (pw-cat)"
        assert ended.message == wanted


def test_no_descriptor_is_left_over(player: Player) -> None:
    with Spawned(player.command("raise SystemExit(1)")) as engine:
        engine.until(protocol.VoiceList)  # they are read from files, once
        engine.spoken(TEXT, "g0")
        before = os.listdir(f"/proc/{engine.process.pid}/fd")
        for number in range(1, 6):
            engine.spoken(TEXT, f"g{number}")
        assert os.listdir(f"/proc/{engine.process.pid}/fd") == before


# -- a player's process


#: Tells when a player is started, a text is looked at, and a process is forked: a line each.
_WATCHED = """
from talkcli.engine.child.synthesizers import guard
tell = lambda what: sys.stderr.write(what + "\\n")
sys.addaudithook(lambda name, _: name in ("os.posix_spawn", "os.fork", "subprocess.Popen") and tell(name))
guarded = guard.guarded
guard.guarded = lambda *text: (tell("text"), guarded(*text))[1]
"""


def _status(child: PlayerProcess, seconds: float = 10.0) -> int:
    """Wait for a child's end, and return its status."""
    end = time.monotonic() + seconds
    while (status := child.poll()) is None:
        assert time.monotonic() < end, "it has not ended"
        child.await_end(0.1)
    child.release()
    return status


def _run(script: str, *inherited: int) -> PlayerProcess:
    return PlayerProcess(("/bin/sh", "-c", script), inherited)


def test_the_holders_of_a_pipe_are_looked_for_no_longer_than_it_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    looked: list[str] = []

    def links(folder: str) -> list[str]:
        looked.append(folder)
        if len(looked) == 2:
            os.close(writing)
        return []

    monkeypatch.setattr(processes, "_read_links", links)
    monkeypatch.setattr(processes, "process_ids", lambda: [-1, -2, -3, -4])
    assert not processes.kill_holders(reading)
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
def test_the_status_of_a_child_is_that_of_its_end(script: str, status: int) -> None:
    assert _status(_run(script)) == status


def test_a_failed_start_leaves_nothing_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # of folders that this user may enter: of others the error is theirs
    plain = tmp_path / "plain"
    plain.write_text("no program")
    before = os.listdir("/proc/self/fd")
    with pytest.raises(FileNotFoundError):
        PlayerProcess(("no-such-program",))
    with pytest.raises(PermissionError):
        PlayerProcess((str(plain),))
    assert os.listdir("/proc/self/fd") == before


def test_a_child_that_is_killed_while_the_interpreter_exits_causes_no_error() -> None:
    """pyttsx3 stops its driver at that time. An error would hide the one that has ended the process."""
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


def test_a_child_has_three_streams_the_inherited_descriptors_and_its_leash() -> None:
    reading, writing = os.pipe()
    before = usage.descriptors(os.getpid())
    child = _run("kill -STOP $$", writing)
    # The files that a program opens while it is loaded are closed when it has stopped itself.
    os.waitid(os.P_PID, child.pid, os.WSTOPPED | os.WNOWAIT)
    its = usage.descriptors(child.pid)
    assert its.pop(1) == os.devnull
    assert its.pop(writing) == os.readlink(f"/proc/self/fd/{writing}")
    ours = {os.readlink(f"/proc/self/fd/{each.fileno()}") for each in (child.stdin, child.stderr, child._leash)}
    assert ours <= set(its.values())
    assert set(its.values()) - ours <= set(before.values()), "nothing else was opened for it"
    assert not os.get_inheritable(writing)
    child.kill()
    _status(child)
    assert usage.descriptors(os.getpid()) == before
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize("ends", [True, False], ids=["ended by itself", "killed"])
def test_all_that_a_child_has_started_ends_with_it(ends: bool) -> None:
    reading, writing = os.pipe()
    child = _run(f"sleep 100 & echo . >&2; {'exit 7' if ends else 'wait'}", writing)
    os.close(writing)
    os.set_blocking(child.stderr.fileno(), True)
    child.stderr.read(1)
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


def _leaving(then: str, *inherited: int) -> PlayerProcess:
    return PlayerProcess((sys.executable, "-S", "-c", _LEAVES.format(then=then)), inherited)


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


def test_a_player_finds_a_piece_at_a_time() -> None:
    player = ProgramPlayer(PlayerCommand("sleep", ("sleep", "100"), read_ahead=0))
    assert [player.offer(memoryview(bytes(882))) for _ in range(2)] == [882, 0]
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
        assert engine.spoken("battery low").outcome == protocol.OUTCOME_COMPLETED
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
from talkcli.engine.child.synthesizers import espeak
load_library = espeak.load_library
espeak.load_library = lambda: (*load_library()[:2], 16_000)
"""
    rates = player.heard.with_name("rates")
    program = player.plays(f"open({str(rates)!r}, 'a').write(sys.argv[2] + ' ')")
    with Spawned(f"{program} {{rate}}", before=before) as engine:
        assert engine.spoken("battery low").outcome == protocol.OUTCOME_COMPLETED
    assert set(rates.read_text().split()) == {"22050"}
    assert player.heard.read_bytes() == without_leading_zeros(render(["battery low"], rate=FAST)[0]).tobytes()


def test_all_that_a_player_has_started_dies_with_a_killed_process(tmp_path: Path) -> None:
    """Even programs that a shell has started behind itself. No sound comes to a player before it is tied."""
    begun, script = tmp_path / "begun", tmp_path / "pipeline"
    os.mkfifo(begun)
    script.write_text(f"#!/bin/sh\nsleep 100 &\nhead -c 1 > /dev/null\necho > {begun}\nwait\n")
    script.chmod(0o755)
    with Spawned(str(script)) as engine:
        engine.say("one two three")
        begun.read_text()
        os.kill(engine.process.pid, signal.SIGKILL)
        assert engine.all_gone()
