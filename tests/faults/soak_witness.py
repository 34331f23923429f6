"""What a soak may not do: an independent watcher of all goals that keeps a few numbers and no events.

It reads as fast as the server writes, for hours, and remembers of an ended goal its number alone.
"""

from __future__ import annotations

import threading
from collections import Counter
from typing import TYPE_CHECKING

from tests.support.connection import PATIENCE, Wire

if TYPE_CHECKING:
    from tests.support.connection import Message

#: What may follow what; None is before the first state.
_FOLLOWS: dict[str | None, set[str]] = {
    None: {"PENDING", "REJECTED"},
    "PENDING": {"ACTIVE", "RECALLED"},
    "ACTIVE": {"PREEMPTING", "SUCCEEDED", "ABORTED"},
    "PREEMPTING": {"PREEMPTED", "SUCCEEDED", "ABORTED"},
}
_TERMINAL = frozenset({"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED"})


class Witness:
    """Watches from before the first goal, in a thread of its own."""

    def __init__(self, path: str) -> None:
        self._wire = Wire(path)
        assert self._wire.request("watch")["ok"]
        self._changed = threading.Condition()
        self._states: dict[str, str] = {}
        self._ended_ids: set[str] = set()
        self._active: str | None = None
        #: how goals ended: by state and reason
        self.ends: Counter[tuple[str, str | None]] = Counter()
        #: what was not as it must be
        self.faults: list[str] = []
        self.closed = False
        self._thread = threading.Thread(target=self._read, name="witness", daemon=True)
        self._thread.start()

    @property
    def ended(self) -> int:
        """How many goals have ended."""
        return self.ends.total()

    def wait_for(self, count: int, timeout: float) -> bool:
        """Wait until so many goals have ended; False if they have not in time."""
        with self._changed:
            return self._changed.wait_for(lambda: self.closed or self.ended >= count, timeout) and not self.closed

    def wait_until_all_have_ended(self, timeout: float = 60.0) -> list[str]:
        """Wait until no goal is left, and return those that are after `timeout` seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or not self._states, timeout)
            return [f"{goal_id} {state}" for goal_id, state in self._states.items()]

    def close(self) -> None:
        self._wire.shut_down()
        self._thread.join()
        self._wire.close()

    def _read(self) -> None:
        try:
            while True:
                message = self._wire.receive(3 * PATIENCE)
                if message.get("event") == "state":
                    with self._changed:
                        self._note(message)
                        self._changed.notify_all()
        except (EOFError, OSError, ValueError) as error:
            with self._changed:
                self.closed = True
                if isinstance(error, TimeoutError):
                    self.faults.append("no sign of life within 15 s")
                self._changed.notify_all()

    def _note(self, event: Message) -> None:
        goal_id, state = event["id"], event["state"]
        before = self._states.pop(goal_id, None)
        if goal_id in self._ended_ids:
            self.faults.append(f"{goal_id}: {state} after its end")
        elif state not in _FOLLOWS[before]:
            self.faults.append(f"{goal_id}: {state} after {before}")
        if state == "ACTIVE":
            if self._active is not None:
                self.faults.append(f"{goal_id} became ACTIVE while {self._active} was")
            self._active = goal_id
        if state not in _TERMINAL:
            self._states[goal_id] = state
            return
        if self._active == goal_id:
            self._active = None
        self._ended_ids.add(goal_id)
        self.ends[state, event["goal"]["reason"]] += 1
