"""The command that installs a package, for each kind of environment."""

from __future__ import annotations

import shlex
import sys

import pytest

from talkcli import install
from talkcli.engine.models import missing_package
from talkcli.engine.voices import unknown_voice_message
from talkcli.frozen import replace
from talkcli.install import Environment, command_for

VENV = Environment("/home/pi/talk/.venv/bin/python")
SYSTEM = Environment("/usr/bin/python3", externally_managed=True)
PIPX = Environment(
    "/home/pi/.local/pipx/venvs/talkcli/bin/python", pipx="/home/pi/.local/pipx/venvs/talkcli", user_home="/home/pi"
)
OPT = Environment("/opt/talk/bin/python3", needs_sudo=True)


#: In the commands, PY stands for the environment's own Python.
@pytest.mark.parametrize(
    ("environment", "reinstall", "command"),
    [
        (VENV, False, "PY -m pip install numpy"),
        (replace(VENV, python="/home/pi/my robot/bin/python"), False, "PY -m pip install numpy"),
        (replace(VENV, has_pip=False), False, "PY -m ensurepip && PY -m pip install numpy"),
        (replace(VENV, has_pip=False, made_by_uv=True), False, "uv pip install --python PY numpy"),
        (replace(VENV, made_by_uv=True), False, "PY -m pip install numpy"),
        (OPT, False, "sudo PY -m pip install numpy"),
        (replace(OPT, has_pip=False), False, "sudo PY -m ensurepip && sudo PY -m pip install numpy"),
        (PIPX, False, "pipx inject talkcli numpy"),
        (replace(PIPX, pipx="/home/pi/.local/pipx/venvs/talkcli-2"), False, "pipx inject talkcli-2 numpy"),
        (
            replace(PIPX, pipx="/opt/pipx/venvs/talkcli", needs_sudo=True),
            False,
            "sudo PIPX_HOME=/opt/pipx pipx inject talkcli numpy",
        ),
        (SYSTEM, False, "PY -m pip install --break-system-packages numpy"),
        (replace(SYSTEM, externally_managed=False), False, "PY -m pip install numpy"),
        (
            replace(SYSTEM, has_pip=False, needs_sudo=True),
            False,
            "sudo apt-get install -y python3-pip && sudo PY -m pip install --break-system-packages numpy",
        ),
        (VENV, True, "PY -m pip install --force-reinstall numpy"),
        (PIPX, True, "pipx inject --force talkcli numpy"),
        (replace(VENV, has_pip=False, made_by_uv=True), True, "uv pip install --reinstall --python PY numpy"),
    ],
)
def test_the_command_fits_the_environment(environment: Environment, reinstall: bool, command: str) -> None:
    expected = command.replace("PY ", f"{shlex.quote(environment.python)} ")
    assert command_for(environment, ["numpy"], reinstall=reinstall) == expected


def test_the_command_names_the_running_python() -> None:
    assert sys.executable in shlex.split(install.command("numpy"))


def test_a_32_bit_system_is_not_offered_packages_without_a_build(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install, "IS_64_BIT", False)
    assert install.espeak_command() == "sudo apt-get install -y libespeak-ng1"
    step = "neural voices need a 64-bit system; use an espeak voice, such as en"
    monkeypatch.setattr(install, "NEURAL_PACKAGES", ["no_such_package"])
    assert missing_package() == f"no_such_package is missing; {step}"
    assert unknown_voice_message("piper/joe", ()) == f'unknown voice "piper/joe"; {step}'
