"""Start `talk` as a fork of a process that has imported it. This takes a few ms instead of 45 (or 90 for a server).

The new process has its own environment, descriptors and session, and is killed with the tests. It differs from other
processes in three ways: /proc shows another command line and environment, the process imports nothing, and its
interpreter isn't cleaned up at the end. If a test needs one of these, or a start with special signals, limits, closed
streams or another interpreter, it must start a real process. See also `can_fork()`.
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

#: Variables that only work at the start of an interpreter: its settings, libraries and the locale.
_INTERPRETER = ("PYTHON", "LD_", "LC_", "LANG", "COVERAGE")


class Forked:
    """A forked process with the part of `subprocess.Popen`'s interface that tests use."""

    def __init__(
        self,
        arguments: Sequence[str],
        env: Mapping[str, str],
        *,
        scripted: bool = False,
        stdin: int = subprocess.DEVNULL,
        stdout: int = subprocess.DEVNULL,
        stderr: int = subprocess.DEVNULL,
        start_new_session: bool = False,
    ) -> None:
        """Start the process. As in `Popen`, a stream is a descriptor, PIPE (text), DEVNULL or STDOUT."""
        self.args = [sys.executable, "-m", "talkcli", *arguments]
        self.returncode: int | None = None
        self.stdin: IO[str] | None = None
        self.stdout: IO[str] | None = None
        self.stderr: IO[str] | None = None
        request = {"arguments": list(arguments), "env": dict(env), "scripted": scripted, "session": start_new_session}
        streams: list[int] = []
        close: list[int] = []
        try:
            for number, stream in enumerate((stdin, stdout, stderr)):
                if stream == subprocess.PIPE:
                    reading, writing = os.pipe()
                    streams.append(writing if number else reading)
                    close.append(streams[-1])
                    self._open(number, reading if number else writing)
                elif stream == subprocess.DEVNULL:
                    streams.append(os.open(os.devnull, os.O_RDWR))
                    close.append(streams[-1])
                else:
                    streams.append(streams[1] if stream == subprocess.STDOUT else stream)
            self._status, status_writer = os.pipe()
            close.append(status_writer)
            self.pid = _server.fork(request, [*streams, status_writer])
        finally:
            for descriptor in close:
                os.close(descriptor)
        self._lock = threading.Lock()
        self._readers: list[threading.Thread] = []
        self._output = ["", ""]

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_error: object) -> None:
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream:
                stream.close()
        self.wait()

    def poll(self) -> int | None:
        """Return the exit code (negative for a signal), or None while the process runs."""
        return self._wait(0)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end and return the exit code, or raise `subprocess.TimeoutExpired`."""
        code = self._wait(timeout)
        if code is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired(self.args, timeout)
        return code

    def communicate(self, input: str | None = None, timeout: float | None = None) -> tuple[str, str]:  # noqa: A002
        """Send input, read all output, and wait for the end."""
        if not self._readers:  # otherwise, this is a second call after a timeout
            for number, file in enumerate((self.stdout, self.stderr)):
                if file:
                    reader = threading.Thread(target=self._read, args=(number, file), daemon=True)
                    self._readers.append(reader)
                    reader.start()
            if self.stdin:
                with contextlib.suppress(BrokenPipeError):  # the process has closed its input
                    self.stdin.write(input or "")
                    self.stdin.flush()
                with contextlib.suppress(BrokenPipeError):
                    self.stdin.close()
        self.wait(timeout)
        for reader in self._readers:
            reader.join(timeout)
            if reader.is_alive():  # a child of the process holds the pipe open
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
        for file in (self.stdout, self.stderr):
            if file:
                file.close()
        return self._output[0], self._output[1]

    def _read(self, number: int, file: IO[str]) -> None:
        self._output[number] += file.read()

    def send_signal(self, number: int) -> None:
        """Send a signal if the process runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _open(self, number: int, descriptor: int) -> None:
        file = os.fdopen(descriptor, "r" if number else "w", encoding="utf-8", errors="replace")
        setattr(self, ("stdin", "stdout", "stderr")[number], file)

    def _wait(self, timeout: float | None) -> int | None:
        if self.returncode is None:
            poll = select.poll()
            poll.register(self._status, select.POLLIN)
            if not poll.poll(None if timeout is None else max(0.0, timeout) * 1000):
                return None
            with self._lock:
                if self.returncode is None:  # otherwise, another thread was faster
                    status = os.read(self._status, 4)
                    assert status, "the forking process has ended"
                    os.close(self._status)
                    self.returncode = os.waitstatus_to_exitcode(struct.unpack("<i", status)[0])
        return self.returncode


def can_fork(env: Mapping[str, str]) -> bool:
    """Return whether a process with this environment can be forked: its interpreter needs no special variables."""
    return hasattr(os, "pidfd_open") and _interpreter_variables(env) == _interpreter_variables(clean_environment("/"))


def _interpreter_variables(env: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in env.items() if name.startswith(_INTERPRETER)}


class _Server:
    """The process that forks. The first request starts it, and it ends with its socket."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._channel: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def fork(self, request: dict[str, object], descriptors: list[int]) -> int:
        """Fork a process, and return its id."""
        with self._lock:
            channel = self._channel or self._start()
            request["directory"] = os.getcwd()
            text = json.dumps(request).encode()
            socket.send_fds(channel, [struct.pack("<q", len(text))], descriptors)
            channel.sendall(text)
            reply = channel.recv(8)
            assert reply, "the forking process has ended"
            child: int = struct.unpack("<q", reply)[0]
            return child

    def _start(self) -> socket.socket:
        self._channel, server_end = socket.socketpair()
        with server_end:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.support.fork_server", str(server_end.fileno())],
                cwd=os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))),
                env=clean_environment(tempfile.gettempdir()),
                stdin=subprocess.DEVNULL,
                pass_fds=[server_end.fileno()],
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
