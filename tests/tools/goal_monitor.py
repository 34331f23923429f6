"""A monitor for all goals of a server. It stores little per goal, so tests can run for hours."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from typing import TYPE_CHECKING

from tests.support.connection import Wire
from tests.support.watcher import TERMINAL

if TYPE_CHECKING:
    from tests.support.connection import Message

#: The allowed states after each state.
_NEXT_STATES: dict[str | None, set[str]] = {
    None: {"PENDING"},
    "PENDING": {"ACTIVE", "RECALLED"},
    "ACTIVE": {"PREEMPTING", "SUCCEEDED", "ABORTED", "INTERRUPTED"},
    "INTERRUPTED": {"ACTIVE", "PREEMPTING", "INTERRUPTED"},
    "PREEMPTING": {"PREEMPTED", "SUCCEEDED", "ABORTED"},
}
#: A server sends a sign of life every 5 s.
_SILENCE_LIMIT_S = 15.0
#: Number of ended goals that a server keeps.
_LOG_GOALS = 2_200


class GoalMonitor:
    """Watches a server in a thread and checks each goal's states and how its text grows."""

    def __init__(self, path: str, *, restarts: bool = False) -> None:
        """With `restarts`, reconnect after the server has ended."""
        self._path, self._restarts = path, restarts
        self._changed = threading.Condition()
        self._states: dict[str, str] = {}
        self._ended_ids: set[str] = set()
        self._active: str | None = None
        self._texts: dict[tuple[str, str], str] = {}
        self._lengths: dict[str, int] = {}  # characters of unfinished goals
        self._starts: defaultdict[str, dict[tuple[str, str], float]] = defaultdict(dict)
        #: number of ends by state and reason
        self.ends: Counter[tuple[str, str | None]] = Counter()
        self.faults: list[str] = []
        self.closed = False
        self._wire: Wire | None = None
        self._watching, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="goal monitor", daemon=True)
        self._thread.start()
        assert self._watching.wait(_SILENCE_LIMIT_S), f"could not watch the server: {self.faults}"

    @property
    def ended(self) -> int:
        return self.ends.total()

    def starts(self, text: str) -> list[float]:
        """Return the Unix times at which goals with this text started."""
        with self._changed:
            return sorted(self._starts.get(text, {}).values())

    def wait_for(self, count: int, timeout: float) -> bool:
        """Wait until `count` goals have ended. Return False on a timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: self.closed or self.ended >= count, timeout) and not self.closed

    def wait_until_all_have_ended(self, timeout: float = 60.0) -> list[str]:
        """Wait until all goals have ended. After the timeout, return those that have not."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or not self._states, timeout)
            return [f"{goal_id} {state}" for goal_id, state in self._states.items()]

    def close(self) -> None:
        self._over.set()
        if self._wire:
            self._wire.shut_down()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.is_set():
            try:
                with Wire(self._path) as self._wire:
                    self._watch(self._wire)
            except TimeoutError as error:
                self.faults.append(f"no sign of life: {error}")
            except (EOFError, OSError):
                pass
            except Exception as error:  # noqa: BLE001 - reported in the test's thread
                self.faults.append(f"the monitor: {type(error).__name__}: {error}")
            if not self._restarts or self.faults:
                break
            self._over.wait(0.01)  # a restarted server sends no event
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _watch(self, wire: Wire) -> None:
        boot = wire.greeting["boot"]
        watch = wire.request("watch")
        interrupted = [item["interrupted"] for item in wire.items if "interrupted" in item]
        waiting = [*interrupted, *(item["pending"] for item in wire.items if "pending" in item)]
        wire.items.clear()
        log = wire.request("log", count=_LOG_GOALS)
        assert watch["ok"], watch
        assert log["ok"], log
        active = watch["active"]
        with self._changed:
            self._active = active and active["id"]
            self._states = {goal["id"]: goal["state"] for goal in [active, *waiting] if goal}
            self._states |= {goal["id"]: "INTERRUPTED" for goal in interrupted}
            self._lengths = {goal["id"]: len(goal["text"]) for goal in [active, *waiting] if goal}
            self._ended_ids = set()  # a restarted server may use the same ids
            for goal in [active, *waiting, *(item["goal"] for item in wire.items)]:
                if goal:
                    self._texts[boot, goal["id"]] = goal["text"]
                    if goal["started_at"] is not None:
                        self._note_start(boot, goal["id"], goal["started_at"])
        self._watching.set()
        events, wire.events = wire.events, []
        for event in events:
            self._note(boot, event)
        while True:
            self._note(boot, wire.receive(_SILENCE_LIMIT_S))

    def _note(self, boot: str, event: Message) -> None:
        if event.get("event") == "text":
            self._grow(event["id"], event["start"], len(event["text"]))
        if event.get("event") not in {"state", "interrupted"}:
            return
        with self._changed:
            goal_id, state = event["id"], event.get("state", "INTERRUPTED")
            if state != "REJECTED":  # a rejected goal may have the same id as another goal
                self._check(goal_id, state)
                if state in TERMINAL:
                    self._grow(goal_id, len(event["goal"]["text"]), 0)
                    del self._lengths[goal_id]
                elif "goal" in event:
                    self._texts[boot, goal_id] = event["goal"]["text"]
                    self._lengths[goal_id] = len(event["goal"]["text"])
                if state == "ACTIVE":
                    self._note_start(boot, goal_id, event["at"])
            if state in TERMINAL:
                self.ends[state, event["goal"]["reason"]] += 1
            self._changed.notify_all()

    def _grow(self, goal_id: str, start: int, length: int) -> None:
        """Check that a text grows at its end."""
        if self._lengths.get(goal_id) != start:
            self.faults.append(f"{goal_id}: text at {start}, but it has {self._lengths.get(goal_id)} characters")
        self._lengths[goal_id] = start + length

    def _note_start(self, boot: str, goal_id: str, at: float) -> None:
        self._starts[self._texts[boot, goal_id]].setdefault((boot, goal_id), at)

    def _check(self, goal_id: str, state: str) -> None:
        before = self._states.pop(goal_id, None)
        if goal_id in self._ended_ids:
            self.faults.append(f"{goal_id}: {state} after its end")
        elif state not in _NEXT_STATES[before]:
            self.faults.append(f"{goal_id}: {state} after {before}")
        if state == "ACTIVE":
            if self._active is not None:
                self.faults.append(f"{goal_id} became ACTIVE while {self._active} was")
            self._active = goal_id
        if self._active == goal_id and (state in TERMINAL or state == "INTERRUPTED"):
            self._active = None
        if state in TERMINAL:
            self._ended_ids.add(goal_id)
        else:
            self._states[goal_id] = state
