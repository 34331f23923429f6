"""The desks of the fleet's soak: some use the library, some the command. Each must hear one end of every goal."""

from __future__ import annotations

import itertools
import json
import random
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from talkcli import Client
from talkcli.errors import Lost, RequestRefused, ServerUnavailable, UnknownGoal
from talkcli.fleet.broker import from_environment
from talkcli.fleet.desk.robot import connect_robot
from talkcli.protocol.events import Result
from tests.support.bridge import Desk
from tests.tools.soak_clients import PATIENCE_S, Workers

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.client.connection import Connection
    from talkcli.client.goal import GoalHandle
    from tests.support.broker import Broker

RATE = 450
#: Ends of a goal that was not sent, or that the robot refused.
UNSENT, REFUSED = "UNSENT", "REFUSED"
UNSPOKEN = frozenset({UNSENT, REFUSED, "REJECTED", "RECALLED"})
_END_OF_CODE = {0: "SUCCEEDED", 3: UNSENT, 4: "ABORTED", 5: "REJECTED", 6: "RECALLED", 7: "PREEMPTED", 12: "LOST"}
#: Seconds until a desk that found no robot tries again.
_RETRY_S = 0.3
_OPTIONS: tuple[dict[str, Any], ...] = (
    *({},) * 10,
    *({"preempt": True}, {"preempt": True, "priority": 2}, {"flush": True, "priority": -1}),
    *({"priority": -1, "ttl": 3.0}, {"preempt": True, "ttl": 0.2}, {"preempt": True, "ttl": 0.5}),
    *({"preempt": True, "ttl": 1.0}, {"ttl": 2.0}, {"ttl": 8.0}, {"key": "one"}, {"patient": True}, {"feedback": True}),
)
_COMMAND_OPTIONS: tuple[tuple[str, ...], ...] = ((), (), ("--preempt",), ("--priority", "1"), ("--feedback",))


@dataclass(slots=True)
class Sent:
    """A goal that a desk has sent once or twice. All times are of the wall clock."""

    id: str
    text: str
    ttl: float | None
    once: bool = True
    sent_at: list[float] = field(default_factory=lambda: [time.time()])
    ends: list[tuple[str, float]] = field(default_factory=list)  # as the desks were told


class Ledger:
    """All goals that the desks have sent."""

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

    def end(self, goal: Sent, how: str) -> None:
        with self._lock:
            goal.ends.append((how, time.time()))
            self.ends[how] += 1


def connect(broker: Broker, robot: str, user: str) -> Connection:
    """Return a connection of this user to a robot."""
    return connect_robot(robot, from_environment(broker.env(user, password=False)), name="soak")


class Desks:
    """Sends goals to a robot until they are stopped."""

    def __init__(self, robot: str, broker: Broker, ledger: Ledger, seed: str) -> None:
        self._robot, self._broker, self._ledger = robot, broker, ledger
        self.workers = Workers()
        kinds = [("library", self._use_library)] * 4 + [("command", self._use_command)] * 2
        for number, (kind, use) in enumerate([*kinds, ("urgent", self._send_urgent_goals)]):
            name = f"{kind}-{number}"
            chance = random.Random(f"{seed} {name}")
            self.workers.start(name, lambda over, use=use, name=name, chance=chance: use(name, chance, over))  # type: ignore[misc]

    # -- the library

    def _use_library(self, name: str, chance: random.Random, over: threading.Event) -> None:
        earlier: deque[Sent] = deque(maxlen=10)
        for client, connection in self._connections(name, over):
            for _ in range(chance.randrange(1, 12)):
                if over.is_set() or connection.ended is not None:
                    break
                self._follow(client, chance, over, earlier)

    def _send_urgent_goals(self, name: str, chance: random.Random, over: threading.Event) -> None:
        """Send goals that expire at once: if they are under way for long, they must not begin."""
        for client, connection in self._connections(name, over):
            while connection.ended is None and not over.wait(chance.uniform(0.5, 3)):
                self._await_ends([self._say(client, {"preempt": True, "ttl": 0.2})], chance)

    def _connections(self, name: str, over: threading.Event) -> Iterator[tuple[Client, Connection]]:
        while not over.is_set():
            try:
                connection = connect(self._broker, self._robot, name)
            except ServerUnavailable:
                over.wait(_RETRY_S)
                continue
            with Client.over(connection) as client:
                yield client, connection

    def _follow(self, client: Client, chance: random.Random, over: threading.Event, earlier: deque[Sent]) -> None:
        """Send goals and wait for their ends. Now and then cancel one, or send one or an earlier one again."""
        sent = [self._say(client, chance.choice(_OPTIONS)) for _ in range(chance.choice((1, 1, 1, 3)))]
        over.wait(chance.random() * 0.4)
        goals = [each for each in sent if each]
        if goals and chance.random() < 0.2:
            sent.append(self._say_again(client, goals[0][0]))
        if goals and chance.random() < 0.4:
            self._cancel(client, goals[0][1], chance)
        self._await_ends(sent, chance)
        if earlier and chance.random() < 0.3:
            self._await_ends([self._say_again(client, chance.choice(earlier))], chance)
        earlier.extend(goal for goal, _ in goals)

    def _say(self, client: Client, options: dict[str, Any]) -> tuple[Sent, GoalHandle] | None:
        return self._send(client, self._ledger.new(options.get("ttl")), options)

    def _say_again(self, client: Client, goal: Sent) -> tuple[Sent, GoalHandle] | None:
        goal.once = False
        goal.sent_at.append(time.time())
        return self._send(client, goal, {"ttl": goal.ttl})

    def _send(self, client: Client, goal: Sent, options: dict[str, Any]) -> tuple[Sent, GoalHandle] | None:
        try:
            return goal, client.say(goal.text, id=goal.id, rate=RATE, **options)
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
            pass  # the goal has an end all the same

    def _await_ends(self, sent: list[tuple[Sent, GoalHandle] | None], chance: random.Random) -> None:
        for goal, handle in filter(None, sent):
            if chance.random() < 0.5:
                self._ledger.end(goal, handle.wait(PATIENCE_S).state.name)
                continue
            *before, last = handle.events(PATIENCE_S)
            assert isinstance(last, Result), f"{handle.id}: the last event is {last}"
            assert not any(isinstance(each, Result) for each in before), f"{handle.id} has two results: {before}"
            self._ledger.end(goal, last.goal.state.name)

    # -- the command

    def _use_command(self, name: str, chance: random.Random, over: threading.Event) -> None:
        with Desk(self._broker, user=name, password=False, env={"TALK_ROBOT": self._robot}) as desk:
            while not over.is_set():
                goal = self._ledger.new()
                options = ("--id", goal.id, "--rate", str(RATE), *chance.choice(_COMMAND_OPTIONS))
                command = desk.start("--json", "say", "--wait", *options, "--", goal.text)
                if chance.random() < 0.2:  # killed while it starts, or waits
                    over.wait(chance.uniform(0.1, 1.0))
                    command.kill()
                    command.communicate()
                    continue
                done = desk.finish(command, timeout=PATIENCE_S)
                assert done.code in _END_OF_CODE, done
                end = _END_OF_CODE[done.code]
                self._ledger.end(goal, end)
                assert end in (UNSENT, "LOST") or _printed_ends(done.out) == [end], done
                if end == UNSENT:
                    over.wait(_RETRY_S)
                if chance.random() < 0.05:
                    done = desk.run("cancel", timeout=PATIENCE_S)
                    assert done.code in (0, 3, 12), done


def _printed_ends(out: str) -> list[str]:
    """Return the end states that a command has printed, with or without feedback before them."""
    lines = [json.loads(each) for each in out.splitlines()]
    return [each.get("goal", each)["state"] for each in lines if each.get("event", "result") == "result"]
