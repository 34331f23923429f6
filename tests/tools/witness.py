"""A witness of all goals at a server, for tests that run for hours: it keeps a few numbers of each goal."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from typing import TYPE_CHECKING

from tests.support.connection import Wire
from tests.support.watcher import TERMINAL

if TYPE_CHECKING:
    from tests.support.connection import Message

#: The allowed states after each state.
_FOLLOWS: dict[str | None, set[str]] = {
    None: {"PENDING"},
    "PENDING": {"ACTIVE", "RECALLED"},
    "ACTIVE": {"PREEMPTING", "SUCCEEDED", "ABORTED"},
    "PREEMPTING": {"PREEMPTED", "SUCCEEDED", "ABORTED"},
}
#: A server gives a sign of life every 5 s.
_SILENCE_LIMIT_S = 15.0
#: As many ended goals as a server keeps.
_LOG = 2_200


class Witness:
    """Watches a server in a thread and checks the order of the states of each goal, and how its text grows."""

    def __init__(self, path: str, *, restarts: bool = False) -> None:
        """`restarts`: connect again after the server has ended."""
        self._path, self._restarts = path, restarts
        self._changed = threading.Condition()
        self._states: dict[str, str] = {}
        self._ended_ids: set[str] = set()
        self._active: str | None = None
        self._texts: dict[tuple[str, str], str] = {}
        self._lengths: dict[str, int] = {}  # of the texts of the goals that have not ended
        self._begun: defaultdict[str, dict[tuple[str, str], float]] = defaultdict(dict)
        #: the number of ends by state and reason
        self.ends: Counter[tuple[str, str | None]] = Counter()
        self.faults: list[str] = []
        self.closed = False
        self._wire: Wire | None = None
        self._watching, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="witness", daemon=True)
        self._thread.start()
        assert self._watching.wait(_SILENCE_LIMIT_S), f"nothing to watch: {self.faults}"

    @property
    def ended(self) -> int:
        return self.ends.total()

    def begun(self, text: str) -> list[float]:
        """Return when goals with this text began (wall clock)."""
        with self._changed:
            return sorted(self._begun.get(text, {}).values())

    def wait_for(self, count: int, timeout: float) -> bool:
        """Wait until so many goals have ended; return False on a timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: self.closed or self.ended >= count, timeout) and not self.closed

    def wait_until_all_have_ended(self, timeout: float = 60.0) -> list[str]:
        """Return the goals that have not ended after a time."""
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
            except Exception as error:  # noqa: BLE001 - reported in the thread of the test
                self.faults.append(f"the witness: {type(error).__name__}: {error}")
            if not self._restarts or self.faults:
                break
            self._over.wait(0.01)  # nothing tells when a server is back
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _watch(self, wire: Wire) -> None:
        boot = wire.greeting["boot"]
        watch = wire.request("watch")
        waiting = [each["pending"] for each in wire.items if "pending" in each]
        wire.items.clear()
        log = wire.request("log", count=_LOG)
        assert watch["ok"], watch
        assert log["ok"], log
        active = watch["active"]
        with self._changed:
            self._active = active and active["id"]
            self._states = {each["id"]: each["state"] for each in [active, *waiting] if each}
            self._lengths = {each["id"]: len(each["text"]) for each in [active, *waiting] if each}
            self._ended_ids = set()  # a new server may have the same ids
            for goal in [active, *waiting, *(each["goal"] for each in wire.items)]:
                if goal:
                    self._texts[boot, goal["id"]] = goal["text"]
                    if goal["started_at"] is not None:
                        self._begin(boot, goal["id"], goal["started_at"])
        self._watching.set()
        due, wire.events = wire.events, []
        for each in due:
            self._note(boot, each)
        while True:
            self._note(boot, wire.receive(_SILENCE_LIMIT_S))

    def _note(self, boot: str, event: Message) -> None:
        if event.get("event") == "text":
            self._grow(event["id"], event["start"], len(event["text"]))
        if event.get("event") != "state":
            return
        with self._changed:
            goal_id, state = event["id"], event["state"]
            if state != "REJECTED":  # a rejected goal may have the id of another one
                self._check(goal_id, state)
                if state in TERMINAL:
                    self._grow(goal_id, len(event["goal"]["text"]), 0)
                    del self._lengths[goal_id]
                elif "goal" in event:
                    self._texts[boot, goal_id] = event["goal"]["text"]
                    self._lengths[goal_id] = len(event["goal"]["text"])
                if state == "ACTIVE":
                    self._begin(boot, goal_id, event["at"])
            if state in TERMINAL:
                self.ends[state, event["goal"]["reason"]] += 1
            self._changed.notify_all()

    def _grow(self, goal_id: str, start: int, length: int) -> None:
        """Check that a text grows at its end."""
        if self._lengths.get(goal_id) != start:
            self.faults.append(f"{goal_id}: text at {start}, but it has {self._lengths.get(goal_id)} characters")
        self._lengths[goal_id] = start + length

    def _begin(self, boot: str, goal_id: str, at: float) -> None:
        self._begun[self._texts[boot, goal_id]].setdefault((boot, goal_id), at)

    def _check(self, goal_id: str, state: str) -> None:
        before = self._states.pop(goal_id, None)
        if goal_id in self._ended_ids:
            self.faults.append(f"{goal_id}: {state} after its end")
        elif state not in _FOLLOWS[before]:
            self.faults.append(f"{goal_id}: {state} after {before}")
        if state == "ACTIVE":
            if self._active is not None:
                self.faults.append(f"{goal_id} became ACTIVE while {self._active} was")
            self._active = goal_id
        if state in TERMINAL:
            self._ended_ids.add(goal_id)
            if self._active == goal_id:
                self._active = None
        else:
            self._states[goal_id] = state
