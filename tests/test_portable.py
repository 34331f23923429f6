"""talk works on systems without Linux-specific interfaces, such as macOS.

`tests/support/macos` hides these interfaces. pyttsx3's driver "dummy" replaces Apple's driver, which can't be tested
here. Both speak without talk's player. talk's own driver is tested on a Linux without these interfaces.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import talkcli
from talkcli.cli.commands import COMMANDS
from tests.conformance.bareserve import TALK, environment, run
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from tests.conftest import MakeTalk

PATH = os.pathsep.join([str(Path(__file__).parent / "support" / "macos"), str(Path(__file__).parents[1])])
_SHOW_PLATFORM = "import sys, os, fcntl, select, socket; print(sys.platform, os.path.exists('/proc/self'), *({} & {}))"
_IMPORT_ALL = """
import importlib, pkgutil, click, talkcli
names = [module.name for module in pkgutil.walk_packages(talkcli.__path__, "talkcli.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
from talkcli.cli.click_app import talk
with click.Context(talk, info_name="talk") as parent:
    commands = {name: talk.get_command(parent, name) for name in talk.list_commands(parent)}
    for name, command in commands.items():
        with click.Context(command, info_name=name, parent=parent) as context:
            assert "exit codes: talk --help" in command.get_help(context), name
print(len(names), len(commands))
"""


def on_macos(*command: str, **extra: str) -> str:
    """Run a program without Linux-specific interfaces, assert that it succeeds, and return its output."""
    with short_directory() as home:
        done = run(command, environment(home, **{"PYTHONPATH": PATH, "TALK_SOCKET": f"{home}/s", **extra}))
    assert (done.code, done.err) == (0, "")
    return done.out


def test_the_linux_interfaces_are_hidden() -> None:
    names = {"pidfd_open", "waitid", "F_SETSIG", "F_SETPIPE_SZ", "epoll", "SO_PEERCRED", "prctl"}
    code = _SHOW_PLATFORM.format(names, "{*dir(os), *dir(fcntl), *dir(select), *dir(socket)}")
    assert on_macos(sys.executable, "-c", code) == "darwin False\n"
    assert on_macos(sys.executable, "-c", code, PYTHONPATH="").startswith("linux True ")


def test_every_module_can_be_imported_and_every_command_has_help() -> None:
    modules = sum(1 for _ in Path(talkcli.__path__[0]).rglob("*.py"))
    counts = on_macos(sys.executable, "-c", _IMPORT_ALL)
    assert counts == f"{modules - 1} {len(COMMANDS)}\n"  # the package itself is already imported
    assert "Exit codes:" in on_macos(*TALK, "--help")


def test_speech_can_be_awaited_paused_cancelled_and_examined(make_talk: MakeTalk) -> None:
    env = {"PYTHONPATH": PATH, "TALK_TEST_PLATFORM": "darwin"}
    server = make_talk("--player", "null", "--rate", "450", driver="dummy", env=env)
    done = server.run("--json", "say", "--wait", "battery low")
    goal = json.loads(done.out)
    assert (done.code, goal["state"], goal["text"]) == (0, "SUCCEEDED", "battery low")
    assert goal["client"]["uid"] == os.getuid()
    assert goal["client"]["pid"] > 1
    assert "SUCCEEDED" in server.run("status").out
    words = server.run("say", "--feedback", "one two three").out
    assert [line.split()[-1] for line in words.splitlines() if " word " in line] == ["one", "two", "three"]

    assert server.run("pause").code == 0
    ids = [server.run("say", text).id for text in ("one", "two", "three")]
    assert server.run("cancel", ids[1]).id == ids[1]
    assert server.run("pause", "--while", "--", "sh", "-c", "exit 5").code == 5
    assert server.run("resume").code == 0
    assert server.run("wait").code == 0
    assert [server.goal(goal_id)["state"] for goal_id in ids] == ["SUCCEEDED", "RECALLED", "SUCCEEDED"]

    done = server.run("doctor", "--silent", "--json")
    findings = {finding["check"]: finding for finding in map(json.loads, done.out.splitlines())}
    assert done.err == ""
    assert {"python", "pyttsx3", "socket", "server", "settings", "sentence"} <= findings.keys()
    assert findings["server"]["state"] == findings["sentence"]["state"] == "ok"


def test_a_player_is_awaited_paused_and_killed_and_its_failure_is_reported(make_talk: MakeTalk) -> None:
    """talk's own driver with two players: one plays on after its input ends, and the other fails."""
    env = {"PYTHONPATH": PATH, "TALK_TEST_PLATFORM": "linux"}
    talk = make_talk("--player", "sh -c 'cat >/dev/null; sleep 0.4'", "--rate", "450", env=env)
    assert talk.run("say", "--wait", "hi").code == 0
    goal_id = talk.run("say", "a sentence of some length, which nobody will hear to its very end").id
    talk.watcher.wait_for_word(goal_id)
    assert talk.request("pause")["goal"]["id"] == goal_id
    assert talk.request("resume")["goal"]["paused"] is False
    assert talk.run("cancel").id == goal_id
    assert talk.goal(goal_id)["state"] == "PREEMPTED"
    failing = make_talk("--player", "sh -c 'echo no such device >&2; exit 1'", env=env)
    done = failing.run("say", "--wait", "hi")
    assert (done.code, "no such device" in done.err) == (4, True)
