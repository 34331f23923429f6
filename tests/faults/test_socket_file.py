"""The socket file, its lock file or its directory is removed, replaced, or already belongs to another user."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import stat
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli.server.run import SOCKET_CHECK_S
from tests.conformance.bareserve import SERVE, TALK, BareServe, environment, run, serving
from tests.faults.test_service_units import SCRIPTED, listening_at, passing_command
from tests.faults.test_users import NOBODY
from tests.support import usage
from tests.support.connection import Wire

if TYPE_CHECKING:
    from collections.abc import Callable


HASTY = [sys.executable, os.path.join(os.path.dirname(os.path.abspath(__file__)), "hasty_serve.py")]
#: Limit in seconds until a server that checks every 0.05 s can be reached again.
LIMIT_S = 5.0


def await_true(condition: Callable[[], object]) -> None:
    """Wait for a change in the file system or in /proc, which send no event."""
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def await_server(path: str, pid: int) -> None:
    """Wait until clients can connect to the server with this process id."""

    def greeted() -> bool:
        with contextlib.suppress(OSError), Wire(path) as wire:
            assert wire.greeting["pid"] == pid
            return True
        return False

    await_true(greeted)


def unlink_both(path: str) -> None:
    os.unlink(path)
    os.unlink(f"{path}.lock")


def remove_directory(path: str) -> None:
    shutil.rmtree(os.path.dirname(path))


def replace_by_stale_socket(path: str) -> None:
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(f"{path}new")
    os.rename(f"{path}new", path)


def move_directory(path: str) -> None:
    os.rename(os.path.dirname(path), f"{os.path.dirname(path)}.{time.monotonic()}")
    os.mkdir(os.path.dirname(path), 0o700)


def test_the_socket_file_is_checked_at_least_every_15_seconds() -> None:
    assert SOCKET_CHECK_S <= 15  # two checks must fit in the documented 30 s, as the disk may be full at the first


@pytest.mark.parametrize(
    "fault",
    [os.unlink, unlink_both, remove_directory, replace_by_stale_socket, move_directory],
    ids=lambda fault: str(fault.__name__),
)
def test_a_removed_or_replaced_socket_is_bound_again(home: str, fault: Callable[[str], None]) -> None:
    path = f"{home}/talk/s"
    env = environment(home, TALK_SOCKET=path)
    with serving(env, "--socket-mode", "0660", command=HASTY) as server, Wire(path) as old:
        goal = old.request("say", text="never-ends", wait=True)["goal"]
        old.receive_event("state", state="ACTIVE")
        fault(path)
        await_server(path, server.process.pid)
        assert stat.S_IMODE(os.stat(path).st_mode) == 0o660
        assert stat.S_IMODE(os.stat(os.path.dirname(path)).st_mode) == 0o700
        # Old connections still work, and new clients can connect.
        assert run([*TALK, "cancel"], env).out.split() == [goal["id"]]
        assert old.receive_event("result")["goal"]["state"] == "PREEMPTED"
        assert old.request("status")["server"]["socket"] == path
        # There is still only one server, which holds the lock file.
        second = run([*SCRIPTED], env)
        assert second.code == 11, second
        assert f"pid {server.process.pid}" in second.err
        with open(f"{path}.lock", encoding="utf-8") as lock:
            assert lock.read() == f"{server.process.pid}\n"
        fault(path)  # and again
        await_server(path, server.process.pid)
        assert server.end(signal.SIGTERM) == 0
    assert not os.path.exists(path)
    assert server.log.count("created the socket") == 2


def test_a_relative_socket_path_is_bound_again_at_the_same_place(home: str) -> None:
    """The server's working directory is gone."""
    path = f"{home}/here/s"
    os.mkdir(f"{home}/here", 0o700)
    command = ["sh", "-c", 'cd "$0" && exec "$@"', f"{home}/here", *HASTY]
    with serving(environment(home, TALK_SOCKET="s"), command=command) as server:
        remove_directory(path)
        await_server(path, server.process.pid)
        with Wire(path) as wire:
            assert wire.request("status")["server"]["socket"] == path
    assert "a bug" not in server.log


def test_a_removed_lock_file_is_created_again_without_leaking_descriptors(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=HASTY) as server:
        await_true(lambda: "engine ready" in server.log)  # the engine's pipes are opened after the socket, only once
        await_server(path, server.process.pid)
        before = len(usage.descriptors(server.process.pid))
        socket_file = os.stat(path).st_ino
        os.unlink(f"{path}.lock")
        await_true(lambda: os.path.exists(f"{path}.lock"))
        await_server(path, server.process.pid)
        assert os.stat(path).st_ino == socket_file
        for _ in range(5):
            unlink_both(path)
            await_server(path, server.process.pid)
        # The last client's connection takes a moment to close.
        await_true(lambda: len(usage.descriptors(server.process.pid)) <= before)


def assert_exits_with_11(server: BareServe, message: str) -> None:
    assert server.process.wait(LIMIT_S) == 11, server.log
    server.end()
    assert message in server.log
    assert "Traceback" not in server.log


def test_a_server_replaced_by_another_one_exits_with_code_11(home: str) -> None:
    path = f"{home}/s"
    env = environment(home, TALK_SOCKET=path)
    with serving(env, command=HASTY) as first, Wire(path) as wire:
        wire.request("say", text="never-ends", wait=True)
        wire.receive_event("state", state="ACTIVE")
        os.kill(first.process.pid, signal.SIGSTOP)  # so that the second server starts before the first one checks
        unlink_both(path)
        with serving(env, command=SCRIPTED) as second:
            os.kill(first.process.pid, signal.SIGCONT)
            result = wire.receive_event("result")["goal"]
            assert (result["state"], result["reason"]) == ("PREEMPTED", "shutdown")
            pid = second.process.pid
            assert_exits_with_11(
                first, f"a server (pid {pid}) is already running at {path}; use it, or stop it with: kill {pid}"
            )
            await_server(path, second.process.pid)


def test_of_two_servers_whose_files_were_removed_one_remains(home: str) -> None:
    path = f"{home}/s"
    env = environment(home, TALK_SOCKET=path)
    with serving(env, command=HASTY) as first:
        os.kill(first.process.pid, signal.SIGSTOP)
        unlink_both(path)
        with serving(env, command=HASTY) as second:
            unlink_both(path)
            os.kill(first.process.pid, signal.SIGCONT)
            both = (first.process, second.process)
            await_true(lambda: any(process.poll() is not None for process in both))
            assert sorted([server.poll() for server in both], key=str) == [11, None]
            await_server(path, next(server.pid for server in both if server.poll() is None))


def test_a_socket_that_another_program_puts_there_is_left_intact(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=HASTY) as server, socket.socket(socket.AF_UNIX) as other:
        other.bind(f"{path}new")
        other.listen()
        os.rename(f"{path}new", path)
        assert_exits_with_11(server, f"another program is now listening at {path}")
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(path)


def replace_by_link(path: str) -> None:
    os.unlink(path)
    os.symlink("/etc/passwd", path)


def replace_by_directory(path: str) -> None:
    os.unlink(path)
    os.mkdir(path)


def open_directory(path: str) -> None:
    move_directory(path)
    os.chmod(os.path.dirname(path), 0o777)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (replace_by_link, "talk/s exists, but is not a socket"),
        (replace_by_directory, "talk/s is a directory, not a socket"),
        (open_directory, "chmod go-w "),
    ],
)
def test_a_server_exits_if_its_socket_path_can_no_longer_be_used(
    home: str, fault: Callable[[str], None], message: str
) -> None:
    path = f"{home}/talk/s"
    with serving(environment(home, TALK_SOCKET=path), command=HASTY) as server:
        fault(path)
        assert_exits_with_11(server, message)
    assert os.path.lexists(path) == (fault is not open_directory)


def test_a_removed_file_of_a_passed_socket_is_only_reported(home: str) -> None:
    path, env = f"{home}/passed", environment(home, LISTEN_FDS="1")
    with (
        listening_at(path) as passed,
        serving(env, command=passing_command(passed, HASTY), pass_fds=[passed.fileno()]) as server,
        Wire(path) as wire,
    ):
        os.unlink(path)
        await_true(lambda: "systemctl restart talk.socket" in server.log)
        time.sleep(0.2)
        assert wire.request("status")["ok"]
        assert not os.path.exists(path)
        assert server.log.count("systemctl restart") == 1  # reported once, not at every check


@pytest.fixture
def _as_tmp(home: str) -> None:
    """Share the home with all users, like /tmp. Skip the test if the default socket would be elsewhere."""
    if sys.platform == "darwin" or os.path.isdir(f"/run/user/{os.getuid()}"):
        pytest.skip("this user has a runtime directory, or the default socket is in the home")
    os.chmod(home, 0o1777)


def runtime_directory(home: str) -> str:
    return f"{home}/runtime-{os.getuid()}"


def dangling_link(home: str) -> None:
    os.symlink("elsewhere", runtime_directory(home))


def link(home: str) -> None:
    dangling_link(home)
    os.mkdir(f"{home}/elsewhere", 0o700)


def link_inside(home: str) -> None:
    link(home)
    os.unlink(runtime_directory(home))
    os.mkdir(runtime_directory(home), 0o700)
    os.symlink("../elsewhere", f"{runtime_directory(home)}/talk")


def open_inside(home: str) -> None:
    os.mkdir(runtime_directory(home), 0o700)
    os.mkdir(f"{runtime_directory(home)}/talk")
    os.chmod(f"{runtime_directory(home)}/talk", 0o777)


def open_to_all(home: str) -> None:
    open_inside(home)
    os.chmod(runtime_directory(home), 0o777)


@pytest.mark.usefixtures("_as_tmp")
@pytest.mark.parametrize(
    "fault", [dangling_link, link, link_inside, open_to_all, open_inside], ids=lambda fault: str(fault.__name__)
)
def test_an_unsafe_runtime_directory_is_refused_with_the_reason(home: str, fault: Callable[[str], None]) -> None:
    fault(home)
    before = sorted(Path(home).rglob("*"))
    done = run(SERVE, environment(home))
    assert (done.code, done.out) == (11, ""), done
    assert runtime_directory(home) in done.err
    assert "Traceback" not in done.err
    assert sorted(Path(home).rglob("*")) == before, "files were created or removed"


@pytest.mark.usefixtures("_as_tmp")
@pytest.mark.skipif(os.getuid() != 0, reason="only root can create directories of another user")
@pytest.mark.parametrize("names", [["talk"], [""], ["", "talk"]], ids=["inside", "whole", "both"])
def test_a_runtime_directory_of_another_user_is_refused(home: str, names: list[str]) -> None:
    for name in names:
        os.makedirs(f"{runtime_directory(home)}/{name}", 0o700)
        os.chown(f"{runtime_directory(home)}/{name}", NOBODY, NOBODY)
    done = run(SERVE, environment(home))
    assert (done.code, done.out) == (11, ""), done
    assert runtime_directory(home) in done.err


@pytest.mark.usefixtures("_as_tmp", "nobody_serves")
def test_a_new_runtime_directory_is_private_whatever_the_umask(home: str) -> None:
    env = environment(home)
    with serving(env, command=["sh", "-c", 'umask 0; exec "$@"', "sh", *SERVE]):
        for path in (runtime_directory(home), f"{runtime_directory(home)}/talk"):
            assert stat.S_IMODE(os.lstat(path).st_mode) == 0o700
            assert os.lstat(path).st_uid == os.getuid()
        assert run([*TALK, "status"], env).code == 0
