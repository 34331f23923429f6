"""What happens to several goals, as one stream in the server's order. `GoalHandle.events` is that of a single goal.

It waits, as a handle does, on their connection; it prints nothing and cancels nothing.
"""

from __future__ import annotations

import time

from talkcli.client.connection import SILENCE_LIMIT
from talkcli.frozen import TYPE_CHECKING
from talkcli.protocol.events import PausedChanged, Result, StateChanged, WordHeard

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from talkcli.client.goal import GoalHandle
    from talkcli.protocol.events import Event


def merged(handles: Sequence[GoalHandle], timeout: float | None = None) -> Iterator[tuple[GoalHandle, Event]]:
    """Iterate over what happens to these goals of one connection, each event with its goal, until all have ended.

    Each goal's last is its Result. That speech is held, which all of them hear, comes once. TimeoutError where they
    have not all ended `timeout` seconds after the first step; where the server goes away, the rest are LOST.
    """
    end = None if timeout is None else time.monotonic() + timeout
    stream = _Stream(handles)
    late = False
    while stream.going:
        connection = stream.going[0]._connection
        if late:  # what had arrived by the deadline counts, nothing after it
            with connection.changed:
                found = stream.arrived()
        else:
            found = connection.wait_until(stream.arrived, lambda: end, SILENCE_LIMIT)
            late = end is not None and time.monotonic() >= end
        if not found:
            for each in stream.going:
                each._give_up(timeout)
            with connection.changed:
                stream.arrived()
        yield from stream.take()


class _Stream:
    """Events taken from the handles and not yet handed out."""

    def __init__(self, handles: Sequence[GoalHandle]) -> None:
        #: goals whose Result was not found yet, each once, whoever named it twice
        self.going = list({each.id: each for each in handles}.values())
        #: the number of the last event, by the goal's id: its Result follows that
        self._last = dict.fromkeys((each.id for each in self.going), 0)
        self._found: list[tuple[int, GoalHandle, Event]] = []
        self._paused_at: int | None = None

    def arrived(self) -> bool:
        """Take what has come for all of them, and tell whether there is something; under the connection's lock."""
        for handle in self.going:
            while (event := handle._buffer.take()) is not None:
                self._add(handle, event)
            if handle.state.terminal:
                self._found.append((self._last[handle.id], handle, Result(handle.goal)))
        self.going = [each for each in self.going if not each.state.terminal]
        return bool(self._found)

    def take(self) -> list[tuple[GoalHandle, Event]]:
        """Return what was found, in the server's order."""
        # A stable sort: a Result has the number of its goal's last event, and was found after that.
        found = sorted(self._found, key=lambda each: each[0])
        self._found = []
        return [(handle, event) for _, handle, event in found]

    def _add(self, handle: GoalHandle, event: Event) -> None:
        number = event.n if isinstance(event, StateChanged | WordHeard | PausedChanged) else None
        if isinstance(event, PausedChanged):
            if number is not None and number == self._paused_at:
                return
            self._paused_at = number
        if number is not None:
            self._last[handle.id] = number
        self._found.append((self._last[handle.id], handle, event))
