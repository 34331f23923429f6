"""The server's socket, lock file and directory, passed sockets, and clients of other users."""

from __future__ import annotations

import os
import shutil
import socket
import stat
import subprocess
import threading

import pytest

from talkcli.server import listener
from tests.conformance.bareserve import SERVE, environment, run, serving
from tests.faults.test_users import NOBODY, as_user, copy_package
from tests.support.connection import Wire


def refused(home: str, *arguments: str, code: int = 11, **extra: str) -> str:
    """Assert that a server doesn't start, and return its error message."""
    done = run([*SERVE, *arguments], environment(home, **extra))
    assert (done.code, done.out) == (code, ""), done
    assert "Traceback" not in done.err
    return done.err


@pytest.mark.parametrize(("mode", "umask"), [("0600", 0o000), ("0660", 0o077)])
def test_the_socket_has_the_requested_mode(home: str, mode: str, umask: int) -> None:
    path = f"{home}/talk/s"
    command = ["sh", "-c", f'umask {umask:04o}; exec "$@"', "sh", *SERVE]
    with serving(environment(home), "--socket", path, "--socket-mode", mode, command=command):
        assert stat.S_IMODE(os.stat(path).st_mode) == int(mode, 8)
        assert stat.S_IMODE(os.stat(os.path.dirname(path)).st_mode) == 0o700
    assert not os.path.exists(path)


def test_a_stale_socket_and_lock_file_are_replaced(home: str) -> None:
    path = f"{home}/s"
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(path)
    for garbage in (b"1\n", b"\xff\0" * 5000):
        with open(f"{path}.lock", "wb") as file:
            file.write(garbage)
        with serving(environment(home), "--socket", path) as server, Wire(path) as wire:
            assert wire.greeting["pid"] == server.process.pid
        assert not os.path.exists(path)


def test_a_second_server_reports_the_current_lock_holder(home: str) -> None:
    """A server that has just acquired the lock may not have written its process id yet."""
    with subprocess.Popen(["true"]) as gone:
        gone.wait()
    path = f"{home}/lock"
    with open(path, "w+b", buffering=0) as file:
        file.write(f"{gone.pid}\n".encode())
        holders: list[int | None] = []
        reader = threading.Thread(target=lambda: holders.append(listener._read_holder(file.fileno())))
        reader.start()
        reader.join(0.1)
        assert reader.is_alive(), f"it returned {holders}, which has ended"
        file.seek(0)
        file.truncate()
        file.write(f"{os.getpid()}\n".encode())
        reader.join()
    assert holders == [os.getpid()]


def test_a_file_at_the_sockets_path_is_not_removed(home: str) -> None:
    path = f"{home}/s"
    with open(path, "w", encoding="utf-8") as file:
        file.write("precious")
    assert "is not a socket; remove it" in refused(home, "--socket", path)
    with open(path, encoding="utf-8") as file:
        assert file.read() == "precious"
    assert f"a directory, not a socket; use --socket {home}/talk.sock" in refused(home, "--socket", home)
    os.mkfifo(f"{home}/pipe")
    assert "is not a socket; choose another path" in refused(home, TALK_SOCKET=f"{home}/pipe")


def test_a_server_that_cannot_start_leaves_no_lock_file(home: str) -> None:
    os.mkdir(f"{home}/directory")
    os.mkfifo(f"{home}/pipe")
    for name in ("directory", "pipe"):
        refused(home, "--socket", f"{home}/{name}")
    assert sorted(os.listdir(home)) == ["directory", "pipe"]
    assert "can't listen at" in refused(home, "--socket", f"{home}/{'s' * (120 - len(home))}")


@pytest.mark.parametrize("fault", ["is not a regular file", "is a symbolic link", "is a hard link"])
def test_an_unsafe_lock_file_is_reported_and_left_unchanged(home: str, fault: str) -> None:
    with open(f"{home}/precious", "w", encoding="utf-8") as file:
        file.write("precious")
    if "regular" in fault:
        os.mkfifo(f"{home}/s.lock")
    else:
        (os.symlink if "symbolic" in fault else os.link)(f"{home}/precious", f"{home}/s.lock")
    message = refused(home, "--socket", f"{home}/s")
    assert f"the lock file {home}/s.lock {fault}" in message
    assert "remove it" in message
    with open(f"{home}/precious", encoding="utf-8") as file:
        assert file.read() == "precious"
    assert sorted(os.listdir(home)) == ["precious", "s.lock"]


def test_a_relative_socket_is_refused_if_the_directory_is_gone(home: str) -> None:
    command = ["sh", "-c", 'mkdir gone && cd gone && rmdir ../gone && exec "$@"', "sh", *SERVE, "--socket", "s"]
    done = run(command, environment(home), cwd=home)
    assert (done.code, done.out) == (11, "")
    assert "the current directory was removed" in done.err
    assert "Traceback" not in done.err


def test_an_unsafe_directory_is_refused(home: str) -> None:
    for name, mode in (("open", 0o777), ("group", 0o770)):
        os.mkdir(f"{home}/{name}")
        os.chmod(f"{home}/{name}", mode)
        message = refused(home, "--socket", f"{home}/{name}/s")
        assert f"{home}/{name}" in message
        assert "chmod go-w" in message
    os.mkdir(f"{home}/real", 0o700)
    os.symlink("real", f"{home}/link")
    assert "symbolic link" in refused(home, "--socket", f"{home}/link/s")
    assert "can't create" in refused(home, "--socket", f"{home}/none/none/s")
    assert "not a directory" in refused(home, "--socket", f"{__file__}/s").lower()
    assert "too long" in refused(home, "--socket", f"{home}/{'s' * 100}").lower()
    os.symlink("/etc/passwd", f"{home}/real/s.lock")
    assert "lock" in refused(home, "--socket", f"{home}/real/s")


@pytest.mark.skipif(os.getuid() != 0 or not shutil.which("setpriv"), reason="only root can act as another user")
def test_a_refused_client_of_another_user_exits_with_10(home: str) -> None:
    path = f"{home}/s"
    other_user = copy_package(home)
    client = [*as_user(NOBODY), "/usr/bin/python3", "-m", "talkcli"]
    with serving(environment(home), "--socket", path):
        for mode, arguments in ((0o600, ["status"]), (0o666, ["say", "hello"])):
            os.chmod(path, mode)
            done = run([*client, "--socket", path, *arguments], other_user)
            assert (done.code, done.out) == (10, ""), done
            assert "Traceback" not in done.err
            assert "ask its owner to run: talk serve --socket-mode 0660" in done.err
            assert done.err.endswith("or start your own server with: talk serve\n")
        os.mkdir(f"{home}/closed", 0o700)
        done = run([*client, "--socket", f"{home}/closed/s", "status"], other_user)
        assert f"  {home}/closed/s: permission denied; you can't enter {home}/closed\n" in done.err
        assert "ask its owner to run: talk serve --socket PATH --socket-mode 0660" in done.err
        done = run([*client, "status"], {**other_user, "TALK_SOCKET": path})
        assert done.err.endswith("or unset TALK_SOCKET to try the usual places\n")
        assert "talk serve\n" not in done.err, "a new server would use the same path"
    with serving(environment(home), "--socket", path, "--socket-mode", "0666"):
        assert run([*client, "--socket", path, "say", "--wait", "hi"], other_user).code == 0
