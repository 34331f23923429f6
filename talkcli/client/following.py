"""Who is told what of the events that come in, and what waits for who takes them late: bounded, in its order.

No I/O, no locks of its own: whoever uses it holds the connection's.
"""

from __future__ import annotations

from _weakrefset import WeakSet  # as `threading` has it: the rest of `weakref` takes longer to import
from collections import deque

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State
from talkcli.protocol import events
from talkcli.protocol.events import PausedChanged, Result, Snapshot, StateChanged, WordHeard

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event

#: Words and pauses kept for whoever takes them late, the newest: the longest text, 10,000 characters, has no more
#: words, so that those of one goal are all there after its end.
MAX_FEEDBACK = 5_000
#: States kept for whoever watches all goals, and doesn't take them while others read on the same connection: those of
#: some 3,000 goals. None is dropped: past this, watching ends.
MAX_STATES = 10_000


@frozen
class Gone:
    """Nothing more will be heard of a goal, though the connection goes on: the server has forgotten it."""

    #: why, for people
    why: str


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
        number = getattr(event, "n", None)
        if number is not None and number == self._last:
            return
        self._last = number
        if self.overrun:
            return
        self._count += 1
        if isinstance(event, WordHeard | PausedChanged):
            self._feedback.append((self._count, event))
        elif len(self._states) < MAX_STATES:
            self._states.append((self._count, event))
        else:
            self.overrun = True

    def __len__(self) -> int:
        return len(self._states) + len(self._feedback)

    def take(self) -> Event | None:
        """Take the oldest event; None if there is none."""
        waiting = [each for each in (self._states, self._feedback) if each]
        return min(waiting, key=lambda each: each[0][0]).popleft()[1] if waiting else None


class Followed:
    """Who is told what of the events that come in: of one goal, of all speech, of everything. Used under one lock."""

    def __init__(self) -> None:
        self._goals: dict[str, list[Callable[[Event | Gone], None]]] = {}
        #: a watch ends when nobody holds its iterator any more
        self._watches: WeakSet[EventBuffer] = WeakSet()

    def add(self, goal_id: str, hear: Callable[[Event | Gone], None]) -> None:
        """Tell of a goal, and of speech that is held or goes on, until its Result, or Gone: its last."""
        self._goals.setdefault(goal_id, []).append(hear)

    def watch(self, buffer: EventBuffer) -> None:
        """Put everything that happens into this buffer, as long as somebody holds it."""
        self._watches.add(buffer)

    @property
    def watched(self) -> bool:
        """Whether anybody watches everything."""
        return bool(self._watches)

    def lose(self, goal_id: str, why: str) -> None:
        """Tell those who follow a goal that nothing more will be heard of it."""
        for hear in self._goals.pop(goal_id, ()):
            hear(Gone(why))

    def hear(self, message: JsonObject) -> None:
        """Hand on an event; ValueError where it is none."""
        event = events.from_json(message)
        if isinstance(event, Result):
            for hear in self._goals.pop(event.goal.id, ()):
                hear(event)
        elif isinstance(event, Snapshot):  # what was watched before is watched anew
            for buffer in self._watches:
                buffer.add(event)
        elif isinstance(event, StateChanged | WordHeard | PausedChanged):
            if isinstance(event, PausedChanged):
                hearing = [hear for each in self._goals.values() for hear in each]
            else:
                hearing = self._goals.get(event.id, [])
            for hear in hearing:
                hear(event)
            state = event.state if isinstance(event, StateChanged) and not event.goal else None
            if state is State.PENDING or (state and state.terminal):
                return  # it comes twice: with the whole goal to those who watch
            for buffer in self._watches:
                buffer.add(event)
