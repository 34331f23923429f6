"""A player program: its process, its error messages, and the player that writes samples to its standard input.

The program is started for one sentence and ends with it. It ends with this process too, and so does everything that it
has started.

`subprocess` can only tie a child to its parent with a function that runs between fork and exec. This needs a real
fork, which copies the page tables of the engine process: 3 ms before every sentence, where `posix_spawn` takes 0.4 ms
(on a PC; a Raspberry Pi takes five to ten times as long). Therefore the child runs no code of ours. Instead, it has a
leash: a pipe that nobody writes to, and whose write end exists only in this process. When this process ends, however it
ends, the kernel closes that end and sends SIGKILL to the program's process group.

These processes escape the leash (which only Linux has):

- A program whose parent is killed in the 0.1 ms between its start and its leash. It has no samples yet, and ends
  because its input does.
- A program that closes the descriptors it inherited (ssh, sudo). The server kills what a dead engine leaves behind.
- A process that has left the process group and the session. It is found in /proc by a pipe that it inherited. If it has
  closed that pipe too (a sound server, `ssh -f`), it has nothing to do with the player any more and is left alone.
"""

from __future__ import annotations

import contextlib
import fcntl
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
from talkcli.processes import close, is_held, kill, kill_holders, open_pipes, signal_name
from talkcli.protocol.lines import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.engine.child.players.base import Interest
    from talkcli.engine.players import PlayerCommand

#: Bytes that the program's input pipe can hold, if the system allows a choice. With a single page, poll reports room
#: only when the program has read everything.
PIPE_BYTES = 4096

#: Seconds that a program which closed its input has to end and to report an error, before it is killed.
ERROR_GRACE_S = 0.5

#: Seconds to wait for a killed program; it takes 1 ms. One that hangs in the kernel is left to `gone`.
REAP_WAIT_S = 0.02

#: Seconds between two checks of a program if the system has no descriptor for its end (macOS, Linux before 5.3).
EXIT_CHECK_S = 0.01

#: Bytes of a line on standard error that are kept: errors are shorter, and the message has to stay readable.
MAX_ERROR_LINE_BYTES = 300

#: Bytes of standard error that are read at a time, so that a flood of messages doesn't delay the samples.
STDERR_READ_BYTES = 65536

#: Lines that are no errors, or that say nothing to a user: library messages, underruns and friendly hints.
_NOISE = (
    r"ALSA lib |underrun|overrun|Playing |Warning:|please, try |Stream (suspended|successfully|started)|^Got signal"
)
_ERROR = (
    r"error|fail|cannot|can't|could ?n[o']t|unable|no such|not found|not available|refused|denied|invalid|unknown"
    r"|disconnected|busy|broken|terminated|killed|lost"
)
#: The source location in "aplay: main:831: text", which says nothing to a user.
_SOURCE_LOCATION = r"^(?P<program>[^\s:]+): \w+:\d+: "

#: Signals that Python ignores, and that a program must not inherit as ignored.
_RESET_SIGNALS = [getattr(signal, name) for name in ("SIGPIPE", "SIGXFSZ") if hasattr(signal, name)]


class PlayerProcess:
    """A running program that leads a process group of its own."""

    def __init__(self, argv: tuple[str, ...], inherited: Sequence[int] = ()) -> None:
        """Start the program.

        Args:
            argv: The command line.
            inherited: More descriptors that the program inherits.

        Raises:
            OSError: It can't be started.
        """
        (stdin, our_stdin), (our_stderr, stderr), (tied, leash) = open_pipes(3)
        try:
            os.set_blocking(our_stdin, False)
            os.set_blocking(our_stderr, False)
            if hasattr(fcntl, "F_SETPIPE_SZ"):
                fcntl.fcntl(our_stdin, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
            self.pid = _spawn(argv, stdin, stderr, [tied, *inherited])
            _tie(tied, self.pid)
        except BaseException:
            close(our_stdin, our_stderr, leash)
            raise
        finally:
            close(stdin, stderr, tied)
        #: the non-blocking ends of the program's standard input and standard error; None once they are closed
        self.stdin: int | None = our_stdin
        self.stderr: int | None = our_stderr
        #: readable once the program has ended; None if the system has no such descriptor (macOS, Linux before 5.3)
        self.exit = _exit_descriptor(self.pid)
        self._leash: int | None = leash
        self._status: int | None = None

    def status(self) -> int | None:
        """Return the exit status, negative for the signal that killed the program; None while it runs.

        The program counts as running until the processes that it started are gone too.
        """
        if self._status is None:
            if hasattr(os, "waitid"):  # not on macOS before Python 3.13
                if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                    return None
                self.kill()
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._status = os.waitstatus_to_exitcode(status)
        if self._status is None or self._leash is None:
            return self._status
        # A process of another user can't be killed, and doesn't count; the server reports that it is still there.
        return None if kill_holders(self._leash) and is_held(self._leash) else self._status

    def kill(self) -> None:
        """Kill the program and its process group."""
        if self._status is None:  # once the program is reaped, its process id may be used again
            kill([-self.pid])

    def await_end(self, seconds: float) -> None:
        """Block until the program ends, for a limited time; return at once if the system can't report the end."""
        if self.exit is not None and self._status is None:
            # Not `wait_ready`: this may run while the interpreter ends, when nothing can be imported any more.
            wait = select.poll()
            wait.register(self.exit, select.POLLIN)
            wait.poll(seconds * 1000)

    def close_stdin(self) -> None:
        """Close the program's standard input."""
        if self.stdin is not None:
            close(self.stdin)
            self.stdin = None

    def close_stderr(self) -> None:
        """Close the program's standard error."""
        if self.stderr is not None:
            close(self.stderr)
            self.stderr = None

    def release(self) -> None:
        """Close every descriptor; call it once the program is reaped. It may be called again."""
        self.close_stdin()
        self.close_stderr()
        close(*(each for each in (self.exit, self._leash) if each is not None))
        self.exit = self._leash = None


def _spawn(argv: tuple[str, ...], stdin: int, stderr: int, inherited: Sequence[int]) -> int:
    """Start the program and return its process id; the inherited descriptors are inheritable only during the call."""
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


def _tie(leash: int, group: int) -> None:
    """Make the kernel kill a process group when the other end of this pipe is closed."""
    if not hasattr(fcntl, "F_SETSIG"):
        return
    with contextlib.suppress(OSError):  # if a sandbox forbids it, the program ends with its input
        fcntl.fcntl(leash, fcntl.F_SETOWN, -group)
        fcntl.fcntl(leash, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(leash, fcntl.F_SETFL, fcntl.fcntl(leash, fcntl.F_GETFL) | os.O_ASYNC)


def _exit_descriptor(pid: int) -> int | None:
    """Return a descriptor that becomes readable when the process ends; None if the system has none."""
    if not hasattr(os, "pidfd_open"):
        return None
    try:
        return os.pidfd_open(pid)
    except OSError:  # an old kernel, or a sandbox that forbids it
        return None


class ErrorOutput:
    """The line on a program's standard error that names the error.

    A player may write underrun messages for hours, so no other line is kept. It is rarely the last line, because some
    programs print their parameters after the error. The patterns are compiled at the first message;
    at the start of each engine process they would cost 1 ms.
    """

    def __init__(self) -> None:
        self._lines = LineSplitter(MAX_ERROR_LINE_BYTES)
        self._error: str | None = None
        self._first: str | None = None

    def feed(self, data: bytes) -> None:
        """Take bytes that the program wrote."""
        for line in self._lines.feed(data):
            self._examine(line)

    def line(self) -> str | None:
        """Return the line that names the error, or else the first line; None if there is neither."""
        self._examine(self._lines.take_rest())
        return self._error or self._first

    def _examine(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").strip()
        if not line or re.search(_NOISE, line, re.IGNORECASE):
            return
        line = re.sub(_SOURCE_LOCATION, r"\g<program>: ", line)
        if self._error is None and re.search(_ERROR, line, re.IGNORECASE):
            self._error = line
        self._first = self._first or line


class ProgramPlayer(Player):
    """A player that writes its sentence to the standard input of a program."""

    real_time = True

    def __init__(self, command: PlayerCommand, inherited: Sequence[int] = ()) -> None:
        """Start the program.

        Args:
            command: The program's command line.
            inherited: More descriptors that the program inherits.

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
            text = error.strerror or str(error)
            raise CannotSpeak(Reason.NO_PLAYER, f"{self.name} cannot be started: {text}") from error
        self._overhead = len(command.preamble)
        self._written = 0
        self._consumed = 0
        self._broken_at: float | None = None
        self._closed = False
        self._write(memoryview(command.preamble))

    def offer(self, data: memoryview) -> int:
        self.ended()  # raises if the program is gone
        if self._process.stdin is None:
            return 0
        # The pipe holds at most one piece, because sound in the pipe is still played after a pause.
        waiting = _unread_bytes(self._process.stdin)
        # If bytes wait although nobody holds the read end, the program has closed its input: the write reports that.
        if waiting == 0 or not is_held(self._process.stdin):
            return self._write(data)
        # A program that has read nothing yet gets as much as it needs to start.
        room = self._command.at_start - waiting if waiting == self._written else 0
        return self._write(data[:room]) if room > 0 else 0

    def consumed(self) -> int:
        """Return the bytes of sound that the program has read from the pipe."""
        if self._process.stdin is not None and self._broken_at is None:
            read = self._written - _unread_bytes(self._process.stdin) - self._overhead
            self._consumed = max(self._consumed, read)
        elif self._closed:
            self._consumed = self._written - self._overhead
        if self._consumed > self._command.read_ahead:
            self.proven = True
        return self._consumed

    def close(self) -> None:
        self._closed = True
        self._process.close_stdin()

    def ended(self) -> bool:
        self._read_stderr()
        status = self._process.status()
        if status is None:
            if self._broken_at is not None and time.monotonic() - self._broken_at >= ERROR_GRACE_S:
                line = self._errors.line()
                raise CannotSpeak(Reason.AUDIO_LOST, line or f"{self.name} closed its input before the sound was over")
            return False
        self._read_stderr()
        if status == 0 and self._closed:
            return True
        raise self._failure(status)

    def interests(self) -> list[Interest]:
        process = self._process
        stdin = process.stdin if self._broken_at is None else None
        wanted = ((stdin, select.POLLOUT), (process.stderr, select.POLLIN), (process.exit, select.POLLIN))
        return [(descriptor, events) for descriptor, events in wanted if descriptor is not None]

    def wake_at(self) -> float | None:
        if self._process.exit is None:
            return time.monotonic() + EXIT_CHECK_S
        return None if self._broken_at is None else self._broken_at + ERROR_GRACE_S

    def kill(self) -> None:
        self._process.kill()
        self._process.close_stdin()
        self._process.await_end(REAP_WAIT_S)
        self.gone()

    def gone(self) -> bool:
        if self._process.status() is None:
            return False
        self._process.release()
        return True

    def _write(self, data: memoryview) -> int:
        if self._process.stdin is None or self._broken_at is not None:
            return 0
        try:
            written = os.write(self._process.stdin, data)
        except BlockingIOError:
            return 0
        except BrokenPipeError:
            self._broken_at = time.monotonic()
            return 0
        self._written += written
        return written

    def _failure(self, status: int) -> CannotSpeak:
        """Return the error for a program that ended too early or with an error."""
        self.consumed()
        line = self._errors.line()
        if status < 0:
            return CannotSpeak(Reason.AUDIO_LOST, f"{self.name} was killed by {signal_name(-status)}")
        if status == 0:
            return CannotSpeak(Reason.AUDIO_LOST, line or f"{self.name} ended before the sound did")
        reason = Reason.AUDIO_LOST if self.proven else Reason.AUDIO_DEVICE
        return CannotSpeak(reason, line or f"{self.name} exited with status {status}")

    def _read_stderr(self) -> None:
        if self._process.stderr is None:
            return
        try:
            data = os.read(self._process.stderr, STDERR_READ_BYTES)
        except BlockingIOError:
            return
        if data:
            self._errors.feed(data)
        else:
            self._process.close_stderr()


def _unread_bytes(pipe: int) -> int:
    """Return how many bytes wait in a pipe; 0 if the system doesn't tell."""
    try:
        return int(struct.unpack("i", fcntl.ioctl(pipe, termios.FIONREAD, b"\0\0\0\0"))[0])
    except OSError:
        return 0
