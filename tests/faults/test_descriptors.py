"""File descriptors used up: by clients, which can't take the engine's, and by anything else."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import time
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance.bareserve import SERVE, TALK, environment, run, serving
from tests.support import processes
from tests.support.connection import Wire
from tests.support.processes import children
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator

SCRIPTED = [SERVE[0], processes.SCRIPTED]
CLIENTS = 60
#: Seconds in which a server that was full is itself again.
SOON = 5.0


def limited(files: int, command: list[str]) -> list[str]:
    return ["sh", "-c", f'ulimit -n {files}; exec "$@"', "sh", *command]


def descriptors(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def kill_engine(pid: int) -> int:
    """Kill a server's engine, and return its former process id."""
    (engine,) = children(pid)
    os.kill(engine, signal.SIGKILL)
    return engine


@contextlib.contextmanager
def crowd(path: str) -> Iterator[list[socket.socket]]:
    """Connect 60 clients at once."""
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(CLIENTS)]
        for each in clients:
            each.settimeout(SOON)
            each.connect(path)
        yield clients


def receive(client: socket.socket) -> dict[str, Any]:
    """Return the object of the next line, without reading further."""
    data = bytearray()
    while not data.endswith(b"\n"):
        byte = client.recv(1)
        assert byte, "the server closed the connection"
        data += byte
    message: dict[str, Any] = json.loads(data)
    return message


def greeted(clients: list[socket.socket]) -> list[socket.socket]:
    """Return the clients that were let in; the others must have been told that descriptors are missing."""
    inside = []
    for each in clients:
        greeting = receive(each)
        if "boot" in greeting:
            each.sendall(b'{"request": "hello"}\n')
            inside.append(each)
        else:
            assert greeting["error"] == "busy"
            assert "LimitNOFILE" in greeting["message"]
    return inside


def assert_status(client: socket.socket) -> None:
    """Assert that a client that was let in gets the status in time."""
    with limits():
        began = time.monotonic()
        client.sendall(b'{"seq": 7, "request": "status"}\n')
        while receive(client).get("seq") != 7:
            pass
        assert_within(time.monotonic() - began, 0.1, "status without descriptors")


def wait_for_descriptors(pid: int, count: int) -> None:
    end = time.monotonic() + SOON
    while descriptors(pid) > count:
        assert time.monotonic() < end, f"{descriptors(pid)} descriptors are open, {count} were"
        time.sleep(0.01)


def test_limit_of_40_and_60_clients_leave_the_engine_what_it_needs(home: str) -> None:
    path = f"{home}/s"
    env = environment(home, TALK_SOCKET=path)
    with serving(env, command=limited(40, [*SERVE, "--rate", "450"])) as server:
        pid = server.process.pid
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0
        wait_for_descriptors(pid, 20)
        before = descriptors(pid)
        with crowd(path) as clients:
            inside = greeted(clients)
            assert 5 <= len(inside) < CLIENTS
            assert_status(inside[0])
            # A client that comes now tries again, and gets in when others leave.
            with processes.start_talk(["say", "--wait", "late"], env) as late:
                time.sleep(0.5)
                assert late.poll() is None
                for each in inside[1:]:
                    each.close()
                assert late.wait(SOON) == 0
        wait_for_descriptors(pid, before)
        with crowd(path) as clients:
            inside = greeted(clients)
            engine = kill_engine(pid)  # so that a new one must find descriptors
            end = time.monotonic() + SOON
            while children(pid) in ([], [engine]):
                assert time.monotonic() < end, "there is no new engine"
                time.sleep(0.01)
            inside[0].sendall(b'{"seq": 8, "request": "say", "text": "again", "wait": true}\n')
            while (line := receive(inside[0])).get("event") != "result":
                pass
            assert line["goal"]["state"] == "SUCCEEDED", line
        wait_for_descriptors(pid, before)
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0
        lines = server.log.splitlines()
        about = [each for each in lines if "files may be open" in each or "Traceback" in each or "bug" in each]
        assert len(about) <= 2, server.log  # at the start, and once for all that were turned away
        assert len(lines) < 12, server.log


def test_descriptors_that_something_else_has_used_up(home: str) -> None:
    path = f"{home}/s"
    env = environment(home, TALK_SOCKET=path)
    with serving(env, command=SCRIPTED) as server, Wire(path) as wire:
        assert wire.request("hello")["ok"]  # else the connection is closed after a while
        pid = server.process.pid
        assert run([*TALK, "say", "--wait", "length=0"], env).code == 0
        before = descriptors(pid)
        most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, most))  # it has more, and gets no new one
        lines = server.log.count("\n")
        with crowd(path) as clients:
            kill_engine(pid)
            time.sleep(2)  # twice as long as it waits to look again; and four starts of the engine
            with limits():
                began = time.monotonic()
                assert wire.request("status")["ok"]
                assert_within(time.monotonic() - began, 0.1, "status without descriptors")
            goal = wire.request("say", text="length=0", wait=True)["goal"]
            assert goal["state"] == "PENDING"
            assert "cannot be started" in wire.request("status")["server"]["engine"]
            assert server.log.count("\n") - lines < 8, server.log
            resource.prlimit(pid, resource.RLIMIT_NOFILE, (most, most))
            assert len(greeted(clients)) == CLIENTS  # those that waited are let in, all of them
            ended = wire.receive_event("result", timeout=15)["goal"]  # the longest pause before a start is 10 s
            assert (ended["id"], ended["state"]) == (goal["id"], "SUCCEEDED")
        wait_for_descriptors(pid, before)
        assert "Traceback" not in server.log
        assert "bug" not in server.log


def test_more_clients_than_a_process_usually_has_descriptors(home: str) -> None:
    if resource.getrlimit(resource.RLIMIT_NOFILE)[1] < 1500:
        pytest.skip("this user may not open 1,500 files")
    path = f"{home}/s"
    with serving(
        environment(home, TALK_SOCKET=path),
        "--max-clients",
        "1200",
        command=["sh", "-c", 'ulimit -S -n 256; exec "$@"', "sh", *SCRIPTED],
    ) as server:
        assert resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE)[0] >= 1200
        with contextlib.ExitStack() as stack:
            for _ in range(400):
                stack.enter_context(Wire(path))
        assert "files may be open" not in server.log
