"""Work that another thread does, and a descriptor that is readable as long as something of it is there to be taken.

It knows nothing of what is made. One thread takes; the work goes on meanwhile, as far ahead as there is room.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_T = TypeVar("_T")


class Work(threading.Thread, Generic[_T]):
    """What an iterator yields, which is run in this thread to its end or its error."""

    def __init__(self, makes: Iterator[_T], room: int) -> None:
        """Begin with it. `room`: how many may lie there that nobody has taken."""
        # None that is left behind at the process's end, in the midst of a library in C, which aborts then.
        super().__init__(daemon=False)
        self._makes = makes
        self._room = threading.Semaphore(room)
        self._made: deque[_T] = deque()
        #: why it ended; None at its good end
        self._error: BaseException | None = None
        self._over = False
        #: held while the descriptors are used by the thread, so that they are not another's by then
        self._closing = threading.Lock()
        self._closed = False
        #: readable as long as something is there, and at the end
        self.descriptor, self._ring = os.pipe()
        self.start()

    def run(self) -> None:
        """Do it."""
        try:
            for each in self._makes:
                self._room.acquire()
                if self._closed:
                    return
                self._made.append(each)
                self._tell()
        except BaseException as error:  # noqa: BLE001 - raised again in the thread that takes
            self._error = error
        self._over = True
        self._tell()

    @property
    def ready(self) -> bool:
        """Whether `take` need not wait."""
        return bool(self._made) or self._over

    def take(self, wait: Callable[[int], None] | None = None) -> _T | None:
        """Return what was made next, None at the end; raises as the work did.

        `wait`: waits for the descriptor, and may return before it is readable; what it raises comes out of here, and
        nothing is lost. It may be left out where it is `ready`.
        """
        while not self._made:
            if self._over:
                # What was made last came before that.
                if self._made:
                    break
                if self._error is not None:
                    raise self._error
                return None
            assert wait is not None
            wait(self.descriptor)
        os.read(self.descriptor, 1)
        self._room.release()
        return self._made.popleft()

    def close(self) -> None:
        """Have it end behind what it makes now, which is nobody's any more; returns at once."""
        with self._closing:
            if not self._closed:
                self._closed = True
                os.close(self.descriptor)
                os.close(self._ring)
        self._room.release()

    def _tell(self) -> None:
        with self._closing:
            if not self._closed:
                os.write(self._ring, b"\0")
