"""Players that fail, each in its own way: never a sentence that counts as spoken, never a hang, always the error."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import playback, protocol
from tests.engine.spawned import SOON, Spawned
from tests.support.processes import children
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

TEXT = "battery low, please come home"

#: A player that takes sound in real time, holds 60 ms of it, and writes what it took to the file in its first argument.
PLAYS = """
import os, sys, time
heard = open(sys.argv[1], "ab", buffering=0)
began, taken = None, 0
while data := os.read(0, 882):
    began = began or time.monotonic()
    taken += len(data)
    heard.write(data)
    {during}
    time.sleep(max(0, began + taken / 44100 - 0.06 - time.monotonic()))
time.sleep(0.06)
{after}
"""


@pytest.fixture
def player(tmp_path: Path) -> Player:
    return Player(tmp_path)


class Player:
    """Makes player programs out of Python code."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.heard = folder / "heard"

    def program(self, code: str, name: str = "player") -> Path:
        path = self._folder / name
        path.write_text(f"#!{sys.executable} -S\n{code}")
        path.chmod(0o755)
        return path

    def command(self, code: str) -> str:
        return f"{self.program(code)} {self.heard}"

    def plays(self, during: str = "pass", after: str = "") -> str:
        return self.command(PLAYS.format(during=during, after=after))


def _failure(command: str, **limits: float) -> tuple[str | None, str | None]:
    with Spawned(command, limits=limits) as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken(TEXT)
        assert ended.outcome == protocol.FAILED
        assert children(engine.process.pid) == []
        return ended.reason, ended.message


def test_a_good_player_gets_every_sample(player: Player) -> None:
    with Spawned(player.plays()) as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken(TEXT)
        assert ended.outcome == protocol.COMPLETED
        assert ended.duration is not None
        assert player.heard.stat().st_size == round(ended.duration * 22050) * 2
        assert len(engine.words()) == 5


def test_underruns_are_no_error(player: Player) -> None:
    with Spawned(player.plays('print("underrun!!! (at least 0.1 ms long)", file=sys.stderr)')) as engine:
        engine.until(protocol.Ready)
        assert engine.spoken(TEXT).outcome == protocol.COMPLETED


def test_underruns_do_not_hide_the_error(player: Player) -> None:
    during = """
    print("underrun!!! (at least 0.1 ms long)" * 50, file=sys.stderr)
    if taken > 8000:
        sys.exit("aplay: pcm_write:2061: write error: No such device")
"""
    assert _failure(player.plays(during)) == ("audio_lost", "aplay: write error: No such device")


def test_exits_1_at_once(player: Player) -> None:
    assert _failure(player.command("raise SystemExit(1)")) == ("audio_device", "player exited with status 1")


def test_exits_1_with_a_line_and_a_dump_after_it(player: Player) -> None:
    code = """
import sys
sys.stderr.write("ALSA lib pcm.c:2660:(snd_pcm_open_noupdate) Unknown PCM cards.pcm.default\\n")
sys.stderr.write("aplay: main:831: audio open error: No such file or directory\\n")
sys.exit("ACCESS: RW_INTERLEAVED\\nBUFFER_SIZE: [1 2]")
"""
    assert _failure(player.command(code)) == ("audio_device", "aplay: audio open error: No such file or directory")


#: Finds the device held by another, so many times.
BUSY = """
import os, sys
with open("{tries}", "a") as tries:
    tries.write(".")
if os.path.getsize("{tries}") <= {times}:
    sys.exit("aplay: main:831: audio open error: Device or resource busy")
"""


@pytest.mark.parametrize("times", [1, 4, 1000])
def test_a_device_that_is_busy_is_tried_again_for_a_while(player: Player, times: int, tmp_path: Path) -> None:
    command = player.command(BUSY.format(tries=tmp_path / "tries", times=times) + PLAYS.format(during="pass", after=""))
    if times < 1000:
        with Spawned(command) as engine:
            engine.until(protocol.Ready)
            ended = engine.spoken(TEXT)
            assert ended.outcome == protocol.COMPLETED
            assert player.heard.stat().st_size == round((ended.duration or 0) * 22050) * 2
        return
    with limits():
        began = time.monotonic()
        assert _failure(command) == ("audio_device", "aplay: audio open error: Device or resource busy")
        assert time.monotonic() - began >= playback.BUSY_FOR
        assert_within(time.monotonic() - began, playback.BUSY_FOR + 1, "the end of a goal whose device is held")


def test_a_goal_whose_device_is_busy_is_stopped_at_once(player: Player, tmp_path: Path) -> None:
    with Spawned(player.command(BUSY.format(tries=tmp_path / "tries", times=1000))) as engine:
        engine.until(protocol.Ready)
        engine.say(TEXT)
        while not (tmp_path / "tries").exists():
            time.sleep(0.005)  # what a player does is no event
        engine.send(protocol.Stop("g1"))
        assert engine.until(protocol.Ended) == protocol.Ended("g1", protocol.STOPPED)


def test_exits_0_at_once(player: Player) -> None:
    assert _failure(player.command("")) == ("audio_lost", "player ended before the sound did")


def test_exits_0_in_mid_sentence(player: Player) -> None:
    during = "if taken > 8000: sys.exit(0)"
    assert _failure(player.plays(during)) == ("audio_lost", "player ended before the sound did")


def test_exits_1_in_mid_sentence(player: Player) -> None:
    during = "if taken > 8000: sys.exit(3)"
    assert _failure(player.plays(during)) == ("audio_lost", "player exited with status 3")


def test_swallows_everything_and_exits_0_too_early(player: Player) -> None:
    reason, message = _failure(player.command("import os\nwhile os.read(0, 65536): pass"))
    assert reason == "audio_lost"
    assert message is not None
    assert message.startswith("player ended ")
    assert message.endswith(" s before the sound did")


def test_exits_1_after_it_took_everything(player: Player) -> None:
    after = 'sys.exit("drain failed: Broken pipe")'
    assert _failure(player.plays(after=after)) == ("audio_lost", "drain failed: Broken pipe")


def test_closes_its_input_and_stays(player: Player) -> None:
    reason, message = _failure(player.plays("if taken > 8000: os.close(0); time.sleep(100)"))
    assert (reason, message) == ("audio_lost", "player closed its input before the sound was over")


def test_never_reads(player: Player) -> None:
    began = time.monotonic()
    reason, message = _failure(player.command("import time\ntime.sleep(100)"), FIRST_WITHIN=0.5)
    assert (reason, message) == ("audio_stalled", "player took no sound for 0.5 s")
    assert time.monotonic() - began < 5


def test_stalls_in_mid_sentence(player: Player) -> None:
    reason, message = _failure(player.plays("if taken > 8000: time.sleep(100)"), STALLED_AFTER=0.4)
    assert (reason, message) == ("audio_stalled", "player took no sound for 0.4 s")


def test_hangs_in_drain(player: Player) -> None:
    reason, message = _failure(player.plays(after="time.sleep(100)"), DRAIN_WITHIN=0.3)
    assert (reason, message) == ("audio_stalled", "player did not end 0.3 s after the sound")


def test_killed_in_mid_sentence(player: Player) -> None:
    with Spawned(player.plays()) as engine:
        engine.until(protocol.Ready)
        engine.say(TEXT)
        engine.until(protocol.Word)
        engine.until(protocol.Word)
        (pid,) = children(engine.process.pid)
        os.kill(pid, signal.SIGKILL)
        ended = engine.until(protocol.Ended)
        assert (ended.reason, ended.message) == ("audio_lost", "player was killed by SIGKILL")
        assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED


def test_a_stop_leaves_no_process(player: Player) -> None:
    with limits(), Spawned(player.plays()) as engine:
        engine.until(protocol.Ready)
        for number in range(3):
            engine.say("one two three four five six seven eight", f"g{number}")
            engine.until(protocol.Word)
            asked = time.monotonic()
            engine.send(protocol.Stop(f"g{number}"))
            assert engine.until(protocol.Ended).outcome == protocol.STOPPED
            assert_within(time.monotonic() - asked, 0.02, "the stop")
            assert children(engine.process.pid) == []


def test_a_stop_ends_a_player_that_never_reads(player: Player) -> None:
    with limits(), Spawned(player.command("import time\ntime.sleep(100)"), alive_every=SOON) as engine:
        engine.until(protocol.Ready)
        engine.say(TEXT)
        engine.until(protocol.Alive)
        asked = time.monotonic()
        engine.send(protocol.Stop("g1"))
        assert engine.until(protocol.Ended).outcome == protocol.STOPPED
        assert_within(time.monotonic() - asked, 0.02, "the stop")
        assert engine.words() == []


def test_no_word_is_reported_while_the_player_stands_still(player: Player) -> None:
    stall = 0.5
    with Spawned(player.plays(f"if 13000 < taken < 13900: time.sleep({stall}); began += {stall}")) as engine:
        engine.until(protocol.Ready)
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


def test_a_missing_program_is_named() -> None:
    assert _failure("/nonexistent/player --rate {rate}") == ("no_player", 'player "/nonexistent/player" not found')
    assert _failure("'unbalanced") == ("no_player", 'player command "\'unbalanced": no closing quotation')


def test_a_program_that_cannot_be_run_is_named(tmp_path: Path) -> None:
    path = tmp_path / "garbage"
    path.write_bytes(b"\x7fELF garbage")
    path.chmod(0o755)
    reason, message = _failure(str(path))
    assert reason == "no_player"
    assert message is not None
    assert message.startswith("garbage cannot be started: ")


def test_rate_and_device_reach_the_command(player: Player) -> None:
    code = f"import sys\nopen({str(player.heard)!r}, 'w').write(' '.join(sys.argv[1:]))"
    with Spawned(f"{player.program(code)} {{rate}} --dev={{device}}", device="hw:1") as engine:
        engine.until(protocol.Ready)
        engine.spoken(TEXT)
    assert player.heard.read_text() == "22050 --dev=hw:1"


def test_the_next_player_is_tried_with_the_whole_sentence(player: Player, tmp_path: Path) -> None:
    player.program("import sys\nsys.exit('aplay: main:831: audio open error: Host is down')", "aplay")
    good = PLAYS.format(during="pass", after="").replace("sys.argv[1]", repr(str(player.heard)))
    player.program(good, "pacat")
    with Spawned(None, environment={"PATH": str(tmp_path)}) as engine:
        assert engine.until(protocol.Ready).player == "aplay"
        ended = engine.spoken(TEXT)
        assert ended.outcome == protocol.COMPLETED
        assert ended.duration is not None
        assert player.heard.stat().st_size == round(ended.duration * 22050) * 2
        assert len(engine.words()) == 5
        assert ended.player == "pacat"
        # It worked, so it is the first next time: the failing one would have left a mark.
        player.program(f"open({str(tmp_path / 'mark')!r}, 'w')", "aplay")
        assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED
        assert not (tmp_path / "mark").exists()


def test_where_all_players_fail_the_first_one_is_quoted(player: Player, tmp_path: Path) -> None:
    player.program("import sys\nsys.exit('aplay: main:831: audio open error: Host is down')", "aplay")
    player.program("import sys\nsys.exit('Connection failure: Connection refused')", "pacat")
    with Spawned(None, environment={"PATH": str(tmp_path)}) as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken(TEXT)
        assert (ended.reason, ended.message) == ("audio_device", "aplay: audio open error: Host is down")


def test_a_player_that_took_sound_is_not_replaced(player: Player, tmp_path: Path) -> None:
    during = "if taken > 8000: sys.exit('write error: No such device')"
    code = PLAYS.format(during=during, after="").replace("sys.argv[1]", repr(str(player.heard)))
    player.program(code, "aplay")
    player.program(f"open({str(tmp_path / 'mark')!r}, 'w')", "pacat")
    with Spawned(None, environment={"PATH": str(tmp_path)}) as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken(TEXT)
        assert (ended.reason, ended.message) == ("audio_lost", "write error: No such device")
        assert not (tmp_path / "mark").exists()


def test_no_player_at_all_says_what_to_install(tmp_path: Path) -> None:
    with Spawned(None, environment={"PATH": str(tmp_path)}) as engine:
        assert engine.until(protocol.Ready).player is None
        ended = engine.spoken(TEXT)
        assert ended.reason == "no_player"
        wanted = "no player found: install alsa-utils (aplay), pulseaudio-utils (pacat) or pipewire-bin (pw-cat)"
        assert ended.message == wanted


def test_no_descriptor_is_left_over(player: Player) -> None:
    with Spawned(player.command("raise SystemExit(1)")) as engine:
        engine.until(protocol.Voices)  # they are read from files, once
        engine.spoken(TEXT, "g0")
        before = os.listdir(f"/proc/{engine.process.pid}/fd")
        for number in range(1, 6):
            engine.spoken(TEXT, f"g{number}")
        assert os.listdir(f"/proc/{engine.process.pid}/fd") == before


@pytest.mark.parametrize("status", [0, 1])
def test_what_a_player_leaves_behind_when_it_ends_is_ended(tmp_path: Path, status: int) -> None:
    script = tmp_path / "pipeline.sh"
    # Both ends of its input stay open: nobody but us would end what it has started.
    script.write_text(f"sleep 60 <&0 & echo $! > {tmp_path}/child; exit {status}\n", "utf-8")
    with Spawned(f"sh {script}") as engine:
        engine.until(protocol.Ready)
        ended = engine.spoken(TEXT)
        assert (ended.outcome, ended.reason) == (protocol.FAILED, "audio_device" if status else "audio_lost")
        child = int((tmp_path / "child").read_text("utf-8"))
        end = time.monotonic() + 1
        while os.path.exists(f"/proc/{child}/exe"):  # a dead one that waits to be reaped by others has none
            assert time.monotonic() < end, "what the player had started goes on"
            time.sleep(0.005)  # the end of somebody else's child is no event


def test_what_a_player_has_started_is_silent_with_it(tmp_path: Path) -> None:
    script = tmp_path / "pipeline.sh"
    script.write_text(f"sleep 60 & echo $! > {tmp_path}/child; cat > /dev/null; wait\n", "utf-8")
    with Spawned(f"sh {script}") as engine:
        engine.until(protocol.Ready)
        engine.say(TEXT, "g1")
        engine.until(protocol.Word)
        child = int((tmp_path / "child").read_text("utf-8"))
        descriptor = os.pidfd_open(child)
        try:
            engine.send(protocol.Stop("g1"))
            assert engine.until(protocol.Ended).outcome == protocol.STOPPED
            assert select.select([descriptor], [], [], 0.1)[0], "what the player had started goes on"
        finally:
            os.close(descriptor)
