"""`--connect-timeout`: a client retries until a server runs, unless a retry can't help."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import polling
from talkcli.client import connect
from talkcli.client.connection import SocketConnection
from talkcli.errors import AccessDenied, ProtocolMismatch, ServerUnavailable, TalkError
from tests.support.connection import PATIENCE
from tests.support.processes import start_talk
from tests.support.scripted_peer import GREETING
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from tests.conftest import MakeTalk
    from tests.support.processes import Process

HELLO = connect.hello(None, urgent=False)
BUSY = b'{"talk": 1, "error": "busy", "message": "256 clients"}\n'
HANG_UP = b""


@pytest.fixture
def path(home: str) -> str:
    return f"{home}/talk/s"


@contextlib.contextmanager
def serving(path: str, *greetings: bytes) -> Iterator[None]:
    """Serve one client after another at this path, and send one greeting to each."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen()

        def serve() -> None:
            for greeting in greetings:
                connected, _ = listening.accept()
                with connected:
                    connected.sendall(greeting)
                    while greeting and connected.recv(65536):
                        pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield
        thread.join(PATIENCE)


class Waits:
    """A replacement for `wait_ready` that calls `act` instead of pausing, and records the length of all waits."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, act: Callable[[int], object] = lambda _: None) -> None:
        self.pauses: list[float] = []
        self.others: list[float] = []
        self._act, self._ready = act, polling.wait_ready
        monkeypatch.setattr(polling, "wait_ready", self)

    def __call__(
        self, watched: Mapping[int, int], timeout: float, interrupt: Mapping[int, int] | None = None
    ) -> set[int] | None:
        if watched:
            self.others.append(timeout)
            return self._ready(watched, timeout, interrupt)
        self.pauses.append(timeout)
        self._act(len(self.pauses))
        return None


def create_stale_socket(path: str) -> None:
    os.makedirs(os.path.dirname(path))
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(path)


@pytest.mark.parametrize(
    ("prepare", "greetings"),
    [
        (lambda _: None, [GREETING]),
        (lambda path: os.makedirs(os.path.dirname(path)), [HANG_UP, GREETING]),
        (create_stale_socket, [BUSY, GREETING]),
    ],
    ids=["no directory", "no socket", "stale socket"],
)
def test_a_client_reaches_a_server_that_starts_while_it_tries(
    path: str, monkeypatch: pytest.MonkeyPatch, prepare: Callable[[str], None], greetings: list[bytes]
) -> None:
    prepare(path)
    with contextlib.ExitStack() as stack:
        waits = Waits(monkeypatch, lambda n: stack.enter_context(serving(path, *greetings)) if n == 3 else None)
        attempt = polling.run_blocking(connect.connect(path, HELLO, keep_trying_s=60))
        assert attempt.socket
        attempt.socket.close()
    assert len(waits.pauses) == 3 + len(greetings) - 1
    low, high = connect.RETRY_PAUSE_S
    assert all(low <= seconds <= high for seconds in waits.pauses)


@pytest.mark.parametrize(
    ("greeting", "error"),
    [
        (b'{"talk": 1, "error": "permission_denied", "message": "not you"}\n', AccessDenied),
        (b'{"talk": 99, "version": "9"}\n', ProtocolMismatch),
        (b"220 mail ready\n", ServerUnavailable),
    ],
)
def test_a_refused_client_does_not_try_again(
    path: str, monkeypatch: pytest.MonkeyPatch, greeting: bytes, error: type[TalkError]
) -> None:
    waits = Waits(monkeypatch)
    with serving(path, greeting), pytest.raises(error):
        polling.run_blocking(connect.connect(path, HELLO, keep_trying_s=60))
    assert waits.pauses == []


def test_an_unusable_socket_path_is_tried_once(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    waits = Waits(monkeypatch)
    os.makedirs(path)
    with pytest.raises(ServerUnavailable, match="a directory, not a socket"):
        polling.run_blocking(connect.connect(path, HELLO, keep_trying_s=60))
    monkeypatch.setattr("talkcli.paths.client_sockets", lambda _: [f"{path}/s"])
    monkeypatch.setattr("talkcli.peers.credentials", lambda _: (1, os.getuid() + 1))
    with serving(f"{path}/s"), pytest.raises(AccessDenied, match="belongs to uid"):
        polling.run_blocking(connect.connect(None, HELLO, keep_trying_s=60))
    assert waits.pauses == []


def test_a_refusal_at_one_socket_does_not_end_the_wait_for_another(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    denied = f"{path}-denied"
    monkeypatch.setattr("talkcli.paths.client_sockets", lambda _: [path, denied])
    refusal = b'{"talk": 1, "error": "permission_denied", "message": "not you"}\n'
    with contextlib.ExitStack() as stack:
        stack.enter_context(serving(denied, refusal))
        Waits(monkeypatch, lambda _: stack.enter_context(serving(path, GREETING)))
        attempt = polling.run_blocking(connect.connect(None, HELLO, keep_trying_s=60))
        assert attempt.socket
        attempt.socket.close()
    assert attempt.path == path


@pytest.mark.parametrize(
    ("keep_trying_s", "left", "least", "most"), [(0, None, 4, 5), (1, None, 4, 5), (60, None, 50, 60), (2, 2, 1, 2)]
)
def test_the_greeting_and_replies_may_take_the_remaining_time(
    path: str, monkeypatch: pytest.MonkeyPatch, keep_trying_s: float, left: float | None, least: float, most: float
) -> None:
    waits = Waits(monkeypatch)
    with serving(path, GREETING):
        end = None if left is None else time.monotonic() + left
        connection = polling.run_blocking(SocketConnection.open(path, keep_trying_s=keep_trying_s, end=end))
        connection.close()
    assert all(least <= seconds <= most for seconds in waits.others)
    assert max(least, 4) <= connection._patience <= max(most, 5)


@contextlib.contextmanager
def client_without_server(path: str, *command: str) -> Iterator[Process]:
    """Start `talk` with --connect-timeout, hang up on its first three attempts, and remove the socket."""
    os.makedirs(os.path.dirname(path))
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen()
        listening.settimeout(PATIENCE)
        env = clean_environment(os.path.dirname(path), {"TALK_SOCKET": path})
        client = start_talk(["--connect-timeout", "60", *command], env)
        for _ in range(3):
            listening.accept()[0].close()
        os.unlink(path)
    try:
        yield client
    finally:
        client.kill()
        client.wait()


def test_a_sentence_is_spoken_when_the_server_has_started(path: str, make_talk: MakeTalk) -> None:
    with client_without_server(path, "say", "--wait", "--id", "first", "length=0.1") as client:
        talk = make_talk(scripted=True, env={"TALK_SOCKET": path})
        out, err = client.communicate(timeout=PATIENCE)
        assert (client.wait(), out) == (0, "first\n"), err
    assert talk.watcher.texts("SUCCEEDED") == ["length=0.1"]


def test_ctrl_c_ends_the_wait_for_a_server(path: str) -> None:
    with client_without_server(path, "say", "--wait", "hello") as client:
        client.send_signal(signal.SIGINT)
        out, err = client.communicate(timeout=PATIENCE)
        assert (client.wait(), out, err) == (130, "", "")


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("--connect-timeout 0.1 say --wait --timeout 60 hello", 3),
        ("--connect-timeout 60 say --wait --timeout 0.1 hello", 124),
        ("--connect-timeout 60 say --lines --wait --timeout 0.1", 124),
        ("--connect-timeout 60 wait --timeout 0.1", 124),
    ],
)
def test_the_shorter_of_two_timeouts_ends_the_wait(path: str, line: str, code: int) -> None:
    client = start_talk(line.split(), clean_environment(os.path.dirname(path), {"TALK_SOCKET": path}))
    out, err = client.communicate(timeout=PATIENCE)
    assert (client.wait(), out) == (code, ""), err
    assert "--lines" in line or f"  {path}: not found" in err
