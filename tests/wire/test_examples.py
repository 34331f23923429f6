"""The documents' examples for the protocol and the library, run with a server."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.support.documents import README, WIRE, Document
from tests.support.surroundings import needs
from tests.wire.test_recorded import differences

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk

#: A robot for the README's loop. It is blocked until the goal has been spoken.
ROBOT = """
import time

class Robot:
    blocked = True
    steps = 0
    lips = []

    def drives(self):
        self.steps += 1
        time.sleep(0.02)
        return self.blocked and self.steps < 500

    def move_lips(self, word):
        self.lips.append(word)

    def wait_for_people(self):
        self.blocked = False

    def flash_lights(self):
        raise SystemExit("nobody heard it")

robot = Robot()
{example}
print(*robot.lips)
"""


def only(document: Document, language: str, title: str | None, mark: str) -> str:
    """Return the only example of a section or document that contains `mark`."""
    (found,) = [example for example in document.examples(language, title) if mark in example]
    return found


def run(talk: Talk, *command: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command, env=talk.env, capture_output=True, text=True, timeout=20, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done


def test_a_goal_can_be_sent_with_socat(scripted: Talk) -> None:
    needs("socat")
    done = run(scripted, "sh", "-c", only(WIRE, "sh", None, "socat -t 5"))
    greeting, reply = map(json.loads, done.stdout.splitlines())
    assert (greeting["talk"], reply["goal"]["text"]) == (1, "battery low")
    assert scripted.watcher.wait_for_terminal(reply["goal"]["id"]) == "SUCCEEDED"


def test_the_conversation_about_a_growing_text(make_talk: MakeTalk) -> None:
    section = WIRE.section("Speak a text while it is written")
    lines = re.findall(r"^([→←]) (.*)$", section, re.MULTILINE)
    assert len(lines) == 13
    unused: list[Message] = []
    with make_talk("--player", "null", "--rate", "450").connect() as client:
        for arrow, line in lines:
            message = json.loads(line.replace(", …", ""))
            if arrow == "→":
                client.send(message)
                continue
            while not (matches := [candidate for candidate in unused if not differences(message, candidate)]):
                unused.append(client.receive())
            unused.remove(matches[0])
    assert {message.get("event") for message in unused} == {"word"}


@pytest.fixture
def shell_client(tmp_path: Path) -> str:
    needs("socat")
    path = tmp_path / "say.sh"
    path.write_text(only(WIRE, "sh", "Two clients", "say.sh"), encoding="utf-8")
    return str(path)


def test_the_shell_client_reports_each_result(scripted: Talk, shell_client: str) -> None:
    ends = {
        'she said "go", \\o/ and\nleft': ("SUCCEEDED", 0),
        '"event": "result", "state": "ABORTED"': ("SUCCEEDED", 0),
        "fail=audio_lost": ("ABORTED", 4),
        "": ("REJECTED", 5),
    }
    for text, (state, code) in ends.items():
        done = run(scripted, "sh", shell_client, text)
        assert (done.stdout, done.returncode) == (f"{state}\n", code)
    spoken = [
        event["goal"]["text"] for event in scripted.watcher.events() if event.get("state") in ("PENDING", "REJECTED")
    ]
    assert spoken == [text.replace("\n", " ") for text in ends]
    scripted.stop()
    done = run(scripted, "sh", shell_client, "battery low")
    assert (done.stdout, done.returncode) == ("no result\n", 1)


def test_the_shell_client_cancels_its_goal_on_ctrl_c(scripted: Talk, shell_client: str) -> None:
    with subprocess.Popen(["sh", shell_client, "never-ends"], env=scripted.env, start_new_session=True) as client:
        goal = scripted.watcher.wait_for(None, "ACTIVE")["id"]
        os.killpg(client.pid, signal.SIGINT)
        assert client.wait(10) == 130
    assert scripted.watcher.wait_for_terminal(goal) == "PREEMPTED"


def test_the_plain_python_client_prints_the_words(scripted: Talk) -> None:
    example = only(WIRE, "python", "Two clients", "socket")
    assert "talkcli" not in example
    done = run(scripted, sys.executable, "-c", example)
    assert done.returncode == 0, done
    *words, last = done.stdout.splitlines()
    assert last == "SUCCEEDED Talk completed successfully"
    assert [line.split()[1] for line in words] == ["battery", "low,", "going", "home"]
    times = [float(line.split()[0]) for line in words]
    assert times == sorted(times)
    refused = run(scripted, sys.executable, "-c", example.replace('"feedback": True', '"melody": True'))
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "melody" in refused.stderr


def test_the_first_example_of_the_library_prints_the_words(scripted: Talk) -> None:
    done = run(scripted, sys.executable, "-c", only(README, "python", "Use it from Python", "battery low"))
    assert done.returncode == 0, done
    assert [line.split(": ")[1] for line in done.stdout.splitlines()] == ["follow", "me", "to", "the", "charger"]


def test_the_loop_of_a_robot_speaks(scripted: Talk) -> None:
    example = only(README, "python", "Use it from Python", "robot.drives")
    done = run(scripted, sys.executable, "-c", ROBOT.format(example=example))
    assert (done.returncode, done.stdout, done.stderr) == (0, "please let me pass\n", "")


@pytest.mark.parametrize(
    ("on_word", "lights", "shown", "state"),
    [
        ("self.blocked = False", 'raise SystemExit("the goal failed")', "", "PREEMPTED"),
        ("os.kill({pid}, signal.SIGKILL)", 'self.blocked, self.lips = False, ["lights"]', "lights", None),
    ],
    ids=["way is free", "server is killed"],
)
def test_the_loop_of_a_robot_handles_an_aborted_goal(
    scripted: Talk, on_word: str, lights: str, shown: str, state: str | None
) -> None:
    """The loop cancels a goal that is no longer needed, and flashes the lights if the goal is lost."""
    example = only(README, "python", "Use it from Python", "robot.drives").replace("please let me pass", "never-ends")
    example = example.replace("Client(name", "Client(timeout=0.3, name")
    robot = ROBOT.replace("self.lips.append(word)", on_word.format(pid=scripted.pid))
    robot = robot.replace('raise SystemExit("nobody heard it")', lights)
    scripted.unfinished = state is None
    done = run(scripted, sys.executable, "-c", "import os, signal\n" + robot.format(example=example))
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{shown}\n", "")
    if state:
        assert scripted.watcher.wait_for(None, state)["goal"]["reason"] == "canceled"
