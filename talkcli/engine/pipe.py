"""A player program at the end of a pipe: the sink that is heard.

It is started for one sentence and is gone after it. It leads a process group, so that a command line of the user's is
silent with all that it has started; and it dies with the engine process. Nothing in here blocks, except that a killed
player is given a moment to be reaped.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import struct
import subprocess
import time
from typing import TYPE_CHECKING

from talkcli.engine.complaint import Complaint
from talkcli.engine.orphan import prepare_child
from talkcli.engine.sink import AudioFailed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.engine.players import Command
    from talkcli.engine.sink import Interest

#: Bytes that the pipe can hold, where the system lets us choose: one page. A pipe of one page is what makes poll say
#: "writable" only when the player has taken everything.
PIPE_SIZE = 4096

#: Seconds that a player which closed its input is given to end and to say why, before it is killed.
LAST_WORDS = 0.5

#: Seconds to wait on the spot for a killed player; it takes 1 ms. One that hangs in the kernel is left to `gone`.
REAP_WITHIN = 0.02

#: Seconds between two looks at the player where the system has no descriptor for its end (macOS, Linux before 5.3).
LOOK_EVERY = 0.01

#: Bytes of standard error that are read in one go; a player that floods it must not keep us from the sound.
STDERR_AT_ONCE = 65536


class PlayerPipe:
    """The running player of one sentence."""

    real_time = True

    def __init__(self, command: Command, inherited: Sequence[int] = ()) -> None:
        """Start the player; AudioFailed (no_player) if that is impossible. It inherits the descriptors given."""
        self.name = command.name
        self.proven = False
        self._read_ahead = command.read_ahead
        self._complaint = Complaint()
        self._process = _start(command, inherited)
        assert self._process.stdin is not None
        assert self._process.stderr is not None
        self._stdin: int | None = self._process.stdin.fileno()
        self._stderr: int | None = self._process.stderr.fileno()
        os.set_blocking(self._stdin, False)
        os.set_blocking(self._stderr, False)
        self._exit = _exit_descriptor(self._process.pid)
        self._overhead = len(command.preamble)
        self._written = 0
        self._consumed = 0
        self._broken_at: float | None = None
        self._closed = False
        self._write(memoryview(command.preamble))

    def offer(self, data: memoryview) -> int:
        """Write what fits into the pipe."""
        self.ended()  # raises if the player is gone
        # One piece at a time: what waits in the pipe would be heard late by whoever pauses.
        if self._stdin is not None and _unread(self._stdin) > 0:
            return 0
        return self._write(data)

    def consumed(self) -> int:
        """Return how many bytes of sound the player has taken out of the pipe."""
        if self._stdin is not None and self._broken_at is None:
            self._consumed = max(self._consumed, self._written - _unread(self._stdin) - self._overhead)
        elif self._closed:
            self._consumed = self._written - self._overhead
        if self._consumed > self._read_ahead:
            self.proven = True
        return self._consumed

    def close(self) -> None:
        """Close the player's input: it drains and ends."""
        self.consumed()
        self._closed = True
        self._close_stdin()

    def ended(self) -> bool:
        """Return True when the player ended well after `close`; AudioFailed if it ended in any other way."""
        self._read_stderr()
        status = self._status()
        if status is None:
            self._check_broken()
            return False
        self._read_stderr()
        if status == 0 and self._closed:
            return True
        raise self._verdict(status)

    def interests(self) -> list[Interest]:
        """Return the pipe, where there is something to write, the player's standard error, and its end."""
        wanted = []
        if self._stdin is not None and self._broken_at is None:
            wanted.append((self._stdin, select.POLLOUT))
        if self._stderr is not None:
            wanted.append((self._stderr, select.POLLIN))
        if self._exit is not None:
            wanted.append((self._exit, select.POLLIN))
        return wanted

    def wake_at(self) -> float | None:
        """Return when to look at the player again."""
        if self._exit is None:
            return time.monotonic() + LOOK_EVERY
        return None if self._broken_at is None else self._broken_at + LAST_WORDS

    def kill(self) -> None:
        """Kill the player and what it has started, and reap it if that takes no time."""
        self._kill_group()
        self._close_stdin()
        if self._exit is not None and self._process.returncode is None:
            wait = select.poll()
            wait.register(self._exit, select.POLLIN)
            wait.poll(REAP_WITHIN * 1000)
        self.gone()

    def gone(self) -> bool:
        """Return True once the player is reaped."""
        if self._status() is None:
            return False
        self._close_stdin()
        self._close_stderr()
        if self._exit is not None:
            os.close(self._exit)
            self._exit = None
        return True

    def _status(self) -> int | None:
        """Return the player's exit status, None while it runs; what it leaves behind must not go on without it."""
        if self._process.returncode is None and _has_ended(self._process.pid):
            self._kill_group()
        return self._process.poll()

    def _kill_group(self) -> None:
        if self._process.returncode is None:  # not reaped yet, so its group can't be another's
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def _write(self, data: memoryview) -> int:
        if self._stdin is None or self._broken_at is not None:
            return 0
        try:
            written = os.write(self._stdin, data)
        except BlockingIOError:
            return 0
        except BrokenPipeError:
            self._broken_at = time.monotonic()
            return 0
        self._written += written
        return written

    def _check_broken(self) -> None:
        """Give up on a player that closed its input but does not end."""
        if self._broken_at is not None and time.monotonic() - self._broken_at >= LAST_WORDS:
            line = self._complaint.line()
            raise AudioFailed("audio_lost", line or f"{self.name} closed its input before the sound was over")

    def _verdict(self, status: int) -> AudioFailed:
        self.consumed()
        line = self._complaint.line()
        if status < 0:
            return AudioFailed("audio_lost", f"{self.name} was killed by {_signal_name(-status)}")
        if status == 0:
            return AudioFailed("audio_lost", line or f"{self.name} ended before the sound did")
        reason = "audio_lost" if self.proven else "audio_device"
        return AudioFailed(reason, line or f"{self.name} exited with status {status}")

    def _read_stderr(self) -> None:
        if self._stderr is None:
            return
        try:
            data = os.read(self._stderr, STDERR_AT_ONCE)
        except BlockingIOError:
            return
        if data:
            self._complaint.feed(data)
        else:
            self._close_stderr()

    def _close_stdin(self) -> None:
        if self._stdin is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._stdin = None

    def _close_stderr(self) -> None:
        if self._stderr is not None and self._process.stderr is not None:
            self._process.stderr.close()
            self._stderr = None


def _start(command: Command, inherited: Sequence[int]) -> subprocess.Popen[bytes]:
    try:
        # A hook between fork and exec, as fork clears PR_SET_PDEATHSIG and exec keeps it.
        return subprocess.Popen(
            command.argv,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            bufsize=0,
            pipesize=PIPE_SIZE,
            pass_fds=inherited,
            preexec_fn=prepare_child(),  # noqa: PLW1509 - one thread
        )
    except (OSError, subprocess.SubprocessError) as error:
        text = getattr(error, "strerror", None) or str(error)
        raise AudioFailed("no_player", f"{command.name} cannot be started: {text}") from error


def _exit_descriptor(pid: int) -> int | None:
    """Return a descriptor that becomes readable when the process ends, None where there is no such thing."""
    if not hasattr(os, "pidfd_open"):
        return None
    try:
        return os.pidfd_open(pid)
    except OSError:  # an old kernel, or a sandbox that forbids it
        return None


def _has_ended(pid: int) -> bool:
    """Return whether a child has ended and waits to be reaped; False where the system cannot tell without reaping."""
    if not hasattr(os, "waitid"):
        return False  # macOS before Python 3.13
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None


def _unread(pipe: int) -> int:
    """Return how many bytes wait in the pipe; 0 where the system does not tell."""
    import fcntl
    import termios

    try:
        return int(struct.unpack("i", fcntl.ioctl(pipe, termios.FIONREAD, b"\0\0\0\0"))[0])
    except OSError:
        return 0


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
