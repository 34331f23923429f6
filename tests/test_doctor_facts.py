"""How `talk doctor` gathers facts: programs that hang, leave children behind or are missing; files of the machine."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.doctor import machine, sound
from talkcli.doctor.machine import Cards, Session
from talkcli.doctor.sound import SoundServer
from tests.faults.broken import write
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from pathlib import Path

#: Of no user on this machine.
STRANGER = Session(4141, "stranger", groups=("4242",), gids=(4242,))
PW_NODES = """
\tid 31, type PipeWire:Interface:Node/3
 \t\tnode.name = "alsa_output.usb"
 \t\tmedia.class = "Audio/Sink"
\tid 32, type PipeWire:Interface:Node/3
 \t\tnode.name = "alsa_input.usb"
 \t\tmedia.class = "Audio/Source"
"""


def env_with(directory: Path, **scripts: str) -> dict[str, str]:
    """Return an environment with these programs and no others on its PATH."""
    for name, does in scripts.items():
        write(directory / name.replace("_", "-"), f"#!/bin/sh\n{does}\n", 0o755)
    return {"PATH": str(directory)}


def test_what_a_program_says_is_kept_and_its_complaint_is_one_line(tmp_path: Path) -> None:
    env = env_with(tmp_path, good='echo out; echo "$LC_ALL"', bad="echo; echo 'first line' >&2; echo more >&2; exit 3")
    killed = sound.asked("killed", env=env_with(tmp_path, killed="kill -ILL $$"))
    assert killed.trouble == "it was killed by SIGILL"
    good, bad = sound.asked("good", env=env), sound.asked("bad", env=env)
    assert good == sound.Said(None, "out\nC\n")
    assert bad == sound.Said("first line", "\n")
    assert sound.asked("missing", env=env) == sound.Said("missing is not there")
    write(tmp_path / "broken", "#!/no/such/interpreter\n", 0o755)
    assert "No such file" in str(sound.asked("broken", env=env).trouble)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
def test_a_program_that_hangs_is_killed_with_all_that_it_has_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sound, "LIMIT", 0.3)
    env = env_with(tmp_path, hangs=f"/bin/sleep 98 & echo $! > {tmp_path}/pid; /bin/sleep 98")
    began = time.monotonic()
    said = sound.asked("hangs", env=env)
    assert said.late
    assert said.trouble == "no answer within 0.3 s"
    assert time.monotonic() - began < 20
    child = int((tmp_path / "pid").read_text())
    end = time.monotonic() + 5
    while _runs(child):
        assert time.monotonic() < end, "what it has started goes on"
        time.sleep(0.01)  # the end of a process that is no child of ours is no event


def test_a_program_that_leaves_a_child_with_its_output_is_not_waited_for(tmp_path: Path) -> None:
    began = time.monotonic()
    said = sound.asked("leaves", env=env_with(tmp_path, leaves="echo out; /bin/sleep 2.7 &"))
    assert (said.out, said.late) == ("out\n", False)
    assert time.monotonic() - began < 2.7


def _runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_devices_are_named_as_their_player_names_them(tmp_path: Path) -> None:
    aplay = "printf 'null\\n    Discard\\ndefault\\n    Default\\nplughw:CARD=Device,DEV=0\\n    USB\\n'"
    pactl = "printf '0\\tusb\\tm.c\\ts16le 2ch 44100Hz\\tSUSPENDED\\n1\\thdmi\\tm.c\\ts16le 2ch 44100Hz\\tIDLE\\n'"
    env = env_with(tmp_path, aplay=aplay, pactl=pactl, pw_cli=f"/bin/cat <<'X'{PW_NODES}X")
    found = {each: sound.devices(env, each, None) for each in ("aplay", "pacat", "pw-cat")}
    assert {player: each and each.names for player, each in found.items()} == {
        "aplay": ("default", "plughw:CARD=Device,DEV=0"),
        "pacat": ("usb", "hdmi"),
        "pw-cat": ("alsa_output.usb",),
    }
    assert sound.devices(env, "my-player", None) is None
    assert sound.suspended(env) == ("usb",)


def test_devices_that_cannot_be_listed_say_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sound, "LIMIT", 0.3)
    env = env_with(tmp_path, aplay="exec /bin/sleep 98", pactl="echo Connection refused >&2; exit 1")
    troubles = [each.trouble for player in ("aplay", "pacat", "pw-cat") if (each := sound.devices(env, player, None))]
    assert troubles == ["no answer within 0.3 s", "Connection refused", None]


def test_a_sound_server_is_found_by_its_own_program_or_by_its_socket(tmp_path: Path) -> None:
    info = "printf 'Server Name: pulseaudio\\nDefault Sink: usb\\n'"
    (tmp_path / "one").mkdir()
    found = sound.sound_server(env_with(tmp_path / "one", pactl=info), STRANGER)
    assert (found.name, found.sink) == ("pulseaudio", "usb")
    (tmp_path / "two").mkdir()
    env = env_with(tmp_path / "two", pactl="echo Connection refused >&2; exit 1", pw_cli="exit 0")
    assert "PipeWire" in str(sound.sound_server(env, STRANGER).name)
    assert not sound.sound_server(env, STRANGER).pulse
    (tmp_path / "run" / "pulse").mkdir(parents=True)
    native = tmp_path / "run" / "pulse" / "native"
    native.touch()
    alone = {"PATH": "/nowhere", "XDG_RUNTIME_DIR": str(tmp_path / "run")}
    found = sound.sound_server(alone, STRANGER)
    assert (found.name, found.trouble, found.sockets) == (None, None, (str(native),))
    native.unlink()
    (tmp_path / "three").mkdir()
    wire = {**alone, **env_with(tmp_path / "three", pw_cli="exit 0")}
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(native))
        refused = sound.sound_server(wire, STRANGER)
        assert (refused.name, refused.pulse) == ("PipeWire, without its PulseAudio part", False)
        server.listen()
        assert sound.sound_server(wire, STRANGER) == SoundServer("PipeWire")
        assert sound.sound_server(alone, STRANGER) == SoundServer(f"one listens on {native}")


def test_how_loud_it_is_comes_from_the_mixer_that_is_in_charge(tmp_path: Path) -> None:
    server, cards = SoundServer(name="PipeWire"), Cards(kernel=True, names=("USB",))
    controls = "case $1 in scontrols) echo \"Simple mixer control 'Master',0\";; *) echo 'Mono: 0 [0%] [off]';; esac"
    env = env_with(tmp_path, amixer=controls, wpctl="echo 'Volume: 0.40 [MUTED]'")
    (alsa,) = sound.levels(env, SoundServer(), cards)
    assert (alsa.name, alsa.muted, alsa.unmute) == ("Master", True, "amixer sset Master unmute")
    (wire,) = sound.levels(env, server, cards)
    assert (wire.muted, wire.percent, wire.unmute) == (True, 40, "wpctl set-mute @DEFAULT_AUDIO_SINK@ 0")
    env = env_with(
        tmp_path, pactl="case $1 in get-sink-mute) echo Mute: no;; *) echo 'Volume: mono: 9 / 30% / x';; esac"
    )
    (pulse,) = sound.levels(env, server, cards)
    assert (pulse.muted, pulse.percent, pulse.louder) == (False, 30, "pactl set-sink-volume @DEFAULT_SINK@ 70%")
    assert sound.levels(env, SoundServer(), Cards(kernel=False)) == ()
    assert sound.levels(env, SoundServer(hangs=True), cards) == ()


def test_cards_and_who_may_open_them(tmp_path: Path) -> None:
    kernel, nodes = tmp_path / "asound", tmp_path / "snd"
    kernel.mkdir()
    nodes.mkdir()
    text = " 0 [Device         ]: USB-Audio - USB Audio Device\n                      C-Media at usb-1\n"
    write(kernel / "cards", text)
    for name, mode in (("pcmC0D0p", 0o660), ("pcmC0D0c", 0o660), ("pcmC1D0p", 0o666)):
        write(nodes / name, "", mode)
    found = machine.cards(STRANGER, str(kernel), str(nodes))
    assert found.names == ("USB Audio Device",)
    assert found.nodes == (f"{nodes}/pcmC0D0p", f"{nodes}/pcmC1D0p")
    assert found.forbidden == (f"{nodes}/pcmC0D0p",), "others may open the second one, by its mode"
    group = os.stat(nodes / "pcmC0D0p").st_gid
    member = Session(4141, "member", gids=(group,))
    assert machine.cards(member, str(kernel), str(nodes)).forbidden == ()
    assert machine.cards(Session(0, "root"), str(kernel), str(nodes)).forbidden == ()
    assert machine.cards(STRANGER, str(tmp_path / "gone"), str(tmp_path / "gone")) == Cards(kernel=False, group="audio")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
def test_a_server_of_the_same_user_is_looked_at_in_its_own_surroundings(tmp_path: Path) -> None:
    env = clean_environment(str(tmp_path), {"XDG_RUNTIME_DIR": str(tmp_path), "SSH_CONNECTION": "1 2 3 4"})
    with subprocess.Popen(["sleep", "98"], env=env) as process:
        try:
            end = time.monotonic() + 5
            while machine._environment(process.pid) != env:  # it is another program's until it has begun
                assert time.monotonic() < end
            found, seen = machine.surroundings(process.pid)
            assert seen == env
            assert (found.server, found.uid, found.runtime) == (process.pid, os.getuid(), str(tmp_path))
            assert found.runtime_owner == os.getuid()
            assert "an ssh session" in found.kinds
            assert set(found.gids) == {os.getegid(), *os.getgroups()}
        finally:
            process.kill()
    found, seen = machine.surroundings(None)
    assert (found.server, seen) == (None, dict(os.environ))
