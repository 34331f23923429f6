"""The desks of a soak: some by the library, some by the command, each of which must be told one end of every goal."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from talkcli import Client
from talkcli.errors import Lost, RequestRefused, ServerUnavailable, UnknownGoal
from talkcli.fleet.broker import from_environment
from talkcli.fleet.robot import reach
from talkcli.protocol.events import Result
from tests.support.bridge import Desk

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Iterator

    from talkcli.client.connection import Connection
    from talkcli.client.goal import GoalHandle
    from tests.support.broker import Broker
    from tests.support.processes import Process

#: Seconds in which any goal has its end at a desk, whatever faults there are: some hold up the queue, one after the
#: other, and whoever is away for 30 s is lost.
PATIENCE = 120.0
#: The fastest that there is, and few words: more goals in the time.
RATE = 450
#: Ends of a goal that was never spoken: not sent, or the robot said so.
UNSENT, REFUSED = "UNSENT", "REFUSED"
UNSPOKEN = frozenset({UNSENT, REFUSED, "REJECTED", "RECALLED"})
#: What a command's exit code says of its goal.
_CODES = {
    0: "SUCCEEDED",
    3: UNSENT,
    4: "ABORTED",
    5: "REJECTED",
    6: "RECALLED",
    7: "PREEMPTED",
    12: "LOST",
}
#: Goals of which one is said again, as if its sender knew nothing of it.
_EARLIER = 10
#: Seconds until a desk that was turned away comes again.
_AGAIN = 0.3
_OPTIONS: tuple[dict[str, Any], ...] = (
    *({},) * 10,
    {"preempt": True},
    {"preempt": True, "priority": 2},
    {"flush": True, "priority": -1},
    {"priority": -1, "ttl": 3.0},
    {"preempt": True, "ttl": 0.2},
    {"preempt": True, "ttl": 0.5},
    {"preempt": True, "ttl": 1.0},
    {"ttl": 2.0},
    {"ttl": 8.0},
    {"key": "one"},
    {"patient": True},
    {"feedback": True},
)
#: The same for the command.
_WORDS: tuple[tuple[str, ...], ...] = ((), (), ("--preempt",), ("--priority", "1"), ("--feedback",))


@dataclass(slots=True)
class Sent:
    """One goal that a desk has sent, once or twice."""

    id: str
    text: str
    ttl: float | None
    #: whether one desk alone has sent it, once: a result that reached the broker is for that
    once: bool = True
    #: wall clock, just before each time that it was sent
    at: list[float] = field(default_factory=lambda: [time.time()])
    #: how it ended at a desk, and when (wall clock), for each time that it was sent
    ends: list[tuple[str, float]] = field(default_factory=list)


class Ledger:
    """All goals that desks have sent."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._sent: dict[str, Sent] = {}
        #: how goals ended at desks
        self.ends: Counter[str] = Counter()
        #: times that a desk found no robot there, and sent nothing
        self.turned_away = 0
        #: desks that were killed while they waited
        self.killed = 0

    @property
    def ended(self) -> int:
        """How many ends desks were told."""
        return self.ends.total()

    def all(self) -> list[Sent]:
        """Return all goals so far."""
        with self._lock:
            return list(self._sent.values())

    def new(self, ttl: float | None = None) -> Sent:
        """Return a goal that is about to be sent, with an id and a text that no other has."""
        number = next(self._numbers)
        goal = Sent(f"soak:{number}", f"go to {number}", ttl)
        with self._lock:
            self._sent[goal.id] = goal
        return goal

    def end(self, goal: Sent, how: str) -> None:
        """Note how a goal has ended at a desk."""
        with self._lock:
            goal.ends.append((how, time.time()))
            self.ends[how] += 1

    def turn_away(self) -> None:
        """Note that a desk found no robot."""
        with self._lock:
            self.turned_away += 1

    def kill(self) -> None:
        """Note that a desk was killed, which is told nothing any more."""
        with self._lock:
            self.killed += 1


class Desks:
    """Desks that send goals until they are told to stop; `failures` are what went wrong."""

    def __init__(
        self,
        robot: str,
        broker: Broker,
        ledger: Ledger,
        chance: Callable[[str], random.Random],
        *,
        libraries: int = 4,
        commands: int = 2,
    ) -> None:
        self._robot, self._broker, self._ledger = robot, broker, ledger
        self._over = threading.Event()
        self.failures: list[str] = []
        kinds = [("library", self._use_library)] * libraries + [("command", self._use_command)] * commands
        kinds.append(("hasty", self._use_hastily))
        self._threads = [
            threading.Thread(target=self._run, args=(use, f"{kind}-{number}", chance(f"{kind} {number}")))
            for number, (kind, use) in enumerate(kinds)
        ]
        for each in self._threads:
            each.start()

    def stop(self) -> None:
        """Let them come to the end of what they wait for; all of it has a bound."""
        self._over.set()
        end = time.monotonic() + 2 * PATIENCE
        for each in self._threads:
            each.join(max(0.0, end - time.monotonic()))
            if each.is_alive():
                self.failures.append("a desk hangs")

    def _run(self, use: Callable[[str, random.Random], None], name: str, chance: random.Random) -> None:
        try:
            use(name, chance)
        except Exception as error:  # noqa: BLE001 - told by the soak, in its own thread
            self.failures.append(f"{name}: {type(error).__name__}: {error}")

    # -- by the library

    def _use_library(self, name: str, chance: random.Random) -> None:
        earlier: deque[Sent] = deque(maxlen=_EARLIER)
        for client, connection in self._connections(name):
            # A connection for some goals, as scripts have it.
            for _ in range(chance.randrange(1, 12)):
                if self._over.is_set() or connection.ended is not None:
                    break
                self._follow(client, chance, earlier)

    def _use_hastily(self, name: str, chance: random.Random) -> None:
        """Say now and then what must be spoken at once: where it is on its way for long, it would begin too late."""
        for client, connection in self._connections(name):
            while connection.ended is None and not self._over.wait(chance.uniform(0.5, 3)):
                found = self._say(client, {"preempt": True, "ttl": 0.2})
                if found:
                    self._ledger.end(found[0], _end(found[1], chance))

    def _connections(self, name: str) -> Iterator[tuple[Client, Connection]]:
        """Yield a connection, another where that is done with, until all is over."""
        broker = from_environment(self._broker.env(name, password=False))
        while not self._over.is_set():
            try:
                connection = reach(self._robot, broker, name="soak")
            except ServerUnavailable:
                self._ledger.turn_away()
                self._over.wait(_AGAIN)
                continue
            with Client.over(connection) as client:
                yield client, connection

    def _follow(self, client: Client, chance: random.Random, earlier: deque[Sent]) -> None:
        """Send a goal, or some at once, at times one of them or an earlier one again, and wait for the end of each."""
        found = [self._say(client, chance.choice(_OPTIONS)) for _ in range(chance.choice((1, 1, 1, 3)))]
        handles = [each for each in found if each]
        self._over.wait(chance.random() * 0.4)
        if handles and chance.random() < 0.2:
            again = self._say_again(client, handles[0][0])
            handles += [again] if again else []
        if handles and chance.random() < 0.4:
            self._cancel(client, handles[0][1], chance)
        for goal, handle in handles:
            self._ledger.end(goal, _end(handle, chance))
        if earlier and chance.random() < 0.3:
            again = self._say_again(client, chance.choice(earlier))
            if again:
                self._ledger.end(again[0], _end(again[1], chance))
        earlier.extend(goal for goal, _ in handles)

    def _say(self, client: Client, options: dict[str, Any]) -> tuple[Sent, GoalHandle] | None:
        goal = self._ledger.new(options.get("ttl"))
        return self._said(goal, lambda: client.say(goal.text, id=goal.id, rate=RATE, **options))

    def _say_again(self, client: Client, goal: Sent) -> tuple[Sent, GoalHandle] | None:
        goal.once = False
        goal.at.append(time.time())
        return self._said(goal, lambda: client.say(goal.text, id=goal.id, rate=RATE, ttl=goal.ttl))

    def _said(self, goal: Sent, say: Callable[[], GoalHandle]) -> tuple[Sent, GoalHandle] | None:
        try:
            return goal, say()
        except Lost:
            self._ledger.end(goal, "LOST")
        except ServerUnavailable:
            self._ledger.end(goal, UNSENT)
        except RequestRefused:
            self._ledger.end(goal, REFUSED)
        return None

    def _cancel(self, client: Client, handle: GoalHandle, chance: random.Random) -> None:
        try:
            chance.choices((handle.cancel, handle.request_cancel, client.status, client.cancel), (5, 4, 4, 1))[0]()
        except (Lost, ServerUnavailable, UnknownGoal):
            pass  # how the goal ends is told all the same

    # -- by the command

    def _use_command(self, name: str, chance: random.Random) -> None:
        with Desk(self._broker, user=name, password=False) as desk:
            for goal in self._goals():
                how = ("--id", goal.id, "--rate", str(RATE), *chance.choice(_WORDS))
                command = desk.start("--robot", self._robot, "--json", "say", "--wait", *how, "--", goal.text)
                if chance.random() < 0.2:
                    self._kill(command, chance)
                    continue
                done = desk.finish(command, timeout=PATIENCE)
                if done.code not in _CODES:
                    self.failures.append(f"{name}: exit code {done.code}: {done.err}")
                    return
                end = _CODES[done.code]
                self._ledger.end(goal, end)
                if end not in (UNSENT, "LOST") and _printed(done.out) != [end]:
                    self.failures.append(f"{name}: exit code {done.code} and not one end, but {done.out}")
                if end == UNSENT:
                    self._over.wait(_AGAIN)
                if chance.random() < 0.05:
                    self._cancel_all(desk)

    def _goals(self) -> Iterator[Sent]:
        while not self._over.is_set():
            yield self._ledger.new()

    def _kill(self, command: Process, chance: random.Random) -> None:
        """Kill a command while it starts, or waits."""
        self._over.wait(chance.uniform(0.1, 1.0))
        command.kill()
        command.communicate()
        self._ledger.kill()

    def _cancel_all(self, desk: Desk) -> None:
        done = desk.run("--robot", self._robot, "cancel", timeout=PATIENCE)
        if done.code not in (0, 3, 12):
            self.failures.append(f"cancel: exit code {done.code}: {done.err}")


def _printed(out: str) -> list[str]:
    """Return the states of the goals whose end a command has printed: alone, or behind its feedback."""
    lines = [json.loads(each) for each in out.splitlines()]
    return [each.get("goal", each)["state"] for each in lines if each.get("event", "result") == "result"]


def _end(handle: GoalHandle, chance: random.Random) -> str:
    """Wait for a goal's end, and return how that is."""
    if chance.random() < 0.5:
        return handle.wait(PATIENCE).state.name
    *before, last = handle.events(PATIENCE)
    assert isinstance(last, Result), f"{handle.id}: the last is {last}"
    assert not [each for each in before if isinstance(each, Result)], f"{handle.id} has two results: {before}"
    return last.goal.state.name
