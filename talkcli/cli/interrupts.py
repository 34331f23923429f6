"""What ends a client's waiting: signals, a timeout, another thread.

All of them become a descriptor that is readable then, so that they never cut a read or a write in two.
"""

from __future__ import annotations

import os
import signal

from talkcli.errors import EXIT_SIGNAL, EXIT_TIMEOUT
from talkcli.values import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable
    from types import FrameType, TracebackType

_CAUGHT = (signal.SIGINT, signal.SIGTERM)
#: Three years: what the system's timer is sure to take.
_LONGEST = 1e8


class Interrupts:
    """Catches SIGINT and SIGTERM: `descriptor` becomes readable, `number` is the signal. A second one ends at once."""

    def __init__(self, timeout: float | None = None, held: Iterable[int] = ()) -> None:
        """`timeout`: seconds after which it becomes readable by itself, and `late` true; counted from the `with`.

        `held`: signals that were blocked until somebody should catch them.
        """
        self.number: int | None = None
        self.late = False
        self._timeout = timeout
        self._held = held

    @property
    def exit_code(self) -> int:
        """The exit code for what has happened: the signal's, if there was one."""
        return EXIT_TIMEOUT if self.number is None else EXIT_SIGNAL + self.number

    def __enter__(self) -> Interrupts:
        self.descriptor, self._write = os.pipe()
        os.set_blocking(self._write, False)
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
    ) -> None:
        if self._timeout is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for each, handler in self._before.items():
            signal.signal(each, handler)
        os.close(self.descriptor)
        os.close(self._write)

    def clear(self) -> None:
        """Make the descriptor wait for another signal; there is none, a second one ends the process."""
        os.set_blocking(self.descriptor, False)
        try:
            os.read(self.descriptor, 16)
        except BlockingIOError:
            pass

    def wake(self) -> None:
        """Make the descriptor readable, from any thread: there is something else to see to."""
        try:
            os.write(self._write, b"\0")
        except BlockingIOError:
            pass  # it is readable, many times over

    def _caught(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        if self.number is not None:
            os._exit(EXIT_SIGNAL + number)
        self.number = number
        self.wake()

    def _expired(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        self.late = True
        self.wake()
