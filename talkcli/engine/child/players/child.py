"""A player's process: started, killed, reaped. It dies with this process, and so does all that it has started.

`subprocess` can have a child die with its parent only by a function between fork and exec. That needs a real fork,
which copies the page tables of an engine process: 3 ms before every sentence where `posix_spawn` takes 0.4, on a PC;
on a Raspberry Pi each is five to ten times that. So nothing of ours runs in the child. What ends it is its leash: a
pipe that nobody writes to, and whose writing end is here and nowhere else. The kernel closes that when this process
ends, however it ends, and sends the signal that it was asked for to the group of processes that it was given.

Whoever is killed between the start of a player and its leash, a ten-thousandth of a second, leaves one that was given
nothing to play, and ends with its input.

So does one that closes what it has inherited (ssh, sudo), if it is the server that is killed: the server kills what a
dead engine leaves behind. Linux only; elsewhere a player that nobody has killed ends with its input.

What it has started out of its process group and session is reached by no signal to the group, and may still be heard.
Such a process is known by a pipe that it has inherited; what closed that has nothing to do with the player any more (a
sound server that it started, `ssh -f`) and is left alone. Linux only, by /proc; elsewhere it lives on.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal

from talkcli.frozen import TYPE_CHECKING
from talkcli.processes import close, is_held, kill, kill_holders, open_pipes

if TYPE_CHECKING:
    from collections.abc import Sequence

#: Bytes that the pipe can hold, where the system lets us choose: one page. A pipe of one page is what makes poll say
#: "writable" only when the player has taken everything.
PIPE_SIZE = 4096

#: Signals that Python ignores, and a program that it starts must not.
_RESTORED = [getattr(signal, name) for name in ("SIGPIPE", "SIGXFSZ") if hasattr(signal, name)]


class Child:
    """A running program, the leader of a process group of its own."""

    def __init__(self, argv: tuple[str, ...], inherited: Sequence[int] = ()) -> None:
        """Start it; OSError if that is impossible. It inherits the descriptors given."""
        (stdin, our_stdin), (our_stderr, stderr), (tied, leash) = open_pipes(3)
        try:
            os.set_blocking(our_stdin, False)
            os.set_blocking(our_stderr, False)
            if hasattr(fcntl, "F_SETPIPE_SZ"):
                fcntl.fcntl(our_stdin, fcntl.F_SETPIPE_SZ, PIPE_SIZE)
            self.pid = _spawn(argv, stdin, stderr, [tied, *inherited])
            _tie(tied, self.pid)
        except BaseException:
            close(our_stdin, our_stderr, leash)
            raise
        finally:
            close(stdin, stderr, tied)
        #: the ends of its standard input and of its standard error, None once they are closed; neither blocks
        self.stdin: int | None = our_stdin
        self.stderr: int | None = our_stderr
        #: readable once it has ended; None where there is no such thing (macOS, Linux before 5.3)
        self.exit = _exit_descriptor(self.pid)
        self._leash: int | None = leash
        self._status: int | None = None

    def status(self) -> int | None:
        """Return its exit status, below zero for the signal that killed it; None while it runs.

        What it leaves behind must not go on without it, in whatever group or session: until that is gone, it runs.
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
        # One that can't be killed, another user's, would keep it for ever; the server sees that it is there.
        return None if kill_holders(self._leash) and is_held(self._leash) else self._status

    def kill(self) -> None:
        """Kill it and what it has started."""
        if self._status is None:  # not reaped yet, so its group can't be another's
            kill([-self.pid])

    def await_end(self, seconds: float) -> None:
        """Wait on the spot for its end, where the system tells of it."""
        if self.exit is not None and self._status is None:
            wait = select.poll()
            wait.register(self.exit, select.POLLIN)
            wait.poll(seconds * 1000)

    def close_stdin(self) -> None:
        """Have its input end."""
        if self.stdin is not None:
            close(self.stdin)
            self.stdin = None

    def close_stderr(self) -> None:
        """Hear its errors no more."""
        if self.stderr is not None:
            close(self.stderr)
            self.stderr = None

    def release(self) -> None:
        """Close all that is open, once it is reaped; may be called again."""
        self.close_stdin()
        self.close_stderr()
        close(*(each for each in (self.exit, self._leash) if each is not None))
        self.exit = self._leash = None


def _spawn(argv: tuple[str, ...], stdin: int, stderr: int, inherited: Sequence[int]) -> int:
    """Start the program and return its process id; what it inherits is inheritable for this moment only."""
    actions = [
        (os.POSIX_SPAWN_DUP2, stdin, 0),
        (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
        (os.POSIX_SPAWN_DUP2, stderr, 2),
    ]
    try:
        for each in inherited:
            os.set_inheritable(each, True)
        return os.posix_spawnp(argv[0], argv, os.environ, file_actions=actions, setpgroup=0, setsigdef=_RESTORED)
    finally:
        for each in inherited:
            os.set_inheritable(each, False)


def _tie(leash: int, group: int) -> None:
    """Have a process group killed when the other end of its leash is closed."""
    if not hasattr(fcntl, "F_SETSIG"):
        return
    with contextlib.suppress(OSError):  # a sandbox that forbids it: then it ends with its input
        fcntl.fcntl(leash, fcntl.F_SETOWN, -group)
        fcntl.fcntl(leash, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(leash, fcntl.F_SETFL, fcntl.fcntl(leash, fcntl.F_GETFL) | os.O_ASYNC)


def _exit_descriptor(pid: int) -> int | None:
    """Return a descriptor that becomes readable when the process ends, None where there is no such thing."""
    if not hasattr(os, "pidfd_open"):
        return None
    try:
        return os.pidfd_open(pid)
    except OSError:  # an old kernel, or a sandbox that forbids it
        return None
