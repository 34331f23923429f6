"""The socket's file, its lock or its directory is removed or replaced while a server serves."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.server.run import LOOK_EVERY
from tests.conformance.bareserve import SERVE, TALK, BareServe, environment, run, serving
from tests.support import processes
from tests.support.connection import Wire
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

HASTY = [sys.executable, os.path.join(os.path.dirname(os.path.abspath(__file__)), "hasty_serve.py")]
SCRIPTED = [SERVE[0], processes.SCRIPTED]
#: Seconds in which a server that looks every 0.05 s is found again.
SOON = 5.0
#: Listens at a path, as another program would, and says so.
OTHER = """
import os, socket, sys, time
s = socket.socket(socket.AF_UNIX)
s.bind(sys.argv[1] + "new")
s.listen()
os.rename(sys.argv[1] + "new", sys.argv[1])
print(flush=True)
time.sleep(60)
"""


@pytest.fixture
def home() -> Iterator[str]:
    with short_directory() as path:
        yield path


def found_again(path: str, pid: int) -> None:
    """Wait until clients reach the server of this process."""
    end = time.monotonic() + SOON
    while True:
        try:
            with Wire(path) as wire:
                assert wire.greeting["pid"] == pid
                return
        except OSError:
            assert time.monotonic() < end, f"nobody answers at {path}"
            time.sleep(0.01)  # a socket's appearance is no event


def unlink(path: str) -> None:
    os.unlink(path)


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


def test_it_is_looked_at_well_within_the_30_seconds_that_are_promised() -> None:
    assert LOOK_EVERY <= 15  # and a second look would find what the first, for a full disk, could not mend


@pytest.mark.parametrize(
    "fault",
    [unlink, unlink_both, remove_directory, replace_by_stale_socket, move_directory],
    ids=lambda each: each.__name__,
)
def test_socket_that_was_removed_or_replaced_is_bound_again(home: str, fault: Callable[[str], None]) -> None:
    path = f"{home}/talk/s"
    env = environment(home, TALK_SOCKET=path)
    with serving(env, "--socket-mode", "0660", command=HASTY) as server, Wire(path) as old:
        goal = old.request("say", text="never-ends", wait=True)["goal"]
        old.receive_event("state", state="ACTIVE")
        fault(path)
        found_again(path, server.process.pid)
        assert stat.S_IMODE(os.stat(path).st_mode) == 0o660
        assert stat.S_IMODE(os.stat(os.path.dirname(path)).st_mode) == 0o700
        # What was there lives on, and what comes finds it.
        assert run([*TALK, "cancel"], env).out.split() == [goal["id"]]
        assert old.receive_event("result")["goal"]["state"] == "PREEMPTED"
        assert old.request("status")["server"]["socket"] == path
        # Still one server, whose lock is the one by this name.
        second = run([*SCRIPTED], env)
        assert second.code == 11, second
        assert f"pid {server.process.pid}" in second.err
        with open(f"{path}.lock", encoding="utf-8") as lock:
            assert lock.read() == f"{server.process.pid}\n"
        fault(path)  # and again
        found_again(path, server.process.pid)
        assert server.end(signal.SIGTERM) == 0
    assert not os.path.exists(path)
    assert server.log.count("bound again") == 2


def test_socket_named_from_the_working_directory_is_bound_again_where_that_was(home: str) -> None:
    """The directory is gone when it is, and with it the place from which its name was to be read."""
    path = f"{home}/here/s"
    os.mkdir(f"{home}/here", 0o700)
    command = ["sh", "-c", 'cd "$0" && exec "$@"', f"{home}/here", *HASTY]
    with serving(environment(home, TALK_SOCKET="s"), command=command) as server:
        remove_directory(path)
        found_again(path, server.process.pid)
        with Wire(path) as wire:
            assert wire.request("status")["server"]["socket"] == path
    assert "a bug" not in server.log


def test_lock_alone_that_was_removed_is_made_again(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=HASTY) as server:
        socket_file = os.stat(path).st_ino
        os.unlink(f"{path}.lock")
        end = time.monotonic() + SOON
        while not os.path.exists(f"{path}.lock"):
            assert time.monotonic() < end
            time.sleep(0.01)
        found_again(path, server.process.pid)
        assert os.stat(path).st_ino == socket_file


def test_descriptors_are_the_same_after_many_times(home: str) -> None:
    path = f"{home}/s"
    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("no /proc")
    with serving(environment(home, TALK_SOCKET=path), command=HASTY) as server:
        found_again(path, server.process.pid)
        before = len(os.listdir(f"/proc/{server.process.pid}/fd"))
        for _ in range(5):
            unlink_both(path)
            found_again(path, server.process.pid)
        end = time.monotonic() + SOON
        while len(os.listdir(f"/proc/{server.process.pid}/fd")) > before:  # the last client may not be gone yet
            assert time.monotonic() < end
            time.sleep(0.01)


def ends_with_11(server: BareServe, words: str) -> None:
    assert server.process.wait(SOON) == 11, server.log
    server.end()
    assert words in server.log
    assert "Traceback" not in server.log


def test_server_whose_place_another_one_took_ends_for_its_supervisor(home: str) -> None:
    path = f"{home}/s"
    env = environment(home, TALK_SOCKET=path)
    with serving(env, command=HASTY) as first, Wire(path) as wire:
        wire.request("say", text="never-ends", wait=True)
        wire.receive_event("state", state="ACTIVE")
        os.kill(first.process.pid, signal.SIGSTOP)  # so that the second is there before the first looks
        unlink_both(path)
        with serving(env, command=SCRIPTED) as second:
            os.kill(first.process.pid, signal.SIGCONT)
            result = wire.receive_event("result")["goal"]
            assert (result["state"], result["reason"]) == ("PREEMPTED", "shutdown")
            pid = second.process.pid
            ends_with_11(first, f"a server (pid {pid}) serves {path} already: use it, or end it first (kill {pid})")
            found_again(path, second.process.pid)  # which lost nothing


def test_two_servers_whose_files_were_removed_together_are_one_in_the_end(home: str) -> None:
    path = f"{home}/s"
    env = environment(home, TALK_SOCKET=path)
    for _ in range(3):
        with serving(env, command=HASTY) as first:
            os.kill(first.process.pid, signal.SIGSTOP)
            unlink_both(path)
            with serving(env, command=HASTY) as second:
                unlink_both(path)
                os.kill(first.process.pid, signal.SIGCONT)
                end = time.monotonic() + SOON
                while None not in (codes := [first.process.poll(), second.process.poll()]) or codes == [None, None]:
                    assert time.monotonic() < end, codes
                    time.sleep(0.01)
                assert sorted(codes, key=str) == [11, None]
                winner = first if codes[0] is None else second
                found_again(path, winner.process.pid)


def test_program_that_listens_in_its_place_keeps_its_socket(home: str) -> None:
    path = f"{home}/s"
    program = [sys.executable, "-S", "-c", OTHER, path]
    with (
        serving(environment(home, TALK_SOCKET=path), command=HASTY) as server,
        subprocess.Popen(program, stdout=subprocess.PIPE) as other,
    ):
        try:
            assert other.stdout
            assert other.stdout.readline()
            ends_with_11(server, f"another program listens at {path}")
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(path)
        finally:
            other.kill()


def test_file_or_link_in_its_place_is_not_removed(home: str) -> None:
    for make in (lambda path: os.symlink("/etc/passwd", path), os.mkdir):
        path = f"{home}/s"
        with serving(environment(home, TALK_SOCKET=path), command=HASTY) as server:
            os.rename(path, f"{path}.old")
            make(path)
            ends_with_11(server, f"{path} exists and is no socket")
        assert os.path.lexists(path)
        os.rename(path, f"{path}.{time.monotonic()}")


def test_directory_that_is_no_longer_safe_ends_it(home: str) -> None:
    path = f"{home}/talk/s"
    with serving(environment(home, TALK_SOCKET=path), command=HASTY) as server:
        move_directory(path)
        os.chmod(f"{home}/talk", 0o777)
        ends_with_11(server, f"chmod go-w {home}/talk")
    assert os.listdir(f"{home}/talk") == []


def test_file_of_a_passed_socket_is_missed_but_not_made(home: str) -> None:
    path = f"{home}/passed"
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen()
        passing = f"import os; os.dup2({listening.fileno()}, 3); os.environ['LISTEN_PID'] = str(os.getpid()); "
        passing += "import sys; os.execv(sys.argv[1], sys.argv[1:])"
        command = [sys.executable, "-S", "-c", passing, *HASTY]
        with serving(environment(home, LISTEN_FDS="1"), command=command, pass_fds=[listening.fileno()]) as server:
            with Wire(path) as wire:
                os.unlink(path)
                end = time.monotonic() + SOON
                while "systemctl restart talk.socket" not in server.log:
                    assert time.monotonic() < end, server.log
                    time.sleep(0.01)
                time.sleep(0.2)
                assert wire.request("status")["ok"]
            assert not os.path.exists(path)
            assert server.log.count("systemctl restart") == 1  # said once, not at every look
