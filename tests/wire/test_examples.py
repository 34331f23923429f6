"""The examples of the wire and of the library, run as they stand in the documents against a server."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from talkcli.goals.states import EXIT_CODES
from tests.support.documents import README, WIRE, Document
from tests.support.surroundings import needs

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.processes import Talk

#: What the loop of the README's robot needs: it is blocked for as long as nobody has heard it.
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
    """Return the one example of a section, or of a whole document, that has a mark in it."""
    (found,) = [each for each in document.examples(language, title) if mark in each]
    return found


def shell_client(directory: Path) -> str:
    path = directory / "say.sh"
    path.write_text(only(WIRE, "sh", "Two clients", "say.sh"), encoding="utf-8")
    return str(path)


def run(talk: Talk, *command: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command, env=talk.env, capture_output=True, text=True, timeout=20, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done


def test_line_of_socat_says_a_sentence(scripted: Talk) -> None:
    needs("socat")
    done = run(scripted, "sh", "-c", only(WIRE, "sh", None, "socat -t 5"))
    greeting, reply = map(json.loads, done.stdout.splitlines())
    assert (greeting["talk"], reply["goal"]["text"]) == (1, "battery low")
    assert scripted.watcher.wait_for_terminal(reply["goal"]["id"]) == "SUCCEEDED"


@pytest.mark.parametrize(
    ("text", "state"),
    [
        ("battery low", "SUCCEEDED"),
        ('she said "go", \\o/ and\nleft', "SUCCEEDED"),
        ('"event": "result", "state": "ABORTED"', "SUCCEEDED"),
        ("fail=audio_lost", "ABORTED"),
        ("", "REJECTED"),
    ],
)
def test_client_in_shell(text: str, state: str, scripted: Talk, tmp_path: Path) -> None:
    needs("socat")
    done = run(scripted, "sh", shell_client(tmp_path), text)
    codes = {each.name: code for each, code in EXIT_CODES.items()}
    assert (done.stdout, done.returncode) == (f"{state}\n", codes[state])
    scripted.watcher.wait_for(None, state)
    (goal,) = [each["goal"] for each in scripted.watcher.events() if "goal" in each and each["state"] == state]
    assert goal["text"] == text.replace("\n", " ")


def test_client_in_shell_without_a_server(scripted: Talk, tmp_path: Path) -> None:
    needs("socat")
    scripted.stop()
    done = run(scripted, "sh", shell_client(tmp_path), "battery low")
    assert (done.stdout, done.returncode) == ("no result\n", 1)


def test_client_in_shell_cancels_on_ctrl_c(scripted: Talk, tmp_path: Path) -> None:
    needs("socat")
    client = subprocess.Popen(
        ["sh", shell_client(tmp_path), "never-ends"],
        env=scripted.env,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    with client:
        goal = scripted.watcher.wait_for(None, "ACTIVE")["id"]
        os.killpg(client.pid, signal.SIGINT)
        client.communicate(timeout=10)
    assert client.returncode == 130
    assert scripted.watcher.wait_for_terminal(goal) == "PREEMPTED"


def test_client_in_plain_python(scripted: Talk) -> None:
    example = only(WIRE, "python", "Two clients", "socket")
    assert "talkcli" not in example
    done = run(scripted, sys.executable, "-c", example)
    assert done.returncode == 0, done
    *told, last = done.stdout.splitlines()
    assert last == "SUCCEEDED Talk completed successfully"
    assert [each.split()[1] for each in told] == ["battery", "low,", "going", "home"]
    times = [float(each.split()[0]) for each in told]
    assert times == sorted(times)


def test_client_in_plain_python_is_told_of_errors(scripted: Talk) -> None:
    example = only(WIRE, "python", "Two clients", "socket").replace('"feedback": True', '"melody": True')
    done = run(scripted, sys.executable, "-c", example)
    assert (done.returncode, done.stdout) == (1, "")
    assert "melody" in done.stderr


def test_first_example_of_the_library(scripted: Talk) -> None:
    done = run(scripted, sys.executable, "-c", only(README, "python", "A tour", "battery low"))
    assert done.returncode == 0, done
    assert [each.split(": ")[1] for each in done.stdout.splitlines()] == ["follow", "me", "to", "the", "charger"]


def test_loop_of_a_robot(scripted: Talk) -> None:
    done = run(scripted, sys.executable, "-c", ROBOT.format(example=only(README, "python", "A tour", "robot.drives")))
    assert (done.returncode, done.stdout, done.stderr) == (0, "please let me pass\n", "")


def test_loop_of_a_robot_cancels_what_is_not_true_any_more(scripted: Talk) -> None:
    example = only(README, "python", "A tour", "robot.drives").replace("please let me pass", "never-ends")
    robot = ROBOT.replace("self.lips.append(word)", "self.blocked, self.steps = False, 490").replace(
        "return self.blocked and", "return"
    )
    done = run(scripted, sys.executable, "-c", robot.format(example=example))
    assert (done.returncode, done.stderr) == (0, "")
    goal = scripted.watcher.wait_for(None, "PREEMPTED")
    assert goal["goal"]["reason"] == "canceled"


def test_loop_of_a_robot_whose_server_is_killed(scripted: Talk) -> None:
    """The voice is gone, the robot knows and goes on."""
    example = only(README, "python", "A tour", "robot.drives").replace("please let me pass", "never-ends")
    robot = ROBOT.replace("self.lips.append(word)", f"os.kill({scripted.pid}, signal.SIGKILL)").replace(
        'raise SystemExit("nobody heard it")', 'self.lips, self.blocked = ["lights"], False'
    )
    done = run(scripted, sys.executable, "-c", "import os, signal\n" + robot.format(example=example))
    scripted.unfinished = True
    assert (done.returncode, done.stdout, done.stderr) == (0, "lights\n", "")
