"""Unused extras cost nothing, and the package of a missing extra is reported.

Imports dominate the start-up time of a process. A module that is not imported takes no memory and starts no thread.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from talkcli.install import NEURAL_PACKAGES
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.support import tiny_voice
from tests.support.import_recorder import imported, record_imports
from tests.support.processes import children
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from pathlib import Path

#: Modules that an engine process doesn't need if no neural voice speaks.
NEURAL_MODULES = [
    *NEURAL_PACKAGES,
    *("difflib", "hashlib", "queue"),
    *(f"talkcli.engine.child.synthesizers.{name}" for name in ("inference", "loader", "phonemes", "piper", "vits")),
]
#: Modules that only neural voices use. A server needs the other `NEURAL_MODULES` anyway.
NEURAL_ONLY = {*NEURAL_PACKAGES, *(name for name in NEURAL_MODULES if name.startswith("talkcli."))}
COMMANDS = ["status", "voices", "say --wait hello", "--json log", "doctor --help", "bridge --help"]


@pytest.mark.usefixtures("nobody_serves")
def test_servers_and_clients_import_no_modules_of_unused_extras(tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "tiny")
    with short_directory() as home:
        os.mkdir(f"{home}/run", 0o700)  # and no TALK_SOCKET
        env = environment(home, XDG_RUNTIME_DIR=f"{home}/run", TALK_VOICES=str(tmp_path / "voices"))
        env = record_imports(tmp_path, env)
        with serving(env) as server:
            for command in COMMANDS:
                done = run([*TALK, *command.split()], env)
                assert (done.code, command != "voices" or "piper/tiny" in done.out) == (0, True), done
            (engine,) = children(server.process.pid)
    modules = imported(tmp_path)
    assert len(modules) > len(COMMANDS)
    assert modules[engine] & {*NEURAL_MODULES} == set()
    for names in modules.values():
        assert "talkcli" in names
        assert not {name for name in names if f"{name}.".startswith(("paho.", "talkcli.fleet."))} | names & NEURAL_ONLY


@pytest.mark.parametrize(
    "arguments",
    [["--robot", "anna", "status"], ["say", "--robot", "anna", "hello"], ["--robot", "anna", "doctor"], ["watch"]],
)
def test_without_the_extra_fleet_commands_name_the_missing_package(arguments: list[str], tmp_path: Path) -> None:
    env = record_imports(
        tmp_path, environment(str(tmp_path), TALK_ROBOT="anna", TALK_BROKER="mqtt://127.0.0.1"), ["paho"]
    )
    done = run([*TALK, *arguments], env)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"talk: a fleet needs paho-mqtt; install it with: {install.command('paho-mqtt')}\n"
