"""Classes that start an engine process, exchange messages with it, and kill it.

`EngineProcess` never blocks for long and makes no decisions, so that the supervisor can use it in an event loop.
`PrivateEngine` is for callers that have only a few texts and can block until each of them is spoken.

A liveness pipe proves that the engine is silent. The engine process and its player inherit the write end, and nobody
writes to it. The read end therefore reports end of file exactly when both have exited, for whatever reason.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING

from talkcli import peers
from talkcli.engine import protocol
from talkcli.engine.protocol import HANG_LIMIT_S, KILL_LIMIT_S, START_LIMIT_S
from talkcli.goals.reasons import Reason
from talkcli.polling import wait_ready
from talkcli.processes import close, kill, kill_holders, open_pipes, process_ids, signal_name
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import TypeVar

    _E = TypeVar("_E", bound=protocol.Event)

#: Environment variables that systemd sets only for the server itself.
_SERVER_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", "LISTEN_FDS", "LISTEN_PID", "LISTEN_FDNAMES")
#: Time allowed for a process to exit on its own after it has closed its connection. Killing it earlier would hide its
#: exit status.
_EXIT_WAIT_S = 0.2
#: Maximum length of a line from standard error. The rest of a longer line is discarded.
MAX_STDERR_LINE_BYTES = 1000


def engine_command() -> list[str]:
    """Return the command line that starts an engine process."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from talkcli.engine.child.main import main; main()"
    return [sys.executable, "-c", code]


class EngineProcess:
    """A running engine process, as seen by the process that started it."""

    def __init__(
        self,
        configure: protocol.Configure,
        on_stderr_line: Callable[[str], None] = lambda _: None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        """Start the process.

        Args:
            configure: settings for the process.
            on_stderr_line: called with each line that the process writes to standard error.
            env: environment for the process, or None for a copy of the current environment.

        Raises:
            OSError: the process can't be started.
        """
        #: whether the process has sent `Ready`
        self.ready = False
        #: whether the process has sent an event about a goal; set by the supervisor
        self.had_goal = False
        #: commands that are waiting for room in the buffer of the socket
        self._unsent = bytearray()
        self._lines = LineSplitter()
        self._stderr_lines = LineSplitter(MAX_STDERR_LINE_BYTES)
        self._last_stderr_line = ""
        self._on_stderr_line = on_stderr_line
        environment = {name: value for name, value in (env or os.environ).items() if name not in _SERVER_VARIABLES}
        with contextlib.ExitStack() as kept, contextlib.ExitStack() as handed_over:
            self.socket, theirs = socket.socketpair()
            kept.enter_context(self.socket)
            handed_over.enter_context(theirs)
            (self.liveness, liveness), (self.stderr, stderr) = open_pipes(2)
            kept.callback(close, self.liveness, self.stderr)
            handed_over.callback(close, liveness, stderr)
            os.set_blocking(self.stderr, False)
            self.socket.setblocking(False)
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                engine_command(),
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env={**environment, protocol.LIVENESS_VARIABLE: str(liveness)},
                pass_fds=[each for each in (liveness, configure.output_fd) if each is not None],
                # In a session of its own, the process doesn't get Ctrl-C from the server's terminal. It also has its
                # own process group, which can be killed as a whole.
                start_new_session=True,
            )
            kept.pop_all()
        self.pid = self._process.pid
        self.send(configure)

    def send(self, command: protocol.Command) -> None:
        """Send a command. If the process is busy, keep the command for later."""
        self._unsent += protocol.encode(command)
        self._flush()

    def _flush(self) -> None:
        """Send waiting commands until the socket is full."""
        with contextlib.suppress(OSError):  # the buffer is full, the process is dead, or memory is short
            while self._unsent:
                del self._unsent[: self.socket.send(self._unsent)]

    @property
    def socket_events(self) -> int:
        """The poll events to wait for before calling `receive`."""
        return select.POLLIN | (select.POLLOUT if self._unsent else 0)

    def receive(self) -> Iterator[protocol.Event | None]:
        """Send waiting commands. Yield the events that have arrived, and None if the connection has ended.

        This never blocks. A malformed message counts as the end of the connection.
        """
        self._flush()
        try:
            data = self.socket.recv(65536)
        except BlockingIOError:
            return
        except ConnectionResetError:
            data = b""
        if not data:
            yield None
        for line in self._lines.feed(data):
            try:
                event = protocol.decode(line, protocol.EVENT_CLASSES)
            except (ValueError, TypeError, KeyError):
                yield None
                return
            self.ready = self.ready or isinstance(event, protocol.Ready)
            yield event

    def read_stderr(self) -> bool:
        """Pass new lines of standard error to `on_stderr_line`. Return whether standard error is still open."""
        try:
            data = os.read(self.stderr, 65536)
        except BlockingIOError:
            return True
        self._report_stderr(data or b"\n")
        return bool(data)

    def _report_stderr(self, data: bytes) -> None:
        """Pass each complete line to `on_stderr_line`. Store the last line."""
        for line in self._stderr_lines.feed(data):
            text = line.decode(errors="replace").rstrip()
            if text:
                self._last_stderr_line = text.lstrip()
                self._on_stderr_line(text)

    def kill(self) -> None:
        """Kill the process, its player, and everything that the player has started.

        Process group and session IDs can't be reused until the process is reaped. Processes that have left both the
        group and the session are found through the liveness pipe.
        """
        if self._process.returncode is None:
            kill([-self.pid])
            # A player dies with the engine process, but the programs of a pipeline have a process group of their own
            # and would survive.
            kill(pid for pid in process_ids() if peers.process_stat(pid)[3:4] == [b"%d" % self.pid])
            kill_holders(self.liveness)

    def reap(self) -> str:
        """Wait briefly for the process to exit, and kill it if it doesn't. Return how it exited."""
        wait_ready({self.liveness: select.POLLIN}, _EXIT_WAIT_S)  # macOS doesn't report a closed end without POLLIN
        self.kill()  # kill before reaping, because the group ID may be reused afterwards
        try:
            status = self._process.wait(_EXIT_WAIT_S)
        except subprocess.TimeoutExpired:
            return "it closed its connection"
        self.read_stderr()
        self._report_stderr(b"\n")  # the line break ends the last line, which may be incomplete
        how = f"it was killed by {signal_name(-status)}" if status < 0 else f"it exited with status {status}"
        return f"{how} ({self._last_stderr_line})" if self._last_stderr_line else how

    def close(self) -> None:
        """Wait briefly for the process to exit, and close the descriptors."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_WAIT_S)
        self.socket.close()
        close(self.liveness, self.stderr)


class EngineFailed(Exception):
    """Raised if the engine process failed.

    Attributes:
        reason: machine-readable reason, as in a goal. For ENGINE_CRASHED, the message describes how the process exited.
        silent_s: the time limit in seconds, if the process sent no message within it; otherwise None.
    """

    def __init__(self, reason: Reason, message: str, silent_s: float | None = None) -> None:
        super().__init__(message)
        self.reason = reason
        self.silent_s = silent_s


class PrivateEngine(contextlib.AbstractContextManager["PrivateEngine"]):
    """A context manager that runs an engine process for a single caller.

    It speaks one text at a time, blocks the caller's thread while waiting, and enforces the time limits in `protocol`.
    Leaving the context kills the process and its player. `say -o` and `talk doctor` use this class.
    """

    def __init__(
        self,
        configure: protocol.Configure,
        *,
        env: Mapping[str, str] | None = None,
        deadline: float = float("inf"),
        interrupt: Mapping[int, int] | None = None,
    ) -> None:
        """Start the engine process.

        Args:
            configure: settings for the process.
            env: environment for the process, or None for a copy of the current environment.
            deadline: monotonic time at which every wait ends with a TimeoutError.
            interrupt: descriptors that end a wait with Interrupted, as in `polling.wait_ready`.

        Raises:
            EngineFailed: the process can't be started.
        """
        try:
            self._process = EngineProcess(configure, env=env)
        except OSError as error:
            raise EngineFailed(Reason.ENGINE_FAILED, f"the engine process could not be started: {error}") from error
        self._deadline = deadline
        self._interrupt = interrupt
        self._last_event_at = time.monotonic()
        #: endless iterator over the events of the process, which raises the same errors as `wait_for`
        self.events = self._receive_events()

    def __exit__(self, *_: object) -> None:
        """Kill the process, and wait until it has exited."""
        self._process.kill()
        wait_ready({self._process.liveness: select.POLLIN}, KILL_LIMIT_S)
        self._process.close()

    def speak(self, command: protocol.GoalCommand) -> None:
        """Tell the process to speak a text.

        It must be ready, and must have finished the previous text.
        """
        self._last_event_at = time.monotonic()
        self._process.send(command)  # if this fails, `wait_for` raises an error

    def stop(self, goal_id: str) -> None:
        """Tell the process to stop speaking this goal."""
        self._process.send(protocol.Stop(goal_id))

    def wait_for(self, event_class: type[_E]) -> _E:
        """Wait for the next event of the given class. Return the event.

        Raises:
            EngineFailed: the process failed, or exceeded a time limit.
            TimeoutError: the deadline has passed.
            Interrupted: one of the descriptors in `interrupt` became ready.
        """
        return next(event for event in self.events if isinstance(event, event_class))

    def _receive_events(self) -> Iterator[protocol.Event]:
        """Yield the events of the process. Raise an error if the process fails or takes too long."""
        process = self._process
        watched = {process.stderr: select.POLLIN}
        while True:
            watched[process.socket.fileno()] = process.socket_events
            limit = HANG_LIMIT_S if process.ready else START_LIMIT_S
            due = min(self._last_event_at + limit, self._deadline)
            ready = wait_ready(watched, due - time.monotonic(), self._interrupt)
            if process.stderr in ready and not process.read_stderr():
                del watched[process.stderr]
            # Read the events before checking the time limits. If this process was suspended (Ctrl-Z), the limits may
            # have passed even though the events arrived in time.
            for event in process.receive() if process.socket.fileno() in ready else ():
                self._last_event_at = time.monotonic()
                if event is None:
                    raise EngineFailed(Reason.ENGINE_CRASHED, process.reap())
                if isinstance(event, protocol.StartFailed):
                    raise EngineFailed(event.reason, event.message)
                yield event
            now = time.monotonic()
            if now >= self._deadline:
                raise TimeoutError
            if now >= self._last_event_at + limit:
                if process.ready:
                    raise EngineFailed(Reason.ENGINE_HUNG, f"the engine did not respond for {limit:g} s", limit)
                raise EngineFailed(Reason.ENGINE_FAILED, f"the engine was not ready within {limit:g} s", limit)
