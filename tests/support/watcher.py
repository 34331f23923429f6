"""An independent witness: a connection of its own that collects all that a server tells a watcher.

What it has collected must keep the promise, each goal one terminal state and nothing after it; `check()` asserts that.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING

from tests.support.connection import PATIENCE, Message, Wire

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

#: Numbers of requests after this one are those of `hello`, with which the watcher catches up.
_FIRST_SEQ = 1000
TERMINAL = frozenset({"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED"})


class Watcher:
    """Watches from before the first goal; a thread reads as fast as the server writes."""

    def __init__(self, path: str) -> None:
        self._wire = Wire(path)
        self._changed = threading.Condition()
        self._events: list[Message] = []
        self._arrivals: dict[int, float] = {}  # by the identity of an event, which stays in `_events`
        self._ended: str | None = None
        #: the last `hello` that was sent to catch up with the server, and the last that was answered
        self._asked = self._answered = _FIRST_SEQ
        try:
            #: the reply that closed the snapshot, and the snapshot's lines
            self.reply = self._wire.request("watch")
            assert self.reply["ok"], f"no watch: {self.reply}"
        except BaseException:
            self._wire.close()
            raise
        self.snapshot = self._wire.items
        self._events += self._wire.events
        self._arrivals |= {id(each): time.monotonic() for each in self._events}
        self._thread = threading.Thread(target=self._read, name="watcher", daemon=True)
        self._thread.start()

    def events(self, goal_id: str | None = None) -> list[Message]:
        """Return all events that the server had sent when this was called, of one goal or of all, `alive` left out."""
        self._catch_up()
        with self._changed:
            return [each for each in self._events if goal_id is None or each.get("id") == goal_id]

    def states(self, goal_id: str) -> list[str]:
        """Return the states of a goal in the order of their events."""
        return [each["state"] for each in self.events(goal_id) if each["event"] == "state"]

    def texts(self, *states: str) -> list[str]:
        """Return the texts of the goals that came to one of these states, in the order in which they did."""
        events = self.events()
        known = {each["id"]: each["goal"]["text"] for each in events if each.get("goal")}
        return [known[each["id"]] for each in events if each.get("state") in states]

    def words(self, goal_id: str) -> list[Message]:
        """Return the word events of a goal."""
        return [each for each in self.events(goal_id) if each["event"] == "word"]

    def arrived(self, event: Message) -> float:
        """Return the monotonic time at which an event, as it was returned from here, had come."""
        return self._arrivals[id(event)]

    def goals(self) -> list[str]:
        """Return the ids of all goals that had an event, in the order of their first."""
        return list(dict.fromkeys(each["id"] for each in self.events() if each.get("id") is not None))

    def terminal_counts(self) -> dict[str, int]:
        """Return for each goal how many terminal events it had; 0 for one that has not ended."""
        counts = dict.fromkeys(self.goals(), 0)
        counts.update(Counter(each["id"] for each in self.events() if each.get("state") in TERMINAL))
        return counts

    def wait_for(self, goal_id: str | None, state: str, timeout: float = PATIENCE) -> Message:
        """Wait until a goal has come to a state, and return that event; any goal if the id is None."""
        return self.wait_until(
            lambda each: each.get("state") == state and goal_id in (None, each["id"]),
            timeout,
            f"{goal_id or 'any goal'} {state}",
        )

    def wait_for_word(self, goal_id: str, timeout: float = PATIENCE) -> Message:
        """Wait for a goal's first word, and return that event; a goal that is ACTIVE may still wait for an engine."""
        return self.wait_until(
            lambda each: each["event"] == "word" and each["id"] == goal_id, timeout, f"a word of {goal_id}"
        )

    def wait_for_terminal(self, goal_id: str, timeout: float = PATIENCE) -> str:
        """Wait until an accepted goal has ended, and return its terminal state."""
        event = self.wait_until(
            lambda each: each.get("id") == goal_id and each.get("state") in TERMINAL - {"REJECTED"},
            timeout,
            f"{goal_id} terminal",
        )
        return str(event["state"])

    def wait_until(self, wanted: Callable[[Message], bool], timeout: float = PATIENCE, what: str = "event") -> Message:
        """Wait for the first event, of all so far and to come, that is wanted, and return it."""
        seen = 0
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                for each in self._events[seen:]:
                    if wanted(each):
                        return each
                seen = len(self._events)
                assert self._ended is None, f"{what}: the watcher's connection ended: {self._ended}; {self._told()}"
                remaining = end - time.monotonic()
                assert remaining > 0, f"{what}: not within {timeout} s; {self._told()}"
                self._changed.wait(remaining)

    def wait_for_end(self, timeout: float = PATIENCE) -> None:
        """Wait until the server has closed the connection: then all events are here."""
        self._thread.join(timeout)
        assert not self._thread.is_alive(), f"the server still has the watcher's connection after {timeout} s"

    def close(self) -> None:
        """End the connection and the thread; what was collected stays."""
        self._wire.shut_down()
        self._thread.join()
        self._wire.close()

    def check(self, unfinished: Collection[str] | bool = False) -> None:
        """Assert of every goal: one terminal event, nothing after it; of all events: `n` only grows.

        `unfinished` are ids that may have no terminal event (True: all), never two. A REJECTED goal does not use its id
        up: what is REJECTED under the id of another goal is no end of that one, and may come at any time.
        """
        numbers = [each["n"] for each in self.events() if "n" in each]
        assert numbers == sorted(set(numbers)), f"event numbers do not grow: {numbers}"
        for goal_id in self.goals():
            self._check(goal_id, unfinished is True or (unfinished is not False and goal_id in unfinished))

    def _check(self, goal_id: str, may_be_unfinished: bool) -> None:
        events = self.events(goal_id)
        own = [each for each in events if each.get("state") != "REJECTED"]
        if not own:
            return
        told = f"{goal_id}: {[each.get('state', each['event']) for each in events]}"
        ends = [place for place, each in enumerate(own) if each.get("state") in TERMINAL]
        assert len(ends) <= 1, f"more than one terminal state: {told}"
        assert ends or may_be_unfinished, f"no terminal state: {told}"
        assert not ends or ends[0] == len(own) - 1, f"an event after the terminal state: {told}"

    def _catch_up(self) -> None:
        """Wait for all that the server has sent: its reply to a request comes after that; a frozen one says nothing."""
        with self._changed:
            if self._ended is not None:
                return
            self._asked = asked = self._asked + 1
            with contextlib.suppress(OSError):  # it has closed: the thread reads to the end
                self._wire.send({"seq": asked, "request": "hello"})
            self._changed.wait_for(lambda: self._answered >= asked or self._ended is not None, PATIENCE)

    def _read(self) -> None:
        while True:
            try:
                message = self._wire.receive(None)
            except (EOFError, OSError, ValueError, AssertionError) as error:
                with self._changed:
                    self._ended = str(error)
                    self._changed.notify_all()
                return
            if message.get("event") == "alive":
                continue
            with self._changed:
                if message.get("seq", 0) > _FIRST_SEQ and "ok" in message:
                    self._answered = message["seq"]
                    self._changed.notify_all()
                    continue
                self._events.append(message)
                self._arrivals[id(message)] = time.monotonic()
                self._changed.notify_all()

    def _told(self) -> str:
        return "events: " + ", ".join(
            f"{each.get('id')} {each.get('state', each.get('event'))}" for each in self._events
        )
