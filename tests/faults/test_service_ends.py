"""Signals and standard error: how fast a server stops, and which faults it survives."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
import uuid
from typing import TYPE_CHECKING

import pytest

from talkcli.daemon import log
from tests.conformance.bareserve import SERVE, TALK, environment, run, serving
from tests.conformance.hearing import engine_process, send, start_goal
from tests.faults.broken import write
from tests.faults.test_service_units import SCRIPTED
from tests.support.connection import Wire
from tests.support.surroundings import MARK, assert_none_left, dying_with_parent
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk

#: A server that speaks at the maximum rate.
FAST = [*SERVE, "--rate", "450"]
#: A long text, and a number of requests whose replies with such texts exceed a connection's buffers.
LONG = "word " * 1900
REQUESTS = 12


@contextlib.contextmanager
def stalled(path: str, count: int = 100) -> Iterator[None]:
    """Connect clients that request long replies, read nothing, and leave a line unfinished."""
    with contextlib.ExitStack() as stack:
        wire = stack.enter_context(Wire(path))
        wire.request("pause")
        for _ in range(10):
            wire.request("say", text=LONG)
        wire.request("cancel")
        wire.request("resume")
        for _ in range(count):
            client = stack.enter_context(socket.socket(socket.AF_UNIX))
            client.connect(path)
            client.sendall(b'{"request": "watch"}\n' + b'{"request": "status"}\n' * REQUESTS + b'{"request": ')
        end = time.monotonic() + 20
        while (clients := wire.request("status", timeout=20)["server"]["clients"]) < count:
            assert time.monotonic() < end, f"{clients} of {count} clients were admitted"
        yield


def test_sigterm_stops_a_server_with_100_stalled_clients_in_3_seconds(home: str) -> None:
    path, mark = f"{home}/s", uuid.uuid4().hex
    with limits():
        with serving(environment(home, TALK_SOCKET=path, **{MARK: mark})) as server, Wire(path) as wire, stalled(path):
            wire.request("say", text="a sentence that is long enough to be in the middle of it", wait=True)
            wire.receive_event("state", state="ACTIVE")
            started_at = time.monotonic()
            server.process.send_signal(signal.SIGTERM)
            result = wire.receive_event("result")["goal"]
            assert (result["state"], result["reason"]) == ("PREEMPTED", "shutdown")
            assert server.end() == 0
            assert_within(time.monotonic() - started_at, 3, "the end after SIGTERM")
        assert not os.path.exists(path)
        assert_none_left(mark, 0.5)


def test_a_second_sigterm_stops_a_server_with_stalled_clients_at_once(home: str) -> None:
    path, mark = f"{home}/s", uuid.uuid4().hex
    env = environment(home, TALK_SOCKET=path, **{MARK: mark})
    with limits():
        with serving(env, command=SCRIPTED) as server, Wire(path) as wire, stalled(path, 10):
            wire.request("watch")
            wire.request("say", text="never-ends ignore-stop words=1")  # takes a while to stop
            wire.receive_event("word")
            server.process.send_signal(signal.SIGTERM)
            wire.receive_event("state", state="PREEMPTING")
            started_at = time.monotonic()
            assert server.end(signal.SIGTERM) == 143
            assert_within(time.monotonic() - started_at, 0.1, "the end after a second SIGTERM")
        assert not os.path.exists(path)
        assert_none_left(mark, 0.5)


def test_a_server_survives_thousands_of_sighups_and_sigpipes(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=FAST) as server, Wire(path) as wire:
        goal = wire.request("say", text="this is spoken to its end", wait=True)["goal"]
        wire.receive_event("state", state="ACTIVE")
        with limits():
            for number in [signal.SIGHUP, signal.SIGPIPE] * 3:
                for _ in range(1000):
                    server.process.send_signal(number)
                started_at = time.monotonic()
                assert wire.request("status")["ok"]
                assert_within(time.monotonic() - started_at, 0.1, "status during thousands of signals")
        ended = wire.receive_event("result", timeout=10)["goal"]
        assert (ended["id"], ended["state"]) == (goal["id"], "SUCCEEDED")


#: Starts a server with its signals blocked and ignored.
START_WITH_BLOCKED_SIGNALS = """
import os, signal, sys
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_BLOCK, set(signal.Signals) - {signal.SIGKILL, signal.SIGSTOP})
os.execv(sys.executable, [sys.executable, "-m", "talkcli", "serve", *sys.argv[1:]])
"""


def test_a_server_resets_inherited_signal_settings(make_talk: MakeTalk, tmp_path: Path) -> None:
    talk = make_talk("--player", "null", program=str(write(tmp_path / "start.py", START_WITH_BLOCKED_SIGNALS)))
    goal = start_goal(talk, "a sentence that is long enough to be in the middle of it", number=1)
    os.kill(engine_process(talk), signal.SIGKILL)
    assert talk.watcher.wait_for_terminal(goal) == "ABORTED"
    assert talk.goal(goal)["message"] == "speech failed: the engine crashed: it was killed by SIGKILL"
    following = send(talk, "yes", rate=450)
    assert talk.watcher.wait_for_terminal(following) == "SUCCEEDED"
    talk.stop()


def test_the_error_for_too_little_memory_names_the_limit(home: str) -> None:
    """The limit allows the imports, but not the stack of a thread, or not quite the whole server."""
    kib = 22_000
    command = ["sh", "-c", f'ulimit -d {kib}; exec "$@"', "sh", *TALK, "serve", "--player", "null"]
    done = run(command, environment(home, TALK_SOCKET=f"{home}/s"))
    error = "(can't start the engine's thread|not enough memory for talk)"
    limit = re.escape(f"the limit is {kib * 1024:,} bytes of memory (ulimit -d, LimitDATA=)")
    assert (done.code, bool(re.fullmatch(f"talk: {error}: {limit}\n", done.err))) == (1, True), done


@contextlib.contextmanager
def serving_unread_log(home: str, redirection: str, stderr: int | None = None) -> Iterator[Wire]:
    """Run a server whose log is not read, and assert that SIGTERM stops it normally."""
    path = f"{home}/s"
    command = dying_with_parent(["sh", "-c", f'exec "$@" {redirection}', "sh", *FAST])
    with subprocess.Popen(command, env=environment(home, TALK_SOCKET=path), stderr=stderr) as process:
        try:
            with _connect(path, process) as wire:
                yield wire
            process.send_signal(signal.SIGTERM)
            assert process.wait(5) == 0
            assert not os.path.exists(path)
        finally:
            process.kill()


def _connect(path: str, process: subprocess.Popen[bytes]) -> Wire:
    end = time.monotonic() + 10
    while True:
        with contextlib.suppress(OSError):
            return Wire(path)
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)  # the creation of a socket sends no event


def assert_speaks(wire: Wire, *texts: str) -> None:
    for text in texts:
        wire.request("say", text=text, wait=True)
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"


@pytest.mark.parametrize("redirection", ["<&- >&- 2>&-", "2>/dev/full"])
def test_speech_continues_with_standard_error_closed_or_full(home: str, redirection: str) -> None:
    with serving_unread_log(home, redirection) as wire:
        assert_speaks(wire, "one", "two")
        wire.request("cancel")
        wire.send_raw(b"nonsense\n")


def _fill(writing: int) -> None:
    os.set_blocking(writing, False)
    for size in (4096, 1):
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writing, b"." * size)
    os.set_blocking(writing, True)


def test_speech_continues_while_standard_error_is_a_full_or_broken_pipe(home: str) -> None:
    reading, writing = os.pipe()
    _fill(writing)
    with serving_unread_log(home, "", writing) as wire:
        os.close(writing)
        assert_speaks(wire, "one", "two", "three")
        os.read(reading, 1 << 20)  # the whole content of the pipe
        assert_speaks(wire, "four")
        log_text = ""
        while '"four"' not in log_text:
            log_text += os.read(reading, 65536).decode()
        # Lost lines are reported as soon as there is room.
        assert "lines before this one could not be written)" in log_text.splitlines()[0]
        os.close(reading)
        assert_speaks(wire, "five", "six")


def test_a_log_message_is_one_line_of_limited_length(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=SCRIPTED) as server, Wire(path) as wire:
        wire.request("say", text=f"length=0 {'word ' * 1900}\ntalk: forged\n", wait=True)
        wire.receive_event("result")
        assert server.end(signal.SIGTERM) == 0
    assert all(line.startswith("talk: ") and len(line) < 4096 for line in server.log.splitlines()), server.log
    assert "talk: forged" not in server.log.splitlines()


def test_sigint_stays_ignored_if_the_shell_ignored_it(home: str) -> None:
    env = environment(home, TALK_SOCKET=f"{home}/s")
    with serving(env, command=["sh", "-c", "trap '' INT; exec \"$@\"", "sh", *SCRIPTED]) as server:
        server.process.send_signal(signal.SIGINT)
        assert run([*TALK, "say", "--wait", "length=0"], env).code == 0
        assert server.process.poll() is None


def test_a_repeated_message_is_logged_once_a_minute_with_a_count(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr(log, "_rate_limits", {})
    monkeypatch.setattr("talkcli.daemon.log.time.monotonic", lambda: now)
    with open(2, "w", encoding="utf-8", closefd=False) as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        for second in range(600):  # ten minutes, ten times a second
            now = 1000.0 + second
            for number in range(10):
                log.write_limited("descriptors", f"no descriptor {number}")
        log.write_limited("another", "of another kind")
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 11
    assert lines[0] == "talk: no descriptor 0"
    assert lines[1] == "talk: no descriptor 0 (599 similar lines were not logged)"
    assert lines[-1] == "talk: of another kind"
