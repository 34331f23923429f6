"""The examples for recipes, containers, services and troubleshooting. Stand-ins protect the machine from changes."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import types
from typing import TYPE_CHECKING, Any

from tests.conformance.bareserve import TALK, serving
from tests.readme.blocks import block, commands, runs
from tests.readme.shell import Shell, wait_until
from tests.support.surroundings import short_directory
from tests.support.wav import write_tone

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


#: A text with characters that a shell treats specially.
AWKWARD = "it's \"5\" o'clock; $HOME & `more` -- \\n"


def texts_of(talk: Talk) -> list[str]:
    """Return the texts of all goals in their order."""
    return [talk.goal(goal_id)["text"] for goal_id in talk.watcher.goals()]


@runs("Recipes: Drive only if it was heard")
def test_a_robot_drives_only_if_the_goal_was_spoken(scripted: Talk, scripted_shell: Shell) -> None:
    script = block("Recipes: Drive only if it was heard")
    for name in ("drive", "flash"):
        scripted_shell.stand_in(name, directory=scripted_shell.directory)
    assert scripted_shell.run(script, "length=0").returncode == 0
    assert (len(scripted_shell.calls("drive")), len(scripted_shell.calls("flash"))) == (1, 0)
    assert "no sound" in scripted_shell.run(script, "fail=audio_device").stdout
    assert (len(scripted_shell.calls("drive")), len(scripted_shell.calls("flash"))) == (1, 1)
    assert "not spoken" in scripted_shell.run(script, "").stdout
    scripted.stop()
    assert "no server" in scripted_shell.run(script, "moving off").stdout


@runs("More recipes: Battery guard")
def test_the_battery_guard_warns_once_and_stops(scripted: Talk, scripted_shell: Shell) -> None:
    battery = scripted_shell.directory / "capacity"
    for charge in ("80", "19", "18", "4"):
        battery.write_text(f"{charge}\n", encoding="utf-8")
        done = scripted_shell.run(block("More recipes: Battery guard"), BATTERY=str(battery))
        assert (done.returncode, done.stdout, done.stderr) == (0, "", ""), done  # the goal at 18 is throttled
    assert texts_of(scripted)[:1] == ["battery at 19 percent"]
    assert [text for text in texts_of(scripted) if "stop" in text] == ["battery at 4 percent, I have to stop"]


@runs("Recipes: Speak a log")
def test_errors_of_a_log_are_spoken(scripted: Talk, scripted_shell: Shell) -> None:
    scripted_shell.stand_in("tail", "printf 'INFO fine\\n12:00 ERROR -5 degrees\\nINFO\\nERROR arm blocked\\n'")
    done = scripted_shell.run(block("Recipes: Speak a log"))
    assert done.returncode == 0, done
    assert scripted_shell.calls("tail") == [["-n", "0", "-F", "/var/log/robot.log"]]
    assert texts_of(scripted) == ["ERROR -5 degrees", "ERROR arm blocked"]


@runs("More recipes: Mute the microphone")
def test_the_microphone_is_muted_while_the_robot_speaks(scripted: Talk, scripted_shell: Shell) -> None:
    scripted_shell.stand_in("wpctl")
    heard = scripted_shell.directory / "heard"
    scripted_shell.program("talk", f'{sys.executable} -m talkcli "$@" | tee {heard}')
    scripted_shell.start(block("More recipes: Mute the microphone"))
    wait_until(lambda: heard.exists() and heard.stat().st_size > 0)  # the snapshot has arrived
    for number, text in enumerate(("one", "fail=audio_lost"), 1):
        scripted.run("say", "--wait", "--", text)
        calls = scripted_shell.wait_for_call("wpctl", 2 * number)
        assert calls[-2:] == [["set-mute", "@DEFAULT_AUDIO_SOURCE@", value] for value in "10"]
    scripted.run("say", "--", "never-ends words=1")
    scripted_shell.wait_for_call("wpctl", 5)
    scripted.run("say", "--wait", "--interject", "--", "length=0")  # the first sentence continues afterwards
    assert [call[-1] for call in scripted_shell.wait_for_call("wpctl", 8)[-4:]] == ["1", "1", "0", "1"]
    scripted.kill()
    assert [call[-1] for call in scripted_shell.wait_for_call("wpctl", 9)[-2:]] == ["1", "0"]


@runs("More recipes: Watchdog")
def test_the_watchdog_reports_how_a_program_ended(scripted: Talk, scripted_shell: Shell) -> None:
    for command, code in ((["true"], 0), (["sh", "-c", "exit 3"], 3), (["/bin/sh", "-c", "kill -9 $$"], 137)):
        assert scripted_shell.run(block("More recipes: Watchdog"), *command).returncode == code
    ends = ("true is done", "sh failed with code 3", "sh was killed by signal 9")
    assert texts_of(scripted) == [f"I have stopped: {end}" for end in ends]


@runs("More recipes: cron")
def test_cron_jobs_run_without_output(speaking: Talk, shell: Shell) -> None:
    """cron sets its own PATH and few variables, and reads an unescaped percent sign as a newline."""
    shell.stand_in("logger")
    path, *jobs = block("More recipes: cron").splitlines()
    assert path.startswith("PATH=/usr/local/bin:")
    kept = {name: value for name, value in shell.env.items() if not name.startswith(("PULSE", "PIPEWIRE", "LANG"))}
    for job in jobs:
        command = job.split(None, 5)[5]
        assert "%" not in command.replace("\\%", "")
        done = subprocess.run(
            ["/bin/sh", "-c", command.replace("\\%", "%")],
            env={**kept, "PATH": f"{shell.directory}/bin:/usr/bin:/bin"},
            capture_output=True,
            timeout=30,
            check=False,
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")  # cron would mail any output
    (clock,) = texts_of(speaking)
    assert (clock.startswith("It is "), clock.endswith(" o'clock")) == (True, True)
    assert shell.calls("logger") == [["-t", "talk", "the robot is mute"]]  # its player is a file


@runs("Recipes: ssh", "More recipes: Forward the socket")
def test_talk_works_over_ssh(speaking: Talk, shell: Shell) -> None:
    shell.ssh()
    done = shell.run(block("Recipes: ssh"), text=AWKWARD)
    assert (done.returncode, done.stderr, "not heard" in done.stdout) == (0, "", False)
    with short_directory() as home:
        done = shell.run(block("More recipes: Forward the socket"), HOME=home)
        assert (done.returncode, done.stderr) == (0, "")
        assert shell.calls("ssh")[-1][-3:] == ["-L", f"{home}/.robot.sock:{speaking.socket}", "robot"]
    assert texts_of(speaking) == ["hello from the office", AWKWARD, "hello from the office"]
    speaking.stop()
    assert "not heard\n" in shell.run(block("Recipes: ssh"), text=AWKWARD).stdout


@runs("In a ROS 2 launch file")
def test_the_launch_file_starts_a_server(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    launch, actions = types.ModuleType("launch"), types.ModuleType("launch.actions")
    launch.__dict__["LaunchDescription"], actions.__dict__["ExecuteProcess"] = list, types.SimpleNamespace
    for module in (launch, actions):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    file: dict[str, Any] = {}
    exec(block("In a ROS 2 launch file"), file)
    (process,) = file["generate_launch_description"]()
    with short_directory() as place:
        env = {**shell.env, "TALK_SOCKET": f"{place}/s", "TALK_PLAYER": "null"}
        with serving(env, command=[*TALK, *process.cmd[1:]]) as server:
            wait_until(lambda: '"ready"' in server.log)  # the greeting was spoken
            assert server.end(signal.SIGINT) == 0  # launch stops it this way


@runs("Keep a history")
def test_a_history_answers_after_a_restart(tmp_path: Path, make_talk: MakeTalk) -> None:
    serve, *logs = commands("Keep a history")
    assert serve == "talk serve --history &"
    talk = make_talk("--history", scripted=True, env={"XDG_STATE_HOME": str(tmp_path / "state")})
    for text, key in (("length=0 to the charger", "eta"), ("fail=audio_lost", "k")):
        talk.run("say", "--wait", "--as", "patrol", "--key", key, text)
    wait_until(lambda: talk.request("status")["server"]["history"]["unwritten"] == 0)
    talk.stop()
    talk.start_server()
    with contextlib.closing(Shell(tmp_path, talk.env)) as shell:
        done = [shell.run(line) for line in logs]
    assert [(each.returncode, each.stderr) for each in done] == [(0, "")] * 4
    assert [len(each.stdout.splitlines()) for each in done] == [0, 1, 1, 1]


@runs("In simulation and CI")
def test_a_simulated_robot_speaks_without_sound(tmp_path: Path, speaking: Talk) -> None:
    with short_directory() as place, contextlib.closing(Shell(tmp_path, speaking.env)) as shell:
        done = shell.run(block("In simulation and CI"), TALK_SOCKET=f"{place}/s")
    assert done.returncode == 0, done
    assert done.stdout.splitlines()[1:] == ["as on the robot"]


#: Runs `docker exec talk COMMAND` on this machine.
_DOCKER = """case $1 in exec) shift 2; exec "$@" ;; *) exit 0 ;; esac"""
#: `sudo tee FILE` writes into the directory of the test.
_SUDO = """case $1 in tee) mkdir -p system; exec tee "system/${2##*/}" ;; *) exit 0 ;; esac"""


@runs("In a container")
def test_the_dockerfile_starts_a_server() -> None:
    lines = block("In a container").splitlines()
    assert [line.split()[0] for line in lines] == ["FROM", "RUN", "COPY", "RUN", "CMD"]
    assert json.loads(lines[-1].removeprefix("CMD")) == ["talk", "serve"]


@runs("In a container #2", "In a container #3")
def test_containers_can_play_through_the_host(speaking: Talk, shell: Shell) -> None:
    shell.stand_in("docker", _DOCKER)
    shell.stand_in("getent", "echo audio:x:29:")
    done = shell.run(block("In a container #2"))
    assert done.returncode == 0, done
    build, run, _, _ = shell.calls("docker")
    assert build == ["build", "-t", "talk", "."]
    assert run[-5:] == ["--device", "/dev/snd", "--group-add", "29", "talk"]
    assert speaking.watcher.goals()
    assert shell.run(block("In a container #3"), XDG_RUNTIME_DIR="/run/user/1000").returncode == 0
    run = shell.calls("docker")[-1]
    assert run[run.index("-v") + 1] == "/run/user/1000/pulse/native:/tmp/pulse.sock"
    assert run[-5:] == ["talk", "talk", "serve", "--player", "pacat"]


@runs("Run it as a service")
def test_services_are_installed(shell: Shell) -> None:
    for name, then in {"sudo": _SUDO, "systemctl": "exit 0"}.items():
        shell.stand_in(name, then)
    done = shell.run(block("Run it as a service"), USER="robin")
    assert done.returncode == 0, done
    units = {".config/systemd/user/talk.service": "--rate", "system/talk.service": "--socket-mode"}
    for unit, option in units.items():
        assert re.search(f"(?m)^ExecStart=.* serve {option}", (shell.directory / unit).read_text(encoding="utf-8"))
    assert shell.calls("systemctl") == [["--user", "daemon-reload"], ["--user", "enable", "--now", "talk"]]
    linger, _, *called = [" ".join(call) for call in shell.calls("sudo")]
    assert linger == "loginctl enable-linger robin"
    assert called == ["systemctl daemon-reload", "systemctl enable --now talk", "usermod -aG audio NAME"]


@runs("Troubleshooting", "Another talk")
def test_troubleshooting_commands_work(shell: Shell) -> None:
    shell.ssh()
    done = shell.run(block("Troubleshooting"))
    assert done.returncode == 0, done
    assert done.stdout.endswith("the robot is mute\n")
    assert done.stdout.count(") makes no sound") == 2
    path, version = shell.run(block("Another talk")).stdout.splitlines()
    assert (path, version.split()[0]) == (f"{shell.directory}/bin/talk", "talk")


@runs("Sounds", "Sounds #2")
def test_the_examples_for_sounds_play_them(make_talk: MakeTalk, shell: Shell) -> None:
    (shell.directory / "sounds").mkdir()
    write_tone(shell.directory / "sounds" / "horn.wav", 0.05, 22_050)
    serve = block("Sounds #2").strip().replace("~", str(shell.directory)).split()[2:]
    talk = make_talk(*serve, "--player", "null")
    done = shell.run(block("Sounds"), TALK_SOCKET=talk.socket)
    assert (done.returncode, done.stderr) == (0, ""), done
    assert done.stdout.split()[3:] == ["chirp", "error", "horn", "warning"]
    assert shell.run("talk play -w horn", TALK_SOCKET=talk.socket).returncode == 0
    assert texts_of(talk)[-1] == "horn"


@runs("Pronunciation", "Pronunciation #2", "Pronunciation #3")
def test_the_examples_for_pronunciation_show_what_is_said(make_talk: MakeTalk, shell: Shell) -> None:
    (shell.directory / "names.txt").write_text(block("Pronunciation"))
    serve = block("Pronunciation #2").strip().replace("names.txt", f"{shell.directory}/names.txt").split()[2:]
    talk = make_talk(*serve, "--player", "null")
    done = shell.run(block("Pronunciation #3"), TALK_SOCKET=talk.socket)
    assert (done.returncode, done.stderr) == (0, ""), done
    assert f"# {done.stdout}" in block("Pronunciation #3")
    assert (shell.directory / "hello.wav").stat().st_size > 10_000
