"""What other threads want done in a thread that waits for descriptors: actions, and one descriptor that wakes it.

It knows nothing of what the actions do. Only `call` is for other threads.
"""

from __future__ import annotations

import contextlib
import os
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Inbox:
    """Actions in the order in which they came."""

    def __init__(self) -> None:
        self._actions: deque[Callable[[], None]] = deque()
        self._closed = False
        #: readable while there is something to do
        self.descriptor, self._wake = os.pipe()
        os.set_blocking(self.descriptor, False)
        os.set_blocking(self._wake, False)

    def call(self, action: Callable[[], None]) -> None:
        """Have the action done by the thread that waits; from any thread. Nothing happens once it is closed."""
        if self._closed:
            return
        self._actions.append(action)
        # Where the pipe is full, a wake-up that was not seen yet does for this one, too.
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake, b"\0")

    def run(self) -> None:
        """Do what waits; where the descriptor is readable."""
        os.read(self.descriptor, 4096)
        while self._actions:
            self._actions.popleft()()

    def refuse(self) -> None:
        """Take no more actions; before `close`, so that no thread is in between."""
        self._closed = True

    def close(self) -> None:
        """Close the descriptors."""
        os.close(self.descriptor)
        os.close(self._wake)
