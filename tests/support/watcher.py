"""A connection that collects all events of a server, for a test."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, TypeVar

from tests.support.connection import PATIENCE, Message, Wire

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

T = TypeVar("T")
#: The watcher's `hello` requests have higher numbers than this.
_FIRST_SEQ = 1000
TERMINAL = frozenset({"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED"})


class Watcher:
    """Collects events in a thread. Connect it before the first goal."""

    def __init__(self, path: str) -> None:
        self._wire = Wire(path)
        self._changed = threading.Condition()
        self._events: list[Message] = []
        self._arrivals: dict[int, float] = {}  # by the event's `id()`
        self._ended: str | None = None
        #: numbers of the last `hello` that was sent and of the last reply
        self._sent = self._replied = _FIRST_SEQ
        try:
            reply = self._wire.request("watch")
            assert reply["ok"], f"watch was refused: {reply}"
        except BaseException:
            self._wire.close()
            raise
        self._events += self._wire.events
        self._arrivals |= {id(event): time.monotonic() for event in self._events}
        self._thread = threading.Thread(target=self._read, name="watcher", daemon=True)
        self._thread.start()

    def events(self, goal_id: str | None = None) -> list[Message]:
        """Return all events that the server has sent so far, for one goal or for all goals."""
        self._catch_up()
        with self._changed:
            return [event for event in self._events if goal_id is None or event.get("id") == goal_id]

    def states(self, goal_id: str) -> list[str]:
        return [event["state"] for event in self.events(goal_id) if event["event"] == "state"]

    def texts(self, *states: str) -> list[str]:
        """Return the texts of the goals that reached one of these states, in this order."""
        events = self.events()
        texts = {event["id"]: event["goal"]["text"] for event in events if event.get("goal")}
        return [texts[event["id"]] for event in events if event.get("state") in states]

    def words(self, goal_id: str) -> list[Message]:
        return [event for event in self.events(goal_id) if event["event"] == "word"]

    def arrived(self, event: Message) -> float:
        return self._arrivals[id(event)]

    def goals(self) -> list[str]:
        return list(dict.fromkeys(event["id"] for event in self.events() if event.get("id") is not None))

    def terminal_counts(self) -> dict[str, int]:
        """Return the number of terminal events of each goal."""
        counts = dict.fromkeys(self.goals(), 0)
        return counts | Counter(event["id"] for event in self.events() if event.get("state") in TERMINAL)

    def wait_for(self, goal_id: str | None, state: str, timeout: float = PATIENCE) -> Message:
        """Wait until a goal (or any goal, if the id is None) has this state, and return the event."""
        return self.wait_until(lambda event: event.get("state") == state and goal_id in (None, event["id"]), timeout)

    def wait_for_word(self, goal_id: str) -> Message:
        """Wait for a goal's first word, because an ACTIVE goal may still be waiting for an engine."""
        return self.wait_until(lambda event: event["event"] == "word" and event["id"] == goal_id)

    def wait_for_terminal(self, goal_id: str, timeout: float = PATIENCE) -> str:
        """Wait until an accepted goal has ended, and return its state."""
        states = TERMINAL - {"REJECTED"}
        event = self.wait_until(lambda event: event.get("id") == goal_id and event.get("state") in states, timeout)
        return str(event["state"])

    def wait_until(self, wanted: Callable[[Message], bool], timeout: float = PATIENCE, what: str = "event") -> Message:
        """Return the first wanted event, including events that have come already. `what` describes it in messages."""
        event = wait_for_first(self._events, wanted, self._changed, timeout, lambda: self._ended is not None)
        events = ", ".join(f"{other.get('id')} {other.get('state', other.get('event'))}" for other in self._events)
        assert event, f"{what}: not within {timeout} s: {self._ended or 'still connected'}; events: {events}"
        return event

    def wait_for_end(self) -> None:
        """Wait until the server has closed the connection."""
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive(), f"the server has not closed the watcher's connection within {PATIENCE} s"

    def close(self) -> None:
        self._wire.shut_down()
        self._thread.join()
        self._wire.close()

    def check(self, unfinished: Collection[str] | bool = False) -> None:
        """Assert that `n` always grows, and that each goal has one terminal event and no later events.

        `unfinished` contains the goals that may have no terminal event. True means all goals.
        """
        numbers = [event["n"] for event in self.events() if "n" in event]
        assert numbers == sorted(set(numbers)), f"event numbers do not grow: {numbers}"
        for goal_id in self.goals():
            events = self.events(goal_id)
            # A rejected goal may have the same id as another goal.
            accepted = [event for event in events if event.get("state") != "REJECTED"]
            summary = f"{goal_id}: {[event.get('state', event['event']) for event in events]}"
            ends = [index for index, event in enumerate(accepted) if event.get("state") in TERMINAL]
            assert len(ends) <= 1, f"more than one terminal state: {summary}"
            if ends:
                assert ends[0] == len(accepted) - 1, f"an event after the terminal state: {summary}"
            elif accepted:
                may_be_unfinished = unfinished is True or (unfinished is not False and goal_id in unfinished)
                assert may_be_unfinished, f"no terminal state: {summary}"

    def _catch_up(self) -> None:
        """Wait for the reply to a new request, because it comes after all earlier events."""
        with self._changed:
            if self._ended is not None:
                return
            self._sent = seq = self._sent + 1
            with contextlib.suppress(OSError):  # if the server has closed, the thread reads to the end
                self._wire.send({"seq": seq, "request": "hello"})
            self._changed.wait_for(lambda: self._replied >= seq or self._ended is not None, PATIENCE)

    def _read(self) -> None:
        try:
            while True:
                message = self._wire.receive(None)
                with self._changed:
                    if message.get("seq", 0) > _FIRST_SEQ and "ok" in message:
                        self._replied = message["seq"]
                    elif message.get("event") != "alive":
                        self._events.append(message)
                        self._arrivals[id(message)] = time.monotonic()
                    self._changed.notify_all()
        except (EOFError, OSError, ValueError, AssertionError) as error:
            with self._changed:
                self._ended = str(error)
                self._changed.notify_all()


def wait_for_first(
    items: Sequence[T],
    wanted: Callable[[T], bool],
    changed: threading.Condition,
    within: float,
    over: Callable[[], bool],
) -> T | None:
    """Return the first wanted item of a growing list, or None if it doesn't come in time or `over` becomes true."""
    seen = 0
    end = time.monotonic() + within
    with changed:
        while True:
            for item in items[seen:]:
                if wanted(item):
                    return item
            seen = len(items)
            remaining = end - time.monotonic()
            if remaining <= 0 or over():
                return None
            changed.wait(remaining)
