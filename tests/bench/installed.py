"""talk as a user has it: its wheel in a virtual environment, and a server that runs from there.

The start of the installed `talk` script counts in whole-process times, so neither the checkout nor `python -m` stands
in for it.
"""

from __future__ import annotations

import contextlib
import filecmp
import os
import shutil
import subprocess
import sys
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

from talkcli import Client
from talkcli.client.connection import SocketConnection
from talkcli.errors import TalkError
from tests.bench.failure import FailedError
from tests.support.census import descendants
from tests.support.surroundings import MARK, assert_none_left, clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_CHECKOUT = Path(__file__).resolve().parents[2]
#: Seconds in which a server must greet and have its engine ready, and in which it must have ended after SIGTERM.
_START, _STOP = 20.0, 5.0


class Installed:
    """A virtual environment with talk in it. `differs`: it is not what the checkout is now."""

    def __init__(self, directory: str) -> None:
        self.directory = directory
        self.python = f"{directory}/bin/python"
        self.talk = f"{directory}/bin/talk"

    @property
    def differs(self) -> bool:
        """Whether a module of talk's here is another than the checkout's."""
        found = next(Path(self.directory).glob("lib/python*/site-packages/talkcli"), None)
        if found is None:
            return True
        ours, theirs = (
            {each.relative_to(root) for each in root.rglob("*.py")} for root in (_CHECKOUT / "talkcli", found)
        )
        return ours != theirs or not all(
            filecmp.cmp(_CHECKOUT / "talkcli" / each, found / each, shallow=False) for each in ours
        )

    def make(self, *, refresh: bool) -> None:
        """Make the environment if it is not there, and install the checkout where something else is; or leave that."""
        made = not os.path.exists(self.python)
        if made:
            _run(sys.executable, "-m", "venv", self.directory)
        if not (made or (refresh and self.differs)):
            return
        with short_directory("wheel-") as built:
            source = f"{built}/source"
            # Built from a copy: a build must leave nothing in the checkout.
            shutil.copytree(_CHECKOUT, source, ignore=shutil.ignore_patterns(".*", "__pycache__", "build", "dist"))
            _run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", built, source)
            (wheel,) = Path(built).glob("*.whl")
            _run(self.python, "-m", "pip", "install", "-q", str(wheel))
            if not made:  # the version is the same, so that pip sees nothing to do
                _run(self.python, "-m", "pip", "install", "-q", "--no-deps", "--force-reinstall", str(wheel))


class Server:
    """A `talk serve` of an installed talk; `env` is that of its clients."""

    def __init__(self, process: subprocess.Popen[bytes], socket: str, env: dict[str, str]) -> None:
        self._process = process
        self.socket = socket
        self.env = env

    @property
    def pids(self) -> list[int]:
        """The ids of the server's process and of all below it: with no sentence being spoken, the engine process."""
        return [self._process.pid, *descendants(self._process.pid)]

    def client(self) -> Client:
        """Return a connection to it."""
        return Client(self.socket, name="bench")


@contextlib.contextmanager
def serve(command: list[str], sound: Mapping[str, str]) -> Iterator[Server]:
    """Run `command` as a server until the end of the block; `sound` are the variables with which it finds a sink."""
    mark = uuid.uuid4().hex
    with short_directory() as home, open(f"{home}/log", "w+b") as log:
        socket = f"{home}/s"
        env = clean_environment(home, {**sound, "TALK_SOCKET": socket, MARK: mark})
        env.pop("PYTHONPATH", None)  # an installed talk finds itself
        process = subprocess.Popen(
            dying_with_parent(command),
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        try:
            _await_engine(process, socket, f"{home}/log")
            yield Server(process, socket, env)
        finally:
            process.terminate()
            try:
                process.wait(_STOP)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            assert_none_left(mark, 2.0)


def _await_engine(process: subprocess.Popen[bytes], socket: str, log: str) -> None:
    end = time.monotonic() + _START
    while True:
        with contextlib.suppress(TalkError), Client.over(SocketConnection(socket, patience=1)) as client:
            if client.status().server.get("engine") == "ready":
                return
        if process.poll() is not None or time.monotonic() > end:
            raise FailedError(f"the server is not ready within {_START:g} s: {Path(log).read_text('utf-8')[-1000:]}")
        time.sleep(0.02)  # a socket's appearance is no event


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise FailedError(f"{' '.join(command)}: {(done.stderr or done.stdout).strip()[-1000:]}")
