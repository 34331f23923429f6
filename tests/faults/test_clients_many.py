"""Clients by the hundred: turned away and taken later, frozen, killed. Others are not harmed, and nothing is left."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.rawsocket import Raw
from tests.faults.broken import assert_answers
from tests.support import census
from tests.support.timing import limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: As many words as the longest text has, less a few.
WORDS = "a " * 4_990
#: kB that a frozen waiter may cost: a goal's text is never dropped and sent three times, 30 kB, and buffers grow by
#: eighths.
FROZEN = 8 * 1024 // 50

#: A process with many connections, each of which sends a line. It tells when all have been answered, and sleeps.
_CROWD = """
import socket, sys
path, count, line = sys.argv[1], int(sys.argv[2]), sys.argv[3].encode()
crowd = [socket.socket(socket.AF_UNIX) for _ in range(count)]
for each in crowd:
    each.connect(path)
    each.sendall(line + b"\\n")
for each in crowd:
    received = b""
    while received.count(b"\\n") < 2:
        received += each.recv(4096) or sys.exit("closed: " + received.decode())
print("ready", flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def crowd(talk: Talk, count: int, line: str) -> Iterator[subprocess.Popen[str]]:
    """Give a process with so many connections, each of which has sent this line and had its reply."""
    process = subprocess.Popen(
        [sys.executable, "-S", "-c", _CROWD, talk.socket, str(count), line],
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


@pytest.mark.parametrize(
    "patience", [("--timeout", "0.5"), pytest.param((), marks=pytest.mark.slow)], ids=["its own", "the usual 5 s"]
)
def test_300_clients_at_once_are_served_or_told_that_the_server_is_busy(
    scripted: Talk, patience: tuple[str, ...]
) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(Raw(scripted.socket)) for _ in range(300)]
        for each in clients:
            each.send(b'{"seq": 1, "request": "hello"}\n')
        lines = [each.receive_lines(1) for each in clients]
        greeted = [client for client, said in zip(clients, lines, strict=True) if "error" not in said[0]]
        busy = [said[0] for said in lines if "error" in said[0]]
        # The watcher of this test is one client of 256.
        assert (len(greeted), len(busy)) == (255, 45)
        assert all((each["talk"], each["error"]) == (1, "busy") for each in busy)
        assert all(each.receive_lines(2)[1] == {"seq": 1, "ok": True} for each in greeted)
        full = scripted.run("--json", "say", "--wait", *patience, "length=0")
        assert (full.code, json.loads(full.err)["error"]["code"]) == (5, "busy")
        assert scripted.run("status").code == 0  # places are kept for `status` and `cancel`
        late = scripted.start("say", "--wait", "length=0")
        greeted[0].socket.close()
        assert scripted.finish(late).code == 0  # it tries again
    assert scripted.run("say", "--wait", "length=0").code == 0


@pytest.fixture
def many_files() -> Iterator[None]:
    """Let the tests open more files than a backlog has places: a user's limit is often lower."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize(
    ("processes", "max_queue"),
    [
        (50, 1000),
        (50, 10),
        pytest.param(500, 1000, marks=pytest.mark.slow),
        pytest.param(500, 100, marks=pytest.mark.slow),
    ],
)
def test_500_say_processes_at_once(make_talk: MakeTalk, processes: int, max_queue: int) -> None:
    """With room for all none is lost. Otherwise the accepted goals are spoken, and the other clients know."""
    talk = make_talk("--max-queue", str(max_queue), scripted=True)
    first = talk.run("say", "never-ends").id
    clients = [talk.start("say", "--", f"length=0 number {number}") for number in range(processes)]
    done = [talk.finish(each, timeout=120) for each in clients]
    accepted = [each.id for each in done if each.code == 0]
    assert {each.code for each in done} == ({0} if max_queue == 1000 else {0, 5}), [each.err for each in done]
    assert len(accepted) == min(processes, max_queue)
    assert len(set(accepted)) == len(accepted)
    for client in done:
        assert client.code == 0 or f"{max_queue} goals are waiting already" in client.err
    talk.run("cancel", first)
    for each in accepted:
        assert talk.watcher.wait_for_terminal(each, timeout=30) == "SUCCEEDED"
    spoken = [each["id"] for each in talk.watcher.events() if each.get("state") == "SUCCEEDED"]
    assert sorted(spoken) == sorted(accepted)


@pytest.mark.parametrize(("waiters", "seconds"), [(10, 1), pytest.param(50, 16, marks=pytest.mark.slow)])
def test_50_waiters_that_are_frozen_take_no_memory_while_10000_words_pass(
    make_talk: MakeTalk, waiters: int, seconds: int
) -> None:
    talk = make_talk(scripted=True, watched=False)

    with limits():
        line = json.dumps({"seq": 1, "request": "watch"})
        with crowd(talk, waiters, line) as frozen:
            frozen.send_signal(signal.SIGSTOP)
            idle = census.count(talk.pid)
            speak_words(talk, seconds)
            before = census.settled(talk.pid, lambda now: now.descriptors <= idle.descriptors)
            speak_words(talk, seconds)
            # After 5,000 words the server owes clients as many as it ever does. The next 5,000 are 840 kB for each.
            census.assert_as_before(talk.pid, before, memory=waiters * FROZEN)
            frozen.send_signal(signal.SIGCONT)


def speak_words(talk: Talk, seconds: int) -> None:
    """Speak a sentence of nearly 5,000 words, while another client gets the status in time."""
    with talk.connect() as wire:
        assert wire.request("say", text=f"length={seconds} {WORDS}", wait=True)["ok"]
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            assert_answers(talk)
            time.sleep(0.005)
        assert wire.receive_event("result", timeout=40)["goal"]["state"] == "SUCCEEDED"


@pytest.mark.parametrize(
    "text",
    ["never-ends length=60 " + "a " * 600, pytest.param("never-ends", marks=pytest.mark.slow)],
    ids=["with a word now and then", "in silence"],
)
def test_500_waiters_that_are_killed_leave_nothing_and_their_goal_goes_on(make_talk: MakeTalk, text: str) -> None:
    """The server notices at the next message: a word, or every 5 s the sign that it is alive."""
    talk = make_talk("--max-clients", "600", scripted=True)
    goal = talk.run("say", text).id
    talk.watcher.wait_for_word(goal)
    line = json.dumps({"seq": 1, "request": "wait", "ids": [goal], "feedback": True})
    before = census.count(talk.pid)
    for _ in range(2):
        with contextlib.ExitStack() as stack:
            crowds = [stack.enter_context(crowd(talk, 50, line)) for _ in range(10)]
            assert census.count(talk.pid).descriptors >= 500
            for each in crowds:
                os.kill(each.pid, signal.SIGKILL)
        census.assert_as_before(talk.pid, before, memory=8 * 1024)
    assert talk.goal(goal)["state"] == "ACTIVE"
    began = time.monotonic()
    assert talk.run("cancel", goal).code == 0
    assert time.monotonic() - began < 5
    assert talk.watcher.wait_for_terminal(goal) == "PREEMPTED"


@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize(
    "commands",
    [
        [["say", "--wait", "--timeout", "0.5", "hello"]],
        pytest.param([["status"], ["cancel"], ["say", "hello"], ["say", "--wait", "hello"]], marks=pytest.mark.slow),
    ],
    ids=["its own patience", "the usual 5 s"],
)
def test_server_that_takes_no_connection_at_all_holds_no_client(scripted: Talk, commands: list[list[str]]) -> None:
    """Frozen, with its backlog full, so that `connect` itself would wait."""
    scripted.freeze()
    try:
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(BlockingIOError):
                while True:
                    connected = stack.enter_context(socket.socket(socket.AF_UNIX))
                    connected.setblocking(False)
                    connected.connect(scripted.socket)
            for client in [scripted.start(*words) for words in commands]:
                done = scripted.finish(client, timeout=10)
                assert (done.code, done.out) == (3, ""), done
                assert "restart it if it hangs" in done.err
    finally:
        scripted.thaw()
    assert scripted.run("say", "--wait", "length=0").code == 0
