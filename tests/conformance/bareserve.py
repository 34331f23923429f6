"""Helpers to run `talk serve` without a named socket, or to check that it does not start."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.support.forking import Forked, can_fork
from tests.support.processes import SCRIPTED, run_talk
from tests.support.surroundings import clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

TALK = [sys.executable, "-m", "talkcli"]
SERVE = [*TALK, "serve", "--player", "null"]
#: Limit in seconds for the start or the end of a process.
LIMIT = 20.0


@dataclass(slots=True)
class Ended:
    """The exit code and the output of a process."""

    code: int
    out: str
    err: str


class BareServe:
    """A server with only this environment."""

    def __init__(self, command: Sequence[str], env: Mapping[str, str], pass_fds: Sequence[int] = ()) -> None:
        self.process: subprocess.Popen[str] | Forked
        arguments = None if pass_fds else _forked(command, env)
        if arguments is not None:
            scripted = command[1] == SCRIPTED
            self.process = Forked(arguments, env, scripted=scripted, stderr=subprocess.PIPE, start_new_session=True)
        else:
            self.process = subprocess.Popen(
                dying_with_parent(list(command)),
                env=dict(env),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                pass_fds=tuple(pass_fds),
                start_new_session=True,
            )
        self._lines: list[str] = []
        self._settled = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def log(self) -> str:
        return "".join(self._lines)

    def serves(self) -> bool:
        """Wait until the server is ready or has ended, and return whether it is ready."""
        assert self._settled.wait(LIMIT), f"neither ready nor ended: {self.log}"
        return "ready on " in self.log

    def end(self, *signals: signal.Signals) -> int:
        """Send these signals, wait for the end, and return the exit code."""
        for number in signals:
            self.process.send_signal(number)
        code = self.process.wait(LIMIT)
        self._reader.join(LIMIT)
        return code

    def close(self) -> None:
        """Kill the server if it still runs."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join(LIMIT)
        if self.process.stderr:
            self.process.stderr.close()

    def _read(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            self._lines.append(line)
            if "ready on " in line:
                self._settled.set()
        self._settled.set()


@contextlib.contextmanager
def serving(
    env: Mapping[str, str], *options: str, command: Sequence[str] = SERVE, pass_fds: Sequence[int] = ()
) -> Iterator[BareServe]:
    """Start a server and wait until it is ready. At the end, stop it with SIGTERM if it still runs."""
    server = BareServe([*command, *options], env, pass_fds)
    try:
        assert server.serves(), server.log
        yield server
        if server.process.poll() is None:
            assert server.end(signal.SIGTERM) == 0, server.log
        assert "Traceback" not in server.log
    finally:
        server.close()


def run(command: Sequence[str], env: Mapping[str, str], **options: object) -> Ended:
    """Run a program, and return its exit code and output."""
    arguments = None if options else _forked(command, env)
    if arguments is not None:
        return Ended(*run_talk(arguments, env, LIMIT))
    done = subprocess.run(  # type: ignore[call-overload]
        list(command),
        env=dict(env),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=LIMIT,
        check=False,
        **options,
    )
    return Ended(done.returncode, os.fsdecode(done.stdout), os.fsdecode(done.stderr))


def alone(*arguments: str, **extra: str) -> Ended:
    """Run `talk` without a server."""
    with short_directory() as home:
        return run([*TALK, *arguments], environment(home, **{"TALK_SOCKET": f"{home}/s", **extra}))


def _forked(command: Sequence[str], env: Mapping[str, str]) -> list[str] | None:
    """Return the arguments of `talk` if the command can be forked, otherwise None."""
    if not can_fork(env):
        return None
    if list(command[:2]) == [sys.executable, SCRIPTED]:
        return ["serve", *command[2:]]
    return list(command[3:]) if list(command[:3]) == TALK else None


def environment(home: str, **extra: str) -> dict[str, str]:
    """Return a clean environment with this home and temporary directory."""
    return clean_environment(home, {"TMPDIR": home, **extra})
