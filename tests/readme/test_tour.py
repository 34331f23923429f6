"""The examples of "A tour" and of the first page, as they stand there."""

from __future__ import annotations

import signal
import subprocess
import sys
import wave
from typing import TYPE_CHECKING

import pytest

from tests.readme.blocks import commands, runs
from tests.readme.shell import wait_for_watcher, wait_until
from tests.support.connection import PATIENCE
from tests.support.surroundings import needs, short_directory

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.readme.shell import Shell
    from tests.support.processes import Talk


@pytest.fixture
def speaking(make_talk: MakeTalk) -> Talk:
    """A server with the real engine that speaks fast, and plays to nobody in its time: goals can be preempted."""
    return make_talk("--player", "null", "--rate", "450")


def assert_serves(options: list[str], talk: Talk) -> None:
    """Start a server beside the one of the test, and end it."""
    with short_directory() as place:
        command = [sys.executable, "-m", "talkcli", "serve", *options, "--socket", f"{place}/s"]
        server = subprocess.Popen(command, env=talk.env, stderr=subprocess.PIPE, text=True)
        assert server.stderr
        with server:
            try:
                assert "ready on" in server.stderr.readline()
            finally:
                server.send_signal(signal.SIGTERM)
                server.communicate(timeout=PATIENCE)
        assert server.returncode == 0


def without_serve(name: str, talk: Talk) -> str:
    """Return a block without the servers that it starts, after each was started by itself."""
    others = []
    for line in commands(name):
        if line.startswith("talk serve"):
            assert_serves(line.split()[2:], talk)
        else:
            others.append(line)
    return "\n".join(others)


@runs("talk")
def test_first_page(speaking: Talk, shell: Shell) -> None:
    done = shell.run("\n".join(commands("talk")))
    assert (done.returncode, done.stderr) == (0, "")
    assert "SUCCEEDED" in done.stdout
    assert speaking.watcher.texts("PENDING") == ["battery low", "stop"]


@runs("A tour: Speak")
def test_speak(speaking: Talk, shell: Shell) -> None:
    shell.program("dmesg", "printf 'first\\nusb 1-1: new device\\n'")
    done = shell.run("\n".join(commands("A tour: Speak")), text="-5 degrees")
    assert (done.returncode, done.stderr, len(done.stdout.split())) == (0, "", 3)
    assert speaking.watcher.texts("PENDING") == ["moving to the charger", "-5 degrees", "usb 1-1: new device"]


@runs("A tour: Wait")
def test_wait(speaking: Talk, shell: Shell) -> None:
    shell.stand_in("move_arm")
    shell.stand_in("close_door")
    done = shell.run("\n".join(commands("A tour: Wait")))
    assert (done.returncode, done.stderr) == (0, "")
    assert (len(shell.calls("move_arm")), len(shell.calls("close_door"))) == (1, 1)
    assert speaking.watcher.texts("SUCCEEDED") == ["please step back", "the door is closing"]


@runs("A tour: Preempt")
def test_preempt(speaking: Talk, shell: Shell) -> None:
    speaking.request("say", text="a long story that nobody hears to its end, for something happens")
    speaking.watcher.wait_for(None, "ACTIVE")
    done = shell.run(without_serve("A tour: Preempt", speaking))
    assert (done.returncode, done.stderr) == (0, "")
    *_, last = done.stdout.split()
    assert speaking.watcher.wait_for_terminal(last) == "SUCCEEDED"
    assert speaking.watcher.texts("SUCCEEDED")[-1] == "emergency stop"


@runs("A tour: Priority and time")
def test_priority_and_time(speaking: Talk, shell: Shell) -> None:
    speaking.request("pause")
    done = shell.run("\n".join(commands("A tour: Priority and time")))
    assert done.returncode == 0
    first, second, third, _, fifth = map(speaking.goal, done.stdout.split())
    assert (first["priority"], second["ttl"], third["key"], fifth["id"]) == (10, 5, "eta", "docking-17")
    speaking.request("cancel")


@runs("A tour: Cancel and pause")
def test_cancel_and_pause(speaking: Talk, shell: Shell) -> None:
    """Speech is held, and goals are cancelled from the last line to the first, which leaves nothing."""
    *cancels, pause, resume = commands("A tour: Cancel and pause")
    assert shell.run(pause).returncode == 0
    assert speaking.request("status")["server"]["paused"]
    ids = [speaking.request("say", text=f"number {each}")["goal"]["id"] for each in range(1, 16)]
    ids.append(speaking.request("say", text="four minutes", key="eta")["goal"]["id"])
    ended = {}
    for line in reversed(cancels):
        done = shell.run(line)
        assert done.returncode == 0, line
        ended[line] = done.stdout.split()
    assert ended == {
        "talk cancel --key eta": ids[15:],
        "talk cancel --before 12": ids[:12],
        "talk cancel 12 13": ids[12:13],
        "talk cancel --current": [],
        "talk cancel": ids[13:15],
    }
    assert shell.run(resume).returncode == 0
    assert not speaking.request("status")["server"]["paused"]


@runs("A tour: Look")
def test_look(scripted: Talk, scripted_shell: Shell) -> None:
    for number in range(1, 13):
        scripted.watcher.wait_for_terminal(scripted.request("say", text=f"length=0 number {number}")["goal"]["id"])
    for line in commands("A tour: Look"):
        if line == "talk watch":
            scripted_shell.start(f"{line} > watched")
            wait_for_watcher(scripted)
            scripted.run("say", "--wait", "--", "who watches?")
            wait_until(lambda: "who watches?" in (scripted_shell.directory / "watched").read_text(encoding="utf-8"))
        else:
            done = scripted_shell.run(line)
            if line == "talk doctor":  # says of this machine what it finds
                assert (done.returncode in {0, 4}, "sentence" in done.stdout) == (True, True), done
            else:
                assert (done.returncode, "number 12" in done.stdout) == (0, True), done


@runs("A tour: Feedback")
def test_feedback(scripted: Talk, scripted_shell: Shell) -> None:
    for number in range(1, 13):
        scripted.watcher.wait_for_terminal(scripted.request("say", text=f"length=0 number {number}")["goal"]["id"])
    scripted_shell.stand_in("lips", where=scripted_shell.directory)
    done = scripted_shell.run("\n".join(commands("A tour: Feedback")), text="follow me")
    assert (done.returncode, done.stderr) == (0, "")
    assert [each for (each,) in scripted_shell.calls("lips")] == ["follow", "me"]


@runs("A tour: Sound")
def test_sound(speaking: Talk, shell: Shell) -> None:
    done = shell.run(without_serve("A tour: Sound", speaking))
    assert (done.returncode, done.stderr) == (0, "")
    settings = speaking.request("set")["settings"]
    assert (settings["rate"], settings["voice"]) == (140, "german")
    assert "German" in done.stdout


@runs("A tour: Files")
def test_files(shell: Shell) -> None:
    needs("aplay")
    (shell.directory / ".asoundrc").write_text("pcm.!default { type null }\n", encoding="utf-8")
    done = shell.run("set -e\n" + "\n".join(commands("A tour: Files")))
    assert (done.returncode, "22050" in done.stderr) == (0, True)  # aplay says what it plays
    with wave.open(str(shell.directory / "welcome.wav")) as file:
        assert file.getnframes() > file.getframerate() / 4
