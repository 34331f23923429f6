"""A desk's connection to one robot of a fleet: the library's `Connection`, by a broker and the robot's bridge.

A broker goes and comes back, and so does a bridge; the robot speaks on meanwhile. So this connects anew by itself, and
then asks again what was not answered. Of a goal it asks by its id what became of it: the sentence is sent a second time
only where the robot has never heard of it. What has happened by then to goals that are followed is heard then.
"""

from __future__ import annotations

import os
import random
import select
import time
from collections import deque
from typing import TYPE_CHECKING

from talkcli import __version__
from talkcli.client.connect import ANSWER_LIMIT, ready, sender
from talkcli.client.connection import BaseConnection, Exchange
from talkcli.errors import (
    AccessDenied,
    BadRequest,
    Lost,
    RequestRefused,
    ServerUnavailable,
    TalkError,
    UnknownGoal,
    UsageError,
)
from talkcli.fleet import topics
from talkcli.fleet.broker import user
from talkcli.fleet.link import KEEPALIVE, NOT_AUTHORIZED, REFUSED, TICK, Link, Opening, boottime
from talkcli.frozen import replace
from talkcli.goals.option import MAX_NAME
from talkcli.goals.options import Cancel, Say, Set
from talkcli.goals.states import State
from talkcli.protocol.events import ServerStatus, Snapshot, check_greeting
from talkcli.protocol.lines import LineSplitter, decode, request_line, write_request
from talkcli.protocol.requests import Hello, Pause, Resume, Wait, Watch
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from talkcli.client.connection import OnReply
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.message import Message
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

#: Seconds after which a broker or a robot that went away counts as gone, and what was waited for as lost: bridges are
#: back within 15 s of their broker, and systemd starts one again after two.
ABSENCE_LIMIT = 30.0
#: Seconds between two tries to reach a broker that went away: any time up to the first, doubled up to the second.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 10.0
#: Seconds for which a robot's presence is awaited that the broker keeps: some send it a moment after the rest.
_GRACE = 0.3
#: Seconds for which the broker keeps anything but a sentence for a robot: what is later, nobody waits for.
_EXPIRY = 5
#: Seconds after which one who waits says again that it is there: a bridge lets go of who says nothing for 90.
_SIGN_OF_LIFE = 30.0
#: Times that a request goes out again after an absence: a broker may end the connection because of it.
_MAX_TRIES = 5
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
        broker: Broker,
        *,
        name: str | None = None,
        interrupt: Mapping[int, int] | None = None,
        patience: float = ANSWER_LIMIT,
        end: float | None = None,
    ) -> None:
        """Connect, and find the robot there.

        `robot`: its name; `name`, `interrupt`, `patience`: as of `SocketConnection`; `end`: until when an answer is
        waited for at most, by the monotonic clock, absences included.

        ServerUnavailable where there is no broker, or no such robot, or that has no server: nothing was sent then.
        AccessDenied where the broker doesn't let this user in, or may not be trusted; UsageError for what can't be.
        """
        super().__init__(patience)
        fault = topics.fault(robot)
        if fault:
            raise UsageError(f"no robot can be called '{printable(robot)}': a name {fault}")
        self._name = sender(name)
        if self._name and len(self._name) > MAX_NAME:
            raise UsageError(f"the name of the sender has {len(self._name)} characters, the longest is {MAX_NAME}")
        self._robot, self._broker, self._user = robot, broker, user(broker)
        self.path = f"{robot} ({broker.url})"
        self._interrupt, self._end = interrupt, end
        #: by which the broker and the bridge tell this connection from others of the user's
        self._session = os.urandom(8).hex()
        self._link: Link | None = None
        self._opening: Opening | None = None
        #: what went wrong last on the way to the broker
        self._failure: TalkError | None = None
        self._tries = 0
        self._next_try = self._served_at = self._signed_at = time.monotonic()
        self._wake, self._write = os.pipe()
        for each in (self._wake, self._write):
            os.set_blocking(each, False)
        #: what has come and is not taken in yet, in its order
        self._inbox: deque[Message] = deque()
        self._splitter = LineSplitter()
        #: the robot's presence, as it is known on this link; and when the link's own marker came back
        self._presence: JsonObject = {}
        self._marked_at: float | None = None
        #: the bridge that was asked, by its session; None where it has to be asked anew
        self._bridge: object = None
        #: since when there is nobody to ask, by the monotonic clock; None while there is
        self._absent_since: float | None = self._served_at
        #: goals that are followed, and whether each of their words is
        self._goals: dict[str, bool] = {}
        #: goals to be asked for, and those that are being asked for: by number, the id and who waits for it
        self._to_ask: deque[tuple[str, Exchange | None]] = deque()
        self._asked: dict[int, tuple[str, Exchange | None]] = {}
        try:
            self._greet()
        except BaseException:
            self.close()
            raise

    # -- requests

    def request(
        self, request: Request, on_reply: OnReply | None = None, *, slow: bool = False
    ) -> tuple[JsonObject, list[JsonObject]]:
        if isinstance(request, Say) and request.id is None:
            # By it the goal can be asked for; it is not of the form of a server's own.
            request = replace(request, id=f"{self._user[:_OF_USER]}:{os.urandom(5).hex()}")
        return super().request(request, on_reply, slow=slow)

    def post(self, request: Request) -> None:
        if not self._publish(next(self._numbers), request):
            raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {self.ended or self._absent}")

    def _send(self, number: int, request: Request) -> None:
        with self.changed:  # so that nobody asks again for what is just being sent
            exchange = self._exchanges[number]
            if isinstance(request, Say) and request.ttl:
                exchange.latest = boottime() + request.ttl
            exchange.sent = self._publish(number, request, exchange)
        if not exchange.sent:
            self._wake_up()  # it goes out as soon as there is somebody to ask

    def _publish(self, number: int, request: Request, exchange: Exchange | None = None) -> bool:
        """Send a request to the robot, and return whether that was possible."""
        link = self._link
        if link is None or self.ended is not None or self._absent_since is not None:
            return False

        def acknowledged(code: int) -> None:
            if exchange is not None and code >= REFUSED:
                exchange.error = self._refused(code, f"ask {self._robot} for anything")

        line = request_line({"seq": number, **write_request(request)})
        if len(line) > link.room:
            if exchange is not None:
                words = f"{request.kind} has {len(line):,} bytes, and the broker takes {link.room:,}: nothing was sent"
                exchange.error = RequestRefused(words, "too_long")
            return False
        self._signed_at = time.monotonic()
        topic = topics.robot(self._robot, topics.REQUEST, self._user)
        response = topics.reply(self._user, self._session, self._robot)
        expiry = (request.ttl or None) if isinstance(request, Say) else _EXPIRY
        return link.publish(topic, line, expiry=expiry, response=response, acknowledged=acknowledged)

    def _answer_by(self, exchange: Exchange) -> float:
        if self._absent_since is None:
            by = super()._answer_by(exchange)
        else:
            by = self._absent_since + (ABSENCE_LIMIT if self._patience >= ANSWER_LIMIT else self._patience)
        return by if self._end is None else min(by, max(self._end, exchange.touched))

    def _silent_by(self, began: float) -> tuple[float, str]:
        if self._absent_since is None:
            return super()._silent_by(began)
        return self._absent_since + ABSENCE_LIMIT, f"{self._absent}, for {ABSENCE_LIMIT:g} s"

    def _refusal(self, reply: JsonObject, items: list[JsonObject]) -> TalkError:
        error = super()._refusal(reply, items)
        kinds = {"not_allowed": AccessDenied, "no_server": ServerUnavailable, "stale": ServerUnavailable, "lost": Lost}
        kind = kinds.get(error.code)
        return kind(f"{self._robot}: {error.message}") if kind else error

    # -- what comes

    def _fill(self, timeout: float, interruptible: bool) -> None:
        link = self._link
        now = time.monotonic()
        if link is not None and (link.ended or now - self._served_at > 2 * KEEPALIVE):
            self._lose_link(link)
            link = None
        due = self._see_to(link, now)
        watched = {self._wake: select.POLLIN}
        descriptor = -1 if link is None else link.fileno()
        if link is not None and descriptor >= 0:  # another thread may have found out that it has ended
            watched[descriptor] = select.POLLIN | (select.POLLOUT if link.wants_write else 0)
        found = ready(watched, min(timeout, due), self._interrupt if interruptible else None)
        if self._wake in found:
            os.read(self._wake, 4096)
        self._served_at = time.monotonic()
        if link is not None and descriptor in found:
            link.read()
        with self.changed:
            self._take()

    def _see_to(self, link: Link | None, now: float) -> float:
        """Do what is due without anybody's word, and return the seconds until more is."""
        if link is None:
            opening = self._opening
            if opening is None and now >= self._next_try:
                self._opening = Opening(self._new_link(), self._wake_up)
            elif opening is not None and opening.done:
                self._opened(opening)
                return 0.0
            return TICK if self._opening else max(0.0, self._next_try - now)
        if now - self._signed_at > _SIGN_OF_LIFE:
            self._publish(next(self._numbers), Hello(self._name))
        link.tick()
        return TICK if self._marked_at is None or self._presence else min(TICK, _GRACE)

    def _new_link(self) -> Link:
        return Link(self._broker, f"talk-desk-{self._user}-{self._session}", self._inbox.append)

    def _opened(self, opening: Opening) -> None:
        """Take over the connection to the broker, or try again after a while."""
        self._opening = None
        if opening.error is not None:
            self._tries += 1
            longest = min(_LONGEST_PAUSE, _FIRST_PAUSE * 2**self._tries)
            self._next_try = time.monotonic() + random.uniform(0, longest)
            self._failure, self._absent = opening.error, str(opening.error)
            return
        self._link, self._tries, self._served_at = opening.link, 0, time.monotonic()
        self._inbox.clear()
        self._splitter = LineSplitter()
        # The marker comes back behind all that the broker keeps.
        marker = topics.reply(self._user, self._session, topics.MARKER)
        answers = topics.reply(self._user, self._session, self._robot)
        opening.link.subscribe(marker, answers, retained=False)
        opening.link.subscribe(topics.robot(self._robot, topics.PRESENCE), retained=True)
        opening.link.publish(marker, b"\n", acknowledged=self._marker_taken)

    def _marker_taken(self, code: int) -> None:
        if code >= REFUSED:
            self._failure = self._refused(code, f"write to {topics.reply(self._user, '+', '+')}")

    def _lose_link(self, link: Link) -> None:
        link.close()
        self._link, self._presence, self._marked_at, self._bridge = None, {}, None, None
        self._next_try = time.monotonic() + random.uniform(0, _FIRST_PAUSE)
        self._away(f"the broker at {self._broker.url} went away")

    def _away(self, why: str) -> None:
        self._absent = why
        if self._absent_since is None:
            self._absent_since = time.monotonic()

    def _take(self) -> None:
        """Take in what has come, in its order; under `changed`."""
        while self._inbox:
            message = self._inbox.popleft()
            if message.topic == topics.robot(self._robot, topics.PRESENCE):
                self._be_present(message.payload)
            elif message.topic.endswith(f"/{topics.MARKER}"):
                self._marked_at = time.monotonic()
            else:
                self._heard = time.monotonic()
                self._lines.extend(self._splitter.feed(message.payload))

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

    def _greet(self) -> None:
        """Wait until the broker has told of the robot."""
        end = time.monotonic() + self._patience
        while not (self._presence and self._marked_at):
            if self._failure is not None:
                raise self._failure
            now = time.monotonic()
            if self._marked_at is not None and now > self._marked_at + _GRACE:
                break
            if now >= end:
                raise self._unanswered()
            self._fill(end - now, interruptible=True)
        if not self._presence:
            words = f"no robot '{self._robot}' is known at {self._broker.url}: nothing was sent"
            raise ServerUnavailable(f"{words}; on the robot: talk bridge --name {self._robot}")
        check_greeting(self._presence, __version__)
        if self._absent_since is not None:
            raise ServerUnavailable(f"{self._absent}: nothing was sent")
        if self._name:
            self._publish(next(self._numbers), Hello(self._name))

    def _unanswered(self) -> TalkError:
        """Return what is wrong where the broker tells nothing of the robot."""
        if self._link is None or self._marked_at is not None:
            return ServerUnavailable(f"the broker at {self._broker.url} does not answer within {self._patience:g} s")
        return self._forbidden(f"read {topics.reply(self._user, '+', '+')}")

    def _refused(self, code: int, what: str) -> TalkError:
        """Return the error for a reason of the broker's for which it has taken nothing."""
        if code == NOT_AUTHORIZED:
            return self._forbidden(what)
        return ServerUnavailable(f"nothing was sent: the broker at {self._broker.url} refuses it, reason 0x{code:02x}")

    def _forbidden(self, what: str) -> AccessDenied:
        words = f"the broker at {self._broker.url} does not let '{self._user}' {what}"
        return AccessDenied(f"{words}: its ACL needs the lines of an operator, see 'talk bridge --print-acl'")

    # -- after an absence

    def _ask_again(self) -> None:
        """Ask again for what was not answered, and for what became of the goals that are followed."""
        if self._name:
            self._publish(next(self._numbers), Hello(self._name))
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
        if left < 0 or exchange.tries > _MAX_TRIES:
            why = "its time was over before an answer came" if left < 0 else f"{self._absent}, {_MAX_TRIES} times"
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

    def _wake_up(self) -> None:
        """Have the thread that waits look around, from any thread."""
        if self._write < 0:
            return
        try:
            os.write(self._write, b"\0")
        except BlockingIOError:
            pass  # it is awake

    def _hang_up(self) -> None:
        link = self._link
        if link is not None and self._bridge is not None:
            # An empty line, by which the bridge lets its own connection for this one go.
            topic = topics.robot(self._robot, topics.REQUEST, self._user)
            link.publish(topic, b"", 0, response=topics.reply(self._user, self._session, self._robot))
        self._wake_up()

    def _drop(self) -> None:
        child = os.getpid() != self._process
        if self._opening is not None and not child:
            self._opening.give_up()
        if self._link is not None:
            self._link.drop() if child else self._link.close()
        descriptors, self._wake, self._write = (self._wake, self._write), -1, -1
        for each in descriptors:
            if each >= 0:
                os.close(each)


def _state(goal: JsonObject) -> State:
    """Return a goal's state; ValueError where it is none."""
    name = goal.get("state")
    if name not in State.__members__:
        raise ValueError(f"the state {name!a} is none")
    return State[str(name)]
