"""Without a robot of a fleet, nothing for fleets is imported; without the extra, a fleet tells what to install."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.support.spied import imported, spied
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from pathlib import Path

COMMANDS = (["status"], ["say", "--wait", "hello"], ["--json", "log"], ["doctor", "--help"], ["bridge", "--help"])


@pytest.mark.usefixtures("nobody_serves")
def test_neither_server_nor_clients_import_anything_for_fleets(tmp_path: Path) -> None:
    with short_directory() as home:
        os.mkdir(f"{home}/run", 0o700)
        env = spied(tmp_path, environment(home, XDG_RUNTIME_DIR=f"{home}/run"))  # as a user who names no socket
        with serving(env):
            for command in COMMANDS:
                done = run([*TALK, *command], env)
                assert done.code == 0, done
    found = imported(tmp_path)
    assert len(found) > len(COMMANDS)
    for names in found.values():
        assert "talkcli" in names
        assert not {each for each in names if f"{each}.".startswith(("paho.", "talkcli.fleet."))}


@pytest.mark.parametrize(
    "words",
    [["--robot", "anna", "status"], ["say", "--robot", "anna", "hello"], ["--robot", "anna", "doctor"], ["watch"]],
)
def test_without_the_extra_a_fleet_tells_what_to_install(words: list[str], tmp_path: Path) -> None:
    env = spied(tmp_path, environment(str(tmp_path), TALK_ROBOT="anna", TALK_BROKER="mqtt://127.0.0.1"), ["paho"])
    done = run([*TALK, *words], env)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"talk: a fleet needs paho-mqtt: {install.command('paho-mqtt')}\n"
