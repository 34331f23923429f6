"""The engine process as its parent sees it: starting it, sending to it, reading from it and killing it.

`EngineProcess` makes no decisions. The supervisor watches one of them beside other things, for months. `PrivateEngine`
is for a caller that only wants to have a few texts spoken and waits for them.

One pipe proves that the engine is silent. The engine process and its player inherit the writing end, and nobody writes
to it. The reading end therefore reports end of file exactly when both are gone, however they ended.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

from talkcli import peers
from talkcli.engine import protocol
from talkcli.engine.protocol import HANG_LIMIT_S, KILL_LIMIT_S, START_LIMIT_S
from talkcli.goals.reasons import Reason
from talkcli.polling import wait_ready
from talkcli.processes import close, kill, kill_holders, open_pipes, processes, signal_name
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import TypeVar

    _E = TypeVar("_E", bound=protocol.Event)

#: Environment variables that systemd sets for the server alone.
_NOT_INHERITED = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", "LISTEN_FDS", "LISTEN_PID", "LISTEN_FDNAMES")
#: Size of the socket's send buffer. The longest text, escaped, fits several times.
_SEND_BUFFER_BYTES = 512 * 1024
#: Time to let a process that closed its connection exit by itself, so that its own exit status is seen.
_EXIT_WAIT_S = 0.2
#: Longest line of standard error that is kept. The rest of a longer line is dropped.
MAX_STDERR_LINE_BYTES = 1000


def engine_command() -> list[str]:
    """Return the command line of the engine process: this interpreter, with this process's own import path."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from talkcli.engine.child.main import main; main()"
    return [sys.executable, "-c", code]


class EngineProcess:
    """A running engine process, and the descriptors to watch for it."""

    def __init__(
        self,
        configure: protocol.Configure,
        on_stderr_line: Callable[[str], None] = lambda _: None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        """Start the process.

        Args:
            configure: its settings.
            on_stderr_line: called with each line that it writes to standard error.
            env: its environment, or None for a copy of this process's.

        Raises:
            OSError: it can't be started.
        """
        self.ready = False
        #: whether it has reported anything about a goal; set by the supervisor
        self.had_goal = False
        #: its own reason for not starting; set by the supervisor
        self.start_failure: protocol.StartFailed | None = None
        #: monotonic time by which it must be gone, once it was killed; set by the supervisor
        self.gone_by = float("inf")
        # Held while sending, so that the descriptor isn't closed and reused by another thread in the meantime.
        self._sending = threading.Lock()
        self._lines = LineSplitter()
        self._stderr_lines = LineSplitter(MAX_STDERR_LINE_BYTES)
        self._last_stderr_line = ""
        self._on_stderr_line = on_stderr_line
        environment = {name: value for name, value in (env or os.environ).items() if name not in _NOT_INHERITED}
        with contextlib.ExitStack() as kept, contextlib.ExitStack() as handed_over:
            self.socket, theirs = socket.socketpair()
            kept.enter_context(self.socket)
            handed_over.enter_context(theirs)
            (self.liveness, liveness), (self.stderr, stderr) = open_pipes(2)
            kept.callback(close, self.liveness, self.stderr)
            handed_over.callback(close, liveness, stderr)
            os.set_blocking(self.stderr, False)
            self.socket.setblocking(False)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                engine_command(),
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env={**environment, protocol.LIVENESS_VARIABLE: str(liveness)},
                pass_fds=[each for each in (liveness, configure.output_fd) if each is not None],
                # Ctrl-C in the server's terminal must not reach it, and one kill must reach its whole process group.
                start_new_session=True,
            )
            kept.pop_all()
        self.pid = self._process.pid
        self.send(configure)

    def send(self, command: protocol.Command) -> bool:
        """Send a command without waiting, from any thread. Return False if the process can't take it."""
        line = protocol.encode(command)
        with self._sending:
            if self.socket.fileno() < 0:
                return False  # closed
            try:
                return self.socket.send(line) == len(line)
            except OSError:  # the process is gone, the buffer is full, or the system is out of memory
                return False

    def receive(self) -> Iterator[protocol.Event | None]:
        """Read once without waiting, and yield the events.

        A final None means that the process has closed the connection or sent a malformed message.
        """
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
                yield protocol.decode(line, protocol.EVENT_CLASSES)
            except (ValueError, TypeError, KeyError):
                yield None
                return

    def read_stderr(self) -> bool:
        """Read what the process wrote to standard error. Return False once that is closed."""
        try:
            data = os.read(self.stderr, 65536)
        except BlockingIOError:
            return True
        self._pass_on_stderr(data or b"\n")
        return bool(data)

    def _pass_on_stderr(self, data: bytes) -> None:
        for line in self._stderr_lines.feed(data):
            text = line.decode(errors="replace").rstrip()
            if text:
                self._last_stderr_line = text.lstrip()
                self._on_stderr_line(text)

    def kill(self) -> None:
        """Kill the process, its player, and everything that the player has started.

        As long as the process isn't reaped, no other process can have its group or session id. Processes that left both
        are found by the liveness pipe.
        """
        if self._process.returncode is None:
            kill([-self.pid])
            # A player has a process group of its own. It dies with the engine process, but the programs of a pipeline
            # started by the player would survive.
            kill(pid for pid in processes() if peers.process_stat(pid)[3:4] == [b"%d" % self.pid])
            kill_holders(self.liveness)

    def describe_exit(self) -> str:
        """Kill what is left of a process that closed its connection, and return how it ended, for people."""
        end = time.monotonic() + _EXIT_WAIT_S
        # macOS has no waitid before Python 3.13. There, the status may be that of the kill below.
        while hasattr(os, "waitid") and time.monotonic() < end:
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None:
                break
            time.sleep(0.001)
        self.kill()  # before it is reaped, because its group id may be reused afterwards
        try:
            status = self._process.wait(_EXIT_WAIT_S)
        except subprocess.TimeoutExpired:
            return "it closed its connection"
        self.read_stderr()
        self._pass_on_stderr(b"\n")  # completes the last line
        how = f"it was killed by {signal_name(-status)}" if status < 0 else f"it exited with status {status}"
        return f"{how} ({self._last_stderr_line})" if self._last_stderr_line else how

    def is_gone(self) -> bool:
        """Return whether the process and its player are gone. Call this only if `liveness` is readable."""
        return os.read(self.liveness, 1) == b""

    def close(self) -> None:
        """Reap the process and close the descriptors. A process that ignores a kill is left to the system."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_WAIT_S)
        with self._sending:
            self.socket.close()
        close(self.liveness, self.stderr)


class EngineFailed(Exception):
    """The engine process failed.

    Attributes:
        reason: the reason as a goal has it, for programs. For "engine_crashed" the text says how the process ended.
        silent_s: how many seconds the process has been silent if that is the failure, else None.
    """

    def __init__(self, reason: Reason, message: str, silent_s: float | None = None) -> None:
        super().__init__(message)
        self.reason = reason
        self.silent_s = silent_s


class PrivateEngine:
    """An engine process for one caller, which has texts spoken one after the other and waits for each.

    `say -o` and `talk doctor` use it, as a context manager. It waits in the caller's thread and enforces the time
    limits of `protocol`. On exit the process and its player are gone, even after an error.
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
            configure: its settings.
            env: its environment, or None for a copy of this process's.
            deadline: monotonic time at which any wait ends with a TimeoutError.
            interrupt: descriptors that end any wait with Interrupted, as in `polling.wait_ready`.

        Raises:
            EngineFailed: it can't be started.
        """
        try:
            self._process = EngineProcess(configure, env=env)
        except OSError as error:
            raise EngineFailed(Reason.ENGINE_FAILED, f"the engine process cannot be started: {error}") from error
        self._deadline = deadline
        self._interrupt = interrupt
        self._last_event_at = time.monotonic()
        #: endless iterator over the events of the process, which raises the errors of `wait_for`
        self.events = self._receive_events()

    def __enter__(self) -> PrivateEngine:
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process and wait until it is gone, so that it can't write to its file any more."""
        self._process.kill()
        wait_ready({self._process.liveness: select.POLLIN}, KILL_LIMIT_S)
        self._process.close()

    def speak(self, command: protocol.GoalCommand) -> None:
        """Have a text spoken. The process must be ready, and the text before must have ended."""
        self._last_event_at = time.monotonic()
        if not self._process.send(command):
            for _ in self._read_events():
                pass  # raises a better error if the process is dead
            raise EngineFailed(Reason.ENGINE_HUNG, "the engine takes no commands")

    def wait_for(self, event_class: type[_E]) -> _E:
        """Return the next event of this class.

        Raises:
            EngineFailed: the process failed, or exceeded a time limit.
            TimeoutError: the deadline has passed.
            Interrupted: one of the descriptors in `interrupt` became ready.
        """
        return next(event for event in self.events if isinstance(event, event_class))

    def _receive_events(self) -> Iterator[protocol.Event]:
        process = self._process
        watched = {process.socket.fileno(): select.POLLIN, process.stderr: select.POLLIN}
        while True:
            limit = HANG_LIMIT_S if process.ready else START_LIMIT_S
            due = min(self._last_event_at + limit, self._deadline)
            ready = wait_ready(watched, due - time.monotonic(), self._interrupt)
            if process.stderr in ready and not process.read_stderr():
                del watched[process.stderr]
            # Read before checking the limits. After a Ctrl-Z they are long past, but the events are all there.
            if process.socket.fileno() in ready:
                yield from self._read_events()
            now = time.monotonic()
            if now >= self._deadline:
                raise TimeoutError
            if now < self._last_event_at + limit:
                continue
            if process.ready:
                raise EngineFailed(Reason.ENGINE_HUNG, f"the engine gave no sign of life for {limit:g} s", limit)
            raise EngineFailed(Reason.ENGINE_FAILED, f"the engine was not ready after {limit:g} s", limit)

    def _read_events(self) -> Iterator[protocol.Event]:
        for event in self._process.receive():
            self._last_event_at = time.monotonic()
            if event is None:
                raise EngineFailed(Reason.ENGINE_CRASHED, self._process.describe_exit())
            if isinstance(event, protocol.StartFailed):
                raise EngineFailed(event.reason, event.message)
            if isinstance(event, protocol.Ready):
                self._process.ready = True
            yield event
