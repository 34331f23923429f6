"""Hundreds of clients that are refused, frozen or killed, and servers without free descriptors."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance.bareserve import SERVE, TALK, environment, run, serving
from tests.conformance.rawsocket import Raw
from tests.faults.broken import assert_answers
from tests.faults.test_service_units import SCRIPTED
from tests.support import processes, usage
from tests.support.connection import Wire
from tests.support.processes import children
from tests.support.timing import assert_within, limits
from tests.tools.goal_monitor import GoalMonitor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: Nearly as many words as the longest text can have.
WORDS = "a " * 4_990
#: Allowed memory of a frozen waiter, in kB. Its goal's text is never dropped and is sent three times, which takes
#: 30 kB, and buffers grow in steps of an eighth.
KB_PER_FROZEN_WAITER = 8 * 1024 // 50

#: Opens many connections, sends a line on each, prints "ready" when all have been answered, and waits.
CLIENT_PROGRAM = """
import socket, sys
path, count, line = sys.argv[1], int(sys.argv[2]), sys.argv[3].encode()
crowd = [socket.socket(socket.AF_UNIX) for _ in range(count)]
for client in crowd:
    client.connect(path)
    client.sendall(line + b"\\n")
for client in crowd:
    received = b""
    while received.count(b"\\n") < 2:
        received += client.recv(4096) or sys.exit("closed: " + received.decode())
print("ready", flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def client_process(talk: Talk, count: int, line: str) -> Iterator[subprocess.Popen[str]]:
    """Run a process with `count` connections, each of which has sent `line` and received the reply."""
    process = subprocess.Popen(
        [sys.executable, "-S", "-c", CLIENT_PROGRAM, talk.socket, str(count), line],
        env=talk.env,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin
    assert process.stdout
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def test_clients_over_the_limit_get_busy_and_are_served_later(scripted: Talk) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(Raw(scripted.socket)) for _ in range(300)]
        for client in clients:
            client.send(b'{"seq": 1, "request": "hello"}\n')
        lines = [client.receive_lines(1) for client in clients]
        admitted = [client for client, messages in zip(clients, lines, strict=True) if "error" not in messages[0]]
        busy = [messages[0] for messages in lines if "error" in messages[0]]
        # The watcher of this test is one client of 256.
        assert (len(admitted), len(busy)) == (255, 45)
        assert all((greeting["talk"], greeting["error"]) == (1, "busy") for greeting in busy)
        assert all(client.receive_lines(2)[1] == {"seq": 1, "ok": True} for client in admitted)
        full = scripted.run("--json", "say", "--wait", "--timeout", "0.5", "length=0")
        assert (full.code, json.loads(full.err)["error"]["code"]) == (5, "busy")
        assert scripted.run("status").code == 0  # some places are reserved for `status` and `cancel`
        late = scripted.start("say", "--wait", "length=0")
        admitted[0].socket.close()
        assert scripted.finish(late).code == 0  # it has tried again
    assert scripted.run("say", "--wait", "length=0").code == 0


@pytest.fixture
def many_files() -> Iterator[None]:
    """Raise the limit of open files, because the default of many users is lower than the size of a backlog."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize(
    ("processes", "max_queue"),
    [(50, 10), *(pytest.param(500, size, marks=pytest.mark.slow) for size in (1000, 100))],
)
def test_500_say_processes_at_once_lose_no_accepted_goal(make_talk: MakeTalk, processes: int, max_queue: int) -> None:
    """If the queue is full, the other clients get an error."""
    talk = make_talk("--max-queue", str(max_queue), scripted=True)
    first = talk.run("say", "never-ends").id
    clients = [talk.start("say", "--", f"length=0 number {number}") for number in range(processes)]
    done = [talk.finish(client, timeout=120) for client in clients]
    accepted = [client.id for client in done if client.code == 0]
    assert {client.code for client in done} == ({0} if max_queue == 1000 else {0, 5}), [client.err for client in done]
    assert len(accepted) == min(processes, max_queue)
    assert len(set(accepted)) == len(accepted)
    for client in done:
        assert client.code == 0 or f"the queue is full ({max_queue} goals)" in client.err
    talk.run("cancel", first)
    for goal_id in accepted:
        assert talk.watcher.wait_for_terminal(goal_id, timeout=30) == "SUCCEEDED"
    spoken = [event["id"] for event in talk.watcher.events() if event.get("state") == "SUCCEEDED"]
    assert sorted(spoken) == sorted(accepted)


@pytest.mark.parametrize(("waiters", "seconds"), [(10, 1), pytest.param(50, 5, marks=pytest.mark.slow)])
def test_50_frozen_waiters_use_no_more_memory_during_10000_words(
    make_talk: MakeTalk, waiters: int, seconds: int
) -> None:
    talk = make_talk(scripted=True, watched=False)

    with limits():
        line = json.dumps({"seq": 1, "request": "watch"})
        with client_process(talk, waiters, line) as frozen:
            frozen.send_signal(signal.SIGSTOP)
            idle = usage.count(talk.pid)
            speak_words(talk, seconds)
            before = usage.wait_until(talk.pid, lambda now: now.descriptors <= idle.descriptors)
            speak_words(talk, seconds)
            # After 5,000 words, the output buffers are full. The next 5,000 words would take 840 kB per client.
            usage.assert_not_grown(talk.pid, before, memory=waiters * KB_PER_FROZEN_WAITER)
            frozen.send_signal(signal.SIGCONT)


def speak_words(talk: Talk, seconds: int) -> None:
    """Speak a sentence of nearly 5,000 words while another client gets the status in time."""
    with talk.connect() as wire:
        assert wire.request("say", text=f"length={seconds} {WORDS}", wait=True)["ok"]
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            assert_answers(talk)
            time.sleep(0.005)
        assert wire.receive_event("result", timeout=40)["goal"]["state"] == "SUCCEEDED"


def test_500_killed_waiters_leak_nothing_and_their_goal_continues(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-clients", "600", scripted=True)
    goal = talk.run("say", "never-ends length=60 " + "a " * 600).id
    talk.watcher.wait_for_word(goal)
    line = json.dumps({"seq": 1, "request": "wait", "ids": [goal], "feedback": True})
    before = usage.count(talk.pid)
    for _ in range(2):
        with contextlib.ExitStack() as stack:
            waiters = [stack.enter_context(client_process(talk, 50, line)) for _ in range(10)]
            assert usage.count(talk.pid).descriptors >= 500
            for process in waiters:
                os.kill(process.pid, signal.SIGKILL)
        usage.assert_not_grown(talk.pid, before, memory=8 * 1024)
    assert talk.goal(goal)["state"] == "ACTIVE"
    started_at = time.monotonic()
    assert talk.run("cancel", goal).code == 0
    assert time.monotonic() - started_at < 5
    assert talk.watcher.wait_for_terminal(goal) == "PREEMPTED"


@pytest.mark.usefixtures("many_files")
def test_a_server_with_a_full_backlog_does_not_block_clients(scripted: Talk) -> None:
    """The server is frozen, and its backlog is full, so that even `connect` would block."""
    scripted.freeze()
    try:
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(BlockingIOError):
                while True:
                    connected = stack.enter_context(socket.socket(socket.AF_UNIX))
                    connected.setblocking(False)
                    connected.connect(scripted.socket)
            done = scripted.run("say", "--wait", "--timeout", "0.5", "hello")
            assert (done.code, done.out, "restart it if it hangs" in done.err) == (3, "", True), done
    finally:
        scripted.thaw()
    assert scripted.run("say", "--wait", "length=0").code == 0


CLIENTS = 60
#: Limit in seconds for the recovery of a full server.
RECOVERY_S = 5.0


@contextlib.contextmanager
def connected(path: str) -> Iterator[list[socket.SocketIO]]:
    """Connect 60 clients at once."""
    with contextlib.ExitStack() as stack:
        clients: list[socket.SocketIO] = []
        for _ in range(CLIENTS):
            with socket.socket(socket.AF_UNIX) as client:
                client.settimeout(RECOVERY_S)
                client.connect(path)
                clients.append(stack.enter_context(client.makefile("rwb", buffering=0)))
        yield clients


def receive(client: socket.SocketIO) -> dict[str, Any]:
    """Return the next message."""
    line = client.readline()
    assert line, "the server closed the connection"
    message: dict[str, Any] = json.loads(line)
    return message


def admitted(clients: list[socket.SocketIO]) -> list[socket.SocketIO]:
    """Return the admitted clients, and assert that the others got an error about missing descriptors."""
    inside = []
    for client in clients:
        greeting = receive(client)
        if "boot" in greeting:
            client.write(b'{"request": "hello"}\n')
            inside.append(client)
        else:
            assert greeting["error"] == "busy"
            assert "LimitNOFILE" in greeting["message"]
    return inside


def wait_for_descriptors(pid: int, most: int) -> None:
    assert usage.wait_until(pid, lambda now: now.descriptors <= most).descriptors <= most, usage.describe(pid)


def test_60_clients_leave_the_engine_enough_of_40_descriptors(home: str) -> None:
    path = f"{home}/s"
    env = environment(home, TALK_SOCKET=path)
    command = ["sh", "-c", 'ulimit -n 40; exec "$@"', "sh", *SERVE, "--rate", "450"]
    with serving(env, command=command) as server:
        pid = server.process.pid
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0
        wait_for_descriptors(pid, 20)
        before = len(usage.descriptors(pid))
        with connected(path) as clients:
            inside = admitted(clients)
            assert 5 <= len(inside) < CLIENTS
            with limits():
                started_at = time.monotonic()
                inside[0].write(b'{"seq": 7, "request": "status"}\n')
                while receive(inside[0]).get("seq") != 7:
                    pass
                assert_within(time.monotonic() - started_at, 0.1, "status without descriptors")
            # This client is refused at first, tries again, and is admitted when others disconnect.
            with processes.start_talk(["say", "--wait", "late"], env) as late:
                time.sleep(0.5)
                assert late.poll() is None
                for client in inside[1:]:
                    client.close()
                assert late.wait(RECOVERY_S) == 0
        wait_for_descriptors(pid, before)
        with connected(path) as clients:
            inside = admitted(clients)
            (engine,) = children(pid)
            os.kill(engine, signal.SIGKILL)  # a new engine needs descriptors
            end = time.monotonic() + RECOVERY_S
            while children(pid) in ([], [engine]):
                assert time.monotonic() < end, "no new engine was started"
                time.sleep(0.01)
            inside[0].write(b'{"seq": 8, "request": "say", "text": "again", "wait": true}\n')
            while (line := receive(inside[0])).get("event") != "result":
                pass
            assert line["goal"]["state"] == "SUCCEEDED", line
        wait_for_descriptors(pid, before)
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0
        lines = server.log.splitlines()
        about = [line for line in lines if "open files" in line or "Traceback" in line or "bug" in line]
        assert len(about) <= 2, server.log  # at the start, and once for all refused clients
        assert len(lines) < 12, server.log


def test_the_server_raises_its_descriptor_limit_for_max_clients(home: str) -> None:
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
        assert "open files" not in server.log


#: Number of unanswered goals, fewer than the queue accepts.
AHEAD = 50


@pytest.mark.parametrize("goals", [500, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_cancel_racing_with_the_end_gives_exactly_one_end_state(make_talk: MakeTalk, goals: int) -> None:
    talk = make_talk(scripted=True, watched=False)
    witness = GoalMonitor(talk.socket)
    over = threading.Event()

    def cancel() -> None:
        with talk.connect() as wire:
            while not over.is_set():
                assert wire.request("cancel", current=True)["ok"]

    thread = threading.Thread(target=cancel)
    thread.start()
    results: Counter[str] = Counter()
    try:
        with talk.connect() as wire:
            for number in range(goals + AHEAD):
                if number < goals:
                    # A goal without words can end before its start is known. Every other goal takes about as long as a
                    # cancel, which would otherwise nearly always be too late on busy cores.
                    text = f"length={0.001 * (number % 2)} words=0"
                    wire.send({"seq": number, "request": "say", "text": text, "wait": True})
                if number >= AHEAD:
                    results[wire.receive_event("result")["goal"]["state"]] += 1
    finally:
        over.set()
        thread.join()
    assert witness.wait_for(goals, timeout=10)
    talk.stop()
    witness.close()
    assert not witness.faults
    assert sum(results.values()) == goals
    assert results.keys() <= {"SUCCEEDED", "PREEMPTED"}
    assert {state: count for (state, _), count in witness.ends.items()} == dict(results)
    # Both outcomes must have been frequent.
    assert min(results["SUCCEEDED"], results["PREEMPTED"]) > goals / 100, results
