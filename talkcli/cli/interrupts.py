"""Signals that end a client's waiting, turned into a descriptor, so that they never cut a read or a write in two."""

from __future__ import annotations

import contextlib
import os
import signal
from typing import TYPE_CHECKING

from talkcli.errors import EXIT_SIGNAL

if TYPE_CHECKING:
    from types import FrameType, TracebackType

_CAUGHT = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """Catches SIGINT and SIGTERM: `descriptor` becomes readable, `number` is the signal. A second one ends at once."""

    def __init__(self) -> None:
        self.number: int | None = None

    @property
    def exit_code(self) -> int:
        return EXIT_SIGNAL + (self.number or 0)

    def __enter__(self) -> Interrupts:
        self.descriptor, self._write = os.pipe()
        os.set_blocking(self._write, False)
        # A shell starts background commands with SIGINT ignored: what is ignored stays so.
        self._before = {
            each: signal.signal(each, self._caught) for each in _CAUGHT if signal.getsignal(each) != signal.SIG_IGN
        }
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)
        os.close(self.descriptor)
        os.close(self._write)

    def clear(self) -> None:
        """Make the descriptor wait for another signal; there is none, a second one ends the process."""
        os.set_blocking(self.descriptor, False)
        with contextlib.suppress(BlockingIOError):
            os.read(self.descriptor, 16)

    def _caught(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        if self.number is not None:
            os._exit(EXIT_SIGNAL + number)
        self.number = number
        os.write(self._write, b"\0")
