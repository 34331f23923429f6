"""The desks of the fleet's soak test, which use the library."""

from __future__ import annotations

import itertools
import random
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from talkcli import Client
from talkcli.errors import Lost, RequestRefused, ServerUnavailable, UnknownGoal
from talkcli.fleet.broker import from_environment
from talkcli.fleet.desk.robot import RobotConnection
from talkcli.polling import run_blocking
from talkcli.protocol.events import Result
from tests.tools.soak_clients import PATIENCE_S, Workers

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.client.connection import Connection
    from talkcli.client.goal import GoalHandle
    from tests.support.broker import Broker

RATE = 450
_DESKS = 6
#: Ends of goals that weren't sent, or that the robot refused.
UNSENT, REFUSED = "UNSENT", "REFUSED"
UNSPOKEN = frozenset({UNSENT, REFUSED, "REJECTED", "RECALLED"})
#: Time until a desk that found no robot tries again, and time between two pieces of a growing text.
_RETRY_S, _INTERVAL_S = 0.3, 0.2
_OPTIONS: tuple[dict[str, Any], ...] = (
    *({},) * 10,
    *({"preempt": True}, {"preempt": True, "priority": 2}, {"flush": True, "priority": -1}),
    *({"priority": -1, "ttl": 3.0}, {"preempt": True, "ttl": 0.2}, {"preempt": True, "ttl": 0.5}),
    *({"preempt": True, "ttl": 1.0}, {"ttl": 2.0}, {"ttl": 8.0}, {"key": "one"}, {"patient": True}, {"feedback": True}),
    *({"stall": 1.0}, {"stall": 5.0}, {"stall": 5.0, "preempt": True}, {"stall": 60.0, "ttl": 8.0}),  # growing texts
)


@dataclass(slots=True)
class Sent:
    """A goal that a desk has sent once or twice. All times are Unix times."""

    id: str
    text: str
    ttl: float | None
    sent_at: list[float] = field(default_factory=lambda: [time.time()])
    ends: list[tuple[str, float]] = field(default_factory=list)  # end and time, as the desks received them


class Ledger:
    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self.goals: list[Sent] = []
        self.ends: Counter[str] = Counter()

    def new(self, ttl: float | None = None) -> Sent:
        number = next(self._numbers)
        goal = Sent(f"soak:{number}", f"go to {number}", ttl)
        self.goals.append(goal)
        return goal

    def end(self, goal: Sent, end: str) -> None:
        with self._lock:
            goal.ends.append((end, time.time()))
            self.ends[end] += 1


def connect(broker: Broker, robot: str, user: str) -> Connection:
    return run_blocking(RobotConnection.open(robot, from_environment(broker.env(user, password=False)), name="soak"))


class Desks:
    """Sends goals to a robot until they are stopped."""

    def __init__(self, robot: str, broker: Broker, ledger: Ledger, seed: str) -> None:
        self._robot, self._broker, self._ledger = robot, broker, ledger
        self.workers = Workers()
        for number in range(_DESKS):
            name = f"desk-{number}"
            self.workers.start(name, partial(self._work, name, random.Random(f"{seed} {name}")))

    def _work(self, name: str, rng: random.Random, over: threading.Event) -> None:
        earlier: deque[Sent] = deque(maxlen=10)
        for client, connection in self._connections(name, over):
            for _ in range(rng.randrange(1, 12)):
                if over.is_set() or connection.ended is not None:
                    break
                self._follow(client, rng, over, earlier)

    def _connections(self, name: str, over: threading.Event) -> Iterator[tuple[Client, Connection]]:
        while not over.is_set():
            try:
                connection = connect(self._broker, self._robot, name)
            except ServerUnavailable:
                over.wait(_RETRY_S)
                continue
            with Client.over(connection) as client:
                yield client, connection

    def _follow(self, client: Client, rng: random.Random, over: threading.Event, earlier: deque[Sent]) -> None:
        """Send goals and wait for their ends. Sometimes cancel a goal, or send a goal again."""
        sent = [self._say(client, rng.choice(_OPTIONS)) for _ in range(rng.choice((1, 1, 1, 3)))]
        over.wait(rng.random() * 0.4)
        goals = [pair for pair in sent if pair]
        if goals and rng.random() < 0.2:
            sent.append(self._say_again(client, goals[0][0]))
        if goals and rng.random() < 0.4:
            self._cancel(client, goals[0][1], rng)
        self._await_ends(sent, rng)
        if earlier and rng.random() < 0.3:
            self._await_ends([self._say_again(client, rng.choice(earlier))], rng)
        earlier.extend(goal for goal, _ in goals)

    def _say(self, client: Client, options: dict[str, Any]) -> tuple[Sent, GoalHandle] | None:
        return self._send(client, self._ledger.new(options.get("ttl")), options)

    def _say_again(self, client: Client, goal: Sent) -> tuple[Sent, GoalHandle] | None:
        goal.sent_at.append(time.time())
        return self._send(client, goal, {"ttl": goal.ttl})

    def _send(self, client: Client, goal: Sent, options: dict[str, Any]) -> tuple[Sent, GoalHandle] | None:
        try:
            if "stall" not in options:
                return goal, client.say(goal.text, id=goal.id, rate=RATE, **options)
            with client.stream(id=goal.id, rate=RATE, **options) as speech:
                for text in (goal.text, ". Then ", "go on, ", "and wait."):
                    speech.write(text)
                    time.sleep(_INTERVAL_S)
            assert speech.goal
            return goal, speech.goal
        except Lost:
            self._ledger.end(goal, "LOST")
        except ServerUnavailable:
            self._ledger.end(goal, UNSENT)
        except RequestRefused:
            self._ledger.end(goal, REFUSED)
        return None

    def _cancel(self, client: Client, handle: GoalHandle, rng: random.Random) -> None:
        try:
            rng.choices((handle.cancel, handle.request_cancel, client.status, client.cancel), (5, 4, 4, 1))[0]()
        except (Lost, ServerUnavailable, UnknownGoal):
            pass  # the goal will still have an end

    def _await_ends(self, sent: list[tuple[Sent, GoalHandle] | None], rng: random.Random) -> None:
        for goal, handle in filter(None, sent):
            if rng.random() < 0.5:
                self._ledger.end(goal, handle.wait(PATIENCE_S).state.name)
                continue
            *before, last = handle.events(PATIENCE_S)
            assert isinstance(last, Result), f"{handle.id}: the last event is {last}"
            assert not any(isinstance(event, Result) for event in before), f"{handle.id} has two results: {before}"
            self._ledger.end(goal, last.goal.state.name)
