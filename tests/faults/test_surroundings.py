"""A full TMPDIR, missing environment variables, and a wall clock that jumps."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import SERVE, TALK, environment, run, serving
from tests.faults.broken import python_path, write
from tests.support.processes import children
from tests.support.surroundings import needs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.sink import Sink

#: Servers that speak at the maximum rate.
AUDIBLE = [*TALK, "serve", "--rate", "450"]
QUIET = [*SERVE, "--rate", "450"]


@contextlib.contextmanager
def mounted(directory: str, options: str) -> Iterator[None]:
    """Mount a small file system; skip the test if this user may not."""
    needs("mount", "umount")
    os.mkdir(directory, 0o700)
    command = ["mount", "-t", "tmpfs", "-o", f"mode=700,{options}", "tmpfs", directory]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"only root can mount a file system: {done.stderr.splitlines()[0]}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", directory], check=True)


def fill(directory: str) -> None:
    """Fill a file system to the last byte."""
    with open(f"{directory}/full", "wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(b"." * 4096)
    with pytest.raises(OSError, match="No space"), open(f"{directory}/more", "wb", buffering=0) as file:
        file.write(b".")


@contextlib.contextmanager
def full(directory: str) -> Iterator[None]:
    with mounted(directory, "size=64k"):
        fill(directory)
        yield


def read_only(directory: str) -> AbstractContextManager[None]:
    return mounted(directory, "size=64k,ro")


def assert_speaks(env: dict[str, str]) -> None:
    done = run([*TALK, "say", "--wait", "--", "battery low"], env)
    assert (done.code, done.err) == (0, ""), done


@pytest.mark.parametrize("fault", [full, read_only], ids=["full", "read-only"])
def test_speech_works_with_a_full_or_read_only_temporary_directory(
    home: str, sink: Sink, fault: Callable[[str], AbstractContextManager[None]]
) -> None:
    with fault(f"{home}/tmp"):
        env = environment(home, **{**sink.env, "TALK_SOCKET": f"{home}/s", "TMPDIR": f"{home}/tmp"})
        with serving(env, command=AUDIBLE) as server:
            assert_speaks(env)
            os.kill(children(server.process.pid)[0], signal.SIGKILL)  # the next engine needs no room, either
            assert_speaks(env)


def test_a_socket_in_a_full_directory_is_served_and_locked(home: str) -> None:
    with full(f"{home}/tmp"):
        env = environment(home, TALK_SOCKET=f"{home}/tmp/s")
        with serving(env, command=QUIET):
            assert_speaks(env)
            second = run(SERVE, env)
            assert second.code == 11
            assert "is already running at" in second.err
        with serving(env, command=QUIET):  # after a restart
            assert_speaks(env)


def test_an_unusable_socket_directory_is_reported_clearly(home: str) -> None:
    with read_only(f"{home}/tmp"):
        done = run(SERVE, environment(home, TALK_SOCKET=f"{home}/tmp/s"))
        assert done.code == 11
        assert done.err == f"talk: can't open the lock file {home}/tmp/s.lock: Read-only file system\n"


@pytest.mark.parametrize("place", [None, "/proc", ""])
def test_speech_works_with_missing_variables_or_a_missing_home(home: str, sink: Sink, place: str | None) -> None:
    env = environment(home, **{**sink.env, "TALK_SOCKET": f"{home}/s"})
    assert "XDG_RUNTIME_DIR" not in env  # see `test_servers_starting`
    if place is None:
        env = {name: value for name, value in env.items() if name not in ("HOME", "PATH", "LANG", "TMPDIR")}
    else:
        env["HOME"] = place
    if "PATH" not in env and not any(os.access(f"/{place}/pacat", os.X_OK) for place in ("bin", "usr/bin")):
        pytest.skip("the player is not in a directory that is searched without PATH")
    # Not aplay, which reads its settings for this sink from the home.
    with serving(env, "--player", "pacat", command=AUDIBLE) as server:
        assert_speaks(env)
        assert run([*TALK, "say", "--wait", "--", "größer 二"], env).code == 0
        assert "engine ready" in server.log


def test_a_path_without_players_is_a_clear_error(home: str) -> None:
    env = environment(home, TALK_SOCKET=f"{home}/s", PATH="")
    with serving(env, command=AUDIBLE):
        started_at = time.monotonic()
        done = run([*TALK, "say", "--wait", "--", "battery low"], env)
        assert done.code == 4
        assert "no player found; install alsa-utils (aplay)" in done.err
        assert time.monotonic() - started_at < 5
        assert run([*TALK, "status"], env).code == 0


def test_clients_in_an_empty_environment_reach_the_server(home: str) -> None:
    env = environment(home, TALK_SOCKET=f"{home}/s")
    with serving(env, command=QUIET):
        for arguments in (["status"], ["say", "--wait", "größer"], ["cancel"], ["log"]):
            kept = {name: env[name] for name in ("PYTHONPATH",) if name in env}
            done = run([*TALK, "--socket", f"{home}/s", *arguments], kept)
            assert (done.code, done.err) == (0, ""), done


pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs mounts and /proc of Linux")

HOUR = 3600
#: Allowed delay of a timer in seconds, on a busy machine.
LATE = 1.0
#: Python runs this when it starts.
SITE_CUSTOMIZE = """
import time
_real = time.time
def _jumped():
    with open({offset!r}) as file:
        return _real() + float(file.read())
time.time = _jumped
"""


@pytest.mark.parametrize("seconds", [HOUR, -HOUR])
def test_a_jump_of_the_wall_clock_changes_no_timer_or_throttle(
    make_talk: MakeTalk, tmp_path: Path, seconds: int
) -> None:
    offset = write(tmp_path / "offset", "0")
    write(tmp_path / "sitecustomize.py", SITE_CUSTOMIZE.format(offset=str(offset)))
    talk = make_talk(scripted=True, env=python_path(tmp_path))
    assert talk.run("say", "--wait", "length=0.05 battery low").code == 0
    spoken_at = time.monotonic()
    active = talk.run("say", "never-ends").id
    talk.watcher.wait_for_word(active)
    started_at = time.monotonic()
    with talk.connect() as wire:
        short = wire.request("say", text="one", ttl=0.5)["goal"]["id"]
        long = wire.request("say", text="two", ttl=20)["goal"]["id"]
    os.replace(write(tmp_path / "new", str(seconds)), offset)
    jumped = talk.request("say", text="")["goal"]
    assert abs(jumped["queued_at"] - time.time() - seconds) < 60, "the clock did not jump, so nothing was tested"
    refused = talk.request("say", text="length=0.05 battery low", throttle=60)["goal"]
    assert (refused["state"], refused["reason"]) == ("REJECTED", "throttled")
    assert talk.watcher.wait_for_terminal(short, 10) == "RECALLED"
    assert 0.5 - 0.05 <= time.monotonic() - started_at <= 0.5 + LATE
    assert talk.goal(long)["state"] == "PENDING"
    assert talk.request("status")["server"]["uptime"] < 60
    throttle = time.monotonic() - spoken_at - 0.1
    assert talk.request("say", text="length=0.05 battery low", throttle=throttle)["goal"]["state"] == "PENDING"
    os.replace(write(tmp_path / "new", "0"), offset)
    assert talk.run("cancel").code == 0
    talk.stop()
