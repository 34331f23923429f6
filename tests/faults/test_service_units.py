"""The units of `talk serve --print-unit`, run as systemd runs them, and the notifications to a supervisor."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import socket
import stat
import sys
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli.cli.services import _path_fault
from talkcli.daemon.systemd import NOTIFY_RETRY_DELAY_S, STATUS_DELAY_S
from talkcli.install import NEURAL_PACKAGES
from tests.conformance.bareserve import SERVE, TALK, BareServe, environment, run, serving
from tests.faults.broken import write
from tests.faults.supervisor import Supervisor
from tests.support import processes, tiny_voice, usage
from tests.support.connection import Wire
from tests.support.processes import children
from tests.support.surroundings import needs, needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tests.conftest import MakeTalk

SCRIPTED = [SERVE[0], processes.SCRIPTED]
UNITS = ["user", "system", "user-socket", "system-socket"]
#: An installed `talk` command.
SCRIPT = f"#!{sys.executable}\nfrom talkcli.cli import main\nmain()\n"
#: Starts a program with a passed socket, as systemd does.
PASS_SOCKET = """
import os, sys
os.dup2(int(sys.argv[1]), 3, inheritable=True)
os.environ["LISTEN_PID"] = str(os.getpid())
os.execv(sys.argv[2], sys.argv[2:])
"""


def print_unit(home: str, name: str, *options: str) -> str:
    done = run([*TALK, "serve", *options, "--print-unit", name], environment(home))
    assert done.code == 0, done
    return done.out


def unit_values(unit: str, name: str) -> list[str]:
    return re.findall(rf"^{name}=(.*)$", unit, re.MULTILINE)


def command_of(unit: str) -> list[str]:
    """Return the command that systemd would run. It uses the shell's quotes, and doubles % and $."""
    (line,) = unit_values(unit, "ExecStart")
    return [word.replace("%%", "%").replace("$$", "$") for word in shlex.split(line)]


def passing_command(passed: socket.socket, command: Sequence[str] = SCRIPTED) -> list[str]:
    """Return a command that starts a server with this socket."""
    return [sys.executable, "-S", "-c", PASS_SOCKET, str(passed.fileno()), *command]


def assert_valid_unit(home: str, name: str, **units: str) -> None:
    """Assert that systemd finds no error in a unit, given the texts of the files by their kind."""
    for kind, text in units.items():
        write(Path(home, f"talk.{kind}"), text)
    scope = ["--user"] if name.startswith("user") else []
    kind = "socket" if name.endswith("socket") else "service"
    command = ["systemd-analyze", *scope, "verify", "--man=no", f"{home}/talk.{kind}"]
    done = run(command, environment(home, XDG_RUNTIME_DIR=home))
    assert (done.code, done.err) == (0, ""), done


@pytest.mark.parametrize("name", UNITS)
def test_a_unit_is_valid_and_explains_its_installation(home: str, name: str) -> None:
    needs("systemd-analyze")
    unit = print_unit(home, name)
    kind = "socket" if name.endswith("socket") else "service"
    folder = "/etc/systemd/system" if name.startswith("system") else "~/.config/systemd/user"
    head = unit.partition("\n[Unit]\n")[0].splitlines()
    assert head[0].startswith(f"# {folder}/talk.{kind}: ")
    assert any(f"talk serve --print-unit {name} " in line for line in head)
    assert any("daemon-reload" in line and "enable --now" in line for line in head)
    assert all(line.startswith("#") and len(line) <= 120 for line in head)
    assert "\n[Install]\nWantedBy=" in unit
    assert unit.endswith("\n")
    service = print_unit(home, name.removesuffix("-socket"))
    assert_valid_unit(home, name, **{"service": service, kind: unit})


def test_services_are_supervised_and_the_system_one_admits_group_audio(home: str) -> None:
    user, system = print_unit(home, "user"), print_unit(home, "system")
    both = {
        "Type": "notify",
        "NotifyAccess": "main",
        "WatchdogSec": "30",
        "Restart": "on-failure",
        "KillMode": "mixed",  # otherwise, SIGTERM kills the engine before the server can end its goal
        "NoNewPrivileges": "yes",
    }
    own = {
        "DynamicUser": "yes",
        "Group": "audio",
        "RuntimeDirectory": "talk",
        "CacheDirectory": "talk",
        "CacheDirectoryMode": "0700",
        "DeviceAllow": "char-alsa rw",
    }
    assert {name: unit_values(user, name) for name in both} == {name: [value] for name, value in both.items()}
    assert {name: unit_values(system, name) for name in {**both, **own}} == {
        name: [value] for name, value in {**both, **own}.items()
    }
    assert "Directory=" not in user  # the directories of the user are sufficient
    assert "PrivateDevices" not in re.sub("#.*", "", system)
    assert "--socket-mode=0660" in command_of(system)
    assert "--socket-mode=0666" in command_of(print_unit(home, "system", "--socket-mode", "0666"))


@pytest.mark.parametrize(
    ("name", "options", "last", "directories"),
    [
        ("system", ["--history"], "--history", ["talk"]),
        ("system", ["--history", "no-text"], "--history=no-text", ["talk"]),
        ("system", [], "--socket-mode=0660", []),
        ("user", ["--history"], "--history", []),  # the server creates it in the user's state directory
        ("user", ["--history", "./h.db"], f"--history={os.getcwd()}/h.db", []),
    ],
)
def test_the_system_unit_has_a_directory_for_the_history(
    home: str, name: str, options: list[str], last: str, directories: list[str]
) -> None:
    unit = print_unit(home, name, *options)
    assert command_of(unit)[-1] == last
    assert unit_values(unit, "StateDirectory") == directories
    assert unit_values(unit, "StateDirectoryMode") == ["0700"] * len(directories)
    if directories:
        needs("systemd-analyze")
        assert_valid_unit(home, name, service=unit)


def test_the_command_is_absolute_and_keeps_the_given_options(home: str) -> None:
    greeting = 'I\'m "here", at 100 % of $HOME \\ now; --really'
    options = ["--rate", "150", "--preempt", "--ttl=2.5", "--greeting", greeting, "--device", "plughw:1,0"]
    command = command_of(print_unit(home, "system", "--player", "aplay", *options))
    assert os.path.isabs(command[0])
    assert os.access(command[0], os.X_OK)
    wanted = ["--rate=150", "--preempt", "--ttl=2.5", "--player=aplay", "--device=plughw:1,0", f"--greeting={greeting}"]
    assert command[-6:] == wanted
    assert command_of(print_unit(home, "user", "--rate", "200"))[-1] == "--rate=200"  # kept, although it is the default
    assert command_of(print_unit(home, "user"))[-1] == "serve"


def test_control_characters_in_an_option_survive_systemds_quoting(home: str) -> None:
    needs("systemd-analyze")
    greeting = 'one\rtwo\nthree\tfour \x01\x7f\x85\u2028 "five" \\\n'
    unit = print_unit(home, "system", "--greeting", greeting, "--socket", f"{home}/a\nb")
    (line,) = unit_values(unit, "ExecStart")
    assert line.isprintable()
    quoted = line.partition('"--greeting=')[2].removesuffix('"')
    assert quoted.encode().decode("unicode_escape").encode("latin-1").decode() == greeting
    assert f"{home}/a\\nb" in unit.partition("[Unit]")[0]
    assert_valid_unit(home, "system", service=unit)


def test_a_socket_unit_listens_where_clients_look(home: str) -> None:
    def settings(name: str, *options: str) -> list[str]:
        unit = print_unit(home, name, *options)
        return unit_values(unit, "ListenStream") + unit_values(unit, "SocketMode") + unit_values(unit, "SocketGroup")

    assert settings("user-socket") == ["%t/talk/talk.sock", "0600"]
    assert settings("system-socket") == ["/run/talk/talk.sock", "0660", "audio"]
    assert settings("user-socket", "--socket", f"{home}/100%", "--socket-mode", "0666") == [f"{home}/100%%", "0666"]
    assert settings("user-socket", "--socket", f"{home}/a b")[0] == f"{home}/a b"


def test_a_unit_that_cannot_be_printed_is_a_usage_error(home: str) -> None:
    cases = [(args, "--print-unit") for args in (["--print-unit"], ["--print-unit", "launchd"], ["--print-unit="])]
    cases += [
        (["--print-unit", name, "--socket", f"{home}/{path}"], "a socket unit can't contain the path")
        for path in ("a\nb", "a\rb", "a ", "a\\")
        for name in ("user-socket", "system-socket")
    ]
    for args, error in cases:
        done = run([*TALK, "serve", *args], environment(home))
        assert (done.code, done.out, error in done.err) == (2, "", True), done


def test_the_unit_names_the_installed_script_however_it_was_called(home: str) -> None:
    os.mkdir(f"{home}/a place")
    script = str(write(Path(home, "a place", "talk"), SCRIPT, 0o755))
    env = environment(home, PATH=f"{home}/a place:{os.environ['PATH']}")
    for command, folder in ((script, "/"), ("talk", "/"), ("./talk", f"{home}/a place")):
        done = run([command, "serve", "--print-unit", "user"], env, cwd=folder)
        assert command_of(done.out) == [script, "serve"], done


def test_printing_the_system_unit_warns_if_its_user_cannot_run_talk(home: str) -> None:
    private = f"{home}/private"
    os.mkdir(private, 0o700)
    script = str(write(Path(private, "talk"), SCRIPT, 0o755))
    os.mkdir(f"{home}/bin")
    os.symlink(script, f"{home}/bin/talk")  # readable for all users, unlike its target
    for command in (script, f"{home}/bin/talk"):
        done = run([command, "serve", "--print-unit", "system"], environment(home))
        assert done.code == 0
        warning = f"talk needs {script}, but the service's user can't enter {private}; install talk for all users"
        assert warning in done.err
        assert done.out.count("[Service]") == 1  # only the unit is printed
    assert run([script, "serve", "--print-unit", "user"], environment(home)).err == ""


@pytest.mark.parametrize(
    ("options", "warning"),
    [
        ("--pronounce /tmp/n.txt", "--pronounce names /tmp/n.txt, but the service has a /tmp of its own (PrivateTmp=)"),
        ("--pronounce /etc/shadow", "the service's user can't read it (DynamicUser=); copy it into /etc/talk"),
        ("--sounds /root", "the service's user can't read it (DynamicUser=)"),
        ("--history /srv/h.db", "the service can't write there (ProtectSystem=); leave out the path"),
        ("--player file:/srv/x.wav", "--player file: names /srv/x.wav, but the service can't write there"),
        ("--player /var/tmp/play", "--player names /var/tmp/play, but the service has a /tmp of its own"),
        ("--socket /var/tmp/s", "choose a path in /run/talk"),
        ("--socket /srv/s", "the service can't write there (ProtectSystem=); choose a path in /run/talk"),
        ("--socket /run/talk/s", None),
        ("--pronounce /etc/passwd --sounds /etc --history no-text --player file:/run/talk/x.wav", None),
    ],
)
def test_printing_the_system_unit_warns_about_paths_that_the_unit_hides(
    home: str, options: str, warning: str | None
) -> None:
    for name in ("system", "user"):
        notes = run([*TALK, "serve", *options.split(), "--print-unit", name], environment(home)).err.splitlines()
        hidden = [line for line in notes if " names " in line]
        assert len(hidden) == (1 if warning and name == "system" else 0)
        assert not hidden or str(warning) in hidden[0]
    hidden_home = _path_fault("--pronounce", "/home/a/n.txt", hides_home=True)
    assert hidden_home == "the unit hides home directories (ProtectHome=)"


def test_systemd_rates_the_system_service_as_well_protected(home: str) -> None:
    needs("systemd-analyze")
    unit = write(Path(home, "talk.service"), print_unit(home, "system"))
    done = run(["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)], environment(home))
    if "unrecognized option" in done.err:
        pytest.skip("systemd-analyze before version 250 can only rate loaded units")
    match = re.search(r"Overall exposure level for talk.service: ([\d.]+)", done.out)
    assert match, done
    assert float(match[1]) <= 2.0


@pytest.mark.usefixtures("nobody_serves")
def test_the_command_serves_in_the_environment_that_systemd_sets(home: str) -> None:
    needs("setpriv")
    os.mkdir(f"{home}/talk", 0o755)
    with Supervisor(f"{home}/n") as supervisor:
        unit = print_unit(home, "system", "--player", "null", "--rate", "450")
        env = {
            **{name: value for name, value in environment(home).items() if name in {"PYTHONPATH", "TMPDIR"}},
            "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
            "RUNTIME_DIRECTORY": f"{home}/talk",
            "NOTIFY_SOCKET": supervisor.address,
            "WATCHDOG_USEC": "30000000",
            "INVOCATION_ID": "0" * 32,
        }
        with serving(env, command=["setpriv", "--no-new-privs", *command_of(unit)]) as server:
            supervisor.wait_for("READY", "1")
            path = f"{home}/talk/talk.sock"
            assert stat.S_IMODE(os.stat(path).st_mode) == 0o660
            assert run([*TALK, "--socket", path, "say", "--wait", "hello"], environment(home)).code == 0
            supervisor.wait_for("STATUS", "idle; ")
            assert server.end(signal.SIGTERM) == 0
        supervisor.wait_for("STOPPING", "1")


def test_the_system_service_caches_a_split_voice(home: str) -> None:
    needs_packages(*NEURAL_PACKAGES)
    tiny_voice.put(Path(home) / "voices", "tiny")
    # As for every service with DynamicUser: the variable names a link to a private directory.
    os.makedirs(f"{home}/private/talk", 0o700)
    os.symlink("private/talk", f"{home}/talk")
    command = command_of(print_unit(home, "system", "--player", "null", "--rate", "450"))
    env = environment(home, CACHE_DIRECTORY=f"{home}/talk", TALK_VOICES=f"{home}/voices", TALK_SOCKET=f"{home}/s")
    with serving(env, command=command):
        assert run([*TALK, "say", "--wait", "--voice", "piper/tiny", "hello"], env).code == 0
    assert len(os.listdir(f"{home}/private/talk")) == 2


@contextlib.contextmanager
def listening_at(path: str, kind: socket.SocketKind = socket.SOCK_STREAM) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, kind) as passed:
        passed.bind(path)
        if kind == socket.SOCK_STREAM:
            passed.listen()
        yield passed


def test_a_passed_socket_is_served_and_its_file_is_kept(home: str) -> None:
    path = f"{home}/s"
    with Supervisor(f"{home}/n") as supervisor, listening_at(path) as passed:
        os.chmod(path, 0o666)
        early = socket.socket(socket.AF_UNIX)
        early.connect(path)  # before the server runs: the connection starts it
        env = environment(home, LISTEN_FDS="1", LISTEN_FDNAMES="talk.socket", NOTIFY_SOCKET=supervisor.address)
        for _ in range(2):  # the second server is the one after a restart
            with serving(env, command=passing_command(passed), pass_fds=[passed.fileno()]) as server:
                supervisor.wait_for("READY")
                early.close()
                with Wire(path):
                    assert run([*TALK, "--socket", path, "say", "--wait", "length=0"], environment(home)).code == 0
                if os.path.isdir("/proc/self/fd"):
                    (engine,) = children(server.process.pid)
                    inode = os.readlink(f"/proc/{server.process.pid}/fd/3")
                    assert inode not in usage.descriptors(engine).values()
                assert server.end(signal.SIGTERM) == 0
            assert os.path.exists(path)
            assert not os.path.exists(f"{path}.lock")


def test_an_unusable_passed_socket_is_refused_with_a_reason(home: str) -> None:
    def refused(passed: socket.socket, count: str = "1", code: int = 2) -> str:
        done = run(passing_command(passed), environment(home, LISTEN_FDS=count), pass_fds=[passed.fileno()])
        assert (done.code, done.out, "Traceback" in done.err) == (code, "", False), done
        return done.err

    with listening_at(f"{home}/s") as passed:
        assert "systemd passed 2 sockets" in refused(passed, count="2")
        os.unlink(f"{home}/s")  # without the file, the supervisor has to restart the socket's unit
        assert "systemctl restart talk.socket" in refused(passed, code=11)
    with listening_at(f"{home}/d", socket.SOCK_DGRAM) as passed:
        assert "is not a listening socket" in refused(passed)
    with socket.socket(socket.AF_INET) as passed:
        passed.bind(("127.0.0.1", 0))
        passed.listen()
        assert "not a Unix socket" in refused(passed)
    near, far = socket.socketpair()
    with near, far:
        assert "is not a listening socket" in refused(near)  # Accept=yes
    if sys.platform.startswith("linux"):
        with listening_at(f"\0talk-{os.getpid()}") as passed:
            assert "has no path" in refused(passed)


def test_a_passed_socket_is_ignored_if_it_is_not_meant_for_this_server(home: str) -> None:
    with listening_at(f"{home}/passed") as passed:
        for place, pid in (("own", {}), ("passed", {}), ("third", {"LISTEN_PID": "1"})):
            env = environment(home, LISTEN_FDS="1", TALK_SOCKET=f"{home}/{place}", **pid)
            command = SCRIPTED if pid else passing_command(passed)
            with serving(env, command=command, pass_fds=[passed.fileno()]), Wire(f"{home}/{place}") as wire:
                assert wire.request("status")["server"]["socket"] == f"{home}/{place}"
                assert os.path.exists(f"{home}/{place}.lock") == (place != "passed")


def supervised_env(home: str, supervisor: Supervisor, **extra: str) -> dict[str, str]:
    return environment(home, TALK_SOCKET=f"{home}/s", NOTIFY_SOCKET=supervisor.address, **extra)


def test_the_supervisor_is_notified_of_start_status_and_stop(home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor, serving(supervised_env(home, supervisor), command=SCRIPTED) as server:
        ready = supervisor.wait_for("READY", "1")
        with Wire(f"{home}/s") as wire:  # READY must not come before clients are served
            assert wire.greeting["pid"] == server.process.pid
            supervisor.wait_for("STATUS", "idle; ", since=ready)
            goal = wire.request("say", text="never-ends a secret")["goal"]
            wire.request("say", text="another")
            supervisor.wait_for("STATUS", f"speaking {goal['id']}, 1 waiting")
            wire.request("pause")
            supervisor.wait_for("STATUS", "paused, 1 waiting")
            wire.request("resume")
            wire.request("cancel")
            supervisor.wait_for("STATUS", "idle; ", since=supervisor.messages[-1][2])
        assert server.end(signal.SIGTERM) == 0
        supervisor.wait_for("STOPPING", "1")
        supervisor.drain()
    names = [name for name, _, _ in supervisor.messages]
    assert (names.count("READY"), names.count("STOPPING"), names.count("WATCHDOG")) == (1, 1, 0)
    assert "secret" not in str(supervisor.messages)  # every user can read a unit's status


def test_the_unit_status_names_the_engines_problem(home: str) -> None:
    write(Path(home, "start"), "fail=engine_failed")
    with Supervisor(f"{home}/n") as supervisor:
        env = supervised_env(home, supervisor, SCRIPTED_START_FILE=f"{home}/start")
        with serving(env, command=SCRIPTED):
            supervisor.wait_for("READY")  # it serves and reports the problem instead of failing in a restart loop
            supervisor.wait_for("STATUS", "engine: ")
            os.unlink(f"{home}/start")
            supervisor.wait_for("STATUS", "idle; ")


def test_the_watchdog_depends_on_the_event_loop_and_not_on_the_engine(home: str) -> None:
    limit = 0.6
    with Supervisor(f"{home}/n") as supervisor:
        env = supervised_env(home, supervisor, WATCHDOG_USEC=str(int(limit * 1e6)))
        with serving(env, command=SCRIPTED) as server, Wire(f"{home}/s") as wire:
            first = supervisor.wait_for("WATCHDOG")
            second = supervisor.wait_for("WATCHDOG", since=first)
            assert limit / 3 - 0.05 <= second - first <= limit
            wire.request("say", text="hang")  # another watchdog detects a hanging engine
            started_at = time.monotonic()
            while (last := supervisor.wait_for("WATCHDOG", since=second)) < started_at + limit * 2:
                assert last - second <= limit
                second = last
            os.kill(server.process.pid, signal.SIGSTOP)
            try:
                time.sleep(0.01)
                supervisor.drain()
                assert not supervisor.receive(limit)  # a stopped event loop does not feed the watchdog
            finally:
                os.kill(server.process.pid, signal.SIGCONT)
            supervisor.wait_for("WATCHDOG", since=time.monotonic())


@pytest.mark.parametrize("extra", [{"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "200000", "WATCHDOG_PID": "1"}])
def test_a_disabled_or_foreign_watchdog_is_not_fed(home: str, extra: dict[str, str]) -> None:
    with Supervisor(f"{home}/n") as supervisor:
        with serving(supervised_env(home, supervisor, **extra), command=SCRIPTED) as server:
            supervisor.wait_for("STATUS", "idle; ")
            assert not supervisor.receive(0.3)
            assert server.end(signal.SIGTERM) == 0
        supervisor.drain()
    assert {name for name, _, _ in supervisor.messages} == {"READY", "STATUS", "STOPPING"}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has abstract sockets")
def test_the_watchdog_is_fed_at_an_abstract_address(home: str) -> None:
    with Supervisor(f"@talk-{uuid.uuid4().hex}") as supervisor:
        # The shell's process becomes the server, like systemd's child.
        command = ["sh", "-c", 'WATCHDOG_PID=$$ exec "$@"', "sh", *SCRIPTED]
        with serving(supervised_env(home, supervisor, WATCHDOG_USEC="500000"), command=command):
            supervisor.wait_for("WATCHDOG", since=supervisor.wait_for("WATCHDOG"))


@pytest.mark.parametrize("address", ["relative", "/nowhere/at/all"])
def test_a_server_works_if_its_supervisor_cannot_be_reached(home: str, address: str) -> None:
    env = environment(home, TALK_SOCKET=f"{home}/s", NOTIFY_SOCKET=address, WATCHDOG_USEC="100000")
    with serving(env, command=SCRIPTED) as server, Wire(f"{home}/s") as wire:
        wire.request("say", text="length=0", wait=True)
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
        if address.startswith("/"):
            time.sleep(NOTIFY_RETRY_DELAY_S + 0.1)  # many watchdog messages, and another attempt to connect
    assert server.log.count("NOTIFY_SOCKET") == (1 if address.startswith("/") else 0)


@limits()
def test_a_slow_supervisor_delays_no_client_and_misses_no_status(home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor:
        env = supervised_env(home, supervisor, WATCHDOG_USEC="100000")
        with serving(env, command=SCRIPTED) as server, Wire(f"{home}/s") as wire:
            supervisor.wait_for("STATUS", "idle; ")
            supervisor.fill()
            goal = wire.request("say", text="never-ends")["goal"]
            time.sleep(STATUS_DELAY_S + 0.2)  # there is no room for its watchdog and status messages
            started_at = time.monotonic()
            wire.request("status")
            assert_within(time.monotonic() - started_at, 0.5, "`status`")
            supervisor.wait_for("STATUS", f"speaking {goal['id']}")
            supervisor.wait_for("WATCHDOG", since=time.monotonic())
            supervisor.fill()
            assert server.end(signal.SIGTERM) == 0


def test_engine_and_player_do_not_inherit_the_supervisors_variables(make_talk: MakeTalk, home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor:
        env = {"NOTIFY_SOCKET": supervisor.address, "WATCHDOG_USEC": "9000000", "LISTEN_FDNAMES": "talk"}
        seen = Path(home, "environment")
        player = write(Path(home, "player"), f"#!/bin/sh\nenv > {seen}\ncat >&2\n", 0o700)
        talk = make_talk("--player", str(player), env=env)
        talk.run("say", "--wait", "hello")
        inherited = {line.partition("=")[0] for line in seen.read_text().splitlines()}
        assert "PATH" in inherited
        assert not [name for name in inherited if name.startswith(("NOTIFY_", "WATCHDOG_", "LISTEN_"))]


def test_a_server_that_cannot_start_never_reports_ready(home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor, serving(environment(home, TALK_SOCKET=f"{home}/s"), command=SCRIPTED):
        second = BareServe(SCRIPTED, supervised_env(home, supervisor))
        try:
            assert not second.serves()
            assert second.end() == 11
        finally:
            second.close()
        assert not supervisor.receive(0.1)
