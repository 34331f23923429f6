"""Players that fail, each in its own way: never a sentence that counts as spoken, never a hang, always the error."""

from __future__ import annotations

import os
import re
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import playback, protocol
from tests.engine.programs import NEVER_READS, PLAYS, SWALLOWS, Player
from tests.engine.spawned import SOON, Spawned
from tests.support.processes import children
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


def _failure(command: str, **limits: float) -> tuple[str | None, str | None]:
    with Spawned(command, limits=limits) as engine:
        ended = engine.spoken(TEXT)
        assert ended.outcome == protocol.FAILED
        assert children(engine.process.pid) == []
        return ended.reason, ended.message


def _assert_all_taken(player: Player, ended: protocol.Ended) -> None:
    assert ended.outcome == protocol.COMPLETED
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
        ("", None, "audio_lost", "player ended before the sound did"),
        (_plays("if taken > 8000: sys.exit(0)"), None, "audio_lost", "player ended before the sound did"),
        (_plays("if taken > 8000: sys.exit(3)"), None, "audio_lost", "player exited with status 3"),
        (_plays(UNDERRUNS), None, "audio_lost", "aplay: write error: No such device"),
        (SWALLOWS, None, "audio_lost", r"player ended \d\.\d s before the sound did"),
        (_plays(after='sys.exit("drain failed: Broken pipe")'), None, "audio_lost", "drain failed: Broken pipe"),
        (
            _plays("if taken > 8000: os.close(0); time.sleep(100)"),
            *(None, "audio_lost", "player closed its input before the sound was over"),
        ),
        (NEVER_READS, "FIRST_WITHIN", "audio_stalled", "player took no sound for 0.4 s"),
        (
            _plays("if taken > 8000: time.sleep(100)"),
            *("STALLED_AFTER", "audio_stalled", "player took no sound for 0.4 s"),
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
    reason, message = _failure(player.plays(after="time.sleep(100)"), DRAIN_WITHIN=0.3)
    assert (reason, message) == ("audio_stalled", "player did not end 0.3 s after the sound")


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
        assert time.monotonic() - began >= playback.BUSY_FOR
        assert_within(time.monotonic() - began, playback.BUSY_FOR + 1, "the end of a goal whose device is held")
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
    assert _failure("'unbalanced") == ("no_player", 'player command "\'unbalanced": no closing quotation')
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
        assert engine.spoken("yes", "g2").outcome == protocol.COMPLETED
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
