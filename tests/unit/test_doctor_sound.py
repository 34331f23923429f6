"""What `talk doctor` makes of facts about sound: each fault of a robot's is named, with the one thing to do."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.doctor import machine, sound
from talkcli.doctor.machine import Cards, Session
from talkcli.doctor.report import FAILED, OK, WARNING, Finding, failed
from talkcli.doctor.sound import Devices, Level, Players, SoundServer
from talkcli.engine.players.devices import DUMMY
from talkcli.frozen import replace
from tests.faults.broken import write

if TYPE_CHECKING:
    from pathlib import Path

PI = Session(1000, "pi", groups=("pi", "audio"), gids=(1000, 29), runtime="/run/user/1000", runtime_owner=1000)
PLAYERS = Players(("aplay", "pacat"), None)
DEVICES = Devices("aplay -L", ("default", "plughw:CARD=Device,DEV=0"))
CARDS = Cards(kernel=True, names=("USB Audio Device",), nodes=("/dev/snd/pcmC0D0p",), group="audio")
NO_CARDS = Cards(kernel=True)
NO_SERVER = SoundServer(trouble="Connection refused")
WIRE = SoundServer("PipeWire, without its PulseAudio part", pulse=False)
PULSE = SoundServer(name="PulseAudio (on PipeWire 1.2.7)", sink="alsa_output.usb")


def judged(
    check: str,
    players: Players = PLAYERS,
    devices: Devices | None = DEVICES,
    cards: Cards = CARDS,
    server: SoundServer = NO_SERVER,
    session: Session = PI,
    *,
    running: bool = False,
) -> Finding:
    found = sound.judge(players, devices, cards, server, session, running=running)
    return next(each for each in found if each.check == check)


def test_a_robot_with_a_card_and_nothing_else_is_well() -> None:
    found = sound.judge(PLAYERS, DEVICES, CARDS, SoundServer(), PI, running=False)
    assert [each.check for each in found] == ["player", "device", "cards", "group", "sound server"]
    assert {each.state for each in found} == {OK}, found
    assert found[0].message == "aplay is used; then pacat"


def test_a_sound_server_that_answers_is_played_to_without_a_program() -> None:
    assert judged("player", server=PULSE).message == "pulse is used, by the sound server; then aplay, pacat"
    alone = judged("player", Players((), None), server=PULSE)
    assert (alone.state, alone.message) == (OK, "pulse is used, by the sound server")
    assert judged("player", Players((), "pulse"), server=PULSE, running=True).message == "pulse (the server's)"
    assert judged("player", server=WIRE).message == "aplay is used; then pacat"
    # What an engine process has chosen counts more than what the sound server says.
    chosen = replace(PLAYERS, first="aplay")
    assert judged("player", chosen, server=PULSE).message == "aplay is used; then pacat"
    assert judged("player", replace(PLAYERS, first="pulse"), server=WIRE).message.startswith("pulse is used")


def test_a_sound_server_with_a_dummy_alone_is_heard_by_nobody() -> None:
    found = judged("sound server", server=replace(PULSE, sink=DUMMY))
    assert (found.state, found.next) == (
        WARNING, "plug in a loudspeaker, and look whether it is there: pactl list short sinks"
    )  # fmt: skip
    assert "has only a dummy output, auto_null: nobody hears it" in found.message


def test_no_player_names_the_package() -> None:
    found = judged("player", Players((), None))
    assert (found.state, found.next) == (FAILED, "sudo apt-get install -y alsa-utils")
    assert judged("player", Players((), None), running=True).state == WARNING


def test_a_player_that_is_set_and_not_there_is_named() -> None:
    found = judged("player", Players(("aplay",), "pw-cat", runs=False))
    assert (found.state, found.next) == (FAILED, "sudo apt-get install -y pipewire-bin")
    found = judged("player", Players(("aplay",), "/opt/play", runs=False))
    assert found.state == FAILED
    assert "/opt/play (TALK_PLAYER)" in found.message


@pytest.mark.parametrize("player", ["null", "file:/tmp/x.wav"])
def test_a_player_without_sound_is_not_heard(player: str) -> None:
    found = sound.judge(Players((), player), None, CARDS, PULSE, PI, running=True)
    assert [each.state for each in found] == [FAILED]
    assert found == sound.judge_silent(player, running=True)
    assert sound.judge_silent("aplay", running=True) == []


def test_a_device_is_looked_for_among_those_that_the_player_lists() -> None:
    assert judged("device", devices=replace(DEVICES, wanted="default")).state == OK
    assert judged("device", devices=replace(DEVICES, wanted="plughw:1,0")).state == OK
    found = judged("device", devices=replace(DEVICES, wanted="robot_speaker"))
    assert found.state == WARNING
    assert "robot_speaker is not among" in found.message
    assert "plughw:CARD=Device,DEV=0" in found.message
    assert judged("device", devices=Devices("aplay -L")).state == WARNING
    assert "no answer" in judged("device", devices=Devices("aplay -L", trouble="no answer")).message


def test_devices_that_no_program_can_list_are_a_fault_only_if_one_is_named() -> None:
    unlisted = Devices("pactl list short sinks", package="pulseaudio-utils")
    assert judged("device", devices=unlisted).state == OK
    found = judged("device", devices=replace(unlisted, wanted="usb"))
    assert (found.state, found.next) == (WARNING, "sudo apt-get install -y pulseaudio-utils")


def test_a_step_that_takes_pactl_says_where_it_comes_from(tmp_path: Path) -> None:
    muted = failed("loudness", "muted", "pactl set-sink-mute @DEFAULT_SINK@ 0")
    without = {"PATH": str(tmp_path)}
    step = f"{muted.next} (for pactl: sudo apt-get install -y pulseaudio-utils)"
    assert sound.installing(muted, without).next == step
    other = failed("socket", "no server", "talk serve")
    assert sound.installing(other, without) == other
    write(tmp_path / "pactl", "", 0o755)
    assert sound.installing(muted, without) == muted


def test_no_device_is_named_with_what_to_plug_in_or_to_hand_in() -> None:
    found = judged("cards", cards=NO_CARDS)
    assert (found.state, "plug in" in str(found.next)) == (WARNING, True)
    found = judged("cards", cards=NO_CARDS, session=replace(PI, kinds=("a container",)))
    assert "--device /dev/snd" in str(found.next)
    assert judged("cards", cards=NO_CARDS, server=PULSE).state == OK


def test_no_permission_for_the_device_names_the_group_and_the_user() -> None:
    stranger = replace(PI, groups=("pi",), gids=(1000,))
    forbidden = replace(CARDS, forbidden=CARDS.nodes)
    found = judged("group", cards=forbidden, session=stranger)
    assert found.state == WARNING
    assert "user pi may not open /dev/snd/pcmC0D0p" in found.message
    assert found.next == "sudo usermod -aG audio pi, and log in again"
    found = judged("group", cards=replace(forbidden, from_next_login=True), session=stranger)
    assert found.next == "log out and in again"
    assert judged("group", cards=forbidden, session=stranger, server=PULSE).state == OK, "it opens them"


@pytest.mark.parametrize(
    ("change", "step"),
    [
        ({"kinds": ("a container",)}, "PULSE_SERVER"),
        ({"kinds": ("a system service",)}, "--print-unit user"),
        ({"uid": 0, "sudo_uid": 1000}, "leave sudo out"),
        ({"runtime": None, "usual_runtime": "/run/user/1000"}, "export XDG_RUNTIME_DIR=/run/user/1000"),
        ({}, "systemctl --user restart"),
    ],
)
def test_why_a_sound_server_is_out_of_reach_depends_on_where_this_runs(change: dict[str, object], step: str) -> None:
    server = replace(NO_SERVER, sockets=("/run/user/1000/pulse/native",))
    found = judged("sound server", server=server, session=replace(PI, **change))
    assert found.state == WARNING
    assert "/run/user/1000/pulse/native cannot be reached from here: Connection refused" in found.message
    assert step in str(found.next)


def test_a_sound_server_that_hangs_or_is_named_wrongly_or_cannot_be_asked() -> None:
    assert "does not answer" in judged("sound server", server=SoundServer(hangs=True)).message
    assert "unset PULSE_SERVER" in str(
        judged("sound server", server=SoundServer(named="unix:/x", trouble="refused")).next
    )
    found = judged("sound server", server=SoundServer(sockets=("/run/user/1000/pipewire-0",)))
    assert found.next == "sudo apt-get install -y pulseaudio-utils"
    service = judged("sound server", server=SoundServer(), cards=NO_CARDS, session=replace(PI, kinds=("a cron job",)))
    assert service.state == WARNING


def test_without_a_runtime_directory_the_session_says_what_to_set() -> None:
    found = machine.judge_session(replace(PI, runtime=None, runtime_owner=None, usual_runtime="/run/user/1000"))
    assert (found.state, found.next) == (WARNING, "export XDG_RUNTIME_DIR=/run/user/1000")
    assert "cron, sudo" in found.message
    served = machine.judge_session(replace(PI, runtime=None, usual_runtime="/run/user/1000", server=7))
    assert "where the server is started" in str(served.next)
    assert machine.judge_session(replace(PI, runtime=None)).state == OK
    assert "not there" in machine.judge_session(replace(PI, runtime_owner=None)).message
    assert "uid 33's" in machine.judge_session(replace(PI, runtime_owner=33)).message


def test_what_is_muted_is_not_heard() -> None:
    def level(name: str, text: str) -> Level:
        return sound.level_of(name, text, f"unmute {name}", f"{name} 70%")

    pulse = level("sink", "Mute: yes\nVolume: mono: 65536 / 100% / 0.00 dB\n")
    assert (pulse.muted, pulse.percent) == (True, 100)
    wire = level("sink", "Volume: 0.05\n")
    assert (wire.muted, wire.percent) == (False, 5)
    assert level("sink", "Volume: 0.40 [MUTED]\n").muted
    alsa = level("Master", "  Front Left: Playback 0 [0%] [-65.25dB] [off]\n  Front Right: 9 [40%] [on]\n")
    assert (alsa.muted, alsa.percent) == (False, 40)
    off = level("Master", "  Mono: Playback 0 [0%] [-65.25dB] [off]\n")
    assert sound.judge_levels((alsa, off), default=True)[0].next == "unmute Master"
    assert sound.judge_levels((pulse,), default=True)[0].state == FAILED
    assert sound.judge_levels((pulse,), default=False)[0].state == WARNING, "another device is played to"
    assert sound.judge_levels((wire,), default=True)[0].state == WARNING
    assert sound.judge_levels((replace(wire, percent=0),), default=True)[0].state == FAILED
    assert sound.judge_levels((alsa,), default=True)[0].state == OK
    assert sound.judge_levels((), default=True) == []


def test_a_player_is_a_user_s_own_where_its_program_is_another() -> None:
    assert all(map(sound.is_custom, ("sleep 100", "/opt/bin/play -x", "false")))
    assert not any(map(sound.is_custom, ("/usr/bin/aplay -q", "pacat", "null", "file:a.wav", "'", "", None)))
