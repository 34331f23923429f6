"""The units that `talk serve --print-unit` prints, read and carried out as systemd does; only pid 1 is missing."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.synthesizers.models import NEEDED
from tests.conformance.bareserve import SERVE, TALK, environment, run, serving
from tests.faults.supervisor import Supervisor
from tests.support import census, processes, tiny_voice
from tests.support.connection import Wire
from tests.support.processes import children
from tests.support.surroundings import needs, needs_packages, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

SCRIPTED = [SERVE[0], processes.SCRIPTED]
UNITS = ["user", "system", "user-socket", "system-socket"]
#: Starts a program as systemd does that passes it a socket.
PASSING = """
import os, sys
os.dup2(int(sys.argv[1]), 3, inheritable=True)
os.environ["LISTEN_PID"] = str(os.getpid())
os.execv(sys.argv[2], sys.argv[2:])
"""


@pytest.fixture
def home() -> Iterator[str]:
    with short_directory() as path:
        yield path


def printed(home: str, name: str, *options: str) -> str:
    done = run([*TALK, "serve", *options, "--print-unit", name], environment(home))
    assert done.code == 0, done
    return done.out


def values(unit: str, name: str) -> list[str]:
    return re.findall(rf"^{name}=(.*)$", unit, re.MULTILINE)


def command_of(unit: str) -> list[str]:
    """Return the command that systemd would run: its quotes are a shell's, its other signs are doubled."""
    (line,) = values(unit, "ExecStart")
    return [each.replace("%%", "%").replace("$$", "$") for each in shlex.split(line)]


@pytest.mark.parametrize("name", UNITS)
def test_unit_says_where_it_goes_and_how_to_enable_it(home: str, name: str) -> None:
    unit = printed(home, name)
    kind = "socket" if name.endswith("socket") else "service"
    folder = "/etc/systemd/system" if name.startswith("system") else "~/.config/systemd/user"
    head = unit.partition("\n[Unit]\n")[0].splitlines()
    assert head[0].startswith(f"# {folder}/talk.{kind}: ")
    assert any(f"talk serve --print-unit {name} " in each for each in head)
    assert any("daemon-reload" in each and "enable --now" in each for each in head)
    assert all(each.startswith("#") and len(each) <= 120 for each in head)
    assert "\n[Install]\nWantedBy=" in unit
    assert unit.endswith("\n")


@pytest.mark.parametrize("name", ["user", "system"])
def test_service_is_supervised_and_ended_by_its_main_process_alone(home: str, name: str) -> None:
    unit = printed(home, name)
    assert values(unit, "Type") == ["notify"]
    assert values(unit, "NotifyAccess") == ["main"]
    assert values(unit, "WatchdogSec") == ["30"]
    assert values(unit, "Restart") == ["on-failure"]
    assert values(unit, "KillMode") == ["mixed"]  # else the engine dies of SIGTERM before the server can end its goal
    assert values(unit, "NoNewPrivileges") == ["yes"]


def test_system_s_service_runs_as_nobody_special_and_lets_the_audio_group_in(home: str) -> None:
    unit = printed(home, "system")
    assert values(unit, "DynamicUser") == ["yes"]
    assert values(unit, "Group") == ["audio"]
    assert values(unit, "RuntimeDirectory") == ["talk"]
    assert (values(unit, "CacheDirectory"), values(unit, "CacheDirectoryMode")) == (["talk"], ["0700"])
    assert values(unit, "DeviceAllow") == ["char-alsa rw"]
    assert "--socket-mode=0660" in command_of(unit)
    assert "PrivateDevices" not in re.sub("#.*", "", unit)
    assert "--socket-mode=0666" in command_of(printed(home, "system", "--socket-mode", "0666"))


@pytest.mark.parametrize("name", ["user", "system"])
def test_command_is_absolute_and_has_the_options_that_were_given(home: str, name: str) -> None:
    greeting = 'I\'m "here", at 100 % of $HOME \\ now; --really'
    options = ["--rate", "150", "--preempt", "--ttl=2.5", "--greeting", greeting, "--device", "plughw:1,0"]
    command = command_of(printed(home, name, "--player", "aplay", *options))
    assert os.path.isabs(command[0])
    assert os.access(command[0], os.X_OK)
    assert command[-6:] == [
        "--rate=150",
        "--preempt",
        "--ttl=2.5",
        "--player=aplay",
        "--device=plughw:1,0",
        f"--greeting={greeting}",
    ]
    assert command_of(printed(home, "user", "--rate", "200"))[-1] == "--rate=200"  # given, if it is the default
    assert command_of(printed(home, "user"))[-1] == "serve"


@pytest.mark.parametrize("name", ["user", "system"])
def test_controls_in_an_option_are_read_by_systemd_as_they_were_given(home: str, name: str) -> None:
    needs("systemd-analyze")
    greeting = 'one\rtwo\nthree\tfour \x01\x7f\x85\u2028 "five" \\\n'
    unit = printed(home, name, "--greeting", greeting, "--socket", f"{home}/a\nb")
    (line,) = values(unit, "ExecStart")
    assert line.isprintable()
    quoted = line.partition('"--greeting=')[2].removesuffix('"')
    assert quoted.encode().decode("unicode_escape").encode("latin-1").decode() == greeting
    assert f"{home}/a\\nb" in unit.partition("[Unit]")[0] or name == "user"
    with open(f"{home}/talk.service", "w", encoding="utf-8") as file:
        file.write(unit)
    scope = ["--user"] if name == "user" else []
    done = run(
        ["systemd-analyze", *scope, "verify", "--man=no", f"{home}/talk.service"],
        environment(home, XDG_RUNTIME_DIR=home),
    )
    assert (done.code, done.err) == (0, ""), done


def test_socket_s_unit_refuses_a_path_that_it_cannot_name(home: str) -> None:
    for path in ("a\nb", "a\rb", "a ", "a\\"):
        for name in ("user-socket", "system-socket"):
            done = run([*TALK, "serve", "--print-unit", name, "--socket", f"{home}/{path}"], environment(home))
            assert (done.code, done.out) == (2, ""), path
            assert "a socket's unit can't name" in done.err
    assert f"ListenStream={home}/a b\n" in printed(home, "user-socket", "--socket", f"{home}/a b")


def test_installed_script_is_what_runs_however_it_was_called(home: str) -> None:
    script = f"{home}/a place/talk"
    os.mkdir(f"{home}/a place")
    with open(script, "w", encoding="utf-8") as file:
        file.write(f"#!{sys.executable}\nfrom talkcli.cli import main\nmain()\n")
    os.chmod(script, 0o755)
    env = environment(home, PATH=f"{home}/a place:{os.environ['PATH']}")
    for words in ([script], ["talk"]):
        done = subprocess.run(
            [*words, "serve", "--print-unit", "user"], env=env, cwd="/", capture_output=True, text=True, check=True
        )
        assert command_of(done.stdout) == [script, "serve"]
    with open(script, "a", encoding="utf-8") as file:
        file.write("# as shells start it\n")
    done = subprocess.run(
        ["./talk", "serve", "--print-unit", "user"],
        env=env,
        cwd=f"{home}/a place",
        capture_output=True,
        text=True,
        check=True,
    )
    assert command_of(done.stdout) == [script, "serve"]


def test_socket_s_unit_has_the_place_where_clients_look(home: str) -> None:
    user, system = printed(home, "user-socket"), printed(home, "system-socket")
    assert (values(user, "ListenStream"), values(user, "SocketMode")) == (["%t/talk/talk.sock"], ["0600"])
    assert (values(system, "ListenStream"), values(system, "SocketMode")) == (["/run/talk/talk.sock"], ["0660"])
    assert values(system, "SocketGroup") == ["audio"]
    named = printed(home, "user-socket", "--socket", f"{home}/100%", "--socket-mode", "0666")
    assert (values(named, "ListenStream"), values(named, "SocketMode")) == ([f"{home}/100%%"], ["0666"])


@pytest.mark.parametrize("words", [["--print-unit"], ["--print-unit", "launchd"], ["--print-unit="]])
def test_unit_that_does_not_exist_is_a_usage_error(home: str, words: list[str]) -> None:
    done = run([*TALK, "serve", *words], environment(home))
    assert (done.code, done.out) == (2, "")
    assert "--print-unit" in done.err


def test_system_s_unit_warns_where_the_service_s_user_can_t_read_the_program(home: str) -> None:
    private = f"{home}/private"
    shutil.copytree(os.path.dirname(processes.__file__), f"{private}/unused")  # any content
    script = f"{private}/talk"
    with open(script, "w", encoding="utf-8") as file:
        file.write(f"#!{sys.executable}\nfrom talkcli.cli import main\nmain()\n")
    os.chmod(script, 0o755)
    os.chmod(private, 0o700)
    os.chmod(home, 0o755)
    done = run([script, "serve", "--print-unit", "system"], environment(home))
    assert done.code == 0
    assert f"this talk needs {script}, and the service's own user can't pass {private}: install it for all" in done.err
    assert done.out.count("[Service]") == 1  # what is printed is the unit alone
    assert run([script, "serve", "--print-unit", "user"], environment(home)).err == ""
    os.mkdir(f"{home}/bin")
    os.symlink(script, f"{home}/bin/talk")  # for all to see, and what it runs is not
    done = run([f"{home}/bin/talk", "serve", "--print-unit", "system"], environment(home))
    assert f"this talk needs {script}, and the service's own user can't pass {private}: " in done.err


@pytest.mark.parametrize("name", UNITS)
def test_systemd_finds_nothing_wrong(home: str, name: str) -> None:
    needs("systemd-analyze")
    folder = f"{home}/units"
    os.mkdir(folder)
    for each in (name, name.removesuffix("-socket")):
        kind = "socket" if each.endswith("socket") else "service"
        with open(f"{folder}/talk.{kind}", "w", encoding="utf-8") as file:
            file.write(printed(home, each))
    env = environment(home, XDG_RUNTIME_DIR=home)
    kind = "socket" if name.endswith("socket") else "service"
    scope = ["--user"] if name.startswith("user") else []
    done = run(["systemd-analyze", *scope, "verify", "--man=no", f"{folder}/talk.{kind}"], env)
    assert (done.code, done.err) == (0, ""), done


def test_system_s_service_is_exposed_to_little(home: str) -> None:
    needs("systemd-analyze")
    with open(f"{home}/talk.service", "w", encoding="utf-8") as file:
        file.write(printed(home, "system"))
    done = run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", f"{home}/talk.service"], environment(home)
    )
    if "unrecognized option" in done.err:
        pytest.skip("this systemd-analyze judges no unit that is not loaded: version 250 does")
    found = re.search(r"Overall exposure level for talk.service: ([\d.]+)", done.out)
    assert found, done
    assert float(found[1]) <= 2.0


@pytest.mark.usefixtures("nobody_serves")
def test_command_serves_in_the_environment_that_systemd_gives_it(home: str) -> None:
    os.mkdir(f"{home}/talk", 0o755)
    with Supervisor(f"{home}/n") as supervisor:
        command = [*command_of(printed(home, "system", "--player", "null", "--rate", "450"))]
        env = {
            **{name: value for name, value in environment(home).items() if name in {"PYTHONPATH", "TMPDIR"}},
            "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
            "RUNTIME_DIRECTORY": f"{home}/talk",
            "NOTIFY_SOCKET": supervisor.address,
            "WATCHDOG_USEC": "30000000",
            "INVOCATION_ID": "0" * 32,
        }
        with serving(env, command=command) as server:
            supervisor.wait_for("READY", "1")
            path = f"{home}/talk/talk.sock"
            assert stat.S_IMODE(os.stat(path).st_mode) == 0o660
            assert run([*TALK, "--socket", path, "say", "--wait", "hello"], environment(home)).code == 0
            supervisor.wait_for("STATUS", "idle; ")
            assert server.end(signal.SIGTERM) == 0
        supervisor.wait_for("STOPPING", "1")


def test_user_s_service_keeps_what_it_keeps_in_the_user_s_own_directories(home: str) -> None:
    assert "Directory=" not in printed(home, "user")


def test_system_s_service_keeps_what_loads_a_voice_faster_where_systemd_says(home: str) -> None:
    needs_packages(*NEEDED)
    tiny_voice.put(Path(home) / "voices", "tiny")
    # As for each service whose user is its own: the directory is elsewhere, and what the variable names leads there.
    os.makedirs(f"{home}/private/talk", 0o700)
    os.symlink("private/talk", f"{home}/talk")
    command = [*command_of(printed(home, "system", "--player", "null", "--rate", "450"))]
    env = environment(home, CACHE_DIRECTORY=f"{home}/talk", TALK_VOICES=f"{home}/voices", TALK_SOCKET=f"{home}/s")
    with serving(env, command=command):
        assert run([*TALK, "say", "--wait", "--voice", "piper/tiny", "hello"], env).code == 0
    assert len(os.listdir(f"{home}/private/talk")) == 2


def test_engine_and_player_run_without_new_privileges(home: str) -> None:
    needs("setpriv")
    command = ["setpriv", "--no-new-privs", *SERVE, "--rate", "450"]
    env = environment(home, TALK_SOCKET=f"{home}/s")
    with serving(env, command=command):
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0


@contextlib.contextmanager
def listening_at(path: str, kind: socket.SocketKind = socket.SOCK_STREAM) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, kind) as passed:
        passed.bind(path)
        if kind == socket.SOCK_STREAM:
            passed.listen()
        yield passed


def test_socket_that_is_passed_is_served_until_the_end_and_left(home: str) -> None:
    path = f"{home}/s"
    with Supervisor(f"{home}/n") as supervisor, listening_at(path) as passed:
        os.chmod(path, 0o666)
        early = socket.socket(socket.AF_UNIX)
        early.connect(path)  # before the server is there: this is what starts it
        command = [sys.executable, "-S", "-c", PASSING, str(passed.fileno()), *SCRIPTED]
        env = environment(home, LISTEN_FDS="1", LISTEN_FDNAMES="talk.socket", NOTIFY_SOCKET=supervisor.address)
        for _ in range(2):  # and the next server, after a restart
            with serving(env, command=command, pass_fds=[passed.fileno()]) as server:
                supervisor.wait_for("READY")
                early.close()
                with Wire(path):
                    assert run([*TALK, "--socket", path, "say", "--wait", "length=0"], environment(home)).code == 0
                if os.path.isdir("/proc/self/fd"):
                    engine = engine_of(server.process.pid)
                    inode = os.readlink(f"/proc/{server.process.pid}/fd/3")
                    assert inode not in census.descriptors(engine).values()
                assert server.end(signal.SIGTERM) == 0
            assert os.path.exists(path)
            assert not os.path.exists(f"{path}.lock")


def engine_of(pid: int) -> int:
    """Return the process id of a server's engine."""
    return children(pid)[0]


def test_socket_that_cannot_be_served_is_refused_in_words(home: str) -> None:
    def refused(passed: socket.socket, *words: str, count: str = "1") -> str:
        command = [sys.executable, "-S", "-c", PASSING, str(passed.fileno()), *SCRIPTED, *words]
        done = run(command, environment(home, LISTEN_FDS=count), pass_fds=[passed.fileno()])
        assert (done.code, done.out, "Traceback" in done.err) == (2, "", False), done
        return done.err

    with listening_at(f"{home}/s") as passed:
        assert "2 sockets were passed" in refused(passed, count="2")
    with listening_at(f"{home}/d", socket.SOCK_DGRAM) as passed:
        assert "doesn't listen" in refused(passed)
    with socket.socket(socket.AF_INET) as passed:
        passed.bind(("127.0.0.1", 0))
        passed.listen()
        assert "not a Unix socket" in refused(passed)
    near, far = socket.socketpair()
    with near, far:
        assert "doesn't listen" in refused(near)  # Accept=yes
    if sys.platform.startswith("linux"):
        with listening_at(f"\0talk-{os.getpid()}") as passed:
            assert "has no file" in refused(passed)


def test_passed_socket_whose_file_is_gone_ends_it_for_its_supervisor(home: str) -> None:
    with listening_at(f"{home}/s") as passed:
        os.unlink(f"{home}/s")
        command = [sys.executable, "-S", "-c", PASSING, str(passed.fileno()), *SCRIPTED]
        done = run(command, environment(home, LISTEN_FDS="1"), pass_fds=[passed.fileno()])
    assert done.code == 11
    assert "systemctl restart talk.socket" in done.err


def test_named_socket_wins_over_one_that_is_passed_for_another_place(home: str) -> None:
    with listening_at(f"{home}/passed") as passed:
        command = [sys.executable, "-S", "-c", PASSING, str(passed.fileno()), *SCRIPTED]
        for place in ("own", "passed"):
            env = environment(home, LISTEN_FDS="1", TALK_SOCKET=f"{home}/{place}")
            with serving(env, command=command, pass_fds=[passed.fileno()]), Wire(f"{home}/{place}"):
                assert os.path.exists(f"{home}/{place}.lock") == (place == "own")


def test_descriptors_of_another_process_are_not_taken(home: str) -> None:
    env = environment(home, LISTEN_FDS="1", LISTEN_PID="1", TALK_SOCKET=f"{home}/s")
    with serving(env, command=SCRIPTED), Wire(f"{home}/s") as wire:
        assert wire.request("status")["server"]["socket"] == f"{home}/s"
