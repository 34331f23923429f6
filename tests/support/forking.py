"""Starts `talk` as a fork of a process that has imported it: a few ms of processor instead of 45, or 90 for a server.

It is a process with its own environment, descriptors and session, killed with the tests. Only its command line and
first environment in /proc are different, it has nothing to import, and its interpreter isn't cleaned up at the end. A
test of these, of signals or limits at a start, of closed streams or of another interpreter starts a program of its own;
see also `can_fork()`.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from typing import IO, TYPE_CHECKING

from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

#: Variables that a forked process can't have of its own: the interpreter's settings, libraries, the locale.
_INTERPRETER = ("PYTHON", "LD_", "LC_", "LANG", "COVERAGE")


class Forked:
    """A process with the part of `subprocess.Popen`'s interface that tests use."""

    def __init__(
        self,
        words: Sequence[str],
        env: Mapping[str, str],
        *,
        scripted: bool = False,
        stdin: int = subprocess.DEVNULL,
        stdout: int = subprocess.DEVNULL,
        stderr: int = subprocess.DEVNULL,
        start_new_session: bool = False,
    ) -> None:
        """Start it; streams are as in `Popen`: a number, PIPE, DEVNULL or STDOUT; pipes are text."""
        self.args = [sys.executable, "-m", "talkcli", *words]
        self.returncode: int | None = None
        self.stdin: IO[str] | None = None
        self.stdout: IO[str] | None = None
        self.stderr: IO[str] | None = None
        asked = {"words": list(words), "env": dict(env), "scripted": scripted, "session": start_new_session}
        theirs: list[int] = []
        close: list[int] = []
        try:
            for number, wanted in enumerate((stdin, stdout, stderr)):
                if wanted == subprocess.PIPE:
                    reading, writing = os.pipe()
                    theirs.append(writing if number else reading)
                    close.append(theirs[-1])
                    self._open(number, reading if number else writing)
                elif wanted == subprocess.DEVNULL:
                    theirs.append(os.open(os.devnull, os.O_RDWR))
                    close.append(theirs[-1])
                else:
                    theirs.append(theirs[1] if wanted == subprocess.STDOUT else wanted)
            self._ended, told = os.pipe()
            close.append(told)
            self.pid = _server.fork(asked, [*theirs, told])
        finally:
            for each in close:
                os.close(each)
        self._lock = threading.Lock()
        self._readers: list[threading.Thread] = []
        self._found = ["", ""]

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_error: object) -> None:
        for each in (self.stdin, self.stdout, self.stderr):
            if each:
                each.close()
        self.wait()

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while it runs."""
        return self._wait(0)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end, and return the exit code; `subprocess.TimeoutExpired` if it takes longer."""
        code = self._wait(timeout)
        if code is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired(self.args, timeout)
        return code

    def communicate(self, input: str | None = None, timeout: float | None = None) -> tuple[str, str]:  # noqa: A002
        """Send input, read all output, wait for the end."""
        if not self._readers:  # otherwise this is called again after a timeout
            for number, file in enumerate((self.stdout, self.stderr)):
                if file:
                    reader = threading.Thread(target=self._read, args=(number, file), daemon=True)
                    self._readers.append(reader)
                    reader.start()
            if self.stdin:
                with contextlib.suppress(BrokenPipeError):  # it closed its input
                    self.stdin.write(input or "")
                    self.stdin.flush()
                with contextlib.suppress(BrokenPipeError):
                    self.stdin.close()
        self.wait(timeout)
        for each in self._readers:
            each.join(timeout)
            if each.is_alive():  # a child of the process has the pipe
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
        for file in (self.stdout, self.stderr):
            if file:
                file.close()
        return self._found[0], self._found[1]

    def _read(self, number: int, file: IO[str]) -> None:
        self._found[number] += file.read()

    def send_signal(self, number: int) -> None:
        """Send a signal, if it runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def _open(self, number: int, descriptor: int) -> None:
        file = os.fdopen(descriptor, "r" if number else "w", encoding="utf-8", errors="replace")
        setattr(self, ("stdin", "stdout", "stderr")[number], file)

    def _wait(self, timeout: float | None) -> int | None:
        if self.returncode is None:
            poll = select.poll()
            poll.register(self._ended, select.POLLIN)
            if not poll.poll(None if timeout is None else max(0.0, timeout) * 1000):
                return None
            with self._lock:
                if self.returncode is None:  # no other thread was sooner
                    status = os.read(self._ended, 4)
                    assert status, "the forking process has ended"
                    os.close(self._ended)
                    self.returncode = os.waitstatus_to_exitcode(struct.unpack("<i", status)[0])
        return self.returncode


def can_fork(env: Mapping[str, str]) -> bool:
    """Return whether a process with this environment may be forked: it changes nothing for the interpreter."""
    return hasattr(os, "pidfd_open") and _told(env) == _told(clean_environment("/"))


def _told(env: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in env.items() if name.startswith(_INTERPRETER)}


class _Server:
    """The process that forks, started by the first request; it ends when its socket is closed, or with us."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._channel: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def fork(self, asked: dict[str, object], descriptors: list[int]) -> int:
        """Have a process forked, and return its id."""
        with self._lock:
            channel = self._channel or self._start()
            asked["directory"] = os.getcwd()
            text = json.dumps(asked).encode()
            socket.send_fds(channel, [struct.pack("<q", len(text))], descriptors)
            channel.sendall(text)
            answer = channel.recv(8)
            assert answer, "the forking process has ended"
            child: int = struct.unpack("<q", answer)[0]
            return child

    def _start(self) -> socket.socket:
        self._channel, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.support.fork_server", str(theirs.fileno())],
                cwd=os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))),
                env=clean_environment(tempfile.gettempdir()),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        atexit.register(self._end)
        return self._channel

    def _end(self) -> None:
        assert self._channel
        assert self._process
        self._channel.close()
        self._process.wait()


_server = _Server()
