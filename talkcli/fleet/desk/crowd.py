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
from talkcli.errors import (
    EXIT_OK,
    Lost,
    ServerUnavailable,
    TalkError,
    UsageError,
)
from talkcli.fleet import topics
from talkcli.fleet.desk.desk import Desk
from talkcli.fleet.desk.outcome import NO_SERVER, OFFLINE, Outcome, failed
from talkcli.fleet.desk.part import Part
from talkcli.fleet.desk.robot import EXPIRY, RobotConnection, new_id
from talkcli.fleet.link import REFUSED, boottime
from talkcli.fleet.presence import Presence
from talkcli.frozen import replace
from talkcli.goals.options import Cancel, Say, Set, bad_key
from talkcli.protocol.lines import request_line, write_request
from talkcli.protocol.requests import Status, Wait

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.desk.selection import Selection
    from talkcli.fleet.link import Link
    from talkcli.fleet.message import Message
    from talkcli.protocol.requests import Request

#: Seconds in which a sentence to several robots must have begun, unless it names its own: what was true for all of them
#: a minute ago is not what the last of them should say.
TTL = 10.0
#: Seconds between two looks at who has not answered in time; and messages that are read before that, which may have
#: come while this process was stopped.
_LOOK, _READ = 0.25, 5000
#: Seconds in which the broker must have taken what was asked by one who does not wait for what becomes of it.
_TAKEN = 1.0


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
        """End it: what was asked is carried out all the same. It may be called again."""
        asked, self._round = self._round, None
        if asked is not None:
            self.desk.flush(_TAKEN)
        link = self.desk.link
        if asked is not None and link is not None and self.to.group is not None:
            topic = topics.group(self.to.group, topics.REQUEST, self.desk.user)
            link.publish(topic, b"", 0, response=topics.reply(self.desk.user, self.desk.session))
        elif asked is not None:
            for each in asked.asked:
                each.hang_up()
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

    def serve(self, timeout: float) -> bool:
        """Wait so long at most for what comes, take it in, and return whether something came; Interrupted."""
        return self.desk.serve(timeout, self._interrupt)

    def picks(self, name: str) -> bool:
        """Whether a robot is one of them, by what it said of itself last."""
        presence = self._presences.get(name)
        return presence is not None and self.to.picks(presence)

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
        link.subscribe(topics.reply(self.desk.user, self.desk.session, topics.ANY), retained=False)
        link.subscribe(topics.robot(topics.ANY, topics.PRESENCE), retained=True)

    def went_down(self, why: str) -> None:
        """Take all for absent; of others than are known by now, the broker will not tell in time."""
        if self._round:
            self._round.is_complete()
        for each in self._robots.values():
            each.went_down(why)

    def hear(self, message: Message) -> None:
        """Take in a robot's presence, or lines of its server's."""
        _, kind, *_, name, last = message.topic.split("/")
        if kind != topics.ROBOT:
            self._answered(last, message)
            return
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
        self._round.look(name, judge=False)


class Round:
    """One request to all of them. Iterate over what becomes of it, or take it from `results`, until it is done.

    It has a connection, which ends with the last of it, with `with`, or by `close`.
    """

    def __init__(self, crowd: Crowd, request: Request, number: int) -> None:
        self.request = request
        self._crowd, self._number = crowd, number
        self._parts: dict[str, Part] = {}
        #: those of them, by name, of which not all is known
        self._open: set[str] = set()
        self._found: deque[Outcome] = deque()
        #: why the broker has taken nothing that was for the group
        self._refused: TalkError | None = None
        #: whether all are known that it is asked of; whether it is cancelled; whether it is over
        self._complete = self._canceled = self._closed = False
        self._latest = boottime() + request.ttl if isinstance(request, Say) and request.ttl else None
        #: the goal that each would make of a sentence that fits into no request
        self._rejected = too_long(request) if isinstance(request, Say) else None

    def __enter__(self) -> Round:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Outcome]:
        return self.results()

    def __len__(self) -> int:
        """How many robots it is asked of, as far as it is known, those among them that can't be."""
        return len(self._parts)

    @property
    def asked(self) -> list[RobotConnection]:
        """The robots that were asked."""
        return [each.robot for each in self._parts.values() if each.was_asked]

    @property
    def open(self) -> list[str]:
        """The names of the robots of which not all is known yet, sorted."""
        return sorted(self._open)

    @property
    def away(self) -> str | None:
        """Why nothing can be sent at this moment; None where it can."""
        broker = self._crowd.desk.broker
        return None if self._crowd.desk.link else f"the broker at {broker.url} went away"

    def results(self, timeout: float | None = None) -> Iterator[Outcome]:
        """Yield what has become of it at each robot, as it comes; nothing more once it is closed.

        TimeoutError after so many seconds, Interrupted as the crowd is; it may be called again then. ServerUnavailable
        where there is no such robot, AccessDenied where the broker lets this user ask none of them.
        """
        end = None if timeout is None else time.monotonic() + timeout
        look_at = time.monotonic() + _LOOK
        while True:
            while self._found:
                yield self._found.popleft()
            if self._closed:
                return
            if self._refused is not None:
                self.close()
                raise self._refused
            self._complete = self._complete or self._crowd.desk.told
            if self._complete and not self._open:
                self.close()
                break
            now = time.monotonic()
            if end is not None and now >= end:
                done = len(self) - len(self._open)
                raise TimeoutError(f"{done} of {len(self)} robots are done after {round(timeout or 0.0, 1):g} s")
            self._crowd.serve(min(look_at, end or look_at) - now)
            if time.monotonic() >= look_at:
                self._look_at_all()
                look_at = time.monotonic() + _LOOK
        if not self._parts:
            raise self._nobody()

    def cancel(self) -> None:
        """Have a sentence be cancelled wherever it has not ended, also at robots that are away and come back: what
        becomes of that, `results` tells. UsageError once that has told all: cancel the goal by its id then.
        """
        if not isinstance(self.request, Say):
            return
        if self._closed:
            raise UsageError("all outcomes have been taken: cancel the goal by its id")
        self._canceled = True
        to, link = self._crowd.to, self._crowd.desk.link
        if to.group is not None and link is not None:
            self._publish(Cancel((str(self.request.id),)), next(self._crowd._numbers))
        for name in self._open:
            # One that has left the group is told by itself.
            self._parts[name].withdraw(told=to.group is not None and self._crowd.picks(name))

    def close(self) -> None:
        """Wait for no more of it: the connection to the broker ends. What was asked is carried out all the same."""
        self._closed = True
        self._crowd.close()

    def _look_at_all(self) -> None:
        """See how far all are, once what has come by now was heard."""
        for _ in range(_READ):
            if not self._crowd.serve(0.0):
                break
        for name in list(self._open):
            self.look(name)

    def _nobody(self) -> TalkError:
        """Return what is wrong where nobody was there to be asked."""
        to, broker = self._crowd.to, self._crowd.desk.broker.url
        if to.group is not None and self.away:
            return Lost(
                f"{self.request.kind} was sent to the group '{to.group}', but {self.away}; it may be carried out"
            )
        which = f"is in the group '{to.group}'" if to.group is not None else f"matches '{to.text}'"
        return ServerUnavailable(f"no robot {which} at {broker}: nothing was sent; 'talk fleet status' lists all")

    # -- what the crowd tells

    def begin(self, presences: Iterable[Presence]) -> None:
        """Ask those that are known to be there."""
        if self._crowd.to.group is not None and self._rejected is None:
            self._publish(self.request, self._number)
        for each in list(presences):
            if self._crowd.to.picks(each):
                self.present(each)

    def is_complete(self) -> None:
        """Ask nobody more."""
        self._complete = True

    def present(self, presence: Presence) -> None:
        """Ask a robot that the broker has just told of, or tell that it can't be asked.

        One that comes once all are known is asked nothing: it was not there. Of a group, one may come in the moment
        between the request and that; it is waited for as the others are, since some brokers tell of all of them then.
        """
        name = presence.name
        if name in self._parts:
            self.look(name, judge=False)
            return
        if self._complete:
            return
        part = self._add(name)
        group = self._crowd.to.group is not None
        if (goal := self._rejected) is not None:
            self._take([Outcome(name, goal.state.name, goal.exit_code or EXIT_OK, goal)])
        elif not presence.online:
            self._take([failed(name, ServerUnavailable(f"{name} is offline: nothing was sent"), OFFLINE)])
        elif group:
            part.expect(self._number, self._latest)
        elif presence.server is None:
            words = f"{name} has no talk server at this moment: nothing was sent"
            self._take([failed(name, ServerUnavailable(words), NO_SERVER)])
        else:
            self._take(part.ask())

    def answering(self, name: str) -> None:
        """Have a robot count that answers, be it that it was taken for absent or that nobody has told of it yet."""
        part = self._parts.get(name)
        if self._crowd.to.group is not None and (part is None or not part.was_asked):
            part = self._add(name)
            part.expect(self._number, self._latest)
            if self._canceled:
                part.withdraw(told=False)

    def look(self, name: str, *, judge: bool = True) -> None:
        """See how far it is at a robot; `judge`: whether it counts as lost where its time is over."""
        if name in self._open:
            self._take(self._parts[name].look(judge=judge))

    def _add(self, name: str) -> Part:
        """Have a robot count."""
        part = self._parts[name] = Part(self._crowd.robot(name), name, self.request)
        self._open.add(name)
        return part

    def _take(self, found: list[Outcome]) -> None:
        self._found += found
        self._open -= {each.robot for each in found if each.last}

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
        if (refused := link.too_long(line, request.kind)) is not None:
            raise refused
        expiry = (request.ttl or None) if isinstance(request, Say) else EXPIRY
        topic, response = topics.group(group, topics.REQUEST, desk.user), topics.reply(desk.user, desk.session)
        link.publish(topic, line, expiry=expiry, response=response, acknowledged=acknowledged)


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
