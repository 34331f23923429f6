"""Several robots, asked at once from one desk: each as one alone would be, and what becomes of it at each as it comes.

A glob is asked robot by robot, a group by one message that the broker hands to all of it. Who belongs to it is told by
presence, and by whoever answers: nothing is taken for done at a robot that did not say so itself.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from typing import TYPE_CHECKING

from talkcli.client.client import batches, check, check_id, too_long
from talkcli.client.connect import ANSWER_LIMIT, FIRST
from talkcli.client.connection import Exchange
from talkcli.client.goal import GoalHandle
from talkcli.errors import (
    EXIT_OK,
    RequestRefused,
    ServerUnavailable,
    TalkError,
    UnknownGoal,
    UsageError,
)
from talkcli.fleet import topics
from talkcli.fleet.desk import Desk
from talkcli.fleet.link import REFUSED, boottime
from talkcli.fleet.outcome import IDLE, NO_SERVER, OFFLINE, PAUSED, RESUMED, SET, Outcome, failed
from talkcli.fleet.presence import Presence
from talkcli.fleet.robot import EXPIRY, RobotConnection, new_id
from talkcli.frozen import replace
from talkcli.goals.goal import Goal
from talkcli.goals.options import Cancel, Say, Set, bad_key
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, ServerStatus, goal_in, goals
from talkcli.protocol.lines import request_line, write_request
from talkcli.protocol.requests import Pause, Resume, Status, Wait

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.link import Link
    from talkcli.fleet.message import Message
    from talkcli.fleet.selection import Selection
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

#: Seconds in which a sentence to several robots must have begun, unless it names its own: what was true for all of them
#: a minute ago is not what the last of them should say.
TTL = 10.0
#: Seconds between two looks at who has not answered in time.
_LOOK = 0.25


class Crowd:
    """The robots that are picked, from one desk. One thread uses it."""

    def __init__(
        self,
        broker: Broker,
        to: Selection,
        *,
        name: str | None = None,
        interrupt: Mapping[int, int] | None = None,
        patience: float = ANSWER_LIMIT,
    ) -> None:
        """Connect to the broker. `name`, `interrupt`, `patience`: as of `SocketConnection`.

        ServerUnavailable or AccessDenied where the broker is not to be had; UsageError for what can't be.
        """
        if to.fault:
            raise UsageError(to.fault)
        self.to, self.patience = to, patience
        self._name, self._interrupt = name, interrupt
        self._robots: dict[str, RobotConnection] = {}
        self._presences: dict[str, Presence] = {}
        self._numbers = itertools.count(FIRST)
        self._round: Round | None = None
        self.desk = Desk(broker)
        self.desk.visitor = self
        try:
            self.desk.await_kept(patience, interrupt=interrupt)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Crowd:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it: what was asked is carried out all the same."""
        link = self.desk.link
        if self.to.group is not None and link is not None:
            topic = topics.group(self.to.group, topics.REQUEST, self.desk.user)
            link.publish(topic, b"", 0, response=topics.reply(self.desk.user, self.desk.session))
        elif self._round is not None:
            for each in self._round.asked:
                each.hang_up()
        self._round = None
        self.desk.close()

    def ask(self, request: Request) -> Round:
        """Ask all of them, and return what becomes of that; UsageError for what can't be, UnknownGoal as `check_id`."""
        _check_ids(request)
        if isinstance(request, Cancel) and request.key is not None and (fault := bad_key(request.key)):
            raise UsageError(fault)
        if isinstance(request, Set):
            check(request)
        if isinstance(request, Say):
            request = replace(
                request, id=request.id or new_id(self.desk), ttl=TTL if request.ttl is None else request.ttl
            )
            check(request)
        self._round = Round(self, request, next(self._numbers))
        self._round.begin(self._presences.values())
        return self._round

    def serve(self, timeout: float) -> None:
        """Wait so long at most for what comes, and take it in; Interrupted."""
        self.desk.serve(timeout, self._interrupt)

    def robot(self, name: str) -> RobotConnection:
        """Return the connection to a robot."""
        found = self._robots.get(name)
        if found is None:
            found = RobotConnection(name, self.desk, name=self._name, patience=self.patience, numbers=self._numbers)
            self._robots[name] = found
        return found

    # -- what the desk tells

    def came_up(self, link: Link) -> None:
        """Have all answers come, and the presence of all robots."""
        link.subscribe(topics.reply(self.desk.user, self.desk.session, "+"), retained=False)
        link.subscribe(topics.robot("+", topics.PRESENCE), retained=True)

    def went_down(self, why: str) -> None:
        """Take all for absent."""
        for each in self._robots.values():
            each.went_down(why)

    def hear(self, message: Message) -> None:
        """Take in a robot's presence, or lines of its server's."""
        levels = message.topic.split("/")
        if levels[-1] != topics.PRESENCE:
            self._answered(levels[-1], message)
            return
        name = levels[-2]
        presence = Presence.read(name, message.payload)
        if presence is None:
            return  # cleared, or it is none
        self._presences[name] = presence
        if name in self._robots or self.to.picks(presence):
            self.robot(name).hear(message)
            if self._round:
                self._round.present(presence)

    def _answered(self, name: str, message: Message) -> None:
        if topics.fault(name) or not self._round:
            return
        robot = self.robot(name)
        self._round.answering(name)
        robot.hear(message)
        robot.hand_out()
        self._round.look(name)


class Round:
    """One request to all of them. Iterate over what becomes of it, or take it from `results`, until it is done."""

    def __init__(self, crowd: Crowd, request: Request, number: int) -> None:
        self.request = request
        self._crowd, self._number = crowd, number
        self._parts: dict[str, _Part] = {}
        self._found: deque[Outcome] = deque()
        #: why the broker has taken nothing that was for the group
        self._refused: TalkError | None = None
        #: whether all are known that it is asked of
        self._complete = False
        self._latest = boottime() + request.ttl if isinstance(request, Say) and request.ttl else None
        #: the goal that each would make of a sentence that fits into no request
        self._rejected = too_long(request) if isinstance(request, Say) else None

    def __iter__(self) -> Iterator[Outcome]:
        return self.results()

    def __len__(self) -> int:
        """How many robots it is asked of, as far as it is known, those among them that can't be."""
        return len(self._parts)

    @property
    def asked(self) -> list[RobotConnection]:
        """The robots that were asked."""
        return [each.robot for each in self._parts.values() if each.was_asked]

    def results(self, timeout: float | None = None) -> Iterator[Outcome]:
        """Yield what has become of it at each robot, as it comes.

        TimeoutError after so many seconds, Interrupted as the crowd is; it may be called again then. ServerUnavailable
        where there is no such robot, AccessDenied where the broker lets this user ask none of them.
        """
        end = None if timeout is None else time.monotonic() + timeout
        look_at = time.monotonic() + _LOOK
        while True:
            while self._found:
                yield self._found.popleft()
            if self._refused is not None:
                raise self._refused
            self._complete = self._complete or self._crowd.desk.told
            if self._complete and all(each.done for each in self._parts.values()):
                self.close()
                break
            now = time.monotonic()
            if end is not None and now >= end:
                done = sum(each.done for each in self._parts.values())
                raise TimeoutError(f"{done} of {len(self)} robots are done after {round(timeout or 0.0, 1):g} s")
            self._crowd.serve(min(look_at, end or look_at) - now)
            if time.monotonic() >= look_at:
                for name in list(self._parts):
                    self.look(name)
                look_at = time.monotonic() + _LOOK
        if not self._parts:
            to, broker = self._crowd.to, self._crowd.desk.broker.url
            which = f"is in the group '{to.group}'" if to.group is not None else f"matches '{to.text}'"
            raise ServerUnavailable(f"no robot {which} at {broker}: nothing was sent; 'talk fleet status' lists all")

    def cancel(self) -> None:
        """Ask those that have not ended to cancel it: what becomes of that, `results` tells."""
        if not isinstance(self.request, Say):
            return
        cancel = Cancel((str(self.request.id),))
        if self._crowd.to.group is not None:
            self._publish(cancel, next(self._crowd._numbers))
            return
        for each in self._parts.values():
            if not each.done:
                each.cancel(cancel)

    def close(self) -> None:
        """Wait for no more of it: the connection to the broker ends."""
        self._crowd.close()

    # -- what the crowd tells

    def begin(self, presences: Iterable[Presence]) -> None:
        """Ask those that are known to be there."""
        if self._crowd.to.group is not None and self._rejected is None:
            self._publish(self.request, self._number)
        for each in list(presences):
            if self._crowd.to.picks(each):
                self.present(each)

    def present(self, presence: Presence) -> None:
        """Ask a robot that the broker has just told of, or tell that it can't be asked.

        One that comes later is asked nothing: it was not there.
        """
        name = presence.name
        if name in self._parts:
            self.look(name)
            return
        if self._complete:
            return
        robot = self._crowd.robot(name)
        part = self._parts[name] = _Part(robot, name, self.request)
        group = self._crowd.to.group is not None
        if (goal := self._rejected) is not None:
            self._take([Outcome(name, goal.state.name, goal.exit_code or EXIT_OK, goal)], part)
        elif not presence.online:
            self._take([failed(name, ServerUnavailable(f"{name} is offline: nothing was sent"), OFFLINE)], part)
        elif group:
            part.expect(self._number, self._latest)
        elif presence.server is None:
            words = f"{name} has no talk server at this moment: nothing was sent"
            self._take([failed(name, ServerUnavailable(words), NO_SERVER)], part)
        else:
            self._take(part.ask(), part)

    def answering(self, name: str) -> None:
        """Have a robot count that answers, be it that it was taken for absent or that nobody has told of it yet."""
        part = self._parts.get(name)
        if self._crowd.to.group is not None and (part is None or not part.was_asked):
            part = self._parts[name] = _Part(self._crowd.robot(name), name, self.request)
            part.expect(self._number, self._latest)

    def look(self, name: str) -> None:
        """See how far it is at a robot."""
        part = self._parts.get(name)
        if part is not None and not part.done:
            self._take(part.look(), part)

    def _take(self, found: list[Outcome], part: _Part) -> None:
        self._found += found
        part.done = part.done or any(each.last for each in found)

    def _publish(self, request: Request, number: int) -> None:
        """Send a request to the group."""
        desk = self._crowd.desk
        link, group = desk.link, self._crowd.to.group
        assert group is not None
        if link is None:
            raise ServerUnavailable(f"the broker at {desk.broker.url} went away: nothing was sent")

        def acknowledged(code: int) -> None:
            if code >= REFUSED:
                self._refused = desk.refused(code, f"ask the group {group} for anything")

        line = request_line({"seq": number, **write_request(request)})
        if len(line) > link.room:
            words = f"{request.kind} has {len(line):,} bytes, and the broker takes {link.room:,}: nothing was sent"
            raise RequestRefused(words, "too_long")
        expiry = (request.ttl or None) if isinstance(request, Say) else EXPIRY
        topic, response = topics.group(group, topics.REQUEST, desk.user), topics.reply(desk.user, desk.session)
        link.publish(topic, line, expiry=expiry, response=response, acknowledged=acknowledged)


class _Part:
    """The request at one robot."""

    def __init__(self, robot: RobotConnection, name: str, request: Request) -> None:
        self.robot = robot
        #: whether all is known of it
        self.done = False
        self._name, self._request = name, request
        self._exchange: Exchange | None = None
        #: the goals that are waited for, since when, and those of them that were told of
        self._handles: list[GoalHandle] = []
        self._since = time.monotonic()
        self._told = 0

    @property
    def was_asked(self) -> bool:
        """Whether the robot was asked, or may have been."""
        return self._exchange is not None

    def ask(self) -> list[Outcome]:
        """Ask it alone, and return what is known at once."""
        try:
            self.robot.check()
            self._exchange = self.robot.begin(self._request, self._accepted)
        except TalkError as error:
            return [failed(self._name, error)]
        return []

    def expect(self, number: int, latest: float | None) -> None:
        """Await its answer: it was asked as one of a group, by this number."""
        self._exchange = Exchange(number, self._request, self._accepted)
        self._exchange.latest = latest
        self.robot.expect(self._exchange)

    def cancel(self, cancel: Cancel) -> None:
        """Ask it to cancel; where it is absent, that it is told as lost is all that can be done."""
        try:
            self.robot.post(cancel)
        except ServerUnavailable:
            pass

    def look(self) -> list[Outcome]:
        """Return what has become of it since, as far as it is new."""
        exchange, robot = self._exchange, self.robot
        assert exchange is not None
        robot.sign()
        now = time.monotonic()
        if not self._handles:
            slow = isinstance(self._request, Pause)
            late = now > (robot.silent_by(self._since)[0] if slow else robot.answer_by(exchange))
            if not (exchange.over or robot.ended is not None or late):
                return []
            robot.forget(exchange)
            try:
                reply, items = robot.answer(exchange)
            except UnknownGoal as error:
                return [*self._canceled(Canceled.from_items(error.items), last=False), failed(self._name, error)]
            except TalkError as error:
                refused = (exchange.reply or {}).get("error")
                serverless = isinstance(refused, dict) and refused.get("code") == ServerUnavailable.code
                return [failed(self._name, error, NO_SERVER if serverless else None)]
            if not self._handles:
                return self._answered(reply, items)
        quiet, why = robot.silent_by(self._since)
        if now > quiet:
            robot.ended = robot.ended or why
        return self._ended()

    def _accepted(self, reply: JsonObject, items: list[JsonObject]) -> None:
        """Follow the goals that are to be waited for."""
        request = self._request
        if isinstance(request, Say) and request.wait:
            found = [Goal.from_json(reply.get("goal"))]
        elif isinstance(request, Wait):
            found = list(goals(items, "goal"))
        else:
            return
        self._since = time.monotonic()
        self._handles = [GoalHandle(self.robot, each) for each in found]
        for each in self._handles:
            each._listen(feedback=False)

    def _ended(self) -> list[Outcome]:
        """Return those of its goals that have ended, in their order."""
        found = []
        while self._told < len(self._handles):
            handle = self._handles[self._told]
            if not (handle.state.terminal or handle._lose()):
                break
            self._told += 1
            whatever = isinstance(self._request, Wait) and self._request.ids is None and handle.state is not State.LOST
            code = EXIT_OK if whatever else handle.goal.exit_code or EXIT_OK
            last = self._told == len(self._handles)
            found.append(Outcome(self._name, handle.state.name, code, handle.goal, last=last))
        return found

    def _answered(self, reply: JsonObject, items: list[JsonObject]) -> list[Outcome]:
        """Return what a reply says of a robot that has nothing more to tell."""
        name, request = self._name, self._request
        goal = goal_in(reply)
        if isinstance(request, Cancel):
            return self._canceled(Canceled.from_items(items)) or [Outcome(name, IDLE)]
        if isinstance(request, Pause | Resume):
            paused = isinstance(request, Pause)
            return [Outcome(name, PAUSED if paused else RESUMED, goal=goal, said={"paused": paused})]
        if isinstance(request, Set):
            return [Outcome(name, SET, said={"settings": reply.get("settings")})]
        if goal is not None:
            return [Outcome(name, goal.state.name, (isinstance(request, Say) and goal.exit_code) or EXIT_OK, goal)]
        if isinstance(request, Status):
            status = ServerStatus.from_reply(reply, items)
            state = status.active.state.name if status.active else IDLE
            state = PAUSED if status.server.get("paused") is True else state
            return [Outcome(name, state, goal=status.active, said={"status": status.to_json()})]
        return [Outcome(name, IDLE)]

    def _canceled(self, done: Canceled, *, last: bool = True) -> list[Outcome]:
        every = (*done.canceled, *done.ended)
        return [Outcome(self._name, each.state.name, EXIT_OK, each, last=last and each is every[-1]) for each in every]


def _check_ids(request: Request) -> None:
    """Raise UsageError for goals that can't be named to several robots, UnknownGoal for an id that none can have."""
    ids = (request.ids if isinstance(request, Cancel | Wait) else None) or ()
    other = request.before if isinstance(request, Cancel) else request.id if isinstance(request, Status) else None
    for each in (*ids, *(() if other is None else (other,))):
        check_id(each)
        if each.isdecimal():
            raise UsageError("a number is a goal of one server: to several robots name the goal by its whole id")
    if len(batches(ids)) > 1:
        raise UsageError(f"{len(ids):,} ids do not fit into one request: to several robots name fewer, or none for all")
