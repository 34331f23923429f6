"""A goal that was sent, or is followed: its state, its events as they come, its end. Of several, one stream of them.

It needs a connection, and knows no client. It reads nothing by itself: whoever waits on the connection reads for all,
and what is for this goal comes to `_hear`. Whatever changes a handle does so under the connection's lock, and never
after the goal has ended.
"""

from __future__ import annotations

import time

from talkcli.client.connection import taken
from talkcli.client.following import EventBuffer, Gone
from talkcli.errors import UsageError
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.goal import Goal
from talkcli.goals.options import Cancel
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, PausedChanged, Result, StateChanged, WordHeard, goals
from talkcli.protocol.requests import Status, Wait

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from talkcli.client.connection import Connection
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event


class GoalHandle:
    """A goal that was sent, or is followed. Any number of threads may use it.

    Its events are kept until somebody takes them, the last 5,000 words of them: `events`, `feedback` and `poll` take
    from the same store, each event is handed out once, and who breaks off and calls again goes on where it was. An
    iterator is for one thread; another calls for its own.
    """

    def __init__(self, connection: Connection, goal: Goal) -> None:
        self._connection = connection
        #: the goal as it was last heard of
        self.goal = goal
        #: whether another `say` had sent this goal before, with the same id: this one only watches
        self.attached = False
        #: whether the server holds all speech, as far as it was heard of: nothing is spoken until somebody resumes
        self.speech_paused = False
        #: since when the server tells this connection how it ends, by the monotonic clock; None where it doesn't
        self._followed_at: float | None = None
        #: whether it tells each word, too
        self._fed = False
        self._buffer = EventBuffer()
        #: whether its Result has been handed out
        self._told = False

    @property
    def id(self) -> str:
        """The goal's id; empty where the goal was REJECTED before it was sent."""
        return self.goal.id

    @property
    def state(self) -> State:
        """The goal's state as far as it was read: `wait`, or any other call of the client, reads on."""
        return self.goal.state

    def wait(self, timeout: float | None = None) -> Goal:
        """Wait until the goal has ended, and return it; TimeoutError after `timeout` seconds.

        Where the server goes away first, the goal's state is LOST: it may have been spoken or not.
        """
        end = _end(timeout)
        self._follow(feedback=False)
        if not self._connection.wait_until(lambda: self.state.terminal, end):
            self._give_up(timeout)
        return self.goal

    def events(self, timeout: float | None = None) -> Iterator[Event]:
        """Iterate over what happens to the goal, as it happens; the last item is its Result.

        StateChanged for each state; and if it was sent or followed with `feedback`, WordHeard for each word as it is
        heard, and PausedChanged where speech is held or goes on.

        TimeoutError where the goal has not ended `timeout` seconds after this call. Where the server goes away first,
        the Result is a goal that is LOST, as with `wait`.
        """
        end = _end(timeout)
        self._follow(feedback=False)
        return self._events(end, timeout)

    def feedback(self, timeout: float | None = None) -> Iterator[WordHeard]:
        """Iterate over the goal's words as they are heard, until it has ended; TimeoutError as with `events`.

        A goal that was sent without `feedback` gives those heard from this call on.
        """
        end = _end(timeout)
        self._follow(feedback=True)
        return (each for each in self._events(end, timeout) if isinstance(each, WordHeard))

    def poll(self) -> Event | None:
        """Return the next event that has come, as `events` has them, else None; the last is the Result. Never waits.

        For a loop that must not: it reads what the server has said meanwhile, so it has to be called again and again.
        UsageError for a goal that was sent with `follow=False`, of which nothing comes until `wait` or `events` asks.
        """
        if self._followed_at is None and not self.state.terminal:
            raise UsageError(f"nothing is heard of {self.id}, which was sent with follow=False: leave that out")
        now, since = time.monotonic(), self._followed_at
        if not self._connection.wait_until(self._has_next, now, since=since, interruptible=False):
            self._lose()
        with self._connection.changed:
            event = self._next()
            if isinstance(event, Result):
                event, self._told = None if self._told else event, True
        return event

    def request_cancel(self) -> None:
        """Ask for the goal to be cancelled, without waiting for it: `wait` tells how it ended."""
        if self.id:
            self._connection.post(Cancel((self.id,)))

    def cancel(self) -> Goal:
        """Cancel the goal, and return it once it has ended: silent, if it was being spoken."""
        if not self.state.terminal:
            found = Canceled.from_items(self._connection.request(Cancel((self.id,)))[1])
            goal = next((each for each in (*found.canceled, *found.ended) if each.id == self.id), None)
            self._settle(goal or Goal.from_json(self._connection.request(Status(self.id))[0].get("goal")))
        return self.goal

    # -- inside

    def _listen(self, *, feedback: bool) -> None:
        """Hear of the goal from now on, which the server tells this connection of; under the connection's lock."""
        self._fed = self._fed or feedback
        if self._followed_at is None:
            self._followed_at = time.monotonic()
            if not self.state.terminal:
                self._connection.followed.add(self.id, self._hear)

    def _hear(self, event: Event | Gone) -> None:
        """Take up an event of this goal, or of all speech."""
        if self.state.terminal:
            return
        if isinstance(event, Gone):
            self.goal = _lost(self.goal, event.why)
        elif isinstance(event, Result):
            self.goal = event.goal
        elif isinstance(event, StateChanged):
            # Its end comes with the result, which says how and why.
            if not event.state.terminal:
                self.goal = replace(self.goal, state=event.state)
            self._buffer.add(event)
        else:
            if isinstance(event, PausedChanged):
                self.speech_paused = event.paused
                held = event.paused and event.id == self.id and self.state is State.ACTIVE
                self.goal = replace(self.goal, paused=held)
            if self._fed:
                self._buffer.add(event)

    def _settle(self, goal: Goal) -> None:
        """Take up what the server says of the goal now, unless it is known to have ended."""
        with self._connection.changed:
            if not self.state.terminal:
                self.goal = goal

    def _events(self, end: float | None, timeout: float | None) -> Iterator[Event]:
        for event in taken(self._connection, self._next, end):
            if event is None:
                self._give_up(timeout)
            elif isinstance(event, Result):
                self._told = True
                yield event
                return
            else:
                yield event

    def _has_next(self) -> bool:
        return self.state.terminal or bool(self._buffer)

    def _next(self) -> Event | None:
        """Take the next event, the Result where there is no other; under the connection's lock."""
        return self._buffer.take() or (Result(self.goal) if self.state.terminal else None)

    def _follow(self, *, feedback: bool) -> None:
        """Have this connection told of the goal, if it isn't yet."""
        if self.state.terminal or (self._followed_at is not None and (self._fed or not feedback)):
            return

        def accepted(_: JsonObject, items: list[JsonObject]) -> None:
            self._settle(next(goals(items, "goal")))
            self._listen(feedback=feedback)

        self._connection.request(Wait((self.id,), feedback), accepted)

    def _give_up(self, timeout: float | None) -> None:
        """Conclude that the goal is lost, where nothing more can be heard of it; else raise TimeoutError."""
        if not self._lose():
            raise TimeoutError(f"{self.id} has not ended after {0 if timeout is None else round(timeout, 1):g} s")

    def _lose(self) -> bool:
        """Conclude that the goal is lost, and return True, where nothing more can be heard of it."""
        ended = self._connection.ended
        if ended is not None:
            self._settle(_lost(self.goal, f"{ended}; it may still be spoken"))
        return ended is not None


def merged(handles: Sequence[GoalHandle], timeout: float | None = None) -> Iterator[tuple[GoalHandle, Event]]:
    """Iterate over what happens to these goals of one connection, each event with its goal, until all have ended.

    Each goal's last is its Result. That speech is held, which all of them hear, comes once. TimeoutError where they
    have not all ended `timeout` seconds after the first step; where the server goes away, the rest are LOST.
    """
    stream = _Stream(handles)
    if not handles:
        return
    for found in taken(handles[0]._connection, stream.take, _end(timeout)):
        if not found:
            for each in stream.going:
                each._give_up(timeout)
        yield from found
        if not stream.going:
            return


class _Stream:
    """The events of some goals, as they come."""

    def __init__(self, handles: Sequence[GoalHandle]) -> None:
        #: goals whose Result was not found yet, each once, whoever named it twice
        self.going = list({each.id: each for each in handles}.values())
        #: the number of the last event, by the goal's id: its Result follows that
        self._last = dict.fromkeys((each.id for each in self.going), 0)
        self._paused_at: int | None = None

    def take(self) -> list[tuple[GoalHandle, Event]]:
        """Take what has come for all of them, in the server's order; under the connection's lock."""
        found = []
        for handle in self.going:
            event: Event | None = None
            while not isinstance(event, Result) and (event := handle._next()):
                number = getattr(event, "n", None)
                if isinstance(event, PausedChanged) and number is not None:
                    if number == self._paused_at:
                        continue
                    self._paused_at = number
                if number is not None:
                    self._last[handle.id] = number
                found.append((self._last[handle.id], handle, event))
        self.going = [each for each in self.going if not each.state.terminal]
        # A stable sort: a Result has the number of its goal's last event, and was found after that.
        return [(handle, event) for _, handle, event in sorted(found, key=lambda each: each[0])]


def _lost(goal: Goal, why: str) -> Goal:
    """Return what is known of a goal of which nothing more can be heard."""
    return replace(goal, state=State.LOST, reason="lost", message=f"Talk lost: {why}")


def _end(timeout: float | None) -> float | None:
    return None if timeout is None else time.monotonic() + timeout
