"""Where a server listens and who may connect: sockets, locks, directories, users, signals, and where clients look."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import click
import pytest

import talkcli
from talkcli.server import lock
from tests.conformance.bareserve import SERVE, TALK, environment, run, serving
from tests.support import processes
from tests.support.connection import Wire
from tests.support.surroundings import needs, short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

NOBODY = 65534
as_root = pytest.mark.skipif(
    os.getuid() != 0 or shutil.which("setpriv") is None, reason="only root can act as another user"
)
AS_NOBODY = ["setpriv", f"--reuid={NOBODY}", "--clear-groups"]
#: A client for users who may not be able to read this checkout or its interpreter.
STRANGER = """
import socket, sys
s = socket.socket(socket.AF_UNIX)
s.settimeout(5)
try:
    s.connect(sys.argv[1])
except OSError as error:
    sys.exit(type(error).__name__)
try:
    s.sendall(b'{"request": "say", "text": "somebody else"}\\n')
    s.shutdown(socket.SHUT_WR)
except OSError:
    pass
while data := s.recv(65536):
    sys.stdout.write(data.decode())
"""
#: Listens where somebody else's server would, and answers nothing.
IMPOSTOR = """
import socket, sys, time
s = socket.socket(socket.AF_UNIX)
s.bind(sys.argv[1])
s.listen()
print()
time.sleep(60)
"""
#: Starts a program as systemd does that passes it a socket.
PASSING = """
import os, sys
os.dup2(int(sys.argv[1]), 3)
os.environ["LISTEN_PID"] = str(os.getpid())
os.execv(sys.argv[2], sys.argv[2:])
"""


@pytest.fixture
def home() -> Iterator[str]:
    with short_directory() as path:
        os.chmod(path, 0o755)  # others can get at what is inside, as far as that lets them
        yield path


def refused(home: str, *words: str, code: int = 11, **extra: str) -> str:
    """Assert that a server does not start, and return what it says."""
    done = run([*SERVE, *words], environment(home, **extra))
    assert (done.code, done.out) == (code, ""), done
    assert "Traceback" not in done.err
    return done.err


def as_stranger(path: str) -> subprocess.CompletedProcess[str]:
    python = "/usr/bin/python3" if os.path.exists("/usr/bin/python3") else sys.executable
    command = [*AS_NOBODY, python, "-c", STRANGER, path]
    return subprocess.run(command, cwd="/", capture_output=True, text=True, timeout=20, check=False)


@pytest.mark.parametrize("mode", ["0600", "0660", "0666"])
@pytest.mark.parametrize("umask", [0o000, 0o077])
def test_socket_has_the_mode_that_was_asked_for(home: str, mode: str, umask: int) -> None:
    path = f"{home}/talk/s"
    with serving(
        environment(home),
        "--socket",
        path,
        "--socket-mode",
        mode,
        command=["sh", "-c", f'umask {umask:04o}; exec "$@"', "sh", *SERVE],
    ):
        assert stat.S_IMODE(os.stat(path).st_mode) == int(mode, 8)
        assert stat.S_IMODE(os.stat(os.path.dirname(path)).st_mode) == 0o700
    assert not os.path.exists(path)


def test_what_is_left_in_the_place_of_socket_and_lock_is_no_obstacle(home: str) -> None:
    path = f"{home}/s"
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(path)
    for garbage in (b"", b"not a number\n", b"1\n", b"\xff\0" * 5000):
        with open(f"{path}.lock", "wb") as file:
            file.write(garbage)
        with serving(environment(home), "--socket", path) as server, Wire(path) as wire:
            assert wire.greeting["pid"] == server.process.pid
        assert not os.path.exists(path)


def test_second_server_names_the_one_that_serves_and_never_the_one_before_it(home: str) -> None:
    """The lock still has the number of a server that is gone when the next one has taken it and not yet written."""
    with subprocess.Popen(["true"]) as gone:
        gone.wait()
    path = f"{home}/lock"
    with open(path, "w+b", buffering=0) as file:
        file.write(f"{gone.pid}\n".encode())
        found: list[int | None] = []
        reader = threading.Thread(target=lambda: found.append(lock._holder(file.fileno())))
        reader.start()
        reader.join(0.1)
        assert reader.is_alive(), f"it named {found}, which has ended"
        file.seek(0)
        file.truncate()
        file.write(f"{os.getpid()}\n".encode())
        reader.join()
    assert found == [os.getpid()]


def test_socket_that_somebody_else_put_in_its_place_is_not_removed(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home), "--socket", path):
        os.unlink(path)
        with socket.socket(socket.AF_UNIX) as other:
            other.bind(path)
    assert os.path.exists(path)


def test_file_in_the_place_of_the_socket_is_not_removed(home: str) -> None:
    path = f"{home}/s"
    with open(path, "w", encoding="utf-8") as file:
        file.write("precious")
    assert "is no socket: remove it" in refused(home, "--socket", path)
    with open(path, encoding="utf-8") as file:
        assert file.read() == "precious"
    assert f"a directory: name one in it, --socket {home}/talk.sock" in refused(home, "--socket", home)
    os.mkfifo(f"{home}/pipe")
    assert "is no socket: name another one" in refused(home, TALK_SOCKET=f"{home}/pipe")


def test_server_that_is_refused_leaves_no_lock(home: str) -> None:
    os.mkdir(f"{home}/directory")
    os.mkfifo(f"{home}/pipe")
    too_long = "s" * (100 - len(home))  # the lock's name is none too long for a file, the socket's for a socket
    for name in ("directory", "pipe", too_long + "s" * 20):
        refused(home, "--socket", f"{home}/{name}")
    assert sorted(os.listdir(home)) == ["directory", "pipe"]
    with open(f"{home}/{too_long}{'s' * 20}.lock", "w", encoding="utf-8"):
        pass
    refused(home, "--socket", f"{home}/{too_long}{'s' * 20}")
    assert len(os.listdir(home)) == 3, "a lock that was there is not its own to remove"


def link(path: str) -> None:
    os.symlink("precious", path)


def hard_link(path: str) -> None:
    os.link(f"{os.path.dirname(path)}/precious", path)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (os.mkfifo, "is no regular file"),
        (os.mkdir, "is no regular file"),
        (link, "is a symbolic link"),
        (hard_link, "is a hard link"),
    ],
    ids=lambda each: getattr(each, "__name__", ""),
)
def test_lock_that_is_none_is_told_and_not_written_to(home: str, make: Callable[[str], None], words: str) -> None:
    with open(f"{home}/precious", "w", encoding="utf-8") as file:
        file.write("precious")
    make(f"{home}/s.lock")
    said = refused(home, "--socket", f"{home}/s")
    assert f"the lock {home}/s.lock {words}" in said
    assert "remove it" in said
    with open(f"{home}/precious", encoding="utf-8") as file:
        assert file.read() == "precious"
    assert sorted(os.listdir(home)) == ["precious", "s.lock"]


def test_socket_without_its_whole_path_is_refused_where_the_working_directory_is_gone(home: str) -> None:
    command = ["sh", "-c", 'mkdir gone && cd gone && rmdir ../gone && exec "$@"', "sh", *SERVE, "--socket", "s"]
    done = run(command, environment(home), cwd=home)
    assert (done.code, done.out) == (11, "")
    assert "the working directory is gone" in done.err
    assert "Traceback" not in done.err


def test_directory_that_is_not_safe_is_refused(home: str) -> None:
    for name, mode in (("open", 0o777), ("group", 0o770)):
        os.mkdir(f"{home}/{name}")
        os.chmod(f"{home}/{name}", mode)
        said = refused(home, "--socket", f"{home}/{name}/s")
        assert f"{home}/{name}" in said
        assert "chmod go-w" in said
    os.mkdir(f"{home}/real", 0o700)
    os.symlink("real", f"{home}/link")
    assert "symbolic link" in refused(home, "--socket", f"{home}/link/s")
    assert "can't be made" in refused(home, "--socket", f"{home}/none/none/s")
    assert "not a directory" in refused(home, "--socket", f"{__file__}/s").lower()
    assert "too long" in refused(home, "--socket", f"{home}/{'s' * 100}").lower()
    os.symlink("/etc/passwd", f"{home}/real/s.lock")
    assert "lock" in refused(home, "--socket", f"{home}/real/s")


@as_root
def test_directory_of_another_user_is_refused(home: str) -> None:
    os.mkdir(f"{home}/theirs", 0o700)
    os.chown(f"{home}/theirs", NOBODY, NOBODY)
    assert f"belongs to uid {NOBODY}" in refused(home, "--socket", f"{home}/theirs/s")


@as_root
def test_another_user_is_refused_before_any_request_is_read(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home), "--socket", path) as server:
        assert as_stranger(path).stderr.strip() == "PermissionError"
        os.chmod(path, 0o666)  # whoever did this did not ask the server
        done = as_stranger(path)
        assert '"error": "permission_denied"' in done.stdout
        assert done.stdout.count("\n") == 1
        assert "boot" not in done.stdout
        with Wire(path) as wire:
            wire.request("status")
            assert wire.items == []
    assert "somebody else" not in server.log


@as_root
def test_another_user_is_let_in_where_the_mode_says_so(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home), "--socket", path, "--socket-mode", "0666"):
        done = as_stranger(path)
        assert '"text": "somebody else"' in done.stdout, done
        assert f'"uid": {NOBODY}' in done.stdout


@as_root
def test_client_of_another_user_ends_with_10(home: str) -> None:
    path = f"{home}/s"
    # Another user may be able to read neither this checkout nor its interpreter: it gets a copy, and the system's.
    needs("/usr/bin/python3")
    for package in (talkcli, click):
        folder = os.path.dirname(str(package.__file__))
        shutil.copytree(folder, f"{home}/lib/{package.__name__}", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run(["chmod", "-R", "a+rX", f"{home}/lib"], check=True)
    client = [*AS_NOBODY, "/usr/bin/python3", "-m", "talkcli"]
    theirs = environment(home, PYTHONPATH=f"{home}/lib", PYTHONDONTWRITEBYTECODE="1")
    with serving(environment(home), "--socket", path):
        for mode in (0o600, 0o666):
            os.chmod(path, mode)
            for words in (["status"], ["cancel"], ["say", "hello"]):
                done = run([*client, "--socket", path, *words], theirs)
                assert (done.code, done.out) == (10, ""), done
                assert "Traceback" not in done.err
                assert "have its owner let you in, with `talk serve --socket-mode 0660`" in done.err
                assert done.err.endswith("or start your own with: talk serve\n")
        done = run([*client, "status"], {**theirs, "TALK_SOCKET": path})
        assert done.err.endswith("or unset TALK_SOCKET, which names this place: no other was tried\n")
        assert "talk serve\n" not in done.err, "it would be at that place, too"
    with serving(environment(home), "--socket", path, "--socket-mode", "0666"):
        # a server of another user is trusted where it was named, root's everywhere
        assert run([*client, "--socket", path, "say", "--wait", "hello"], theirs).code == 0


@pytest.mark.usefixtures("nobody_serves")
@as_root
def test_server_that_another_user_put_where_ours_would_be_is_not_trusted(home: str) -> None:
    os.mkdir(f"{home}/talk", 0o777)
    os.chmod(f"{home}/talk", 0o777)
    python = "/usr/bin/python3" if os.path.exists("/usr/bin/python3") else sys.executable
    command = [*AS_NOBODY, python, "-u", "-c", IMPOSTOR, f"{home}/talk/talk.sock"]
    with subprocess.Popen(command, cwd="/", stdout=subprocess.PIPE) as theirs:
        try:
            assert theirs.stdout
            assert theirs.stdout.readline()
            done = run([*TALK, "say", "a secret"], environment(home, XDG_RUNTIME_DIR=home))
            assert (done.code, done.out) == (10, ""), done
            assert f"belongs to uid {NOBODY}" in done.err
        finally:
            theirs.kill()


def test_second_sigterm_ends_at_once_and_sighup_not_at_all(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=[SERVE[0], processes.SCRIPTED]) as server:
        server.process.send_signal(signal.SIGHUP)
        with Wire(path) as wire:
            wire.request("watch")
            wire.request("say", text="never-ends ignore-stop words=1")  # what takes a while to end
            wire.receive_event("word")
            server.process.send_signal(signal.SIGTERM)
            wire.receive_event("state", state="PREEMPTING")
            assert server.end(signal.SIGTERM) == 143
    assert not os.path.exists(path)


def test_socket_that_is_passed_is_served_and_left(home: str) -> None:
    path = f"{home}/passed"
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen()
        fd = listening.fileno()
        command = [sys.executable, "-c", PASSING, str(fd), *SERVE]
        with serving(environment(home, LISTEN_FDS="1"), command=command, pass_fds=[fd]):
            done = run([*TALK, "--socket", path, "say", "--wait", "hello"], environment(home))
            assert done.code == 0, done
        assert os.path.exists(path)
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(path)  # systemd listens on
    several = run([sys.executable, "-c", PASSING, "1", *SERVE], environment(home, LISTEN_FDS="2"))
    assert several.code == 2
    assert "LISTEN_FDS" in several.err
