"""One engine process as its parent sees it: started, written to, read, killed, reaped; and a conversation with it.

It decides nothing. The supervisor watches a process among other things, for months; who has but a text or two waits for
one of his own, in a conversation.

What makes "silent" provable is one pipe that nobody writes to: the engine process and its player inherit the writing
end, so its reading end shows end of file exactly when both are gone, however they went.

What the process writes to standard error comes out of here as whole lines; the last one is a crash's own words.
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
from talkcli.engine.protocol import HANG_AFTER, SILENCE_LIMIT, START_LIMIT
from talkcli.polling import wait_ready
from talkcli.processes import close, kill, kill_holders, open_pipes, processes, signal_name
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import TypeVar

    _E = TypeVar("_E", bound=protocol.Event)

#: Variables of the server's own supervisor, which its children must not answer to.
_NOT_INHERITED = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", "LISTEN_FDS", "LISTEN_PID", "LISTEN_FDNAMES")
#: Bytes that may wait to be read by the process: the longest text, escaped, fits several times.
_SEND_BUFFER = 512 * 1024
#: Seconds a process that closed its connection is given to end by itself, so that its own exit status is seen.
_LAST_BREATH = 0.2
#: Bytes of a line of standard error that are kept, of one that never ends as well.
LONGEST = 1000


def engine_command() -> list[str]:
    """Return the command line of the engine process: this interpreter, with this process's own import path."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from talkcli.engine.child.main import main; main()"
    return [sys.executable, "-c", code]


class EngineProcess:
    """A running engine process, with the descriptors that the engine thread has to watch.

    OSError from the constructor if it cannot be started.
    """

    def __init__(
        self,
        configure: protocol.Configure,
        on_line: Callable[[str], None] = lambda _: None,
        env: Mapping[str, str] | None = None,
        command: list[str] | None = None,
    ) -> None:
        """`on_line` is called with each line that is read of its standard error.

        `env`: if not this process's; `command`: its command line, if not `engine_command`'s.
        """
        self.ready = False
        #: whether it has said anything of a goal; for who watches over it
        self.used = False
        #: what the process said itself of why it cannot start
        self.failed: protocol.StartFailed | None = None
        #: the monotonic time by which it must be gone, once it was killed; for who watches over it
        self.gone_by = float("inf")
        # Held for a send that doesn't wait: the descriptor must not be closed, and be another's, in the middle of one.
        self._sending = threading.Lock()
        self._lines = LineSplitter()
        self._stderr_lines = LineSplitter(LONGEST)
        self._last_line = ""
        self._on_line = on_line
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
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                command or engine_command(),
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env={**environment, protocol.LIVENESS_VARIABLE: str(liveness)},
                pass_fds=[liveness] if configure.output is None else [liveness, configure.output],
                # Ctrl-C in the server's terminal must not reach it, and one kill reaches all of its group.
                start_new_session=True,
            )
            kept.pop_all()
        self.send(configure)

    @property
    def pid(self) -> int:
        return self._process.pid

    def send(self, command: protocol.Command) -> bool:
        """Write a command, from any thread; False if the process is gone or takes nothing any more."""
        line = protocol.encode(command)
        with self._sending:
            if self.socket.fileno() < 0:
                return False  # closed
            try:
                return self.socket.send(line) == len(line)
            except OSError:  # gone, full, or the system has no memory for it: it has no whole line of it
                return False

    def receive(self) -> Iterator[protocol.Event | None]:
        """Return what the process said; None as the last one if it closed the connection or said what can't be read."""
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
                yield protocol.decode(line, protocol.EVENTS)
            except (ValueError, TypeError, KeyError):
                yield None
                return

    def read_stderr(self) -> bool:
        """Read what the process wrote to standard error; False once that is closed."""
        try:
            data = os.read(self.stderr, 65536)
        except BlockingIOError:
            return True
        self._complain(data or b"\n")
        return bool(data)

    def _complain(self, data: bytes) -> None:
        for line in self._stderr_lines.feed(data):
            words = line.decode(errors="replace").rstrip()
            if words:
                self._last_line = words.lstrip()
                self._on_line(words)

    def kill(self) -> None:
        """Kill the process, its player, and what that has started.

        The process isn't reaped yet, so its group and its session can't be anybody else's. What left both is known by
        the pipe that it holds.
        """
        if self._process.returncode is None:
            kill([-self.pid])
            # A player leads a group of its own; it dies with the engine process, but a pipeline that it has started
            # would not.
            kill(pid for pid in processes() if peers.stat_of(pid)[3:4] == [b"%d" % self.pid])
            kill_holders(self.liveness)

    def last_words(self) -> str:
        """Return how a process that closed its connection ended, for people; what it started is killed.

        Waits a moment for it to be gone.
        """
        self._await_exit()
        self.kill()  # before it is reaped: from then on its group could be another's
        try:
            status = self._process.wait(_LAST_BREATH)
        except subprocess.TimeoutExpired:
            return "it closed its connection"
        self.read_stderr()
        self._complain(b"\n")  # that was its last
        how = f"it was killed by {signal_name(-status)}" if status < 0 else f"it exited with status {status}"
        return f"{how} ({self._last_line})" if self._last_line else how

    def _await_exit(self) -> None:
        """Let the process end by itself, so that its own exit status is seen; it stays to be reaped."""
        if not hasattr(os, "waitid"):
            return  # macOS before Python 3.13: the status seen may be that of the kill
        end = time.monotonic() + _LAST_BREATH
        pid = self._process.pid
        while os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None and time.monotonic() < end:
            time.sleep(0.001)

    def silent(self) -> bool:
        """Whether process and player are gone. Call where `liveness` is readable: nothing is ever written there."""
        return os.read(self.liveness, 1) == b""

    def close(self) -> None:
        """Reap the process, which must be gone or ignore a kill, and close the descriptors."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_LAST_BREATH)
        with self._sending:
            self.socket.close()
        close(self.liveness, self.stderr)


class EngineFailed(Exception):
    """The engine process failed: `reason` is for programs, as a goal has it. For `engine_crashed` the text says how.

    `silent`: for how many seconds it has said nothing, where that is why.
    """

    def __init__(self, reason: str, words: str, silent: float | None = None) -> None:
        super().__init__(words)
        self.reason = reason
        self.silent = silent


class Conversation:
    """A conversation with one engine process of one's own, for a text or a few in their order: `say -o`, `talk doctor`.

    From the `with` to its end; EngineFailed where it can't be started. It waits in the caller's thread and keeps the
    limits of `protocol`. When it is over, however that came, the process and its player are gone. Which text comes
    next, and what an end means, is for who asks.
    """

    def __init__(
        self,
        configure: protocol.Configure,
        *,
        env: Mapping[str, str] | None = None,
        deadline: float = float("inf"),
        interrupt: Mapping[int, int] | None = None,
    ) -> None:
        """`env`: the process's environment, if not this one's; `deadline`: the monotonic time by which all is over.

        `interrupt`: what ends any waiting with Interrupted, as in `connect.ready`.
        """
        self._configure = configure
        self._env = env
        self._deadline = deadline
        self._interrupt = interrupt

    def __enter__(self) -> Conversation:
        try:
            self._process = EngineProcess(self._configure, env=self._env)
        except OSError as error:
            raise EngineFailed("engine_failed", f"the engine process cannot be started: {error}") from error
        self._heard_at = time.monotonic()
        #: what the process says, without an end; raises as `until`
        self.events = self._listen()
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process and see it gone: it could write to its file once more."""
        self._process.kill()
        wait_ready({self._process.liveness: select.POLLIN}, SILENCE_LIMIT)
        self._process.close()

    def say(self, say: protocol.Say) -> None:
        """Have a text spoken; the process must be ready, and have ended the one before."""
        self._heard_at = time.monotonic()
        if not self._process.send(say):
            for _ in self._received():
                pass  # where it is dead, it is known how it died
            raise EngineFailed("engine_hung", "the engine takes no commands")

    def until(self, kind: type[_E]) -> _E:
        """Return the next of such events; EngineFailed, TimeoutError past the deadline, Interrupted."""
        return next(event for event in self.events if isinstance(event, kind))

    def _listen(self) -> Iterator[protocol.Event]:
        process = self._process
        watched = {process.socket.fileno(): select.POLLIN, process.stderr: select.POLLIN}
        while True:
            limit = HANG_AFTER if process.ready else START_LIMIT
            due = min(self._heard_at + limit, self._deadline)
            found = wait_ready(watched, due - time.monotonic(), self._interrupt)
            if process.stderr in found and not process.read_stderr():
                del watched[process.stderr]
            # Before the limits: who was stopped by Ctrl-Z finds all that was said meanwhile, and the limits long past.
            if process.socket.fileno() in found:
                yield from self._received()
            now = time.monotonic()
            if now >= self._deadline:
                raise TimeoutError
            if now < self._heard_at + limit:
                continue
            if process.ready:
                raise EngineFailed("engine_hung", f"the engine gave no sign of life for {limit:g} s", limit)
            raise EngineFailed("engine_failed", f"the engine was not ready after {limit:g} s", limit)

    def _received(self) -> Iterator[protocol.Event]:
        for event in self._process.receive():
            self._heard_at = time.monotonic()
            if event is None:
                raise EngineFailed("engine_crashed", self._process.last_words())
            if isinstance(event, protocol.StartFailed):
                raise EngineFailed(event.reason, event.message)
            if isinstance(event, protocol.Ready):
                self._process.ready = True
            yield event
