"""Code that sends events and keep-alive messages to subscribed clients.

A cancel may end thousands of goals. Therefore, events are sent no faster than clients read them.
"""

from __future__ import annotations

import asyncio
from collections import deque
from itertools import chain, count
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.frozen import replace
from talkcli.goals.goal import By
from talkcli.goals.states import State
from talkcli.protocol.events import (
    GoalInterrupted,
    PausedChanged,
    Result,
    StateChanged,
    TextAdded,
    TextMissing,
    WordHeard,
)
from talkcli.protocol.lines import encode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from talkcli.engine.protocol import Word
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.record import Record
    from talkcli.server.connection import ClientConnection, PendingRequest
    from talkcli.server.stream import ClientStreams

#: Interval between keep-alive messages. Clients consider a server dead if three of them are missing.
CLIENT_ALIVE_INTERVAL_S = 5.0

#: Maximum number of notifications to process in one iteration of the event loop. They take three milliseconds.
_MAX_CALLS_PER_TURN = 64
#: If one iteration adds more unread output than this, the server waits for clients to read.
_UNREAD_LIMIT_BYTES = 1024 * 1024
#: Maximum time to wait for clients to read.
_READ_TIME_S = 0.05
#: How often to check whether clients have read their output.
_READ_CHECK_S = 0.002
#: Factor that shortens the wait each time clients don't read. All waits add up to 0.8 s, so that a cancel is
#: answered within 2 s even if no client reads.
_READ_TIME_FACTOR = 0.94


class Subscribers:
    """The connections that receive events."""

    def __init__(self, waiting_for_room: Callable[[], Iterable[ClientConnection]]) -> None:
        """Start with no subscribers.

        Args:
            waiting_for_room: function that returns the connections whose goals or texts wait for room. They also get
                keep-alive messages.
        """
        self._loop = asyncio.get_running_loop()
        self._waiting_for_room = waiting_for_room
        #: event numbers, which let watchers detect dropped feedback
        self._numbers = count(1)
        #: the connections that wait for each goal, and whether they want feedback
        self._waiters: dict[str, dict[ClientConnection, bool]] = {}
        self._watchers: dict[ClientConnection, None] = {}
        self._alive_timer: asyncio.TimerHandle | None = None

    def subscribe_to_goal(self, goal_id: str, connection: ClientConnection, *, feedback: bool = False) -> None:
        """Subscribe a connection to a goal's states and result, and optionally its words."""
        waiting = self._waiters.setdefault(goal_id, {})
        waiting[connection] = waiting.get(connection, False) or feedback
        self.schedule_keep_alive()

    def watch(self, connection: ClientConnection) -> None:
        """Subscribe a connection to all events."""
        self._watchers[connection] = None
        self.schedule_keep_alive()

    def is_subscribed(self, connection: ClientConnection) -> bool:
        """Return whether a connection is subscribed to any events."""
        return connection in self._watchers or any(connection in each for each in self._waiters.values())

    def left(self, connection: ClientConnection) -> None:
        """Unsubscribe a connection that was closed."""
        self._watchers.pop(connection, None)
        for waiting in self._waiters.values():
            waiting.pop(connection, None)

    def state_changed(self, record: Record, state: State, at: float) -> None:
        """Publish a goal's new state. If the goal has ended, send the result and end the subscriptions to it."""
        event = StateChanged(record.id, state, at, next(self._numbers))
        if self._watchers:
            # The first and the last event of a goal contain the whole goal.
            whole = record.snapshot(state) if state is State.PENDING or state.terminal else None
            _publish(replace(event, goal=whole).to_json(), self._watchers)
        if not state.terminal:
            _publish(event.to_json(), self._waiters.get(record.id, ()))
        elif record.id in self._waiters:
            # Encode the lines only once, because a thousand clients may be waiting for the goal.
            lines = encode(event.to_json()) + encode(Result(record.snapshot()).to_json())
            for connection in self._waiters.pop(record.id):
                connection.publish(lines)

    def word_heard(self, word: Word, text: str, at: float) -> None:
        """Send a word that is being spoken to the clients that want feedback.

        Args:
            word: the engine's event.
            text: the word as it is written in the goal's text.
            at: the time, in seconds since 1970 UTC.
        """
        event = WordHeard(word.id, text, word.start, word.end, word.number, word.time, at, next(self._numbers))
        _publish(event.to_json(), self._feedback_receivers([self._waiters.get(word.id, {})]), feedback=True)

    def text_added(self, goal_id: str, start: int, text: str, at: float) -> None:
        """Tell watching clients that a goal's text has grown.

        The new text begins at the offset `start`.
        """
        if self._watchers:
            _publish(TextAdded(goal_id, start, text, at, next(self._numbers)).to_json(), self._watchers)

    def text_missing(self, goal_id: str, at: float, *, waits: bool) -> None:
        """Tell clients that want feedback whether a goal waits for text."""
        event = TextMissing(goal_id, waits, at, next(self._numbers))
        _publish(event.to_json(), self._feedback_receivers([self._waiters.get(goal_id, {})]))

    def interrupted(self, goal_id: str, interrupted_by: str, at: float) -> None:
        """Tell the clients that watch or wait for a goal about the goal that interrupts it."""
        event = GoalInterrupted(goal_id, By(goal=interrupted_by), at, next(self._numbers))
        _publish(event.to_json(), dict.fromkeys(chain(self._watchers, self._waiters.get(goal_id, ()))))

    def paused_changed(self, goal_id: str | None, *, paused: bool, by: By, at: float) -> None:
        """Send a pause or resume event to the clients that want feedback.

        `goal_id` is the id of the affected goal, if any.
        """
        event = PausedChanged(paused, goal_id, by, at, next(self._numbers))
        _publish(event.to_json(), self._feedback_receivers(self._waiters.values()))

    def schedule_keep_alive(self) -> None:
        """Schedule the next keep-alive messages, unless they are already scheduled."""
        if self._alive_timer is None:
            self._alive_timer = self._loop.call_later(CLIENT_ALIVE_INTERVAL_S, self._send_alive)

    def _feedback_receivers(self, waiters: Iterable[dict[ClientConnection, bool]]) -> dict[ClientConnection, None]:
        """Return all watching connections, and the waiting connections that want feedback."""
        listeners = dict(self._watchers)
        for each in waiters:
            listeners.update((connection, None) for connection, feedback in each.items() if feedback)
        return listeners

    def _send_alive(self) -> None:
        """Send a keep-alive message to all clients that watch or wait, and schedule the next one."""
        self._alive_timer = None
        listeners = dict.fromkeys(chain(self._watchers, self._waiting_for_room(), *self._waiters.values()))
        _publish({"event": "alive"}, listeners)
        if listeners:
            self.schedule_keep_alive()


def _publish(event: JsonObject, connections: Iterable[ClientConnection], *, feedback: bool = False) -> None:
    """Encode an event once, and send it to several connections.

    Feedback may be dropped for slow clients.
    """
    receivers = list(connections)
    line = encode(event) if receivers else b""  # usually, there are no receivers
    for connection in receivers:
        connection.publish(line, feedback=feedback)


class Notifications:
    """A queue of functions that notify clients.

    Usually, the functions are called immediately. If there are many, only some are called in each iteration of the
    event loop, so that the server can do other work and the clients have time to read.
    """

    def __init__(self, streams: ClientStreams) -> None:
        self._loop = streams.loop
        self._streams = streams
        self._pending: deque[Callable[[], None]] = deque()
        self._working = False
        self._next_call: asyncio.Handle | None = None
        self._read_time_s = _READ_TIME_S
        #: called when the queue has become empty
        self.on_done: Callable[[], None] = lambda: None

    @property
    def done(self) -> bool:
        """Whether the queue is empty."""
        return not self._pending

    def add(self, notifications: Iterable[Callable[[], None]]) -> None:
        """Queue functions, and start calling them.

        If a called function adds more, those are called at once.
        """
        if self._working:
            for each in notifications:
                self._call(each)
            return
        self._pending.extend(notifications)
        if self._next_call is None:
            self._work(self._streams.unread_bytes)

    async def wait_done(self, request: PendingRequest) -> None:
        """Let a request wait until the functions in the queue have been called."""
        if self._pending:
            self._pending.append(request.resume)
            await request.wait({})

    def _work(self, unread_before: int) -> None:
        """Call some of the queued functions, and schedule a call for the rest.

        Args:
            unread_before: the size of the unread output before the first call.
        """
        self._next_call = None
        self._working = True
        for _ in range(min(_MAX_CALLS_PER_TURN, len(self._pending))):
            self._call(self._pending.popleft())
            if self._streams.unread_bytes > unread_before + _UNREAD_LIMIT_BYTES:
                break
        self._working = False
        if not self._pending:
            self._read_time_s = _READ_TIME_S
            self.on_done()
        elif self._streams.unread_bytes > unread_before + _UNREAD_LIMIT_BYTES:
            until = self._loop.time() + self._read_time_s
            self._next_call = self._loop.call_later(_READ_CHECK_S, self._await_readers, unread_before, until)
        else:
            self._next_call = self._loop.call_soon(self._work, min(unread_before, self._streams.unread_bytes))

    def _await_readers(self, unread_before: int, until: float) -> None:
        """Continue `_work` once the unread output is down to `unread_before` bytes, or at `until`."""
        if self._streams.unread_bytes <= unread_before:
            self._work(unread_before)
        elif self._loop.time() < until:
            self._next_call = self._loop.call_later(_READ_CHECK_S, self._await_readers, unread_before, until)
        else:
            self._read_time_s *= _READ_TIME_FACTOR
            self._work(self._streams.unread_bytes)

    def _call(self, notification: Callable[[], None]) -> None:
        """Call a function. Log an exception instead of raising it."""
        try:
            notification()
        except Exception as error:  # noqa: BLE001 - the other functions must still be called
            log.write_bug("a notification", error)
