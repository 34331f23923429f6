"""A desk's connection to one robot of a fleet: the library's `Connection`, by a broker and the robot's bridge.

A broker goes and comes back, and so does a bridge; the robot speaks on meanwhile. So this connects anew by itself, and
then asks again what was not answered. Of a goal it asks by its id what became of it: the sentence is sent a second time
only where the robot has never heard of it. What has happened by then to goals that are followed is heard then.
"""

from __future__ import annotations

import os
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from talkcli import __version__
from talkcli.client.connect import ANSWER_LIMIT, sender
from talkcli.client.connection import BaseConnection, Exchange
from talkcli.errors import (
    AccessDenied,
    BadRequest,
    Lost,
    ServerUnavailable,
    TalkError,
    UnknownGoal,
    UsageError,
)
from talkcli.fleet import topics
from talkcli.fleet.desk.desk import ABSENCE_LIMIT, Desk
from talkcli.fleet.link import REFUSED, boottime
from talkcli.frozen import replace
from talkcli.goals.option import MAX_NAME
from talkcli.goals.options import Cancel, Say, Set
from talkcli.goals.states import State
from talkcli.polling import wait_ready
from talkcli.protocol.events import ServerStatus, Snapshot, check_greeting
from talkcli.protocol.lines import LineSplitter, decode, request_line, write_request
from talkcli.protocol.requests import Hello, Pause, Resume, Wait, Watch
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from talkcli.client.connection import OnReply
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.link import Link
    from talkcli.fleet.message import Message
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

#: Seconds for which the broker keeps anything but a sentence for a robot: what is later, nobody waits for.
EXPIRY = 5
#: Seconds after which one who waits says again that it is there: a bridge lets go of who says nothing for 90.
_SIGN_OF_LIFE = 30.0
#: Times that a request goes out again after an absence: a broker may end the connection because of it.
_MAX_TRIES = 5
#: Seconds between two tries to reach a broker that is not there yet.
_PAUSE_S = 0.25
#: Characters of a user's name in the ids that are given here, which have 64 at most.
_OF_USER = 48
#: Goals that are asked for at once after an absence: a bridge takes 64 requests of one asker.
_ASKED_AT_ONCE = 32


class RobotConnection(BaseConnection):
    """A connection to a robot's server, by the broker. A thread of its own it has only while it connects."""

    lasting = (Say, Cancel, Set, Pause, Resume)
    #: no process of this machine
    listener: int | None = None

    def __init__(
        self,
        robot: str,
        desk: Desk,
        *,
        name: str | None = None,
        interrupt: Mapping[int, int] | None = None,
        patience: float = ANSWER_LIMIT,
        end: float | None = None,
        numbers: Iterator[int] | None = None,
    ) -> None:
        """A robot that `desk` will tell of, see `reach`; what is asked before that waits.

        `robot`: its name; `name`, `interrupt`, `patience`: as of `SocketConnection`; `end`: until when an answer is
        waited for at most, by the monotonic clock, absences included; `numbers`: those of requests, where others of the
        desk have some, too. UsageError for names that can't be.
        """
        super().__init__(patience)
        fault = topics.fault(robot)
        if fault:
            raise UsageError(f"no robot can be called '{printable(robot)}': a name {fault}")
        self._name = sender(name)
        if self._name and len(self._name) > MAX_NAME:
            raise UsageError(f"the name of the sender has {len(self._name)} characters, the longest is {MAX_NAME}")
        self._robot, self._desk = robot, desk
        self._numbers = numbers or self._numbers
        self.path = f"{robot} ({desk.broker.url})"
        self._interrupt, self._end = interrupt, end
        self._signed_at = time.monotonic()
        self._splitter = LineSplitter()
        #: the robot's presence, as it is known on this connection to the broker
        self._presence: JsonObject = {}
        #: the bridge that was asked, by its session; None where it has to be asked anew
        self._bridge: object = None
        #: since when there is nobody to ask, by the monotonic clock; None while there is
        self._absent_since: float | None = self._signed_at
        #: goals that are followed, and whether each of their words is
        self._goals: dict[str, bool] = {}
        #: goals that are cancelled, whoever is there to hear it
        self._withdrawn: set[str] = set()
        #: goals to be asked for, and those that are being asked for: by number, the id and who waits for it
        self._to_ask: deque[tuple[str, Exchange | None]] = deque()
        self._asked: dict[int, tuple[str, Exchange | None]] = {}

    # -- requests

    def begin(self, request: Request, on_reply: OnReply | None = None) -> Exchange:
        if isinstance(request, Say) and request.id is None:
            request = replace(request, id=new_id(self._desk))
        return super().begin(request, on_reply)

    def expect(self, exchange: Exchange) -> None:
        """Take in the answer to a request that was sent to a group of which this robot is one."""
        self._exchanges[exchange.number] = exchange
        self._signed_at = time.monotonic()

    def post(self, request: Request) -> None:
        if not self._publish(next(self._numbers), request):
            raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {self.ended or self._absent}")

    def withdraw(self, goal_id: str, *, told: bool) -> None:
        """Cancel a goal, and again after each absence, and send it no more; `told`: not now, the robot knows of it."""
        with self.changed:
            self._withdrawn.add(goal_id)
            if not told:
                self._publish(next(self._numbers), Cancel((goal_id,)))

    def _send(self, number: int, request: Request) -> None:
        with self.changed:  # so that nobody asks again for what is just being sent
            exchange = self._exchanges[number]
            if isinstance(request, Say) and request.ttl:
                exchange.latest = boottime() + request.ttl
            exchange.sent = self._publish(number, request, exchange)
        if not exchange.sent:
            self._desk.wake()  # it goes out as soon as there is somebody to ask

    def _publish(self, number: int, request: Request, exchange: Exchange | None = None) -> bool:
        """Send a request to the robot, and return whether that was possible."""
        link = self._desk.link
        if link is None or self.ended is not None or self._absent_since is not None:
            return False

        def acknowledged(code: int) -> None:
            if exchange is not None and code >= REFUSED:
                exchange.error = self._desk.refused(code, f"ask {self._robot} for anything")

        line = request_line({"seq": number, **write_request(request)})
        if (refused := link.too_long(line, request.kind)) is not None:
            if exchange is not None:
                exchange.error = refused
            return False
        self._signed_at = time.monotonic()
        topic = topics.robot(self._robot, topics.REQUEST, self._desk.user)
        response = self._desk.answers(self._robot)
        expiry = (request.ttl or None) if isinstance(request, Say) else EXPIRY
        return link.publish(topic, line, expiry=expiry, response=response, acknowledged=acknowledged)

    def answer_by(self, exchange: Exchange) -> float:
        if self._absent_since is None:
            by = super().answer_by(exchange)
        else:
            by = self._absent_since + (ABSENCE_LIMIT if self._patience >= ANSWER_LIMIT else self._patience)
        return by if self._end is None else min(by, max(self._end, exchange.touched))

    @property
    def _no_reply(self) -> str:
        return super()._no_reply if self._absent_since is None else self._absent

    def silent_by(self, began: float) -> tuple[float, str]:
        if self._absent_since is None:
            return super().silent_by(began)
        return self._absent_since + ABSENCE_LIMIT, f"{self._absent}, for {ABSENCE_LIMIT:g} s"

    def _refusal(self, reply: JsonObject, items: list[JsonObject]) -> TalkError:
        error = super()._refusal(reply, items)
        kinds = {"not_allowed": AccessDenied, "no_server": ServerUnavailable, "stale": ServerUnavailable, "lost": Lost}
        kind = kinds.get(error.code)
        return kind(f"{self._robot}: {error.message}") if kind else error

    # -- what comes

    def _fill(self, timeout: float, interruptible: bool) -> None:
        self.sign()
        self._desk.serve(timeout, self._interrupt if interruptible else None)

    def sign(self) -> None:
        """Say that one still waits, where that is due."""
        if time.monotonic() - self._signed_at > _SIGN_OF_LIFE:
            self._publish(next(self._numbers), Hello(self._name))

    # -- what the desk tells

    def came_up(self, link: Link) -> None:
        """Have the robot's answers come, and its presence."""
        link.subscribe(self._desk.answers(self._robot), retained=False)
        link.subscribe(topics.robot(self._robot, topics.PRESENCE), retained=True)

    def went_down(self, why: str) -> None:
        """Take the robot for absent until the broker tells of it again."""
        with self.changed:
            self._splitter = LineSplitter()
            self._presence, self._bridge = {}, None
            self._away(why)

    def hear(self, message: Message) -> None:
        """Take in the robot's presence, or lines of its server's."""
        with self.changed:
            if message.topic == topics.robot(self._robot, topics.PRESENCE):
                self._be_present(message.payload)
            else:
                self._heard = time.monotonic()
                self._lines.extend(self._splitter.feed(message.payload))

    def _away(self, why: str) -> None:
        self._absent = why
        if self._absent_since is None:
            self._absent_since = time.monotonic()

    def _be_present(self, payload: bytes) -> None:
        """Take up what the robot's bridge, or its will, says of the robot."""
        try:
            said = decode(payload.strip())
        except BadRequest:
            return  # somebody has cleared it
        self._presence = said
        server = said.get("server")
        if said.get("online") is not True:
            self._away(f"{self._robot} is offline")
        elif not isinstance(server, dict):
            self._away(f"{self._robot} has no talk server at this moment")
        elif self._bridge != said.get("session") or self._absent_since is not None:
            self.boot = server["boot"] if isinstance(server.get("boot"), str) else ""
            self.pid = server["pid"] if isinstance(server.get("pid"), int) else None
            self._bridge = said.get("session")
            self._absent_since, self._heard = None, time.monotonic()
            self._ask_again()

    # -- the beginning

    def greet(self, give_up: float) -> None:
        """Wait until the broker has told of the robot, and until `give_up` (monotonic) for it to be online.

        Errors as of `reach`.
        """
        left = self._patience if self._end is None else max(0.0, self._end - time.monotonic())
        self._desk.await_kept(min(self._patience, left), lambda: bool(self._presence), self._interrupt)
        while self._absent_since is not None and self._desk.link and (left := give_up - time.monotonic()) > 0:
            self._desk.serve(left, self._interrupt)
        self._patience = max(self._patience, round(give_up - time.monotonic(), 1))
        if not self._presence:
            words = f"no robot '{self._robot}' is known at {self._desk.broker.url}: nothing was sent"
            raise ServerUnavailable(f"{words}; on the robot: talk bridge --name {self._robot}")
        self.check()

    def check(self) -> None:
        """Raise what keeps the robot from being asked: ServerUnavailable, ProtocolMismatch."""
        check_greeting(self._presence, __version__)
        if self._absent_since is not None:
            raise ServerUnavailable(f"{self._absent}: nothing was sent")

    # -- after an absence

    def _ask_again(self) -> None:
        """Ask again for what was not answered, and for what became of the goals that are followed."""
        if self._name:
            self._publish(next(self._numbers), Hello(self._name))
        if self._withdrawn:
            self._publish(next(self._numbers), Cancel(tuple(self._withdrawn)))
        for number in self._asked:
            del self._exchanges[number]
        self._asked.clear()
        self._to_ask = deque((each, None) for each in self._goals)
        for exchange in [each for each in list(self._exchanges.values()) if not each.over]:
            if not exchange.sent:
                self._say_again(exchange)
            elif isinstance(exchange.request, Say):
                self._to_ask.append((str(exchange.request.id), exchange))
            elif isinstance(exchange.request, self.lasting):
                exchange.error = self._lost(exchange, self._absent)  # a second time it could mean what has come since
            else:
                self._say_again(exchange)
        if self.followed.watched:
            self._ask(Watch(), "", None)
        self._ask_more()

    def _say_again(self, exchange: Exchange) -> None:
        """Send a request once more, or at last; a sentence only as long as it may still begin."""
        request = exchange.request
        left = 0.0 if exchange.latest is None else exchange.latest - boottime()
        exchange.tries += 1
        why = "its time was over before an answer came" if left < 0 else f"{self._absent}, {_MAX_TRIES} times"
        if isinstance(request, Say) and request.id in self._withdrawn:
            left, why = -1.0, "it was cancelled before the robot had heard of it"
        if left < 0 or exchange.tries > _MAX_TRIES:
            exchange.error = self._lost(exchange, why)
            return
        if isinstance(request, Say) and left:
            request = replace(request, ttl=left)
        exchange.items.clear()
        exchange.touched = time.monotonic()
        exchange.sent = self._publish(exchange.number, request, exchange) or exchange.sent

    def _lost(self, exchange: Exchange, why: str) -> Lost:
        words = f"{exchange.request.kind} was sent to the server at {self.path}, but {why}"
        return Lost(f"{words}; it may have been carried out")

    def _ask_more(self) -> None:
        """Ask for goals, as many at once as a bridge takes."""
        while self._to_ask and len(self._asked) < _ASKED_AT_ONCE:
            goal_id, exchange = self._to_ask.popleft()
            feedback = self._goals.get(goal_id, False)
            if exchange is not None and isinstance(exchange.request, Say):
                feedback = exchange.request.feedback
                exchange.touched = time.monotonic()
            self._ask(Wait((goal_id,), feedback), goal_id, exchange)

    def _ask(self, request: Request, goal_id: str, waiting: Exchange | None) -> None:
        """Ask something that nobody of this program waits for."""
        number = next(self._numbers)
        self._asked[number] = goal_id, waiting
        self._exchanges[number] = Exchange(number, request, self._on_news)
        self._publish(number, request)

    def _dispatch(self, message: JsonObject) -> None:
        if message.get("event") == "gone":
            self.ended = self.ended or printable(str(message.get("message") or "the server went away"))
            return
        super()._dispatch(message)
        if message.get("event") == "result":
            goal = message.get("goal")
            self._goals.pop(str(goal.get("id")) if isinstance(goal, dict) else "", None)
        number = message.get("seq")
        exchange = self._exchanges.get(number) if isinstance(number, int) else None
        if exchange is None or exchange.reply is not message:
            return
        if message.get("ok") is True:
            self._keep(exchange)
        if exchange.number in self._asked:
            del self._exchanges[exchange.number]
            self._learn(*self._asked.pop(exchange.number), exchange)
            self._ask_more()

    def _on_news(self, reply: JsonObject, items: list[JsonObject]) -> None:
        """Tell those who follow goals, or watch all, how it stands now; the reply to what `_ask` has asked."""
        if "server" in reply:
            self.followed.hear(Snapshot(ServerStatus.from_reply(reply, items)).to_json())

    def _keep(self, exchange: Exchange) -> None:
        """Keep in mind whose end will be told from now on."""
        request, reply = exchange.request, exchange.reply or {}
        if isinstance(request, Say) and request.wait:
            found, feedback = [reply.get("goal")], request.feedback
        elif isinstance(request, Wait):
            found, feedback = [each.get("goal") for each in exchange.items], request.feedback
        else:
            return
        for goal in found:
            if isinstance(goal, dict) and not _state(goal).terminal:
                goal_id = str(goal.get("id"))
                self._goals[goal_id] = self._goals.get(goal_id, False) or feedback

    def _learn(self, goal_id: str, waiting: Exchange | None, answer: Exchange) -> None:
        """Take up what the robot says of a goal that was asked for after an absence."""
        if not goal_id:
            return
        goal = next((each["goal"] for each in answer.items if isinstance(each.get("goal"), dict)), None)
        if isinstance(goal, dict):
            if waiting is not None and not waiting.over:
                reply: JsonObject = {"ok": True, "goal": goal}
                if waiting.on_reply:
                    waiting.on_reply(reply, [])
                waiting.reply = reply
            elif not _state(goal).terminal:  # else its result comes next
                self.followed.hear({"event": "state", "id": goal_id, "state": _state(goal).name})
            return
        refused = self._refusal(answer.reply or {}, [])
        if waiting is not None and isinstance(refused, UnknownGoal):
            self._say_again(waiting)
        elif waiting is not None:
            waiting.error = Lost(f"what became of {goal_id} is not told, it may still be spoken: {refused.message}")
        else:
            self._goals.pop(goal_id, None)
            self.followed.lose(goal_id, f"{refused.message}; it may have been spoken")

    # -- the end

    def hang_up(self) -> None:
        """Have the bridge let its own connection for this one go, by an empty line."""
        link = self._desk.link
        if link is not None and self._bridge is not None:
            topic = topics.robot(self._robot, topics.REQUEST, self._desk.user)
            link.publish(topic, b"", 0, response=self._desk.answers(self._robot))

    def _hang_up(self) -> None:
        self.hang_up()
        self._desk.wake()

    def _drop(self) -> None:
        if os.getpid() != self._process:
            self._desk.drop()
        else:
            self._desk.close()


def reach(robot: str, broker: Broker, *, keep_trying: float = 0.0, **options: Any) -> RobotConnection:
    """Connect to a robot's server by a desk of its own, and find the robot there; the options are RobotConnection's.

    `keep_trying`: seconds for which a broker that can't be reached is tried again, and the robot is waited for.

    ServerUnavailable where there is no broker, or no such robot, or that has no server: nothing was sent then.
    AccessDenied where the broker doesn't let this user in, or may not be trusted; UsageError for what can't be.
    """
    give_up = time.monotonic() + keep_trying
    while True:
        desk = Desk(broker)
        try:
            desk.visitor = connection = RobotConnection(robot, desk, **options)
            connection.greet(give_up)
            return connection
        except BaseException as error:
            desk.close()
            left = give_up - time.monotonic()
            if not isinstance(error, ServerUnavailable) or left <= 0:
                raise
        wait_ready({}, min(_PAUSE_S, left), options.get("interrupt"))


def new_id(desk: Desk) -> str:
    """Return an id for a sentence, by which it can be asked for; it is not of the form of a server's own."""
    return f"{desk.user[:_OF_USER]}:{os.urandom(5).hex()}"


def _state(goal: JsonObject) -> State:
    """Return a goal's state; ValueError where it is none."""
    name = goal.get("state")
    if name not in State.__members__:
        raise ValueError(f"the state {name!a} is none")
    return State[str(name)]
