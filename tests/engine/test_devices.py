"""Whether anything is there that could sound: by files alone, and "nothing" only where that is certain."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.players import devices

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def bare(tmp_path: Path) -> dict[str, str]:
    """The environment of a container that was given nothing: no sound device, no sound server, no settings."""
    for name in ("home", "run", "snd", "etc"):
        (tmp_path / name).mkdir()
    for name in ("controlC0", "pcmC0D0c", "timer"):  # a microphone alone
        (tmp_path / "snd" / name).touch()
    put(tmp_path / "etc/pulse/client.conf", "# default-server =\nautospawn = no\n")
    return {"HOME": f"{tmp_path}/home", "XDG_RUNTIME_DIR": f"{tmp_path}/run"}


def put(path: Path, text: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


@pytest.fixture
def nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, str]], bool]:
    """Tells whether nothing sounds in an environment of that container."""
    monkeypatch.setattr(os, "getuid", lambda: 4_242_424)  # this machine's user may have a sound server
    monkeypatch.setattr(devices, "_SYSTEM_WIDE", f"{tmp_path}/system")  # and this machine
    return lambda env: devices.nothing_sounds(env, f"{tmp_path}/snd", f"{tmp_path}/etc")


Nothing = Callable[[dict[str, str]], bool]


def test_nothing_is_there(tmp_path: Path, bare: dict[str, str], nothing: Nothing) -> None:
    assert nothing(bare)
    assert nothing({})
    assert devices.nothing_sounds({}, f"{tmp_path}/gone", f"{tmp_path}/gone")


@pytest.mark.parametrize(
    "path",
    [
        "snd/pcmC1D3p",
        "run/pulse/native",
        "run/pipewire-0",
        "home/.config/pulse/0123-runtime/native",
        "home/.asoundrc",
        "home/.config/alsa/asoundrc",
        "etc/asound.conf",
    ],
)
def test_anything_there_may_sound(tmp_path: Path, bare: dict[str, str], nothing: Nothing, path: str) -> None:
    put(tmp_path / path)
    assert not nothing(bare)


@pytest.mark.parametrize("path", ["home/.config/pulse/client.conf", "etc/pulse/client.conf.d/00-host.conf"])
def test_a_server_in_settings_may_sound(tmp_path: Path, bare: dict[str, str], nothing: Nothing, path: str) -> None:
    put(tmp_path / path, "autospawn = no\n")
    assert nothing(bare)
    put(tmp_path / path, "autospawn = no\n  default-server = unix:/run/host/pulse\n")
    assert not nothing(bare)


@pytest.mark.parametrize("name", ["PULSE_SERVER", "PULSE_CLIENTCONFIG", "PIPEWIRE_REMOTE", "ALSA_CONFIG_PATH"])
def test_a_place_that_a_variable_names_may_sound(bare: dict[str, str], nothing: Nothing, name: str) -> None:
    assert nothing({**bare, name: ""})
    assert not nothing({**bare, name: "somewhere"})


def test_sound_servers_are_those_of_the_environment_and_of_the_users(tmp_path: Path) -> None:
    env = {name: f"{tmp_path}/{name}" for name in ("XDG_RUNTIME_DIR", "PULSE_RUNTIME_PATH", "PIPEWIRE_RUNTIME_DIR")}
    there = ["XDG_RUNTIME_DIR/pulse/native", "PULSE_RUNTIME_PATH/native", "PIPEWIRE_RUNTIME_DIR/pipewire-0"]
    for each in there:
        put(tmp_path / each)
    found = [each.removeprefix(f"{tmp_path}/") for each in devices.sound_servers(env)]
    assert [each for each in found if not each.startswith("/run/")] == there
