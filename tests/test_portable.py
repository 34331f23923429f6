"""On a system without Linux's own interfaces, as macOS is one, talk is imported, helps, serves, speaks and cancels.

`tests/support/macos` hides these interfaces. Apple's own voice can't be tried here: pyttsx3's driver "dummy" stands
in for it, as both speak without talk's player; and talk's own driver is tried on a Linux without these names.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import talkcli
from talkcli.cli.commands import COMMANDS
from tests.conformance.bareserve import TALK, environment, run
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from tests.conftest import MakeTalk

PATH = os.pathsep.join([str(Path(__file__).parent / "support" / "macos"), str(Path(__file__).parents[1])])
_PEEK = "import sys, os, fcntl, select, socket; print(sys.platform, os.path.exists('/proc/self'), *({} & {}))"
_IMPORT_ALL = """
import importlib, pkgutil, click, talkcli
names = [each.name for each in pkgutil.walk_packages(talkcli.__path__, "talkcli.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
from talkcli.cli.click_app import talk
with click.Context(talk, info_name="talk") as parent:
    commands = {each: talk.get_command(parent, each) for each in talk.list_commands(parent)}
    for name, command in commands.items():
        with click.Context(command, info_name=name, parent=parent) as context:
            assert "exit codes: talk --help" in command.get_help(context), name
print(len(names), len(commands))
"""


def on_macos(*command: str, **extra: str) -> str:
    """Run a program without these interfaces, assert that it succeeds, and return its output."""
    with short_directory() as home:
        done = run(command, environment(home, **{"PYTHONPATH": PATH, "TALK_SOCKET": f"{home}/s", **extra}))
    assert (done.code, done.err) == (0, "")
    return done.out


def test_the_linux_interfaces_are_hidden() -> None:
    names = {"pidfd_open", "waitid", "F_SETSIG", "F_SETPIPE_SZ", "epoll", "SO_PEERCRED", "prctl"}
    code = _PEEK.format(names, "{*dir(os), *dir(fcntl), *dir(select), *dir(socket)}")
    assert on_macos(sys.executable, "-c", code) == "darwin False\n"
    assert on_macos(sys.executable, "-c", code, PYTHONPATH="").startswith("linux True ")


def test_every_module_can_be_imported_and_every_command_has_help() -> None:
    modules = sum(1 for _ in Path(talkcli.__path__[0]).rglob("*.py"))
    found = on_macos(sys.executable, "-c", _IMPORT_ALL)
    assert found == f"{modules - 1} {len(COMMANDS)}\n"  # the package itself is there by then
    assert "Exit codes:" in on_macos(*TALK, "--help")


@pytest.mark.parametrize(("platform", "driver"), [("darwin", "dummy"), ("linux", "espeak")])
def test_speech_can_be_awaited_paused_cancelled_and_examined(make_talk: MakeTalk, platform: str, driver: str) -> None:
    """The platform's name differs, or only its interfaces."""
    env = {"PYTHONPATH": PATH, "TALK_TEST_PLATFORM": platform}
    served = make_talk("--player", "null", "--rate", "450", driver=driver, env=env)
    done = served.run("--json", "say", "--wait", "battery low")
    goal = json.loads(done.out)
    assert (done.code, goal["state"], goal["text"]) == (0, "SUCCEEDED", "battery low")
    assert goal["client"]["uid"] == os.getuid()
    assert goal["client"]["pid"] > 1
    assert served.run("wait", goal["id"]).code == 0
    assert "SUCCEEDED" in served.run("status").out
    assert served.run("voices").out
    words = served.run("say", "--feedback", "one two three").out
    assert [line.split()[-1] for line in words.splitlines() if " word " in line] == ["one", "two", "three"]

    assert served.run("pause").code == 0
    ids = [served.run("say", each).id for each in ("one", "two", "three")]
    assert served.run("cancel", ids[1]).id == ids[1]
    assert served.run("resume").code == 0
    assert served.run("wait").code == 0
    assert [served.goal(each)["state"] for each in ids] == ["SUCCEEDED", "RECALLED", "SUCCEEDED"]

    done = served.run("doctor", "--silent", "--json")
    found = {each["check"]: each for each in map(json.loads, done.out.splitlines())}
    assert done.err == ""
    assert {"python", "pyttsx3", "socket", "server", "settings", "sentence"} <= found.keys()
    assert found["server"]["state"] == found["sentence"]["state"] == "ok"


def test_a_player_is_awaited_and_killed_and_its_failure_is_reported(make_talk: MakeTalk) -> None:
    """With talk's own driver: one program plays silence for longer than it is fed, and another one fails."""
    env = {"PYTHONPATH": PATH, "TALK_TEST_PLATFORM": "linux"}
    talk = make_talk("--player", "sh -c 'cat >/dev/null; sleep 0.4'", "--rate", "450", env=env)
    assert talk.run("say", "--wait", "hi").code == 0
    goal_id = talk.run("say", "a sentence of some length, which nobody will hear to its very end").id
    talk.watcher.wait_for_word(goal_id)
    assert talk.run("cancel").id == goal_id
    assert talk.goal(goal_id)["state"] == "PREEMPTED"
    failing = make_talk("--player", "sh -c 'echo no such device >&2; exit 1'", env=env)
    done = failing.run("say", "--wait", "hi")
    assert (done.code, "no such device" in done.err) == (4, True)
