"""Who names no robot of a fleet pays nothing for one, and who does without the extra is told what to install."""

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

#: What a fleet alone has a use for.
OWN = {"paho", "talkcli.fleet"}
COMMANDS = (
    ["status"],
    ["set", "--rate", "400"],
    ["say", "--wait", "hello"],
    ["--json", "log"],
    ["voices"],
    ["--version"],
    ["say", "--help"],
    ["doctor", "--help"],
    ["bridge", "--help"],
)


@pytest.mark.usefixtures("nobody_serves")
def test_neither_server_nor_clients_import_anything_of_it(tmp_path: Path) -> None:
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
        assert not {each for each in names for own in OWN if each == own or each.startswith(f"{own}.")}


@pytest.mark.parametrize(
    "words",
    [["--robot", "anna", "status"], ["say", "--robot", "anna", "hello"], ["--robot", "anna", "doctor"], ["watch"]],
)
def test_what_to_install_is_said_where_a_robot_is_named(words: list[str], tmp_path: Path) -> None:
    env = spied(tmp_path, environment(str(tmp_path), TALK_ROBOT="anna", TALK_BROKER="mqtt://127.0.0.1"), ["paho"])
    done = run([*TALK, *words], env)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"talk: a fleet needs paho-mqtt: {install.command('paho-mqtt')}\n"
