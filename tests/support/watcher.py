"""A witness for a test: a connection of its own that collects all events of a server."""

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
#: The numbers of the `hello` requests with which the watcher catches up are above this one.
_FIRST_SEQ = 1000
TERMINAL = frozenset({"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED"})


class Watcher:
    """Collects events in a thread, from before the first goal."""

    def __init__(self, path: str) -> None:
        self._wire = Wire(path)
        self._changed = threading.Condition()
        self._events: list[Message] = []
        self._arrivals: dict[int, float] = {}  # by the identity of an event
        self._ended: str | None = None
        #: the last `hello` that was sent, and the last that was answered
        self._asked = self._answered = _FIRST_SEQ
        try:
            reply = self._wire.request("watch")
            assert reply["ok"], f"no watch: {reply}"
        except BaseException:
            self._wire.close()
            raise
        self._events += self._wire.events
        self._arrivals |= {id(each): time.monotonic() for each in self._events}
        self._thread = threading.Thread(target=self._read, name="watcher", daemon=True)
        self._thread.start()

    def events(self, goal_id: str | None = None) -> list[Message]:
        """Return all events that the server has sent so far, of one goal or of all goals."""
        self._catch_up()
        with self._changed:
            return [each for each in self._events if goal_id is None or each.get("id") == goal_id]

    def states(self, goal_id: str) -> list[str]:
        return [each["state"] for each in self.events(goal_id) if each["event"] == "state"]

    def texts(self, *states: str) -> list[str]:
        """Return the texts of the goals that reached one of these states, in the order of these events."""
        events = self.events()
        known = {each["id"]: each["goal"]["text"] for each in events if each.get("goal")}
        return [known[each["id"]] for each in events if each.get("state") in states]

    def words(self, goal_id: str) -> list[Message]:
        return [each for each in self.events(goal_id) if each["event"] == "word"]

    def arrived(self, event: Message) -> float:
        return self._arrivals[id(event)]

    def goals(self) -> list[str]:
        return list(dict.fromkeys(each["id"] for each in self.events() if each.get("id") is not None))

    def terminal_counts(self) -> dict[str, int]:
        """Return the number of terminal events of each goal."""
        counts = dict.fromkeys(self.goals(), 0)
        return counts | Counter(each["id"] for each in self.events() if each.get("state") in TERMINAL)

    def wait_for(self, goal_id: str | None, state: str, timeout: float = PATIENCE) -> Message:
        """Return the event of a goal's state, or of any goal's if the id is None."""
        return self.wait_until(lambda each: each.get("state") == state and goal_id in (None, each["id"]), timeout)

    def wait_for_word(self, goal_id: str) -> Message:
        """Return the first word event of a goal. A goal that is ACTIVE may still wait for an engine."""
        return self.wait_until(lambda each: each["event"] == "word" and each["id"] == goal_id)

    def wait_for_terminal(self, goal_id: str, timeout: float = PATIENCE) -> str:
        """Return the terminal state of an accepted goal."""
        states = TERMINAL - {"REJECTED"}
        event = self.wait_until(lambda each: each.get("id") == goal_id and each.get("state") in states, timeout)
        return str(event["state"])

    def wait_until(self, wanted: Callable[[Message], bool], timeout: float = PATIENCE, what: str = "event") -> Message:
        """Return the first wanted event, also of those that came before."""
        found = wait_for_first(self._events, wanted, self._changed, timeout, lambda: self._ended is not None)
        events = ", ".join(f"{each.get('id')} {each.get('state', each.get('event'))}" for each in self._events)
        assert found, f"{what}: not within {timeout} s: {self._ended or 'still connected'}; events: {events}"
        return found

    def wait_for_end(self) -> None:
        """Wait until the server has closed the connection."""
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive(), f"the server still has the watcher's connection after {PATIENCE} s"

    def close(self) -> None:
        self._wire.shut_down()
        self._thread.join()
        self._wire.close()

    def check(self, unfinished: Collection[str] | bool = False) -> None:
        """Assert that `n` only grows, and that each goal has one terminal event and no event after it.

        Args:
            unfinished: ids of goals that may have no terminal event, or True for all.
        """
        numbers = [each["n"] for each in self.events() if "n" in each]
        assert numbers == sorted(set(numbers)), f"event numbers do not grow: {numbers}"
        for goal_id in self.goals():
            events = self.events(goal_id)
            # A rejected goal may have the id of another goal, at any time.
            own = [each for each in events if each.get("state") != "REJECTED"]
            told = f"{goal_id}: {[each.get('state', each['event']) for each in events]}"
            ends = [place for place, each in enumerate(own) if each.get("state") in TERMINAL]
            assert len(ends) <= 1, f"more than one terminal state: {told}"
            if ends:
                assert ends[0] == len(own) - 1, f"an event after the terminal state: {told}"
            elif own:
                may_be_unfinished = unfinished is True or (unfinished is not False and goal_id in unfinished)
                assert may_be_unfinished, f"no terminal state: {told}"

    def _catch_up(self) -> None:
        """Wait for the reply to a request, which comes after all earlier events."""
        with self._changed:
            if self._ended is not None:
                return
            self._asked = asked = self._asked + 1
            with contextlib.suppress(OSError):  # the server has closed, and the thread reads to the end
                self._wire.send({"seq": asked, "request": "hello"})
            self._changed.wait_for(lambda: self._answered >= asked or self._ended is not None, PATIENCE)

    def _read(self) -> None:
        try:
            while True:
                message = self._wire.receive(None)
                with self._changed:
                    if message.get("seq", 0) > _FIRST_SEQ and "ok" in message:
                        self._answered = message["seq"]
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
    """Return the first wanted item of a list that grows, None if it doesn't come in time or the list is over."""
    seen = 0
    end = time.monotonic() + within
    with changed:
        while True:
            for each in items[seen:]:
                if wanted(each):
                    return each
            seen = len(items)
            left = end - time.monotonic()
            if left <= 0 or over():
                return None
            changed.wait(left)
