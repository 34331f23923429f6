"""A forked `talk` behaves like a started one, and dies with its parent."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.support.forking import Forked, can_fork
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    import pathlib
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


def serving(env: dict[str, str], *, session: bool = False) -> Forked:
    """Start a server, and return it when it is ready."""
    arguments = ["serve", "--player", "null"]
    process = Forked(arguments, env, stderr=subprocess.PIPE, start_new_session=session)
    assert process.stderr
    assert any("ready on " in line for line in process.stderr)
    return process


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
    for _ in range(10):
        reading = piped(["say", "-"], env)  # without a signal, this waits forever
        reading.send_signal(signal.SIGINT)
        assert reading.wait(LIMIT_S) in (130, -signal.SIGINT)
        reading.communicate(timeout=LIMIT_S)


def test_a_fatal_signal_gives_a_negative_exit_code(env: dict[str, str]) -> None:
    number = signal.SIGSEGV
    with serving(env, session=True) as process:
        assert process.poll() is None
        assert os.getsid(process.pid) == process.pid != os.getsid(0)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
        process.send_signal(number)
        assert process.wait(LIMIT_S) == -number
        assert process.poll() == process.returncode == -number
        process.send_signal(number)  # must not reach another process


def test_sigint_and_sigterm_give_the_exit_codes_of_a_shell(env: dict[str, str]) -> None:
    with serving(env) as server:
        for number in (signal.SIGINT, signal.SIGTERM):
            client = piped(["watch"], env)
            assert client.stdout
            assert client.stdout.readline()
            client.send_signal(number)
            client.communicate(timeout=LIMIT_S)
            assert client.returncode == 128 + number
        server.terminate()
        assert server.wait(LIMIT_S) == 0


def test_input_environment_and_directory_can_be_set(env: dict[str, str], tmp_path: pathlib.Path) -> None:
    assert env["TALK_SOCKET"] in run_forked(["status"], env)[2]
    assert env["TALK_SOCKET"] not in run_forked(["status"], {**env, "TALK_SOCKET": "/nowhere/else"})[2]
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(tmp_path / name)
            assert run_forked(["say", "-o", "here.wav", "-"], env, "grün, 日本\n") == (0, "", "")
        assert (tmp_path / name / "here.wav").stat().st_size > 1000


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


def test_can_fork_rejects_another_interpreter_library_or_locale(env: dict[str, str]) -> None:
    assert can_fork(env)
    assert can_fork({**env, "TALK_PLAYER": "null", "HOME": "/elsewhere"})
    for name, value in (("PYTHONPATH", "/elsewhere"), ("PYTHONUTF8", "0"), ("LD_PRELOAD", "lib.so")):
        assert not can_fork({**env, name: value}), name
    for name in ("LC_ALL", "LANG"):
        assert not can_fork({**env, name: "C"}), name
