"""What other threads want done in a thread that waits for descriptors: actions, and one descriptor that wakes it.

It knows nothing of what the actions do. `call` is for other threads, the rest for the one that waits.
"""

from __future__ import annotations

import os
import selectors
import threading
import time
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

NEVER = float("inf")


class Inbox:
    """Actions in the order in which they came, and the descriptors that the thread waits for besides."""

    def __init__(self, doze: float) -> None:
        """`doze`: the seconds that the thread sleeps at most after it had something to do, before it sleeps on.

        What is left for it meanwhile, and may wait for as long, need not wake it.
        """
        self.selector = selectors.DefaultSelector()
        self._actions: deque[Callable[[], None]] = deque()
        self._closed = False
        #: held while an action is left, so that the descriptor that wakes is not closed meanwhile, and another's then
        self._entering = threading.Lock()
        #: whether a wake-up is on its way: it does for all that comes until it is seen
        self._woken = False
        #: the monotonic time until which the thread sleeps if nothing wakes it; 0 while it is awake
        self._sleeps_until = 0.0
        self._doze = doze
        self._dozes_until = 0.0
        self._descriptor, self._wake = os.pipe()
        os.set_blocking(self._descriptor, False)
        os.set_blocking(self._wake, False)
        self.selector.register(self._descriptor, selectors.EVENT_READ)

    def call(self, action: Callable[[], None], by: float = 0.0) -> None:
        """Have the action done by the thread that waits; from any thread. Nothing happens once it is closed.

        `by`: the monotonic time up to which it may lie until the thread wakes for another reason. To wake a thread, and
        to have it take the interpreter from the one that runs, costs some 50 µs: as much as a hundred lines.
        """
        with self._entering:
            if self._closed:
                return
            self._actions.append(action)
            # In this order; `wait` looks in the opposite one. So either this sees that it sleeps, or that sees the
            # action.
            if self._sleeps_until > by and not self._woken:
                self._woken = True
                os.write(self._wake, b"\0")

    def wait(self, until: float) -> list[selectors.SelectorKey]:
        """Wait for a descriptor or an action, at most until this monotonic time; do the actions, return the keys."""
        now = time.monotonic()
        if now < self._dozes_until < until:
            until = self._dozes_until
        self._sleeps_until = until
        seconds = 0.0 if self._actions else max(0.0, until - now)
        ready = [key for key, _ in self.selector.select(None if seconds == NEVER else seconds)]
        self._sleeps_until = 0.0
        if ready:
            self._dozes_until = time.monotonic() + self._doze
        if any(key.fd == self._descriptor for key in ready):
            os.read(self._descriptor, 4096)
            # Before it looks at what waits: what comes after that finds it so, and wakes the thread again.
            self._woken = False
        self.run()
        return [key for key in ready if key.fd != self._descriptor]

    def run(self) -> None:
        """Do what waits."""
        while self._actions:
            self._actions.popleft()()

    def close(self) -> None:
        """Take no more actions, and close the descriptors, of others' none."""
        with self._entering:  # no thread is in between
            self._closed = True
        self.selector.close()
        os.close(self._descriptor)
        os.close(self._wake)
