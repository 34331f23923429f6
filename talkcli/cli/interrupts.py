"""What ends a client's waiting: signals, a timeout, a reader of standard output that goes away.

The first two become a descriptor that is readable then, so that they never cut a read or a write in two. The last is
seen at standard output itself, which is waited for together with that. Until there is one of these, a signal for a goal
that was sent early is held, by `plain`.
"""

from __future__ import annotations

import os
import select
import signal
import sys

from talkcli.cli.show import OUTPUT, give_up_output
from talkcli.errors import EXIT_SIGNAL, EXIT_SIGPIPE, EXIT_TIMEOUT
from talkcli.frozen import TYPE_CHECKING
from talkcli.polling import Interrupted

if TYPE_CHECKING:
    from collections.abc import Iterable
    from types import FrameType, TracebackType

_CAUGHT = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Three years: what the system's timer is sure to take.
_LONGEST = 1e8


def give_up_unread() -> None:
    """Have nothing shown on a standard output that nobody could read from the start: that matters to nothing."""
    if not has_reader():
        give_up_output()


def has_reader() -> bool:
    """Whether standard output is open, and whatever it leads to has not gone away."""
    # Not POLLNVAL, which is what macOS says of a terminal.
    return sys.stdout is not None and not _condition() & (select.POLLERR | select.POLLHUP)


def watched_output() -> dict[int, int]:
    """Return what to wait for, as `connect.ready` takes it, so that a reader of standard output that goes ends it."""
    return {} if _condition() & select.POLLNVAL else {OUTPUT: 0}  # that would end it at once


def _condition() -> int:
    """Return what poll says of standard output, unasked; 0 for nothing, as it always does of a file."""
    poll = select.poll()
    poll.register(OUTPUT, 0)
    return next((found for _, found in poll.poll(0)), 0)


class Interrupts:
    """Catches SIGINT, SIGTERM and SIGHUP: `number` is the signal then. A second one ends the process at once, but for
    SIGHUP: of a terminal that is closed the shell tells its commands, and then the system.

    `watched` has all that there is to wait for, as `connect.ready` takes it, a descriptor that becomes readable then
    among it; it may change. That it ends the waiting ends the `with`, too; `exit_code` then says why.
    """

    def __init__(self, timeout: float | None = None, held: Iterable[int] = (), *, output: bool = False) -> None:
        """`timeout`: seconds after which it becomes readable by itself, and `late` true; counted from the `with`.

        `held`: signals that were blocked until somebody should catch them; `output`: whether a reader of standard
        output that goes away ends the waiting, too.
        """
        self.number: int | None = None
        self.late = False
        #: whether the reader of standard output has gone away
        self.gone = False
        self._timeout = timeout
        self._held = held
        self._output = output

    @property
    def exit_code(self) -> int:
        """The exit code for what has happened: the signal's, if there was one."""
        if self.number is not None:
            return EXIT_SIGNAL + self.number
        return EXIT_SIGPIPE if self.gone else EXIT_TIMEOUT

    def __enter__(self) -> Interrupts:
        self._descriptor, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self.watched = {self._descriptor: select.POLLIN, **(watched_output() if self._output else {})}
        # Python calls a handler between two steps of the main thread: a signal that comes in the last moment before
        # that waits, or that the kernel gives another thread, would end no wait. What the system writes here does.
        self._woken_before = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        # A shell starts background commands with SIGINT ignored: what is ignored stays so.
        self._before = {
            each: signal.signal(each, self._caught) for each in _CAUGHT if signal.getsignal(each) != signal.SIG_IGN
        }
        if self._timeout is not None:
            self._before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._expired)
            signal.setitimer(signal.ITIMER_REAL, max(1e-6, min(self._timeout, _LONGEST)))  # 0 would be for never
        if self._held:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, self._held)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if kind is Interrupted:
            self.look()
        if self._timeout is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for each, handler in self._before.items():
            signal.signal(each, handler)
        signal.set_wakeup_fd(self._woken_before)
        os.close(self._descriptor)
        os.close(self._write)
        return kind is Interrupted

    def look(self) -> None:
        """Find out whether it was the reader of standard output that has ended the waiting."""
        self.gone = self.gone or (OUTPUT in self.watched and not has_reader())

    def clear(self) -> None:
        """Have nothing end the waiting that has; of the signals, only a first one still will."""
        signal.set_wakeup_fd(-1)  # a second SIGHUP means nothing
        self.look()
        self.watched.pop(OUTPUT, None)
        os.set_blocking(self._descriptor, False)
        try:
            os.read(self._descriptor, 16)
        except BlockingIOError:
            pass

    def _wake(self) -> None:
        """Make the descriptor readable."""
        try:
            os.write(self._write, b"\0")
        except BlockingIOError:
            pass  # it is readable, many times over

    def _caught(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        if self.number is not None:
            if number == signal.SIGHUP:
                return
            os._exit(EXIT_SIGNAL + number)
        self.number = number
        self._wake()

    def _expired(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        self.late = True
        self._wake()
