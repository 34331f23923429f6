"""What a soak may not do, seen from its two ends: what the robot speaks, and which results have reached the broker.

Both come again by themselves when the server or the broker does, and keep a few numbers of each goal.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

from tests.fleet.soak_desks import UNSPOKEN
from tests.support.connection import Wire
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from tests.fleet.soak_desks import Ledger, Sent
    from tests.support.broker import Broker
    from tests.support.connection import Message

#: Seconds by which a goal may begin after its time: a robot refuses what is on its way for longer.
STALE = 6.0
#: Seconds without a sign of life from a server after which it counts as gone; it gives one every 5.
_SILENCE = 15.0
#: Seconds in which all that has happened has come here, too; and in which a desk has what the broker has.
_BEHIND = 1.0
#: Goals that have ended, as many as a server keeps.
_LOG = 2_200


@dataclass(frozen=True, slots=True)
class Begun:
    """That a goal was begun, by which server, and when (wall clock)."""

    boot: str
    id: str
    at: float


class Witness:
    """Watches at the robot, in a thread of its own: all that was begun there, by its text."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._begun: defaultdict[str, set[Begun]] = defaultdict(set)
        self._texts: dict[tuple[str, str], str] = {}
        #: goals that ended at the robot
        self.ends: Counter[str] = Counter()
        self.failures: list[str] = []
        self._wire: Wire | None = None
        self._watching = threading.Event()
        self._thread = threading.Thread(target=self._run, name="witness", daemon=True)
        self._thread.start()
        assert self._watching.wait(_SILENCE), "there is nothing to watch"

    def begun(self, text: str) -> list[Begun]:
        """Return all that was begun with this text, the first one first."""
        with self._lock:
            return sorted(self._begun.get(text, ()), key=lambda each: each.at)

    def close(self) -> None:
        """End it."""
        self._over.set()
        if self._wire:
            self._wire.shut_down()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._over.is_set():
                try:
                    with Wire(self._path) as self._wire:
                        self._watch(self._wire)
                except (EOFError, OSError):
                    self._over.wait(0.01)  # that a server is there again is no event
        except Exception as error:  # noqa: BLE001 - told by the soak, in its own thread
            self.failures.append(f"the witness: {type(error).__name__}: {error}")

    def _watch(self, wire: Wire) -> None:
        boot = wire.greeting["boot"]
        watch = wire.request("watch")
        log = wire.request("log", count=_LOG)
        assert watch["ok"], watch
        assert log["ok"], log
        with self._lock:
            # What has happened between the server's start and now.
            for goal in [each["goal"] for each in wire.items] + [watch["active"]]:
                if goal:
                    self._texts[boot, goal["id"]] = goal["text"]
                    if goal["started_at"] is not None:
                        self._begin(boot, goal["id"], goal["started_at"])
        self._watching.set()
        due, wire.events = wire.events, []
        for each in due:
            self._note(boot, each)
        while True:
            self._note(boot, wire.receive(_SILENCE))

    def _note(self, boot: str, event: Message) -> None:
        if event.get("event") != "state":
            return
        with self._lock:
            if "goal" in event:
                self._texts[boot, event["id"]] = event["goal"]["text"]
            if event["state"] == "ACTIVE":
                self._begin(boot, event["id"], event["at"])
            elif event["state"] not in ("PENDING", "PREEMPTING"):
                self.ends[event["state"]] += 1

    def _begin(self, boot: str, goal_id: str, at: float) -> None:
        found = self._begun[self._texts[boot, goal_id]]
        # It is told twice, by the log and by the event, where it happens just then.
        if not any((each.boot, each.id) == (boot, goal_id) for each in found):
            found.add(Begun(boot, goal_id, at))


class Overheard:
    """Hears all that the robot answers anybody, on a connection to the broker that lasts as long as that does."""

    def __init__(self, broker: Broker) -> None:
        self._broker = broker
        self._lock = threading.Lock()
        self._results: dict[str, float] = {}
        self._seen = 0
        self._listener: Listener | None = None
        self.listen()

    def listen(self) -> None:
        """Connect, once more where the broker was started again."""
        self.close()
        self._listener = Listener(self._broker, "talk/reply/#")

    def close(self) -> None:
        """End the connection; what was heard stays."""
        if self._listener:
            self._listener.close()
        self.results()
        self._listener, self._seen = None, 0

    def results(self) -> dict[str, float]:
        """Return when the broker had the first result of each goal (wall clock)."""
        with self._lock:
            messages = self._listener.messages[self._seen :] if self._listener else []
            self._seen += len(messages)
            shift = time.time() - time.monotonic()
            for message in messages:
                for goal_id in _results(message.payload):
                    self._results.setdefault(goal_id, message.arrived + shift)
            return dict(self._results)


#: Seconds in which a bridge that was killed is there again and has asked its server what was said.
_TOGETHER = 6.0


@dataclass(slots=True)
class Outages:
    """When each was killed (wall clock)."""

    broker: list[float] = field(default_factory=list)
    server: list[float] = field(default_factory=list)
    bridge: list[float] = field(default_factory=list)

    def excuse_twice(self, sent: float, first: float, second: float) -> bool:
        """Whether a goal may be begun twice: the server that knew its id died, and then the bridge that remembered it,
        or that so shortly before that the next bridge had no time to ask the server. `sent`: the first time.
        """
        servers = [each for each in self.server if first < each < second]
        bridges = [each for each in self.bridge if sent < each < second]
        return any(bridge > server - _TOGETHER for server in servers for bridge in bridges)

    def excuse_lost(self, reached: float, ended: float) -> bool:
        """Whether a result may be unknown to its desk: the broker died with it, and the server that could repeat it."""
        died = any(reached - _BEHIND < each < reached + _BEHIND for each in self.broker)
        return died and any(reached - _BEHIND < each < ended for each in self.server)


def judge(ledger: Ledger, witness: Witness, overheard: Overheard, outages: Outages) -> list[str]:
    """Return what is wrong with the goals whose end desks were told so far."""
    results = overheard.results()
    now = time.time()
    found = []
    for goal in ledger.all():
        begun = witness.begun(goal.text)
        sent = list(goal.at)
        twice = [(one.at, other.at) for one, other in pairwise(begun)]
        if not all(outages.excuse_twice(sent[0], *each) for each in twice):
            found.append(f"{goal.id} was spoken {len(begun)} times: {begun}, sent at {sent}, {outages}")
        for each in begun:
            late = each.at - max((at for at in sent if at < each.at), default=sent[0])
            if goal.ttl is not None and late > goal.ttl + STALE:
                found.append(f"{goal.id} began {late:.1f} s after it was sent, its ttl is {goal.ttl:g} s")
        settled = [how for how, at in goal.ends if at < now - _BEHIND]
        if settled:
            found += _contradictions(goal, settled, begun, results.get(goal.id), outages)
    return found


def _contradictions(
    goal: Sent, ends: list[str], begun: list[Begun], reached: float | None, outages: Outages
) -> list[str]:
    found = []
    if begun and set(ends) <= UNSPOKEN and len(ends) == len(goal.ends):
        found.append(f"{goal.id} was spoken, and its desk was told {', '.join(ends)}: {goal}, {begun}")
    if not begun and set(ends) & {"SUCCEEDED", "PREEMPTED"}:
        found.append(f"{goal.id} was not spoken, and its desk was told {', '.join(ends)}: {goal}")
    for how, at in goal.ends:
        lost = goal.once and how == "LOST" and reached is not None and reached < at - _BEHIND
        if lost and reached is not None and not outages.excuse_lost(reached, at):
            found.append(f"{goal.id} is LOST at its desk {at - reached:.1f} s after the broker had its result: {goal}")
    return found


def _results(payload: bytes) -> list[str]:
    """Return the ids of the goals whose end some lines of a server tell."""
    lines = [json.loads(each) for each in payload.splitlines() if b'"result"' in each]
    return [each["goal"]["id"] for each in lines if each.get("event") == "result"]
