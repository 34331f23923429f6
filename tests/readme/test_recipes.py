"""The examples of "Recipes", with stand-ins for the robot, for other machines, and for what hears and mutes."""

from __future__ import annotations

import contextlib
import functools
import signal
import subprocess
import sys
import types
from typing import TYPE_CHECKING, Any

import pytest

from tests.readme.blocks import block, runs
from tests.readme.shell import Shell, wait_until
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.processes import Talk

#: What a text may have in it that a shell takes for something else.
AWKWARD = "it's \"5\" o'clock; $HOME & `more` -- \\n"


def said(talk: Talk) -> list[str]:
    """Return the texts of all goals, in their order."""
    return [talk.goal(each)["text"] for each in talk.watcher.goals()]


@runs("Recipes: Drive only if it was heard")
def test_drive_only_if_it_was_heard(scripted: Talk, scripted_shell: Shell) -> None:
    script = block("Recipes: Drive only if it was heard")
    for name in ("drive", "flash"):
        scripted_shell.stand_in(name, where=scripted_shell.directory)
    assert scripted_shell.run(script, "moving off").returncode == 0
    assert (len(scripted_shell.calls("drive")), len(scripted_shell.calls("flash"))) == (1, 0)
    assert "no loudspeaker" in scripted_shell.run(script, "fail=audio_device").stdout
    assert (len(scripted_shell.calls("drive")), len(scripted_shell.calls("flash"))) == (1, 1)
    waiting = scripted_shell.start(script, "never-ends")
    scripted.watcher.wait_until(lambda each: (each.get("goal") or {}).get("text") == "never-ends")
    scripted.run("say", "--preempt", "--wait", "--", "obstacle")
    out, _ = waiting.communicate(timeout=20)
    assert "somebody was quicker" in out
    assert "not spoken" in scripted_shell.run(script, "").stdout
    scripted.stop()
    assert "no server" in scripted_shell.run(script, "moving off").stdout


@runs("Recipes: Battery guard")
def test_battery_guard(scripted: Talk, scripted_shell: Shell) -> None:
    battery = scripted_shell.directory / "capacity"
    for charge in ("80", "19", "18", "4"):
        battery.write_text(f"{charge}\n", encoding="utf-8")
        done = scripted_shell.run(block("Recipes: Battery guard"), BATTERY=str(battery))
        assert (done.returncode, done.stdout, done.stderr) == (0, "", ""), done  # 18: throttled
    assert said(scripted)[:1] == ["battery at 19 percent"]
    assert [each for each in said(scripted) if "stop" in each] == ["battery at 4 percent, I have to stop"]
    assert scripted_shell.run(block("Recipes: Battery guard"), BATTERY="/nowhere").returncode != 0


@runs("Recipes: Log to speech")
def test_log_to_speech(scripted: Talk, scripted_shell: Shell) -> None:
    scripted_shell.stand_in("tail", "printf 'INFO fine\\n12:00 ERROR -5 degrees\\nINFO\\nERROR arm blocked\\n'")
    done = scripted_shell.run(block("Recipes: Log to speech"))
    assert done.returncode == 0, done
    assert scripted_shell.calls("tail") == [["-n", "0", "-F", "/var/log/robot.log"]]
    assert said(scripted) == ["ERROR -5 degrees", "ERROR arm blocked"]


@runs("Recipes: Microphone mute")
def test_microphone_mute(scripted: Talk, scripted_shell: Shell) -> None:
    scripted_shell.stand_in("wpctl")
    heard = scripted_shell.directory / "heard"
    scripted_shell.program("talk", f'{sys.executable} -m talkcli "$@" | tee {heard}')
    scripted_shell.start(block("Recipes: Microphone mute"))
    wait_until(lambda: heard.exists() and heard.stat().st_size > 0)  # it begins with what there is now
    for number, text in enumerate(("one", "fail=audio_lost"), 1):
        scripted.run("say", "--wait", "--", text)
        calls = scripted_shell.wait_for_call("wpctl", 2 * number)
        assert calls[-2:] == [["set-mute", "@DEFAULT_AUDIO_SOURCE@", each] for each in "10"]
    scripted.run("say", "--", "never-ends")
    scripted_shell.wait_for_call("wpctl", 5)
    scripted.kill()
    assert [each[-1] for each in scripted_shell.wait_for_call("wpctl", 6)[-2:]] == ["1", "0"]


@runs("Recipes: Watchdog")
@pytest.mark.parametrize(
    ("program", "code", "words"),
    [
        (["true"], 0, "true is done"),
        (["sh", "-c", "exit 3"], 3, "sh failed with code 3"),
        (["/bin/sh", "-c", "kill -9 $$"], 137, "sh was killed by signal 9"),
    ],
)
def test_watchdog(program: list[str], code: int, words: str, scripted: Talk, scripted_shell: Shell) -> None:
    done = scripted_shell.run(block("Recipes: Watchdog"), *program)
    assert done.returncode == code
    assert said(scripted) == [f"I have stopped: {words}"]


@runs("Recipes: cron")
def test_cron(speaking: Talk, shell: Shell) -> None:
    """As cron does it: its own PATH, hardly a variable, a percent sign is a newline unless it is escaped."""
    shell.stand_in("logger")
    path, *jobs = block("Recipes: cron").splitlines()
    assert path.startswith("PATH=/usr/local/bin:")
    kept = {name: value for name, value in shell.env.items() if not name.startswith(("PULSE", "PIPEWIRE", "LANG"))}
    for job in jobs:
        *times, command = job.split(None, 5)
        assert len(times) == 5
        assert "%" not in command.replace("\\%", "")
        env = {**kept, "PATH": f"{shell.directory}/bin:/usr/bin:/bin"}
        run = functools.partial(subprocess.run, env=env, capture_output=True, text=True, timeout=30, check=False)
        done = run(["/bin/sh", "-c", command.replace("\\%", "%")])
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")  # what it prints is mailed
    (clock,) = said(speaking)  # what doctor plays in silence is no goal
    assert clock.startswith("It is ")
    assert clock.endswith(" o'clock")
    assert shell.calls("logger") == [["-t", "talk", "the robot is mute"]]  # its player is a file
    speaking.stop()
    done = run(["/bin/sh", "-c", jobs[0].split(None, 5)[5].replace("\\%", "%")])
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.startswith("talk: no server")


@runs("Recipes: ssh")
def test_ssh(speaking: Talk, shell: Shell) -> None:
    """What is said, and what with the server gone."""
    shell.ssh()
    done = shell.run(block("Recipes: ssh"), text=AWKWARD)
    assert (done.returncode, done.stderr) == (0, "")
    assert "not heard" not in done.stdout
    assert said(speaking) == ["hello from the office", AWKWARD]
    assert shell.calls("ssh")[0] == ["robot", "talk", "status"]
    speaking.stop()
    assert "not heard\n" in shell.run(block("Recipes: ssh"), text=AWKWARD).stdout


@runs("Recipes: The socket, forwarded")
def test_socket_forwarded(speaking: Talk, shell: Shell) -> None:
    shell.ssh()
    with short_directory() as home:
        done = shell.run(block("Recipes: The socket, forwarded") + "talk status\n", HOME=home)
        assert (done.returncode, done.stderr) == (0, "")
        assert said(speaking) == ["hello from the office"]
        _, forward = shell.calls("ssh")
        assert forward[-3:] == ["-L", f"{home}/.robot.sock:{speaking.socket}", "robot"]


class _Launched:
    """What the launch file makes, with the names that launch has."""

    def __init__(self, *, cmd: list[str], name: str, output: str, respawn: bool, respawn_delay: float) -> None:
        self.cmd = cmd
        assert (name, output, respawn, respawn_delay > 0) == ("talk", "screen", True, True)


#: The modules of launch, as far as the README needs them.
_LAUNCH: dict[str, dict[str, Any]] = {
    "launch": {"LaunchDescription": list},
    "launch.actions": {"ExecuteProcess": _Launched},
}


@runs("Recipes: ROS 2")
def test_launch_file(speaking: Talk, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, members in _LAUNCH.items():
        module = types.ModuleType(name)
        module.__dict__.update(members)
        monkeypatch.setitem(sys.modules, name, module)
    file: dict[str, Any] = {}
    exec(block("Recipes: ROS 2"), file)
    (process,) = file["generate_launch_description"]()
    with short_directory() as place:
        env = {**shell.env, "TALK_SOCKET": f"{place}/s", "TALK_PLAYER": "null"}
        server = subprocess.Popen(process.cmd, env=env, executable=str(shell.directory / "bin" / "talk"), stderr=-1)
        with server:
            try:
                assert server.stderr
                told = b""
                while b'"ready"' not in told:  # its log: the greeting was said
                    told = server.stderr.readline()
                    assert told
                server.send_signal(signal.SIGINT)  # as launch does
                server.communicate(timeout=20)
            finally:
                server.kill()
        assert server.returncode == 0
    assert speaking.running


@runs("Recipes: Simulation and CI")
def test_simulation(tmp_path: Path, speaking: Talk) -> None:
    with short_directory() as place, contextlib.closing(Shell(tmp_path, speaking.env)) as shell:
        done = shell.run(block("Recipes: Simulation and CI"), TALK_SOCKET=f"{place}/s")
    assert done.returncode == 0, done
    assert done.stdout.splitlines()[1:] == ["as on the robot"]
