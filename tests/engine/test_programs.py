"""Tests for player commands and their errors, the player "file:", and the check for any audio output."""

from __future__ import annotations

import os
import wave
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import players, protocol
from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.players.builtin import WavPlayer, WavStreamPlayer
from talkcli.engine.child.players.chooser import PlayerChooser
from talkcli.engine.child.players.program import MAX_ERROR_LINE_BYTES, ErrorOutput, ProgramPlayer
from talkcli.engine.players import PACKAGES, PLAYERS, PlayerMissing, player_commands
from tests.engine.process import Engine

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.sink import Sink

#: Replaces the set of installed programs.
Install = Callable[[set[str]], None]


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Install:
    return lambda programs: monkeypatch.setattr(players, "on_path", programs.__contains__)


def _names(player: str | None, last: str | None = None) -> list[str]:
    return [command.name for command in player_commands(player, None, 22050, last)]


def test_installed_players_are_tried_and_the_last_that_worked_comes_first(install: Install) -> None:
    install({"aplay", "pw-cat", "pacat"})
    assert _names(None) == ["aplay", "pacat", "pw-cat"]
    assert _names(None, "pw-cat") == ["pw-cat", "aplay", "pacat"]
    assert _names("pacat", "aplay") == ["pacat"]
    install({"pacat"})
    assert _names(None) == ["pacat"]


def test_the_automatic_choice_tries_built_in_players_before_programs(install: Install) -> None:
    install({*PACKAGES})
    tried = []
    for opens in PlayerChooser(protocol.Configure(0, None, None, None, None)).candidates(22050):
        assert isinstance(opens, partial)
        tried.append(opens.args[0] if isinstance(opens.args[0], str) else opens.args[0].name)
    automatic = [name for name, row in PLAYERS.items() if row.automatic]
    assert tried == sorted(automatic, key=PACKAGES.__contains__)


@pytest.mark.parametrize(
    ("player", "expected"),
    [("aplay", ["-D", "usb"]), ("pacat", ["-d", "usb"]), ("pw-cat", ["--target=usb", "-"])],
)
def test_the_device_is_passed_in_the_players_own_syntax(install: Install, player: str, expected: list[str]) -> None:
    install({player})
    (command,) = player_commands(player, "usb", 16000)
    assert list(command.argv[-len(expected) :]) == expected
    assert "16000" in " ".join(command.argv) or b"\x80\x3e\x00\x00" in command.preamble


def test_a_player_that_is_not_a_program_is_built_in(sink: Sink, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in sink.env.items():
        monkeypatch.setenv(name, value)
    for name in PLAYERS.keys() - PACKAGES.keys():
        (opens,) = PlayerChooser(protocol.Configure(0, None, name, None, None)).candidates(22050)
        player = opens()
        assert player.name == name
        assert not isinstance(player, ProgramPlayer)
        player.kill()
        assert player.gone()


def test_a_command_line_is_split_without_a_shell(install: Install) -> None:
    install({"/opt/my"})
    (command,) = player_commands("/opt/my player -r{rate} '{device} x' $HOME", None, 22050)
    assert command.argv == ("/opt/my", "player", "-r22050", "default x", "$HOME")
    assert command.name == "my"


@pytest.mark.parametrize(
    ("player", "message"),
    [
        ("pacat", 'player "pacat" not found; install pulseaudio-utils'),
        ("sox -", 'player "sox" not found'),
        ("", "player command is empty"),
        ("  ", "player command is empty"),
        ("'", "no closing quotation"),
    ],
)
def test_a_missing_player_is_an_error(install: Install, player: str, message: str) -> None:
    install(set())
    with pytest.raises(PlayerMissing, match=message):
        player_commands(player, None, 22050)
    (opens,) = PlayerChooser(protocol.Configure(0, None, player, None, None)).candidates(22050)
    with pytest.raises(CannotSpeak, match=message) as caught:
        opens()
    assert caught.value.reason == "no_player"


@pytest.mark.parametrize(
    ("output", "line"),
    [
        ("", None),
        ("underrun!!! (at least 12.3 ms long)\n", None),
        ("ALSA lib conf.c:5180:(snd_config_expand) Evaluate error: No such file or directory\n", None),
        (
            "aplay: main:831: audio open error: No such file or directory\n",
            "aplay: audio open error: No such file or directory",
        ),
        (
            "aplay: set_params:1416: Unable to install hw params:\nACCESS:  RW_INTERLEAVED\nFORMAT:  S16_LE\n",
            "aplay: Unable to install hw params:",
        ),
        ("Connection failure: Connection refused\n", "Connection failure: Connection refused"),
        ("Stream error: No such entity", "Stream error: No such entity"),
        ("hello\nworld\n", "hello"),
        ("hello\npw-cat: error: Host is down\n", "pw-cat: error: Host is down"),
        ("first error\nsecond error\n", "first error"),
        ("caf\xe9\n", "café"),
    ],
)
def test_the_error_line_is_found_in_standard_error(output: str, line: str | None) -> None:
    errors = ErrorOutput()
    for byte in output.encode():
        errors.feed(bytes([byte]))
    assert errors.find_error() == line


def test_only_the_start_of_a_flood_of_standard_error_is_kept() -> None:
    errors = ErrorOutput()
    for _ in range(100):
        errors.feed(b"x" * 10_000)
    assert errors.find_error() == "x" * MAX_ERROR_LINE_BYTES


# -- whether the machine has any audio output


@pytest.fixture
def bare(tmp_path: Path) -> dict[str, str]:
    """Return the environment of a container without a sound device, a sound server, or audio settings."""
    for name in ("home", "run", "snd", "etc"):
        (tmp_path / name).mkdir()
    for name in ("controlC0", "pcmC0D0c", "timer"):  # a microphone, but no loudspeaker
        (tmp_path / "snd" / name).touch()
    put(tmp_path / "etc/pulse/client.conf", "# default-server =\nautospawn = no\n")
    return {"HOME": f"{tmp_path}/home", "XDG_RUNTIME_DIR": f"{tmp_path}/run"}


def put(path: Path, text: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


#: Returns whether an environment of the container has no audio output.
HasNoOutput = Callable[[dict[str, str]], bool]


@pytest.fixture
def has_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> HasNoOutput:
    monkeypatch.setattr(os, "getuid", lambda: 4_242_424)  # the real user may have a sound server
    monkeypatch.setattr(players, "_SYSTEM_PULSE", f"{tmp_path}/system")  # so may the real system
    return lambda env: players.has_no_output(env, f"{tmp_path}/snd", f"{tmp_path}/etc")


def test_a_bare_container_has_no_output(tmp_path: Path, bare: dict[str, str], has_no_output: HasNoOutput) -> None:
    assert has_no_output(bare)
    assert has_no_output({})
    assert players.has_no_output({}, f"{tmp_path}/gone", f"{tmp_path}/gone")
    put(tmp_path / "etc/pulse/client.conf.d/00-host.conf", "autospawn = no\n")
    assert has_no_output(bare)


#: A line that configures a sound server.
SERVER = "autospawn = no\n  default-server = unix:/run/host/pulse\n"


@pytest.mark.parametrize(
    ("path", "text"),
    [
        *((path, "") for path in ("snd/pcmC1D3p", "run/pulse/native", "run/pipewire-0", "etc/asound.conf")),
        *((f"home/{path}", "") for path in (".config/pulse/01-runtime/native", ".asoundrc", ".config/alsa/asoundrc")),
        *((path, SERVER) for path in ("home/.config/pulse/client.conf", "etc/pulse/client.conf.d/00-host.conf")),
    ],
)
def test_a_device_a_socket_or_a_configuration_counts_as_output(
    tmp_path: Path, bare: dict[str, str], has_no_output: HasNoOutput, path: str, text: str
) -> None:
    put(tmp_path / path, text)
    assert not has_no_output(bare)


@pytest.mark.parametrize("name", ["PULSE_SERVER", "PULSE_CLIENTCONFIG", "PIPEWIRE_REMOTE", "ALSA_CONFIG_PATH"])
def test_an_audio_variable_counts_as_output(bare: dict[str, str], has_no_output: HasNoOutput, name: str) -> None:
    assert has_no_output({**bare, name: ""})
    assert not has_no_output({**bare, name: "somewhere"})


def test_sound_server_sockets_are_found_through_the_environment(tmp_path: Path) -> None:
    env = {name: f"{tmp_path}/{name}" for name in ("XDG_RUNTIME_DIR", "PULSE_RUNTIME_PATH", "PIPEWIRE_RUNTIME_DIR")}
    expected = ["XDG_RUNTIME_DIR/pulse/native", "PULSE_RUNTIME_PATH/native", "PIPEWIRE_RUNTIME_DIR/pipewire-0"]
    for path in expected:
        put(tmp_path / path)
    sockets = [path.removeprefix(f"{tmp_path}/") for path in players.sound_server_sockets(env)]
    assert [path for path in sockets if not path.startswith("/run/")] == expected


# -- the player "file:". Its WAV file is always valid, and other files are never changed


def _write(path: Path, data: bytes, rate: int = 22050) -> None:
    file = WavPlayer(str(path), rate)
    assert file.offer(memoryview(data)) == len(data)
    file.close()
    assert file.ended()


def _read(path: Path) -> bytes:
    with wave.open(str(path), "rb") as file:
        assert (file.getnchannels(), file.getsampwidth(), file.getframerate()) == (1, 2, 22050)
        return file.readframes(file.getnframes())


def test_sentences_are_appended_and_remains_of_a_crash_are_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    path.touch()
    _write(path, b"one ")
    assert _read(path) == b"one "
    with path.open("ab") as file:
        file.write(b"torn!")
    _write(path, b"two ")
    assert _read(path) == b"one two "
    assert path.stat().st_size == 44 + 8


def _stereo(path: Path) -> None:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(2)
        file.setframerate(22050)
        file.writeframes(b"12345678")


def _with_another_chunk(path: Path) -> None:
    _write(path, b"one ")
    data = bytearray(path.read_bytes() + b"LIST\x04\0\0\0INFO")
    data[4:8] = (len(data) - 8).to_bytes(4, "little")
    path.write_bytes(data)


def _cut_short(path: Path) -> None:
    _write(path, b"one two ")
    os.truncate(path, 46)


def _text(path: Path) -> None:
    path.write_text("my diary, which is a good deal longer than the header of a WAV file")


def _other_rate(path: Path) -> None:
    _write(path, b"one ", 16000)


def _of_unknown_length(path: Path) -> None:
    """Write a WAV stream, as `say -o -` does."""
    with path.open("wb") as file:
        WavStreamPlayer(file.fileno(), 22050, first=True).offer(memoryview(b"one "))


@pytest.mark.parametrize("make", [_of_unknown_length, _stereo, _with_another_chunk, _cut_short, _text, _other_rate])
def test_a_file_with_other_content_is_refused_and_not_changed(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "x.wav"
    make(path)
    before = path.read_bytes()
    with pytest.raises(CannotSpeak) as caught:
        WavPlayer(str(path), 22050)
    assert caught.value.reason == "audio_device"
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


def test_an_unsuitable_path_is_refused_and_leaves_no_descriptor_open(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    before = os.listdir("/proc/self/fd")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "missing" / "x.wav", "", "/dev/null", "/dev/full"):
        with pytest.raises(CannotSpeak) as caught:
            WavPlayer(str(path), 22050)
        assert caught.value.reason == "audio_device"
    assert os.listdir("/proc/self/fd") == before


def test_a_goal_reports_the_file_error_and_a_stop_leaves_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "x.wav"
    with Engine(f"file:{path}") as engine:
        ended = engine.spoken("yes", "g1")
        assert (ended.reason, ended.message) == ("audio_device", f"{path} cannot be written: No such file or directory")
        path.parent.mkdir()
        engine.say("one two three four five. " * 300, "g2")
        engine.until_word()
        engine.stop("g2")
        length = len(_read(path))
        assert length > 0
        assert path.stat().st_size == 44 + length
        ended = engine.spoken("yes", "g3")
        assert ended.duration is not None
        assert len(_read(path)) == length + round(ended.duration * 22050) * 2
