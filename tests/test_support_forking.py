"""A forked `talk` behaves like a started one, and dies with its parent."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.support.forking import Forked
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="talk is forked only on Linux")

#: A generous limit for commands that take milliseconds.
LIMIT_S = 20.0


@pytest.fixture
def env() -> Iterator[dict[str, str]]:
    """Return an environment without a server."""
    with short_directory() as home:
        yield clean_environment(home, {"TALK_SOCKET": f"{home}/s"})


def piped(arguments: list[str], env: dict[str, str]) -> Forked:
    return Forked(arguments, env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def run_forked(arguments: list[str], env: dict[str, str], text: str | None = None) -> tuple[int, str, str]:
    """Run a forked `talk`, and return its exit code, output and errors."""
    process = piped(arguments, env)
    out, err = process.communicate(text, LIMIT_S)
    return process.wait(LIMIT_S), out, err


def test_a_forked_command_ends_like_a_started_one(env: dict[str, str]) -> None:
    for arguments, code, out, err in (
        (["--version"], 0, "talk ", ""),
        (["sya"], 2, "", "did you mean"),
        (["status"], 3, "", "talk serve"),
    ):
        result = run_forked(arguments, env)
        assert (result[0], result[1].startswith(out), err in result[2]) == (code, True, True), result
        command = [sys.executable, "-m", "talkcli", *arguments]
        started = subprocess.run(command, env=env, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        assert result == (started.returncode, started.stdout, started.stderr)


def test_an_early_signal_is_not_lost(env: dict[str, str]) -> None:
    for _ in range(3):
        reading = piped(["say", "-"], env)  # without a signal, this waits forever
        reading.send_signal(signal.SIGINT)
        assert reading.wait(LIMIT_S) in (130, -signal.SIGINT)
        reading.communicate(timeout=LIMIT_S)


def test_a_forked_server_dies_with_its_parent(env: dict[str, str]) -> None:
    code = (
        "import os, sys\nfrom tests.support.forking import Forked\n"
        "server = Forked(['serve', '--player', 'null'], dict(os.environ), stderr=-1)\n"
        "assert any('ready on ' in line for line in server.stderr)\n"
        "print('ready', flush=True)\nsys.stdin.read()\n"
    )
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, env=env, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:
        assert owner.stdout
        assert owner.stdout.readline() == b"ready\n"
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(LIMIT_S)
            client.connect(env["TALK_SOCKET"])
            assert client.recv(65536).startswith(b'{"talk": 1')
            owner.kill()
            while client.recv(65536):
                pass  # until the server is gone
