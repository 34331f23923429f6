"""Goal handles, and the merged events of several goals.

`GoalCalls` is the part of a handle that the blocking and the asyncio client share. `GoalHandle` is the blocking handle.
A handle needs a connection, but no client. The connection delivers the events of all handles while any thread waits for
one of them. A handle changes only while the connection's lock is held, and never after its goal has ended.
"""

from __future__ import annotations

import time

from talkcli.client.connection import event_reader
from talkcli.client.core import TrackedGoal
from talkcli.errors import TalkError, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.options import Cancel
from talkcli.goals.states import State
from talkcli.polling import run_blocking
from talkcli.protocol.events import Canceled, PausedChanged, Result, WordHeard, goals
from talkcli.protocol.requests import Status, Wait

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence

    from talkcli.client.connection import Connection
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event


class GoalCalls(TrackedGoal):
    """The base class of goal handles. The methods that wait are coroutines."""

    def __init__(self, connection: Connection, goal: Goal) -> None:
        super().__init__(goal)
        self._connection = connection
        #: whether the Result has been returned to the caller
        self._result_taken = False

    @property
    def id(self) -> str:
        """The goal's id, which is empty if the goal was REJECTED before it got an id."""
        return self.goal.id

    @property
    def state(self) -> State:
        """The goal's last known state.

        Calls that read from the server update it, for example `wait` and `poll`.
        """
        return self.goal.state

    def poll(self) -> Event | None:
        """Read from the server without blocking. Return the goal's next event, if any.

        The Result is the last event. Call this method regularly, because each call also receives the events of other
        goals, and sends the rest of earlier requests.

        Raises:
            UsageError: the goal was sent with `follow=False`, and neither `wait` nor `events` has been called.
        """
        if self._followed_at is None and not self.state.terminal:
            raise UsageError(
                f"goal {self.id} was sent with follow=False; to get the goal's events, leave out follow=False"
            )
        since = None if self.state.terminal else self._followed_at
        self._connection.wait_until(lambda: False, time.monotonic(), since=since, interruptible=False)
        if not self._has_event():
            self._lose_if_disconnected()
        with self._connection.changed:
            event = self._take()
            if isinstance(event, Result):
                event, self._result_taken = None if self._result_taken else event, True
        return event

    def request_cancel(self) -> None:
        """Ask the server to cancel the goal, without waiting for the answer.

        Use `wait` or `poll` to find out how the goal ends.

        Raises:
            ServerUnavailable: the client is closed, or 256 KiB of requests are waiting to be sent.
        """
        if self.id and (not self.state.terminal or self.state is State.LOST):
            failures: list[TalkError] = []
            self._connection.submit(Cancel((self.id,)), lambda *_: None, failures.append)
            # If the buffer is empty, the connection has broken, which is not an error here.
            if failures and self._connection.unsent_bytes:
                raise failures[0]

    # -- internal

    async def _wait(self, timeout: float | None) -> Goal:
        """Wait until the goal has ended, and return it. Raise TimeoutError if `timeout` expires first."""
        end = end_time(timeout)
        await self._follow(feedback=False)
        if not await self._connection.until(lambda: self.state.terminal, end):
            self._give_up(timeout)
        return self.goal

    async def _read_event(self, read: Callable[[], Awaitable[Event | None]], timeout: float | None) -> Event:
        """Return the goal's next event. Raise TimeoutError if the deadline of `read` has passed."""
        while (event := await read()) is None:
            self._give_up(timeout)
        if isinstance(event, Result):
            self._result_taken = True
        return event

    async def _cancel(self) -> Goal:
        """Cancel the goal, and wait until it has stopped. Return the goal."""
        if not self.state.terminal:
            found = Canceled.from_items((await self._connection.request(Cancel((self.id,))))[1])
            goal = next((each for each in (*found.canceled, *found.ended) if each.id == self.id), None)
            goal = goal or Goal.from_json((await self._connection.request(Status(self.id)))[0].get("goal"))
            with self._connection.changed:
                self._update(goal)
        return self.goal

    def _listen(self, *, feedback: bool) -> None:
        """Register this handle to receive the goal's events, optionally with words.

        The caller must hold the connection's lock.
        """
        self._listen_to(self._connection.listeners, feedback=feedback, followed_at=time.monotonic())

    async def _follow(self, *, feedback: bool) -> None:
        """Ask the server for the goal's events, unless it already sends them."""
        if self.state.terminal or (self._followed_at is not None and (self._with_feedback or not feedback)):
            return

        def accepted(_: JsonObject, items: list[JsonObject]) -> None:
            self._update(next(goals(items, "goal")))
            self._listen(feedback=feedback)

        await self._connection.request(Wait((self.id,), feedback), accepted)

    def _give_up(self, timeout: float | None) -> None:
        """End the goal as LOST if the connection has ended. Otherwise, raise TimeoutError."""
        if not self._lose_if_disconnected():
            raise TimeoutError(f"goal {self.id} has not ended after {0 if timeout is None else round(timeout, 1):g} s")

    def _lose_if_disconnected(self) -> bool:
        """End the goal as LOST if the connection has ended. Return whether it has."""
        ended = self._connection.ended
        if ended is not None:
            with self._connection.changed:
                self._mark_lost(f"{ended}; the sentence may still be spoken")
        return ended is not None


class GoalHandle(GoalCalls):
    """A handle for following and cancelling a goal.

    Any number of threads may use it. Events are buffered until they are read. If there are more than 5,000 words and
    pauses, the oldest are dropped. `events`, `feedback` and `poll` read from the same buffer, so each event is returned
    only once. A new loop continues where an interrupted one stopped. Each thread needs an iterator of its own.
    """

    def wait(self, timeout: float | None = None) -> Goal:
        """Wait until the goal has ended, and return it. Raise TimeoutError if `timeout` expires first.

        If the goal can no longer be followed, for example because the server was restarted, the goal ends as LOST. It
        may or may not have been spoken.

        Args:
            timeout: time limit in seconds; None for no limit.

        Raises:
            TimeoutError: the goal has not ended in this time. The goal itself is not affected.
        """
        return run_blocking(self._wait(timeout))

    def events(self, timeout: float | None = None) -> Iterator[Event]:
        """Iterate over the goal's events as they happen. The last event is the Result.

        There is a StateChanged for each state. If another goal interrupts this one, there is a GoalInterrupted, and a
        StateChanged to ACTIVE when this one continues.

        If the goal was sent or followed with `feedback`, there is also a WordHeard for each word as it is heard, and a
        PausedChanged whenever speech is paused or resumed. If the goal can no longer be followed, for example because
        the server was restarted, the goal ends as LOST.

        Args:
            timeout: seconds in which the goal must end, counted from this call; None for no limit.

        Raises:
            TimeoutError: the goal has not ended in this time.
        """
        end = end_time(timeout)
        run_blocking(self._follow(feedback=False))
        return self._iterate_events(end, timeout)

    def feedback(self, timeout: float | None = None) -> Iterator[WordHeard]:
        """Iterate over the goal's words as they are heard, until the goal has ended.

        If the goal was sent without `feedback`, only words that are heard after this call are yielded.

        Args:
            timeout: seconds in which the goal must end, counted from this call; None for no limit.

        Raises:
            TimeoutError: the goal has not ended in this time.
        """
        end = end_time(timeout)
        run_blocking(self._follow(feedback=True))
        return (each for each in self._iterate_events(end, timeout) if isinstance(each, WordHeard))

    def cancel(self) -> Goal:
        """Cancel the goal, and wait until it has stopped. Return the goal.

        Raises:
            UnknownGoal: the server doesn't know the goal, for example because the server was restarted.
            ServerUnavailable: the server can't be reached.
            Lost: the server didn't answer. The goal may have been cancelled.
        """
        return run_blocking(self._cancel())

    def _iterate_events(self, deadline: float | None, timeout: float | None) -> Iterator[Event]:
        """Yield the goal's events up to the Result. After `deadline`, raise a TimeoutError that names `timeout`."""
        read, event = event_reader(self._connection, self._take, deadline), None
        while not isinstance(event, Result):
            event = run_blocking(self._read_event(read, timeout))
            yield event


def merged(handles: Sequence[GoalHandle], timeout: float | None = None) -> Iterator[tuple[GoalHandle, Event]]:
    """Yield each event of several goals with its goal's handle, until all goals have ended.

    The last event of each goal is its Result. A pause of all speech is yielded only once. If the connection ends, the
    remaining goals end as LOST.

    Args:
        handles: the goals, which must use the same connection.
        timeout: seconds in which all goals must end; None for no limit.

    Yields:
        The handle of a goal, and an event of this goal.

    Raises:
        TimeoutError: some goals have not ended in this time.
    """
    stream = _EventStream(handles)
    if not handles:
        return
    read = event_reader(handles[0]._connection, stream.take, end_time(timeout))
    while stream.unfinished:
        found = run_blocking(read())
        if not found:
            for each in stream.unfinished:
                each._give_up(timeout)
        yield from found


class _EventStream:
    """The merged events of several goals, in the server's order."""

    def __init__(self, handles: Sequence[GoalHandle]) -> None:
        #: the unfinished goals, without duplicates
        self.unfinished = list({each.id: each for each in handles}.values())
        #: the number of each goal's last event
        self._last_numbers: dict[str, int] = {}
        #: the number of the last pause. Every goal receives the pause, but only the first event is yielded.
        self._last_pause = 0

    def take(self) -> list[tuple[GoalHandle, Event]]:
        """Remove and return the new events of all goals, in the server's order.

        The caller must hold the connection's lock.
        """
        found: list[tuple[int, GoalHandle, Event]] = []
        for handle in self.unfinished:
            event: Event | None = None
            while not isinstance(event, Result) and (event := handle._take()):
                # A Result has no number, and is sorted by the number of its goal's last event. It stays after this
                # event, because sorting is stable.
                number = getattr(event, "n", None) or self._last_numbers.get(handle.id, 0)
                self._last_numbers[handle.id] = number
                found.append((number, handle, event))
        self.unfinished = [each for each in self.unfinished if not each.state.terminal]
        merged_events = []
        for number, handle, event in sorted(found, key=lambda each: each[0]):
            if isinstance(event, PausedChanged):
                if number <= self._last_pause:
                    continue
                self._last_pause = number
            merged_events.append((handle, event))
        return merged_events


def end_time(timeout: float | None) -> float | None:
    """Return the monotonic time at which a timeout expires."""
    return None if timeout is None else time.monotonic() + timeout
