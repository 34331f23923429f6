"""The README's examples, run as they stand there against a server."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.states import EXIT_CODES
from tests.support.surroundings import needs
from tests.wire.readme import examples, section

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

#: What jq does for the microphone, where there is none.
JQ = """
import json, sys
for line in sys.stdin:
    event = json.loads(line)
    if event["event"] == "state":
        print(event["state"])
"""


def only(language: str, title: str, mark: str) -> str:
    """Return the one example of a section that has a mark in it."""
    (found,) = [each for each in examples(language, section(title)) if mark in each]
    return found


def shell_client(directory: Path) -> str:
    path = directory / "say.sh"
    path.write_text(only("sh", "Two clients", "say.sh"), encoding="utf-8")
    return str(path)


def run(talk: Talk, *command: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command, env=talk.env, capture_output=True, text=True, timeout=20, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done


def write_program(path: Path, script: str) -> None:
    path.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
    path.chmod(0o755)


def with_talk(talk: Talk, directory: Path) -> dict[str, str]:
    """Return an environment in which `talk` is a program, as it is where talk is installed."""
    write_program(directory / "talk", f'exec {sys.executable} -m talkcli "$@"')
    return {**talk.env, "PATH": f"{directory}:{os.environ['PATH']}"}


def shell(talk: Talk, directory: Path, script: str) -> subprocess.CompletedProcess[str]:
    """Run a script that calls `talk`."""
    env = with_talk(talk, directory)
    return subprocess.run(["sh", "-c", script], env=env, capture_output=True, text=True, timeout=20, check=False)


def test_shell_can_read_every_example() -> None:
    for each in examples("sh"):
        done = subprocess.run(["sh", "-n"], input=each, capture_output=True, text=True, timeout=20, check=False)
        assert (done.returncode, done.stderr) == (0, ""), each


def test_line_of_socat_says_a_sentence(scripted: Talk) -> None:
    needs("socat")
    done = run(scripted, "sh", "-c", only("sh", "The wire", "battery low"))
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
    example = only("python", "Two clients", "socket")
    assert "talkcli" not in example
    done = run(scripted, sys.executable, "-c", example)
    assert done.returncode == 0, done
    *told, last = done.stdout.splitlines()
    assert last == "SUCCEEDED Talk completed successfully"
    assert [each.split()[1] for each in told] == ["battery", "low,", "going", "home"]
    times = [float(each.split()[0]) for each in told]
    assert times == sorted(times)


def test_client_in_plain_python_is_told_of_errors(scripted: Talk) -> None:
    example = only("python", "Two clients", "socket").replace('"feedback": True', '"melody": True')
    done = run(scripted, sys.executable, "-c", example)
    assert (done.returncode, done.stdout) == (1, "")
    assert "melody" in done.stderr


def test_first_example_of_the_library(scripted: Talk) -> None:
    done = run(scripted, sys.executable, "-c", only("python", "A tour", "battery low"))
    assert done.returncode == 0, done
    assert [each.split(": ")[1] for each in done.stdout.splitlines()] == ["follow", "me", "to", "the", "charger"]


def test_loop_of_a_robot(scripted: Talk) -> None:
    done = run(scripted, sys.executable, "-c", ROBOT.format(example=only("python", "A tour", "def patrol")))
    assert (done.returncode, done.stdout, done.stderr) == (0, "please let me pass\n", "")


def test_loop_of_a_robot_cancels_what_is_not_true_any_more(scripted: Talk) -> None:
    example = only("python", "A tour", "def patrol").replace("please let me pass", "never-ends")
    robot = ROBOT.replace("self.lips.append(word)", "self.blocked, self.steps = False, 490").replace(
        "return self.blocked and", "return"
    )
    done = run(scripted, sys.executable, "-c", robot.format(example=example))
    assert (done.returncode, done.stderr) == (0, "")
    goal = scripted.watcher.wait_for(None, "PREEMPTED")
    assert goal["goal"]["reason"] == "canceled"


def test_loop_of_a_robot_whose_server_is_killed(scripted: Talk) -> None:
    """The voice is gone, the robot knows and goes on."""
    example = only("python", "A tour", "def patrol").replace("please let me pass", "never-ends")
    robot = ROBOT.replace("self.lips.append(word)", f"os.kill({scripted.pid}, signal.SIGKILL)").replace(
        'raise SystemExit("nobody heard it")', 'self.lips, self.blocked = ["lights"], False'
    )
    done = run(scripted, sys.executable, "-c", "import os, signal\n" + robot.format(example=example))
    scripted.unfinished = True
    assert (done.returncode, done.stdout, done.stderr) == (0, "lights\n", "")


def test_battery_low_is_not_said_twice(scripted: Talk, tmp_path: Path) -> None:
    (line,) = [each for each in examples("sh") if "--key battery" in each]
    first = shell(scripted, tmp_path, line)
    assert first.returncode == 0, first
    assert scripted.watcher.wait_for_terminal(first.stdout.strip()) == "SUCCEEDED"
    second = shell(scripted, tmp_path, line)
    assert (second.returncode, second.stdout) == (0, "")
    assert scripted.watcher.wait_until(lambda each: each.get("state") == "REJECTED")["goal"]["reason"] == "throttled"


def test_lines_of_a_log_are_spoken(scripted: Talk, tmp_path: Path) -> None:
    (line,) = [row for each in examples("sh") for row in each.splitlines() if "--lines" in row]
    command = line.split("|")[1].split("#")[0].strip()
    done = shell(scripted, tmp_path, f"printf 'docking\\n\\ndocked\\n' | {command}")
    assert done.returncode == 0, done
    scripted.watcher.wait_until(lambda each: (each.get("goal") or {}).get("text") == "docked")
    texts = [each["goal"]["text"] for each in scripted.watcher.events() if each.get("state") == "PENDING"]
    assert texts == ["docking", "docked"]


def test_microphone_is_muted_while_the_robot_speaks(scripted: Talk, tmp_path: Path) -> None:
    (line,) = [each for each in examples("sh") if "wpctl" in each]
    if shutil.which("jq") is None:
        write_program(tmp_path / "jq", f"exec {sys.executable} -u -c '{JQ}'")
    calls = tmp_path / "calls"
    os.mkfifo(calls)
    write_program(tmp_path / "wpctl", f'echo "$3" > {calls}')
    watching = subprocess.Popen(["sh", "-c", line], env=with_talk(scripted, tmp_path), start_new_session=True)
    with watching, open(os.open(calls, os.O_RDWR), encoding="utf-8") as told:
        try:
            while scripted.request("status")["server"]["clients"] < 3:  # the test's watcher, this, and the README's
                time.sleep(0.02)  # who watches is no event
            for text in ("one", "two"):
                assert scripted.run("say", "--wait", "--", text).code == 0
                assert [told.readline(), told.readline()] == ["1\n", "0\n"]
        finally:
            os.killpg(watching.pid, signal.SIGTERM)
