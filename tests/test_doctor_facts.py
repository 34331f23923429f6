"""How `talk doctor` examines sockets, engine processes, programs and system files."""

from __future__ import annotations

import grp
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import espeakng_loader
import pytest

from talkcli.client.connection import SocketConnection
from talkcli.doctor import server, sound, voice
from talkcli.doctor.report import FAILURE, OK, WARNING
from talkcli.doctor.sound import ProgramOutput, SoundServer, UserSession
from talkcli.frozen import replace
from tests.conformance.bareserve import environment, serving
from tests.conformance.rawsocket import FakeServer
from tests.faults.broken import write
from tests.faults.test_users import NOBODY, impostor
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.doctor.report import Finding
    from tests.conftest import MakeTalk

#: A user without access to this machine's sound.
STRANGER = UserSession(4141, "stranger", gids=(4242,))
PW_NODES = """
\tid 31, type PipeWire:Interface:Node/3
 \t\tnode.name = "alsa_output.usb"
 \t\tmedia.class = "Audio/Sink"
\tid 32, type PipeWire:Interface:Node/3
 \t\tnode.name = "alsa_input.usb"
 \t\tmedia.class = "Audio/Source"
"""


# Sockets


@pytest.fixture
def home(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return a directory that contains all usual socket paths, except the system's."""
    with short_directory() as path:
        os.makedirs(f"{path}/run/talk", 0o700)
        monkeypatch.setenv("TMPDIR", path)
        monkeypatch.setenv("XDG_RUNTIME_DIR", f"{path}/run")
        yield path


def no_server(named: str | None = None) -> Finding:
    """Return the finding about the missing server. `named` is the value of TALK_SOCKET."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TALK_SOCKET", named or "")
        client, finding = server.connect(None, None)
    assert client is None
    assert finding.state == FAILURE
    return finding


@pytest.mark.usefixtures("nobody_serves")
def test_the_state_of_each_usual_socket_path_is_described(home: str) -> None:
    path = f"{home}/run/talk/talk.sock"

    def check(message: str, step: str) -> None:
        finding = no_server()
        others = ("/run/talk/talk.sock: not found", f"{home}/runtime-{os.getuid()}/talk/talk.sock: not found")
        assert [part for part in (f"{path}: {message}", *others) if part not in finding.message] == []
        assert finding.next == step

    check("not found", "talk serve")
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(path)
    check("no server responds (left over from an earlier server)", "talk serve (it replaces the old socket)")
    os.unlink(path)
    write(Path(path), "")
    check("a file, not a socket", f"remove {path}, and run: talk serve")


@pytest.mark.usefixtures("nobody_serves")
def test_a_talk_socket_that_is_a_directory_is_reported(home: str) -> None:
    finding = no_server(f"{home}/run")
    assert f"{home}/run: a directory, not" in finding.message
    assert finding.next == f"name the socket in this directory: TALK_SOCKET={home}/run/talk.sock"


@pytest.mark.usefixtures("nobody_serves")
@pytest.mark.parametrize(
    ("greeting", "message", "step"),
    [
        ("220 mail ready", "is not a talk server", "restart the server on"),
        ('{"talk": 2, "version": "9"}', "upgrade", "install the same version of talk"),
        ('{"talk": 1, "error": "permission_denied"}', "refused", "--socket-mode 0660"),
    ],
)
def test_a_process_that_admits_no_client_is_reported(home: str, greeting: str, message: str, step: str) -> None:
    with FakeServer(f"{home}/s", [f"{greeting}\n".encode()], closes=True):
        finding = no_server(f"{home}/s")
    assert message in finding.message
    assert step in str(finding.next)


@pytest.mark.usefixtures("nobody_serves")
def test_a_stopped_or_full_server_is_reported(make_talk: MakeTalk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SocketConnection, "open", partial(SocketConnection.open, patience_s=0.2))
    talk = make_talk("--max-clients", "1", scripted=True, watched=False)
    with talk.connect() as wire:
        assert wire.request("hello")["ok"]
        assert "--max-clients" in str(no_server(talk.socket).next)
    talk.freeze()
    finding = no_server(talk.socket)
    talk.thaw()
    assert finding.message.endswith(f"{talk.socket}: a stopped process is listening")
    assert finding.next == f"continue the process: kill -CONT {talk.pid}"


@pytest.mark.usefixtures("nobody_serves")
def test_a_wrong_talk_socket_is_reported_with_the_running_server(home: str) -> None:
    os.chmod(f"{home}/run", 0o700)
    with serving(environment(home, XDG_RUNTIME_DIR=f"{home}/run")):
        finding = no_server(f"{home}/wrong")
    assert f"TALK_SOCKET names {home}/wrong: not found" in finding.message
    assert finding.next == f"unset TALK_SOCKET, because a server is running on {home}/run/talk/talk.sock"


@pytest.mark.usefixtures("nobody_serves")
@pytest.mark.skipif(
    os.getuid() != 0 or shutil.which("setpriv") is None, reason="only root can act as other users (and setpriv)"
)
def test_another_users_server_is_reported_and_receives_no_data(home: str) -> None:
    os.chmod(home, 0o755)
    os.chmod(f"{home}/run", 0o755)
    os.chmod(f"{home}/run/talk", 0o777)
    path = f"{home}/run/talk/talk.sock"
    with impostor(path) as heard:
        finding = no_server()
        assert heard() == b"b''\n", "it hung up without sending anything"
    assert f"{path}: another user's server (uid {NOBODY})" in finding.message
    assert f"if you trust uid {NOBODY}, run: talk --socket {path} doctor" in str(finding.next)


# Engine processes


def engine_fault(directory: Path, named: str | None = None) -> Finding:
    """Return the fault of an engine process that searches this directory first for modules and libraries."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(directory)
        env = environment(str(directory), LD_LIBRARY_PATH=str(directory))
        finding = voice.judge_engine(
            "2.99", voice.probe_engine(voice.EngineOptions(voice=named, env=env)), server_engine=None
        )[-1]
    assert finding.state == FAILURE
    return finding


def test_the_reason_why_an_engine_cannot_start_is_reported(tmp_path: Path) -> None:
    finding = engine_fault(tmp_path, "klingon-7")
    assert (finding.check, 'unknown voice "klingon-7"' in finding.message) == ("voices", True)
    (tmp_path / "libespeak-ng.so.1").write_bytes(b"no library")
    library = os.path.join(os.path.dirname(espeakng_loader.__file__), "libespeak-ng.so")
    for name, text, message in (
        ("espeakng_loader", "raise ModuleNotFoundError('', name='espeakng_loader')", "libespeak-ng is missing"),
        (
            "espeakng_loader",
            f"get_library_path = lambda: {library!r}\nget_data_path = str",
            "espeak-ng data is missing",
        ),
        ("pyttsx3", "import os\nos.kill(os.getpid(), 11)", "SIGSEGV"),
    ):
        write(tmp_path / f"{name}.py", f"{text}\n")
        finding = engine_fault(tmp_path)
        assert (finding.check, message in finding.message) == ("libespeak-ng", True), finding
        assert "apt-get install" in str(finding.next)
        (tmp_path / f"{name}.py").unlink()


# Programs


def env_with(directory: Path, **scripts: str) -> dict[str, str]:
    """Return an environment with only these programs on its PATH."""
    for name, script in scripts.items():
        write(directory / name.replace("_", "-"), f"#!/bin/sh\n{script}\n", 0o755)
    return {"PATH": str(directory)}


def test_a_programs_output_is_kept_and_its_error_is_one_line(tmp_path: Path) -> None:
    env = env_with(tmp_path, good='echo out; echo "$LC_ALL"', bad="echo; echo 'first line' >&2; echo more >&2; exit 3")
    killed = sound.run_program("killed", env=env_with(tmp_path, killed="kill -ILL $$"))
    assert killed.error == "it was killed by SIGILL"
    good, bad = sound.run_program("good", env=env), sound.run_program("bad", env=env)
    assert (good, bad) == (ProgramOutput(None, "out\nC\n"), ProgramOutput("first line", "\n"))
    write(tmp_path / "broken", "#!/no/such/interpreter\n", 0o755)
    for name in ("broken", "missing"):
        assert "No such file" in str(sound.run_program(name, env=env).error)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
def test_a_hanging_program_is_killed_with_its_children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sound, "PROGRAM_LIMIT_S", 0.3)
    env = env_with(tmp_path, hangs=f"/bin/sleep 98 & echo $! > {tmp_path}/pid; /bin/sleep 98")
    started_at = time.monotonic()
    output = sound.run_program("hangs", env=env)
    assert output.timed_out
    assert output.error == "no answer within 0.3 s"
    assert time.monotonic() - started_at < 20
    child = int((tmp_path / "pid").read_text())
    end = time.monotonic() + 5
    while _runs(child):
        assert time.monotonic() < end, "its child is still running"
        time.sleep(0.01)  # the end of another program's child isn't reported


def test_a_child_that_keeps_a_programs_output_open_is_not_awaited(tmp_path: Path) -> None:
    started_at = time.monotonic()
    output = sound.run_program("leaves", env=env_with(tmp_path, leaves="echo out; /bin/sleep 2.7 &"))
    assert (output.stdout, output.timed_out) == ("out\n", False)
    assert time.monotonic() - started_at < 2.7


def _runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_installed_players_are_found_in_order_of_preference(tmp_path: Path) -> None:
    env = env_with(tmp_path, **dict.fromkeys(("pacat", "aplay", "mine"), "exit 0"))
    assert sound.installed_players({"PATH": "/nowhere"}) == []
    assert sound.installed_players(env) == ["aplay", "pacat"]
    assert sound.check_player(env, "mine -x", "mine -x", used_by_server=False).state == OK
    assert sound.check_player(env, "missing", "missing", used_by_server=False).state != OK


APLAY = "printf 'null\\n    Discard\\ndefault\\n    Default\\nplughw:CARD=Device,DEV=0\\n    USB\\n'"


def test_the_devices_of_each_player_are_listed(tmp_path: Path) -> None:
    pactl = "printf '0\\tusb\\tm.c\\ts16le 2ch 44100Hz\\tSUSPENDED\\n1\\thdmi\\tm.c\\ts16le 2ch 44100Hz\\tIDLE\\n'"
    env = env_with(tmp_path, aplay=APLAY, pactl=pactl, pw_cli=f"/bin/cat <<'X'{PW_NODES}X")
    findings = {player: sound.check_device(env, player, None) for player in ("aplay", "pulse", "pacat", "pw-cat")}
    assert {finding.state for finding in findings.values()} == {OK}
    assert {player: finding.message for player, finding in findings.items()} == {
        "aplay": "the default device; aplay -L lists default, plughw:CARD=Device,DEV=0",
        "pulse": "the default device; pactl list short sinks lists usb, hdmi",
        "pacat": "the default device; pactl list short sinks lists usb, hdmi",
        "pw-cat": "the default device; pw-cli ls Node lists alsa_output.usb",
    }
    assert sound.suspended_sinks(env) == ("usb",)


def test_a_device_is_looked_up_in_its_players_list(tmp_path: Path) -> None:
    env = env_with(tmp_path, aplay=APLAY)
    for wanted in ("default", "plughw:1,0"):
        assert sound.check_device(env, "aplay", wanted).state == OK
    finding = sound.check_device(env, "aplay", "robot_speaker")
    assert (finding.state, "robot_speaker is not a device that aplay -L lists" in finding.message) == (WARNING, True)
    assert "plughw:CARD=Device,DEV=0" in finding.message
    assert str(finding.next).endswith("from this list: aplay -L")
    assert sound.check_device(env, "pacat", None).state == OK, "it is a fault only if a device is given"
    finding = sound.check_device(env, "pacat", "usb")
    assert (finding.state, finding.next) == (WARNING, "sudo apt-get install -y pulseaudio-utils")
    env = env_with(tmp_path, aplay="exit 0")
    assert sound.check_device(env, "aplay", None).state == WARNING


def test_errors_of_failed_and_hanging_programs_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sound, "PROGRAM_LIMIT_S", 0.1)
    env = env_with(tmp_path, aplay="exec /bin/sleep 98", pactl="echo Connection refused >&2; exit 1")
    findings = [sound.check_device(env, player, None) for player in ("aplay", "pacat", "pw-cat")]
    assert [(finding.state, re.split(": |because ", finding.message)[-1]) for finding in findings] == [
        (WARNING, "no answer within 0.1 s"), (OK, "Connection refused"), (OK, "pw-cli is not installed")
    ]  # fmt: skip
    assert sound.find_sound_server(env, STRANGER).hangs is False
    assert sound.find_sound_server(env_with(tmp_path, pactl="exec /bin/sleep 98", pw_cli="exit 0"), STRANGER).hangs


def test_a_sound_server_is_found_by_its_program_or_its_socket(tmp_path: Path) -> None:
    for name in ("pulse", "wire", "run/pulse"):
        (tmp_path / name).mkdir(parents=True)
    env = env_with(tmp_path / "pulse", pactl="printf 'Server Name: pulseaudio\\nDefault Sink: usb\\n'")
    sound_server = sound.find_sound_server(env, STRANGER)
    assert (sound_server.name, sound_server.default_sink) == ("pulseaudio", "usb")
    env = env_with(tmp_path / "pulse", pactl="echo Connection refused >&2; exit 1", pw_cli="exit 0")
    sound_server = sound.find_sound_server(env, STRANGER)
    assert ("PipeWire" in str(sound_server.name), sound_server.accepts_pulse) == (True, False)
    native = tmp_path / "run" / "pulse" / "native"
    native.touch()
    alone = {"PATH": "/nowhere", "XDG_RUNTIME_DIR": str(tmp_path / "run")}
    sound_server = sound.find_sound_server(alone, STRANGER)
    assert (sound_server.name, sound_server.error, sound_server.sockets) == (None, None, (str(native),))
    native.unlink()
    wire = {**alone, **env_with(tmp_path / "wire", pw_cli="exit 0")}
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(native))
        refused = sound.find_sound_server(wire, STRANGER)
        assert (refused.name, refused.accepts_pulse) == ("PipeWire without PulseAudio support", False)
        server.listen()
        assert sound.find_sound_server(wire, STRANGER) == SoundServer("PipeWire")
        assert sound.find_sound_server(alone, STRANGER) == SoundServer(f"a sound server listens on {native}")


def test_the_volume_is_read_from_the_active_mixer(tmp_path: Path) -> None:
    server, cards = SoundServer(name="PipeWire"), ("USB",)
    controls = "case $1 in scontrols) echo \"Simple mixer control 'Master',0\";; *) echo 'Mono: 0 [0%] [off]';; esac"
    env = env_with(tmp_path, amixer=controls, wpctl="echo 'Volume: 0.40 [MUTED]'")
    (alsa,) = sound.check_levels(env, SoundServer(), cards, in_use=True)
    assert (alsa.message, alsa.next) == ("Master is muted", "amixer sset Master unmute")
    (wire,) = sound.check_levels(env, server, cards, in_use=True)
    assert (wire.message, wire.next) == (
        "the default sink is muted", "wpctl set-mute @DEFAULT_AUDIO_SINK@ 0"
    )  # fmt: skip
    env = env_with(
        tmp_path, pactl="case $1 in get-sink-mute) echo Mute: no;; *) echo 'Volume: mono: 9 / 15% / x';; esac"
    )
    (pulse,) = sound.check_levels(env, server, cards, in_use=True)
    assert pulse.message == "the default sink is at 15%, which may be too quiet"
    assert pulse.next == "pactl set-sink-volume @DEFAULT_SINK@ 70%"
    assert sound.check_levels(env, SoundServer(), (), in_use=True) == []
    assert sound.check_levels(env, SoundServer(hangs=True), cards, in_use=True) == []


# System files


@pytest.fixture
def nodes(tmp_path: Path) -> str:
    """Return a directory with device files: one card is for its group only, and one for everybody."""
    for name, mode in (("pcmC0D0p", 0o660), ("pcmC0D0c", 0o660), ("pcmC1D0p", 0o666)):
        write(tmp_path / name, "", mode)
    return str(tmp_path)


def test_access_to_a_card_depends_on_user_group_and_mode(nodes: str, monkeypatch: pytest.MonkeyPatch) -> None:
    group = os.stat(f"{nodes}/pcmC0D0p").st_gid
    name = grp.getgrgid(group).gr_name if group else "audio"
    monkeypatch.setattr(sound, "_name_or_id", lambda _, number: name if number == group else str(number))
    finding = sound.check_access(SoundServer(), STRANGER, nodes)
    assert (finding.state, finding.next) == (WARNING, f"sudo usermod -aG {name} stranger, and log in again")
    assert finding.message == f"user stranger may not open {nodes}/pcmC0D0p, and is not in the group {name}"
    assert sound.check_access(SoundServer("PipeWire"), STRANGER, nodes).state == OK, "the sound server opens the cards"
    member = UserSession(4141, "member", gids=(group,))
    assert sound.check_access(SoundServer(), member, nodes).message == (
        f"user member may open the cards (in the group {name})"
    )
    assert "which is not needed" in sound.check_access(SoundServer(), UserSession(0, "root"), nodes).message
    assert "/gone has no playback devices" in sound.check_access(SoundServer(), STRANGER, "/gone").message


def test_a_new_group_member_is_advised_to_log_in_again(nodes: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grp, "getgrnam", lambda _: SimpleNamespace(gr_mem=["stranger"]))
    assert sound.check_access(SoundServer(), STRANGER, nodes).next == "log out and in again"
    served = sound.check_access(SoundServer(), replace(STRANGER, server_pid=7), nodes)
    assert served.next == "restart the server from a new login"


def test_cards_are_listed_with_the_kernels_names(tmp_path: Path) -> None:
    write(tmp_path / "cards", " 0 [Device         ]: USB-Audio - USB Audio Device\n              C-Media at usb-1\n")
    assert sound.find_cards(str(tmp_path)) == ("USB Audio Device",)
    assert sound.find_cards("/gone") == ()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
def test_a_server_of_the_same_user_is_examined_with_its_environment(tmp_path: Path) -> None:
    env = clean_environment(str(tmp_path), {"XDG_RUNTIME_DIR": str(tmp_path), "SSH_CONNECTION": "1 2 3 4"})
    with subprocess.Popen(["sh", "-c", "sleep 98; :", "--player", "x"], env=env, start_new_session=True) as process:
        try:
            end = time.monotonic() + 5
            while sound._read_environment(process.pid) != env:  # until the program has started, it has ours
                assert time.monotonic() < end
            session, seen = sound.find_session(process.pid)
            assert seen == env
            assert (session.server_pid, session.uid, session.runtime_dir) == (process.pid, os.getuid(), str(tmp_path))
            assert session.runtime_owner == os.getuid()
            assert "an ssh session" in session.origins
            assert set(session.gids) == {os.getegid(), *os.getgroups()}
            assert sound.server_names_player(process.pid, {})
        finally:
            os.killpg(process.pid, 9)


def test_without_a_server_the_current_process_is_examined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", f"{tmp_path}/gone")
    session, seen = sound.find_session(None)
    assert (session.server_pid, session.runtime_owner, seen) == (None, None, dict(os.environ))
    assert f"{tmp_path}/gone, which does not exist" in sound.judge_session(session).message
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert sound.find_session(None)[0].runtime_dir is None
    assert sound.server_names_player(os.getpid(), {"TALK_PLAYER": "x"})
    assert not sound.server_names_player(os.getpid(), {})
