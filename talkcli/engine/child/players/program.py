"""Player programs, which read samples from standard input.

A program is started for one sentence and exits after it. It never outlives this process, and neither does any process
that it has started.

With `subprocess`, a child can be tied to its parent only by a function between fork and exec. This needs a real fork,
which copies the page tables of the engine process. On a PC, the fork takes 3 ms before every sentence, while
`posix_spawn` takes 0.4 ms. A Raspberry Pi takes five to ten times as long. Therefore the child runs no Python code.
Instead, every program has a leash. This is a pipe that nobody writes to, and only this process has its write end. When
this process ends for any reason, the kernel closes the write end and sends SIGKILL to the program's process group.

The leash, which only Linux has, doesn't reach these processes:

- A program whose parent is killed in the 0.1 ms between its start and its leash. It has no samples yet, and exits
  because its input is closed.
- A program that closes inherited descriptors (ssh, sudo). The server kills the remaining processes of a dead engine.
- A process that has left the process group and the session. It is found in /proc by a pipe that it inherited. If it has
  closed that pipe too (a sound server, `ssh -f`), it is no longer part of the player and is left alone.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import re
import select
import signal
import struct
import termios
import time

from talkcli.engine.child.players.base import CannotSpeak, Player
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.reasons import Reason
from talkcli.polling import NEVER
from talkcli.processes import close, is_held, kill, kill_holders, open_pipes, signal_name
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.engine.child.players.base import Interest
    from talkcli.engine.players import PlayerCommand

#: The capacity of the program's input pipe in bytes, if the system lets a process set it. If the pipe has only one
#: page, poll reports room only after the program has read everything.
PIPE_BYTES = 4096

#: If a program closes its input, it may take this long to report an error and exit. After that, it is killed.
ERROR_GRACE_S = 0.5

#: Maximum seconds for which `kill` waits for the program to exit, which usually takes 1 ms. If the program hangs in the
#: kernel, `gone` keeps checking.
REAP_WAIT_S = 0.02

#: Seconds between checks for a program's exit, on systems without a descriptor that reports it (macOS, Linux before
#: 5.3).
EXIT_CHECK_S = 0.01

#: The maximum length of a stored line from standard error. Errors are usually shorter, and longer messages would be
#: hard to read.
MAX_ERROR_LINE_BYTES = 300

#: Lines that aren't errors or don't help users, such as messages of libraries, underruns and hints.
_NOISE = (
    r"ALSA lib |underrun|overrun|Playing |Warning:|please, try |Stream (suspended|successfully|started)|^Got signal"
)
_ERROR = (
    r"error|fail|cannot|can't|could ?n[o']t|unable|no such|not found|not available|refused|denied|invalid|unknown"
    r"|disconnected|busy|broken|terminated|killed|lost"
)
#: Matches the beginning of a message such as "aplay: main:831: text". The source location doesn't help users.
_SOURCE_LOCATION = r"^(?P<program>[^\s:]+): \w+:\d+: "

#: Signals that Python ignores. Programs are started with the default actions for these signals.
_RESET_SIGNALS = [getattr(signal, name) for name in ("SIGPIPE", "SIGXFSZ") if hasattr(signal, name)]


class PlayerProcess:
    """A running player program in its own process group."""

    def __init__(self, argv: tuple[str, ...], inherited: Sequence[int] = ()) -> None:
        """Start the program.

        Args:
            argv: The command line.
            inherited: Other descriptors that the program inherits.

        Raises:
            OSError: The program can't be started.
        """
        (stdin, our_stdin), (our_stderr, stderr), (tied, leash) = open_pipes(3)
        #: our non-blocking ends of the pipes to the program
        self.stdin, self.stderr = io.FileIO(our_stdin, "w"), io.FileIO(our_stderr)
        self._leash = io.FileIO(leash, "w")
        #: a file that becomes readable when the program exits; None on macOS and on Linux before 5.3
        self.exit: io.FileIO | None = None
        self._status: int | None = None
        try:
            os.set_blocking(our_stdin, False)
            os.set_blocking(our_stderr, False)
            if hasattr(fcntl, "F_SETPIPE_SZ"):
                fcntl.fcntl(our_stdin, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
            self.pid = _spawn(argv, stdin, stderr, [tied, *inherited])
            _attach_leash(tied, self.pid)
        except BaseException:
            self.release()
            raise
        finally:
            close(stdin, stderr, tied)
        with contextlib.suppress(AttributeError, OSError):  # the system is too old, or a sandbox forbids it
            self.exit = io.FileIO(os.pidfd_open(self.pid))

    def poll(self) -> int | None:
        """Return the exit status, or None while the program runs. Kill any processes it has left behind.

        This also reaps the program. If a signal killed it, the status is the negative number of the signal. The program
        counts as running until all processes that it has started have exited.
        """
        if self._status is None:
            if hasattr(os, "waitid"):  # missing on macOS before Python 3.13
                if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                    return None
                self.kill()
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._status = os.waitstatus_to_exitcode(status)
        if self._status is None or self._leash.closed:
            return self._status
        # Processes of other users can't be killed, so they are ignored here. The server reports them.
        leash = self._leash.fileno()
        return None if kill_holders(leash) and is_held(leash) else self._status

    def kill(self) -> None:
        """Kill the program and its process group."""
        if self._status is None:  # after the program is reaped, its process ID may be reused
            kill([-self.pid])

    def await_exit(self, seconds: float) -> None:
        """Block until the program exits or the time is up.

        If the system can't report the exit, return at once.
        """
        if self.exit is not None and self._status is None:
            # Don't use `wait_ready` here. This code may run while the interpreter exits, when no module can be imported
            # any more.
            wait = select.poll()
            wait.register(self.exit, select.POLLIN)
            wait.poll(seconds * 1000)

    def release(self) -> None:
        """Close all descriptors of a program that has been reaped.

        Calling this again does nothing.
        """
        for each in filter(None, (self.stdin, self.stderr, self._leash, self.exit)):
            each.close()


def _spawn(argv: tuple[str, ...], stdin: int, stderr: int, inherited: Sequence[int]) -> int:
    """Start a program. Return its process ID.

    The `inherited` descriptors are inheritable only during the call.
    """
    actions = [
        (os.POSIX_SPAWN_DUP2, stdin, 0),
        (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
        (os.POSIX_SPAWN_DUP2, stderr, 2),
    ]
    try:
        for each in inherited:
            os.set_inheritable(each, True)
        return os.posix_spawnp(argv[0], argv, os.environ, file_actions=actions, setpgroup=0, setsigdef=_RESET_SIGNALS)
    finally:
        for each in inherited:
            os.set_inheritable(each, False)


def _attach_leash(read_end: int, group: int) -> None:
    """Make the kernel kill a process group when the write end of a pipe is closed."""
    if not hasattr(fcntl, "F_SETSIG"):
        return
    # Even if a sandbox forbids these calls, the program exits when its input is closed.
    with contextlib.suppress(OSError):
        fcntl.fcntl(read_end, fcntl.F_SETOWN, -group)
        fcntl.fcntl(read_end, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(read_end, fcntl.F_SETFL, fcntl.fcntl(read_end, fcntl.F_GETFL) | os.O_ASYNC)


class ErrorOutput:
    """Finds the error message in a program's standard error.

    Only two lines are stored, the first line that looks like an error and the very first line, because a player may
    write underrun messages for hours. The last line is rarely the error, because some programs print their parameters
    after it. The patterns are compiled when the first message comes, because compiling them at the start of each engine
    process would take 1 ms.
    """

    def __init__(self) -> None:
        self._lines = LineSplitter(MAX_ERROR_LINE_BYTES)
        self._error: str | None = None
        self._first: str | None = None

    def feed(self, data: bytes) -> None:
        """Look for an error message in the next piece of the program's error output."""
        for line in self._lines.feed(data):
            self._examine_line(line)

    def find_error(self) -> str | None:
        """Return the first line with an error. If there is none, return the first line.

        Return None if there are no lines.
        """
        self._examine_line(self._lines.take_rest())
        return self._error or self._first

    def _examine_line(self, raw: bytes) -> None:
        """Store a line if it is the first one or the first error.

        Ignore noise.
        """
        line = raw.decode("utf-8", "replace").strip()
        if not line or re.search(_NOISE, line, re.IGNORECASE):
            return
        line = re.sub(_SOURCE_LOCATION, r"\g<program>: ", line)
        if self._error is None and re.search(_ERROR, line, re.IGNORECASE):
            self._error = line
        self._first = self._first or line


class ProgramPlayer(Player):
    """Plays a sentence by writing the samples to the standard input of a program."""

    real_time = True

    def __init__(self, command: PlayerCommand, inherited: Sequence[int] = ()) -> None:
        """Start the program.

        Args:
            command: The command line of the program.
            inherited: Other descriptors that the program inherits.

        Raises:
            CannotSpeak: The program can't be started (`no_player`).
        """
        self.name = command.name
        self.proven = False
        self._command = command
        self._errors = ErrorOutput()
        try:
            self._process = PlayerProcess(command.argv, inherited)
        except OSError as error:
            message = f"{self.name} could not be started: {error.strerror or error}"
            raise CannotSpeak(Reason.NO_PLAYER, message) from error
        #: the number of sample bytes written; negative until the preamble is written
        self._written = -len(command.preamble)
        self._consumed = 0
        #: the deadline for the program to exit after it has closed its input
        self._exit_due = NEVER
        self._closed = False
        self._write(memoryview(command.preamble))

    def offer(self, data: memoryview) -> int:
        """Write samples if the program has read all earlier ones. Return the number of bytes written."""
        self.ended()  # raises CannotSpeak if the program has exited
        stdin = self._process.stdin
        if stdin.closed:
            return 0
        # Only one piece is kept in the pipe, because sound in the pipe is still played after a pause begins.
        # If no process has the read end open, the program has closed its input, and the write fails.
        return self._write(data) if _unread_bytes(stdin) == 0 or not is_held(stdin.fileno()) else 0

    def consumed(self) -> int:
        """Return the number of sample bytes that the program has read from the pipe."""
        if not self._process.stdin.closed:
            self._consumed = max(self._consumed, self._written - _unread_bytes(self._process.stdin))
        elif self._closed:
            self._consumed = self._written
        if self._consumed > self._command.read_ahead:
            self.proven = True
        return self._consumed

    def close(self) -> None:
        """Close the program's standard input. The program plays the rest and exits."""
        self._closed = True
        self._process.stdin.close()

    def ended(self) -> bool:
        """Return whether the program has played everything. Raise CannotSpeak if it has failed."""
        status = self._process.poll()
        self._read_stderr()
        if status is None:
            if time.monotonic() >= self._exit_due:
                line = self._errors.find_error()
                raise CannotSpeak(Reason.AUDIO_LOST, line or f"{self.name} closed its input too early")
            return False
        if status == 0 and self._closed:
            return True
        raise self._exit_error(status)

    def interests(self) -> list[Interest]:
        """Return the program's descriptors, each with its poll events."""
        process = self._process
        wanted = ((process.stdin, select.POLLOUT), (process.stderr, select.POLLIN), (process.exit, select.POLLIN))
        return [(file.fileno(), events) for file, events in wanted if file is not None and not file.closed]

    def wake_at(self) -> float:
        """Return when to check whether the program has exited, or NEVER if a descriptor reports the exit."""
        return time.monotonic() + EXIT_CHECK_S if self._process.exit is None else self._exit_due

    def kill(self) -> None:
        """Kill the program, and wait briefly for its exit."""
        self._process.kill()
        self._process.stdin.close()
        self._process.await_exit(REAP_WAIT_S)
        self.gone()

    def gone(self) -> bool:
        """Return whether the program has exited. If so, close its descriptors."""
        if self._process.poll() is None:
            return False
        self._process.release()
        return True

    def _write(self, data: memoryview) -> int:
        """Write to the program without blocking. Return the number of bytes written.

        If the program has closed its input, return 0, and allow it a short time to exit.
        """
        try:
            written = self._process.stdin.write(data) or 0  # None if the pipe is full
        except BrokenPipeError:
            self._process.stdin.close()
            self._exit_due = time.monotonic() + ERROR_GRACE_S
            return 0
        self._written += written
        return written

    def _exit_error(self, status: int) -> CannotSpeak:
        """Return the error for a program that exited too early or failed."""
        self.consumed()
        line = self._errors.find_error()
        if status < 0:
            return CannotSpeak(Reason.AUDIO_LOST, f"{self.name} was killed by {signal_name(-status)}")
        if status == 0:
            return CannotSpeak(Reason.AUDIO_LOST, line or f"{self.name} exited too early")
        reason = Reason.AUDIO_LOST if self.proven else Reason.AUDIO_DEVICE
        return CannotSpeak(reason, line or f"{self.name} exited with status {status}")

    def _read_stderr(self) -> None:
        """Read the program's new error output without blocking, and look for an error message in it."""
        stderr = self._process.stderr
        data = None if stderr.closed else stderr.read(65536)  # `read` returns None if there is no data
        if data:
            self._errors.feed(data)
        elif data == b"":
            stderr.close()


def _unread_bytes(pipe: io.FileIO) -> int:
    """Return the number of unread bytes in a pipe."""
    return int(struct.unpack("i", fcntl.ioctl(pipe, termios.FIONREAD, b"\0\0\0\0"))[0])
