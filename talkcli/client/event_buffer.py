"""Events that were read and that nobody has taken yet: bounded, in their order. No I/O, no locks of its own."""

from __future__ import annotations

from collections import deque

from talkcli.frozen import TYPE_CHECKING
from talkcli.protocol.events import PausedChanged, StateChanged, WordHeard

if TYPE_CHECKING:
    from talkcli.protocol.events import Event

#: Words and pauses kept for whoever takes them late, the newest: the longest text, 10,000 characters, has no more
#: words, so that those of one goal are all there after its end.
MAX_FEEDBACK = 5_000
#: States kept for whoever watches all goals, and doesn't take them while others read on the same connection: those of
#: some 3,000 goals. None is dropped: past this, watching ends.
MAX_STATES = 10_000


class EventBuffer:
    """What waits for one reader. Its users hold a lock of theirs."""

    __slots__ = ("__weakref__", "_count", "_feedback", "_last", "_states", "overrun")

    def __init__(self) -> None:
        # Each with its number in the order of arrival; two queues, so that the oldest feedback is dropped in no time.
        self._states: deque[tuple[int, Event]] = deque()
        self._feedback: deque[tuple[int, Event]] = deque(maxlen=MAX_FEEDBACK)
        self._count = 0
        self._last: int | None = None
        #: whether a state came that there was no room for: nothing that came after it is here
        self.overrun = False

    def add(self, event: Event) -> None:
        """Keep an event. One that comes twice, to a connection that waits for a goal and watches all, is kept once."""
        if isinstance(event, StateChanged | WordHeard | PausedChanged):
            if event.n is not None and event.n == self._last:
                return
            self._last = event.n
        if self.overrun:
            return
        self._count += 1
        if isinstance(event, WordHeard | PausedChanged):
            self._feedback.append((self._count, event))
        elif len(self._states) < MAX_STATES:
            self._states.append((self._count, event))
        else:
            self.overrun = True

    def take(self) -> Event | None:
        """Take the oldest event; None if there is none."""
        if not (self._states or self._feedback):
            return None
        if not self._feedback or (self._states and self._states[0][0] < self._feedback[0][0]):
            return self._states.popleft()[1]
        return self._feedback.popleft()[1]
