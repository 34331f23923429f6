"""`talk serve` for tests that name no socket, or in which it must not start."""

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
#: Seconds in which a process starts or ends.
LIMIT = 20.0


@dataclass(slots=True)
class Ended:
    """The exit code and the output of a process."""

    code: int
    out: str
    err: str


class BareServe:
    """A server whose whole environment is given."""

    def __init__(self, command: Sequence[str], env: Mapping[str, str], pass_fds: Sequence[int] = ()) -> None:
        self.process: subprocess.Popen[str] | Forked
        words = None if pass_fds else _forked(command, env)
        if words is not None:
            scripted = command[1] == SCRIPTED
            self.process = Forked(words, env, scripted=scripted, stderr=subprocess.PIPE, start_new_session=True)
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
        """Wait until it serves or has closed its standard error; return whether it serves."""
        assert self._settled.wait(LIMIT), f"neither ready nor ended: {self.log}"
        return "ready on " in self.log

    def end(self, *signals: signal.Signals) -> int:
        """Send signals one after another, and return the exit code."""
        for number in signals:
            self.process.send_signal(number)
        code = self.process.wait(LIMIT)
        self._reader.join(LIMIT)
        return code

    def close(self) -> None:
        """Kill it if it still runs."""
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
    """Run a server that is ready. At the end SIGTERM must end it, unless it has already ended."""
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
    """Run a program to its end."""
    words = None if options else _forked(command, env)
    if words is not None:
        return Ended(*run_talk(words, env, LIMIT))
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


def alone(*words: str, **extra: str) -> Ended:
    """Run `talk` without a server."""
    with short_directory() as home:
        return run([*TALK, *words], environment(home, **{"TALK_SOCKET": f"{home}/s", **extra}))


def _forked(command: Sequence[str], env: Mapping[str, str]) -> list[str] | None:
    """Return the arguments of `talk` in a command that can be forked, else None."""
    if not can_fork(env):
        return None
    if list(command[:2]) == [sys.executable, SCRIPTED]:
        return ["serve", *command[2:]]
    return list(command[3:]) if list(command[:3]) == TALK else None


def environment(home: str, **extra: str) -> dict[str, str]:
    """Return a clean environment with this home and temporary directory."""
    return clean_environment(home, {"TMPDIR": home, **extra})
