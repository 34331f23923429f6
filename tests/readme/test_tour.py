"""The README's examples for speaking, waiting, cancelling, status commands and files."""

from __future__ import annotations

import wave
from typing import TYPE_CHECKING

from tests.conformance.bareserve import TALK, serving
from tests.readme.blocks import commands, runs
from tests.readme.shell import wait_for_watcher, wait_until
from tests.support.surroundings import needs, short_directory

if TYPE_CHECKING:
    from tests.readme.shell import Shell
    from tests.support.processes import Talk


def without_servers(name: str, talk: Talk) -> str:
    """Return the commands of an example without those that start a server. Run these on another socket."""
    servers = [command for command in commands(name) if command.startswith("talk serve")]
    for server in servers:
        command = [*TALK, *server.split()[1:]]
        with short_directory() as place, serving({**talk.env, "TALK_SOCKET": f"{place}/s"}, command=command):
            pass
    return "\n".join(command for command in commands(name) if command not in servers)


@runs("talk", "Say something", "Wait for the result", "Say something: Interrupt", "Choose a voice")
def test_goals_are_spoken_awaited_and_preempted(speaking: Talk, shell: Shell) -> None:
    for program, text in (("date", "Thursday"), ("llm", "at your service")):
        shell.program(program, f"echo {text}")
    for program in ("move_arm", "close_door"):
        shell.stand_in(program)
    for name in ("talk", "Say something", "Wait for the result", "Say something: Interrupt", "Choose a voice"):
        done = shell.run(without_servers(name, speaking), text="-5 degrees")
        assert (done.returncode, done.stderr) == (0, ""), name
    assert (len(shell.calls("move_arm")), len(shell.calls("close_door"))) == (1, 1)
    texts = speaking.watcher.texts("PENDING")
    assert texts[:5] == ["battery low", "stop", "moving to the charger", "-5 degrees", "Thursday"]
    assert texts[5:8] == ["at your service", "please step back", "the door is closing"]
    speaking.watcher.wait_until(lambda _: "emergency stop" in speaking.watcher.texts("SUCCEEDED"))
    (door,) = [goal for goal in map(speaking.goal, speaking.watcher.goals()) if goal["text"].endswith("at the door")]
    assert door["priority"] == 10
    settings = speaking.request("set")["settings"]
    assert (settings["rate"], settings["voice"], "German" in done.stdout) == (140, "german", True)


@runs("Say something: Drop outdated sentences", "Stop")
def test_options_of_a_goal_and_cancels_work(speaking: Talk, shell: Shell) -> None:
    *cancels, pause, resume = commands("Stop")
    assert shell.run(pause).returncode == 0
    assert speaking.request("status")["server"]["paused"]
    done = shell.run("\n".join(commands("Say something: Drop outdated sentences")))
    assert done.returncode == 0
    first, second, _, fourth = map(speaking.goal, done.stdout.split())
    assert (first["ttl"], second["key"], fourth["id"]) == (5, "eta", "docking-17")
    speaking.request("cancel")
    while speaking.request("say", text="before")["goal"]["id"].rpartition("-")[2] != "11":
        pass
    ids = [speaking.request("say", text=f"number {number}")["goal"]["id"] for number in range(12, 16)]
    ids.append(speaking.request("say", text="four minutes", key="eta")["goal"]["id"])
    ended = {line: shell.run(line).stdout.split() for line in reversed(cancels)}
    assert (ended["talk cancel --key eta"], ended["talk cancel --before 12"][-1:]) == (ids[4:], ids[:1])
    assert (ended["talk cancel 12 13"], ended["talk cancel --current"], ended["talk cancel"]) == (
        ids[1:2],
        [],
        ids[2:4],
    )
    assert shell.run(resume).returncode == 0
    assert not speaking.request("status")["server"]["paused"]


@runs("Ask what it says", "Wait for the result: Follow the words")
def test_status_commands_and_feedback_work(scripted: Talk, scripted_shell: Shell) -> None:
    for number in range(1, 13):
        scripted.watcher.wait_for_terminal(scripted.request("say", text=f"length=0 number {number}")["goal"]["id"])
    for line in commands("Ask what it says"):
        if line == "talk watch":
            scripted_shell.start(f"{line} > watched")
            wait_for_watcher(scripted)
            scripted.run("say", "--wait", "--", "who watches?")
            wait_until(lambda: "who watches?" in (scripted_shell.directory / "watched").read_text(encoding="utf-8"))
        else:
            done = scripted_shell.run(line)
            if line == "talk doctor":  # its findings depend on this machine
                assert (done.returncode in {0, 4}, "sentence" in done.stdout) == (True, True), done
            else:
                assert (done.returncode, "number 12" in done.stdout) == (0, True), done
    scripted_shell.stand_in("lips", directory=scripted_shell.directory)
    done = scripted_shell.run("\n".join(commands("Wait for the result: Follow the words")), text="follow me")
    assert (done.returncode, done.stderr) == (0, "")
    assert [word for (word,) in scripted_shell.calls("lips")] == ["follow", "me"]


@runs("Say something: Write a WAV file")
def test_a_wav_file_is_written_and_played(shell: Shell) -> None:
    needs("aplay")
    (shell.directory / ".asoundrc").write_text("pcm.!default { type null }\n", encoding="utf-8")
    done = shell.run("set -e\n" + "\n".join(commands("Say something: Write a WAV file")))
    assert (done.returncode, "22050" in done.stderr) == (0, True)  # aplay prints the sample rate
    with wave.open(str(shell.directory / "welcome.wav")) as file:
        assert file.getnframes() > file.getframerate() / 4
