"""Who runs beside whom where tests run several at a time (`pytest -n`): most in company, some alone.

What is heard is compared sample by sample, and a limit is a promise of a machine that is not busy with other tests. So
what was late in company, or heard something else, is tried again alone, and only that counts. Two locks do it, on files
of this checkout; the kernel drops them with their holder.
"""

from __future__ import annotations

import fcntl
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import TracebackType


class Company:
    """The place of one test among those that run at the same time. In a run of one at a time it locks nothing."""

    def __init__(self, files: tuple[str, str] | None) -> None:
        """`files` are those that stand for the door and for the room; None where one test runs at a time."""
        self._descriptors = [os.open(each, os.O_RDONLY | os.O_CLOEXEC) for each in files or ()]
        #: whether no other test runs
        self.alone = files is None

    def __enter__(self) -> Company:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for each in self._descriptors:
            os.close(each)

    def join(self) -> None:
        """Run beside others, once none is alone or wants to be."""
        self._enter(fcntl.LOCK_SH)
        self.alone = not self._descriptors

    def stay_alone(self) -> None:
        """Wait until the others have ended, and let none begin."""
        self._enter(fcntl.LOCK_EX)
        self.alone = True

    def leave(self) -> None:
        """Let the others go on."""
        for each in self._descriptors:
            fcntl.flock(each, fcntl.LOCK_UN)
        self.alone = not self._descriptors

    def _enter(self, how: int) -> None:
        if not self._descriptors:
            return
        door, room = self._descriptors
        fcntl.flock(room, fcntl.LOCK_UN)
        # Who waits for the room holds the door: else two that take turns would keep out for ever who wants to be alone.
        fcntl.flock(door, fcntl.LOCK_EX)
        fcntl.flock(room, how)
        fcntl.flock(door, fcntl.LOCK_UN)


_FILES = (__file__, os.path.join(os.path.dirname(__file__), "__init__.py"))
#: The place of the test that this process runs.
company = Company(_FILES if "PYTEST_XDIST_WORKER" in os.environ else None)
