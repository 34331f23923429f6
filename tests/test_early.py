"""Early requests: a client sends its request once, before most of its imports. A signal still cancels the goal."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.cli.interrupts import Interrupts
from talkcli.client.connect import ConnectionAttempt, connect, hello, reach, send_early, yield_processor
from talkcli.errors import AccessDenied
from talkcli.paths import client_sockets
from talkcli.polling import run_blocking, wait_ready
from tests.conformance.bareserve import TALK, run
from tests.support.connection import PATIENCE
from tests.support.scripted_peer import GREETING, Peer, goal, result, serving
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.goals.goal import JsonObject
    from tests.support.processes import Talk


def start(path: str) -> subprocess.Popen[str]:
    """Start `talk say --wait hello` with the server at this path."""
    env = clean_environment(os.path.dirname(path), {"TALK_SOCKET": path})
    command = [*TALK, "say", "--wait", "hello"]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@contextlib.contextmanager
def listening_at(path: str, backlog: int = 8) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen(backlog)
        yield listening


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_during_the_imports_cancels_the_sent_goal(number: signal.Signals) -> None:
    def play(peer: Peer) -> None:
        request = peer.receive("say")
        # The client has sent its request, but hasn't imported most of its modules yet.
        client.send_signal(number)
        peer.send({"seq": request["seq"], "ok": True, "goal": goal("PENDING")})
        peer.reply("cancel")
        peer.send(result("RECALLED"))

    with serving(play) as path:
        client = start(path)
        out, err = client.communicate(timeout=PATIENCE)
    assert (client.returncode, out) == (128 + number, "g\n"), err


def assert_hello_is_sent_once(serve: Callable[[socket.socket], None], requests: list[dict[str, Any]]) -> None:
    """Run `talk say hello` with this server, which appends the received requests to `requests`."""
    with short_directory() as directory, listening_at(f"{directory}/s") as listening:
        thread = threading.Thread(target=serve, args=[listening], daemon=True)
        thread.start()
        done = run([*TALK, "say", "hello"], clean_environment(directory, {"TALK_SOCKET": f"{directory}/s"}))
        thread.join(PATIENCE)
    assert (done.code, done.out, done.err) == (0, "g\n", "")
    assert requests == [{"request": "hello"}, {"seq": 1, "request": "say", "text": "hello"}]


def answer(connected: socket.socket, requests: list[dict[str, Any]]) -> None:
    """Read two requests, accept the goal, and read until the client hangs up."""
    with connected.makefile("rb") as file:
        requests.extend(json.loads(file.readline()) for _ in range(2))
        connected.sendall(json.dumps({"seq": requests[1]["seq"], "ok": True, "goal": goal("PENDING")}).encode() + b"\n")
        requests.extend(json.loads(line) for line in file)


@pytest.mark.parametrize(
    "greeting",
    [
        [GREETING[:10], GREETING[10:]],
        [b"", GREETING],
        [GREETING.replace(b'{"talk": 1,', b'{ "talk":1,')],
        [GREETING[:-1] + b"\n" + b'{"event": "alive"}\n'],
    ],
    ids=["in parts", "late", "other spacing", "with an event"],
)
def test_a_request_is_sent_once_however_the_server_greets(greeting: list[bytes]) -> None:
    requests: list[dict[str, Any]] = []

    def serve(listening: socket.socket) -> None:
        connected, _ = listening.accept()
        with connected:
            for part in greeting:
                connected.sendall(part)
                time.sleep(0.3 if part is not greeting[-1] else 0)  # longer than a client waits before its imports
            answer(connected, requests)

    assert_hello_is_sent_once(serve, requests)


def test_nothing_is_sent_to_a_server_that_lacks_a_feature() -> None:
    with serving(lambda _: None) as path:
        env = clean_environment(os.path.dirname(path), {"TALK_SOCKET": path})
        done = run([*TALK, "say", "--markdown", "**hello**"], env)
    assert (done.code, done.out) == (9, ""), done
    assert done.err == "talk: the server (version 0) does not support Markdown; restart it\n"


def test_a_request_is_sent_again_if_the_server_hangs_up() -> None:
    """For example if the server ended, and a socket unit started the next one."""
    requests: list[dict[str, Any]] = []

    def serve(listening: socket.socket) -> None:
        connected, _ = listening.accept()
        with connected:
            connected.recv(1, socket.MSG_PEEK)  # closing a socket with unread bytes breaks the connection
        connected, _ = listening.accept()
        with connected:
            connected.sendall(GREETING)
            answer(connected, requests)

    assert_hello_is_sent_once(serve, requests)


def test_the_request_is_sent_before_the_client_is_imported(scripted: Talk) -> None:
    """The imports would delay the first word."""
    code = (
        "import sys\n"
        "from talkcli.client import connect\n"
        "send_early = connect.send_early\n"
        "def spy(*arguments):\n"
        "    attempt = send_early(*arguments)\n"
        "    assert attempt and attempt.request_sent\n"
        "    heavy = {{'click', 'json', 're', 'enum', 'socket', 'typing', 'talkcli.client.client'}}\n"
        "    print(sorted(heavy & {{*sys.modules}}))\n"
        "    return attempt\n"
        "connect.send_early = spy\n"
        "from talkcli.cli import run\n"
        "assert run({}) == 0\n"
        "print('click' in sys.modules)\n"
    )
    for arguments in (["say", "--wait", "length=0"], ["status"], ["cancel"], ["pause"]):
        done = run([sys.executable, "-c", code.format(arguments)], scripted.env)
        assert [done.out.splitlines()[index] for index in (0, -1) if done.out] == ["[]", "False"], done


def test_a_waiting_client_delays_its_imports(scripted: Talk) -> None:
    """The imports would compete with the engine and the player until the first sound."""
    code = (
        "import sys\n"
        "from talkcli.client import connect\n"
        "yield_processor = connect.yield_processor\n"
        "def spy(*attempt):\n"
        "    yield_processor(*attempt)\n"
        "    print('stood back', {{'json', 'talkcli.client.client'}} & {{*sys.modules}})\n"
        "connect.yield_processor = spy\n"
        "from talkcli.cli import run\n"
        "assert run({}) == 0\n"
    )
    for arguments, stands_back in (
        (["say", "--wait", "-q", "length=0.3"], True),
        (["say", "--wait", "--feedback", "-q", "length=0.3"], False),
        (["say", "-q", "length=0.3"], False),
        (["status", "-q"], False),
    ):
        done = run([sys.executable, "-c", code.format(arguments)], scripted.env)
        assert ("stood back set()" in done.out.splitlines()) == stands_back, (arguments, done)


def test_a_client_yields_the_processor_and_loses_no_reply(monkeypatch: pytest.MonkeyPatch) -> None:
    client_end, server_end = socket.socketpair()
    attempt = ConnectionAttempt(client_end, "s", hello_sent=True, request_sent=b"request\n")
    with client_end, server_end:
        for answer in (b"", b"reply\n"):
            server_end.sendall(answer)
            monkeypatch.setattr("talkcli.client.connect.time.process_time", lambda: 0.1)
            started_at = time.monotonic()
            yield_processor(attempt, None)
            assert time.monotonic() - started_at >= 0.1
            monkeypatch.setattr("talkcli.client.connect.time.process_time", lambda: PATIENCE)
            started_at = time.monotonic()
            yield_processor(attempt, 0.05)  # its own limit is shorter
            yield_processor(attempt, None)  # on a slow machine, the wait has a maximum
            assert time.monotonic() - started_at < PATIENCE
        monkeypatch.setattr("talkcli.client.connect._LONGEST_YIELD_S", PATIENCE)
        assert client_end.recv(100) == b"reply\n"
        started_at = time.monotonic()
        for refused in (b'{"seq": 1, "ok": false}\n', b'{"goal": {"state": "REJECTED"}}\n'):
            server_end.sendall(refused)
            yield_processor(attempt, None)  # a refusal needs no wait
            assert (os.get_blocking(client_end.fileno()), client_end.recv(100)) == (False, refused)
        server_end.close()
        yield_processor(attempt, None)  # the server is gone
        assert time.monotonic() - started_at < PATIENCE
        assert (os.get_blocking(client_end.fileno()), client_end.recv(1)) == (False, b"")


def test_simple_commands_import_neither_click_nor_slow_modules(scripted: Talk) -> None:
    heavy = ["click", "asyncio", "concurrent", "multiprocessing", "ssl", "logging", "tempfile", "dataclasses"]
    heavy += ["pathlib", "pyttsx3", "platformdirs", "talkcli.server", "talkcli.goals.scheduler", "talkcli.engine"]
    code = (
        "import sys; from talkcli.cli import run\n"
        "for arguments in {}: assert run(arguments) == 0\n"
        "print([name for name in {} if name in sys.modules])"
    )
    commands = [["say", "--wait", "length=0"], ["status"], ["cancel"], ["wait"], ["log"], ["voices"], ["set"]]
    commands += [["pause"], ["resume"]]
    done = run([sys.executable, "-c", code.format([*commands, ["set", "--rate", "150"]], heavy)], scripted.env)
    assert done.out.splitlines()[-1] == "[]", done


def test_ctrl_c_before_the_greeting_prints_no_traceback() -> None:
    with short_directory() as directory, listening_at(f"{directory}/s") as listening:
        client = start(f"{directory}/s")
        connected, _ = listening.accept()
        with connected:
            assert connected.recv(65536) == b'{"request": "hello"}\n'
            client.send_signal(signal.SIGINT)
            out, err = client.communicate(timeout=PATIENCE)
            assert (client.returncode, out, err) == (130, "", "")
            assert connected.recv(65536) == b""


def test_a_server_with_a_full_backlog_is_not_skipped() -> None:
    with short_directory() as directory, contextlib.ExitStack() as stack:
        first, second = f"{directory}/runtime/talk/talk.sock", f"{directory}/runtime-{os.getuid()}/talk/talk.sock"
        for path in (first, second):
            os.makedirs(os.path.dirname(path))
            listening = stack.enter_context(listening_at(path, 0 if path == first else 8))
        with contextlib.suppress(BlockingIOError):
            while True:
                waiting = stack.enter_context(socket.socket(socket.AF_UNIX))
                waiting.setblocking(False)
                waiting.connect(first)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_RUNTIME_DIR", f"{directory}/runtime")
            patch.setenv("TMPDIR", directory)
            assert first in client_sockets(None)
            assert second in client_sockets(None)
            attempt = reach(None)
            assert (attempt.socket, attempt.backlog_full, attempt.failures[-1][0]) == (None, True, first)
        listening.setblocking(False)
        with pytest.raises(BlockingIOError):  # no client connected to the second socket
            listening.accept()


@pytest.mark.parametrize("early", [False, True])
def test_a_server_that_refuses_the_client_is_skipped(early: bool) -> None:
    heard: list[bytes] = []

    def serve(listening: socket.socket, greeting: bytes) -> None:
        with contextlib.suppress(OSError):  # until it is closed
            while True:
                connected, _ = listening.accept()
                with connected:
                    connected.sendall(greeting)
                    heard.append(connected.recv(65536))

    def attempt() -> ConnectionAttempt | None:
        first: JsonObject = {"request": "status"}
        return send_early(reach(None), hello(None, urgent=False), first, lambda: None) if early else None

    refusal = b'{"talk": 1, "error": "permission_denied", "message": "not you"}\n'
    with short_directory() as directory, contextlib.ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        first, second = f"{directory}/first", f"{directory}/second"
        patch.setattr("talkcli.paths.client_sockets", lambda _: [first, second])
        for path, greeting in ((first, refusal), (second, GREETING)):
            listening = stack.enter_context(listening_at(path))
            thread = threading.Thread(target=serve, args=(listening, greeting), daemon=True)
            thread.start()
            stack.callback(thread.join, PATIENCE)
            stack.callback(listening.shutdown, socket.SHUT_RDWR)
        line = run_blocking(connect(None, hello(None, urgent=False), attempt=attempt()))
        assert (line.path, line.request_sent) == (second, b"")
        assert line.socket
        line.socket.close()
        os.unlink(second)
        with pytest.raises(AccessDenied, match=f"(?s)tried:\n  {first}: the server refused the connection: not you\n"):
            run_blocking(connect(None, hello(None, urgent=False), attempt=attempt()))
    assert set(heard) == {b'{"request": "hello"}\n'}, "the request is only for the server that admits the client"


# Signals during a wait


def signal_another_thread(number: signal.Signals) -> None:
    """Send a signal to a thread other than the main thread, which keeps waiting."""
    thread = threading.Thread(target=lambda: signal.pthread_kill(threading.get_ident(), number))
    thread.start()
    thread.join()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_another_thread_ends_the_wait(number: signal.Signals) -> None:
    started_at = time.monotonic()
    with Interrupts() as interrupts:
        sender = threading.Timer(0.1, signal_another_thread, [number])
        sender.start()
        wait_ready({}, 10, interrupts.watched)
    sender.join()
    assert interrupts.exit_code == 128 + number
    assert time.monotonic() - started_at < 5
    assert signal.set_wakeup_fd(-1) == -1  # the wake-up descriptor is removed


def test_during_cleanup_only_a_first_signal_ends_the_wait() -> None:
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGHUP)
        interrupts.prepare_cleanup()
        signal.raise_signal(signal.SIGHUP)
        assert wait_ready({}, 0.05, interrupts.watched) == set()
    assert interrupts.signal_number == signal.SIGHUP
    with Interrupts() as interrupts:
        interrupts.prepare_cleanup()
        signal.raise_signal(signal.SIGTERM)
        wait_ready({}, 10, interrupts.watched)
        pytest.fail("it was not interrupted")
    assert interrupts.signal_number == signal.SIGTERM
