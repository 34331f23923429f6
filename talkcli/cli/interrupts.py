"""Handling of signals and closed output while a command waits.

A signal makes a file descriptor readable, so it never interrupts a read or a write halfway. Standard output is polled
together with this descriptor. If a goal was sent early, `plain` blocks signals until `Interrupts` is entered.
"""

from __future__ import annotations

import os
import select
import signal
import sys

from talkcli.cli.show import STDOUT_FD, discard_output, reader_is_gone
from talkcli.errors import EXIT_SIGNAL, EXIT_SIGPIPE
from talkcli.frozen import TYPE_CHECKING
from talkcli.polling import Interrupted, wait_ready

if TYPE_CHECKING:
    from collections.abc import Iterable
    from types import FrameType

_HANDLED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def discard_unread_output() -> None:
    """Redirect standard output to /dev/null if it is closed or has no reader.

    Commands call this before they write anything.
    """
    if not has_reader():
        discard_output()


def has_reader() -> bool:
    """Return whether standard output is open and has a reader."""
    # POLLNVAL is ignored, because macOS reports it for terminals.
    return sys.stdout is not None and not _poll_output() & (select.POLLERR | select.POLLHUP)


def _poll_output() -> int:
    """Return the current poll events of standard output, without waiting."""
    poll = select.poll()
    poll.register(STDOUT_FD, 0)
    return next((events for _, events in poll.poll(0)), 0)


class Interrupts:
    """A context manager that ends a wait on SIGINT, SIGTERM, SIGHUP or, optionally, closed output.

    Pass `watched` to `wait_ready` as `interrupt`. The context manager suppresses the Interrupted exception that ends
    the wait, and provides the command's `exit_code`. A second SIGINT or SIGTERM ends the process. A second SIGHUP is
    ignored, because the shell and the system both send one when a terminal is closed.
    """

    def __init__(self, blocked: Iterable[int] = (), *, output: bool = False) -> None:
        """Initialise the context manager.

        Args:
            blocked: signals that were blocked earlier and can be handled now.
            output: whether to end the wait if the reader of standard output goes away.
        """
        #: the first signal that was received, or None
        self.signal_number: int | None = None
        #: whether the reader of standard output has gone away
        self.reader_gone = False
        self._blocked = blocked
        self._output = output

    @property
    def exit_code(self) -> int:
        """The command's exit code after an interrupted wait."""
        return EXIT_SIGPIPE if self.signal_number is None else EXIT_SIGNAL + self.signal_number

    def __enter__(self) -> Interrupts:
        self._descriptor, self._write = os.pipe()
        os.set_blocking(self._write, False)
        #: the poll events to wait for, by file descriptor; callers may add other descriptors
        self.watched = {self._descriptor: select.POLLIN}
        # A descriptor with POLLNVAL would end every wait at once.
        if self._output and not _poll_output() & select.POLLNVAL:
            self.watched[STDOUT_FD] = 0
        # Python runs signal handlers with a delay, so a handler couldn't end a wait that is just starting. The wakeup
        # descriptor is written immediately.
        self._old_wakeup_fd = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        # Keep ignored signals ignored. For example, shells start background commands with SIGINT ignored.
        self._old_handlers = {
            each: signal.signal(each, self._handle_signal)
            for each in _HANDLED_SIGNALS
            if signal.getsignal(each) != signal.SIG_IGN
        }
        if self._blocked:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, self._blocked)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        for each, handler in self._old_handlers.items():
            signal.signal(each, handler)
        signal.set_wakeup_fd(self._old_wakeup_fd)
        os.close(self._descriptor)
        os.close(self._write)
        return kind is Interrupted

    def handle_error(self, error: Interrupted | OSError) -> None:
        """Discard the output if its reader is gone. Re-raise unexpected errors.

        Interrupts, timeouts and failed writes to a missing reader are expected. Record in `reader_gone` whether the
        reader is gone.
        """
        if isinstance(error, Interrupted | TimeoutError):
            self.reader_gone = STDOUT_FD in self.watched and not has_reader()
        elif reader_is_gone(error):
            self.reader_gone = True
        else:
            raise error
        if self.reader_gone:
            discard_output()

    def prepare_cleanup(self) -> None:
        """Let the cleanup wait despite the recorded signal. A second signal ends the process at once.

        The exit code stays the same. If no signal was recorded, a new one ends the wait of the cleanup. Closed output
        no longer ends a wait.
        """
        if self.signal_number is not None:
            signal.set_wakeup_fd(-1)  # a second SIGHUP must not interrupt the cleanup
        self.watched.pop(STDOUT_FD, None)
        if wait_ready({self._descriptor: select.POLLIN}, 0):
            os.read(self._descriptor, 16)

    def _handle_signal(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        """Record the first signal. Exit the process on a second signal, unless it is SIGHUP."""
        if self.signal_number is not None:
            if number == signal.SIGHUP:
                return
            os._exit(EXIT_SIGNAL + number)
        self.signal_number = number
