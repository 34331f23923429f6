"""Who looks at all robots of a fleet: which come and go, and what happens to the goals of each, as it happens.

It has a desk, whose connection comes back where it breaks. What has changed meanwhile is found out then, by what the
broker keeps: the presence of each robot, and by its status what it speaks, and what has ended last. What ended before
that is not told again. Nothing is asked of anybody.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from talkcli.client.connect import ANSWER_LIMIT
from talkcli.errors import BadRequest, Lost
from talkcli.fleet import topics
from talkcli.fleet.desk.desk import ABSENCE_LIMIT, Desk
from talkcli.fleet.desk.sighting import Away, Back, Begun, Changed, Happened, Missed
from talkcli.fleet.presence import Presence
from talkcli.fleet.status import Standing, Status
from talkcli.goals.states import State
from talkcli.protocol.events import PausedChanged, StateChanged, from_json
from talkcli.protocol.lines import decode

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Mapping

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.desk.selection import Selection
    from talkcli.fleet.desk.sighting import Sighting
    from talkcli.fleet.link import Link
    from talkcli.fleet.message import Message

#: Seconds in which bridges are back once their broker is: robots of which that has kept nothing count as gone then.
BACK_WITHIN = 15.0


class Lookout:
    """Looks at all robots, or at those that a selection picks. One thread uses it."""

    def __init__(self, broker: Broker, selection: Selection | None = None) -> None:
        """UsageError where the user's name can't be in a topic. It connects in `follow`."""
        self._broker, self._selection = broker, selection
        self._wanted = (selection and selection.only) or topics.ANY
        self._desk = Desk(broker)
        self._desk.visitor = self
        self._seen: deque[Sighting] = deque()
        #: the robots that are known, by name; and of each the goal of which was told last that it has ended (True), and
        #: the one that it is spoken (False), by their ids
        self._known: dict[str, Presence] = {}
        self._told: dict[str, dict[bool, str]] = {}
        #: robots that may have spoken while nobody could hear of it, which their next status tells
        self._unheard: set[str] = set()
        #: what comes on a new connection, until all that the broker keeps has come; None after that
        self._arriving: _Arriving | None = None
        self._begun = False
        #: by the monotonic clock: since when there is no broker, None while there is, and why; until when each robot
        #: that was there before that may still come back
        self._away_since: float | None = time.monotonic()
        self._why = ""
        self._missing: dict[str, float] = {}

    def follow(self, interrupt: Mapping[int, int] | None = None) -> Iterator[Sighting]:
        """Tell what happens, until `interrupt` ends it with Interrupted, as of `connect.ready`.

        ServerUnavailable, AccessDenied and the rest of `Link.open` where there is no broker in the beginning, or it
        doesn't let this user ask; Lost where it is away for `ABSENCE_LIMIT` seconds later on.
        """
        try:
            while True:
                now = time.monotonic()
                self._see_to(now)
                while self._seen:
                    yield self._seen.popleft()
                self._desk.serve(self._left(now), interrupt)
        finally:
            self._desk.close()

    # -- what the desk tells

    def came_up(self, link: Link) -> None:
        """Ask for what the broker keeps, and for what happens."""
        self._arriving = _Arriving()
        link.subscribe(topics.robot(self._wanted, topics.EVENT, topics.ANY), retained=False)
        kept = (topics.robot(self._wanted, each) for each in (topics.PRESENCE, topics.STATUS))
        link.subscribe(*kept, retained=True)

    def went_down(self, why: str) -> None:
        """Take note of it; that another try has failed is no news."""
        self._arriving, self._why = None, why
        if self._away_since is None:
            self._away_since = time.monotonic()
            self._seen.append(Away(why, ABSENCE_LIMIT))

    def hear(self, message: Message) -> None:
        """Take what a robot says."""
        _, _, name, kind, *_ = message.topic.split("/")
        arriving = self._arriving
        if kind == topics.EVENT:
            happened = _happened(name, message.payload)
            if happened and arriving:
                arriving.events.append(happened)
            elif happened:
                self._happen(happened)
        elif kind == topics.STATUS:
            if arriving:
                arriving.statuses[name] = Status.read(message.payload)
            elif name in self._unheard:  # of the others, events say more
                self._catch_up(name, Status.read(message.payload))
        else:
            self._be_present(name, message.payload)

    # -- inside

    def _see_to(self, now: float) -> None:
        """Do what is due."""
        if self._arriving and self._desk.told:
            self._settle(self._arriving, now)
        if not self._begun and self._desk.failure:
            raise self._desk.failure
        if self._away_since is not None:
            away = now - self._away_since
            if not self._begun and away >= ANSWER_LIMIT:
                raise self._desk.unanswered(ANSWER_LIMIT)
            if away >= ABSENCE_LIMIT:
                raise Lost(f"the broker at {self._broker.url} was away for {ABSENCE_LIMIT:g} s: {self._why}")
        for name in [name for name, until in self._missing.items() if now >= until]:
            del self._missing[name]
            self._change(name, None)

    def _left(self, now: float) -> float:
        """Return the seconds until something is due, if nothing happens before."""
        due = list(self._missing.values())
        if self._away_since is not None:
            due.append(self._away_since + (ABSENCE_LIMIT if self._begun else ANSWER_LIMIT))
        return max(0.0, min(due, default=now + ABSENCE_LIMIT) - now)

    def _settle(self, arrived: _Arriving, now: float) -> None:
        """Begin, or go on, with what the broker keeps."""
        self._arriving = None
        there = {name: each for name, each in sorted(arrived.presences.items()) if each}
        if not self._begun:
            self._begun = True
            self._known = there
            self._seen.append(Begun(tuple(Standing(each, arrived.statuses.get(name)) for name, each in there.items())))
        else:
            self._seen.append(Back(now - (self._away_since or now)))
            gone = [name for name, each in self._known.items() if each.online and name not in there]
            self._missing = dict.fromkeys(gone, now + BACK_WITHIN)
            for name, presence in there.items():
                self._change(name, presence)
        self._away_since = None
        self._unheard = set(self._known)
        coming = {each.event.id for each in arrived.events}
        for name in there:
            self._catch_up(name, arrived.statuses.get(name), coming)
        for each in arrived.events:
            self._happen(each)

    def _be_present(self, name: str, payload: bytes) -> None:
        """Take up what is said of a robot's presence; one that is not one of those that are looked at is none."""
        said = Presence.read(name, payload)
        if payload and said is None:
            return  # what is no presence is no news of it
        if said and self._selection and not self._selection.picks(said):
            said = None
        if self._arriving:
            self._arriving.presences[name] = said
        else:
            self._missing.pop(name, None)
            self._change(name, said)

    def _change(self, name: str, now: Presence | None) -> None:
        before = self._known.pop(name, None)
        if now:
            self._known[name] = now
            if before is None or not before.online:
                self._unheard.add(name)
        if _what_counts(before) != _what_counts(now):
            self._seen.append(Changed(name, before, now))

    def _catch_up(self, name: str, status: Status | None, coming: Container[str | None] = ()) -> None:
        """Tell what a robot has spoken while nobody could hear of it; of the goals that are `coming` events do."""
        if status is None:
            return
        events, known, presence = status.events(), name in self._told, self._known.get(name)
        told = self._told.setdefault(name, {})
        fresh = [each for each in events if told.get(each.state.terminal) != each.id and each.id not in coming]
        told.update({each.state.terminal: each.id for each in events})
        if events:  # a bridge that has just begun may not know any yet
            self._unheard.discard(name)
        if known and fresh and presence and presence.online:
            self._seen.append(Missed(Standing(presence, status), tuple(fresh)))

    def _happen(self, happened: Happened) -> None:
        name, event = happened.name, happened.event
        if self._selection and name not in self._known:
            return
        if isinstance(event, StateChanged) and (event.state.terminal or event.state is State.ACTIVE):
            self._told.setdefault(name, {})[event.state.terminal] = event.id
        self._seen.append(happened)


class _Arriving:
    """What comes on a new connection until all that the broker keeps has come."""

    def __init__(self) -> None:
        self.presences: dict[str, Presence | None] = {}
        self.statuses: dict[str, Status | None] = {}
        self.events: list[Happened] = []


def _happened(name: str, payload: bytes) -> Happened | None:
    """Return what is told by an event's payload; None for what is none, or of a kind that isn't known."""
    if topics.fault(name):
        return None
    try:
        message = decode(payload.strip())
        event = from_json(message)
    except (BadRequest, ValueError):
        return None
    return Happened(name, event, message) if isinstance(event, StateChanged | PausedChanged) else None


def _what_counts(presence: Presence | None) -> tuple[object, ...]:
    """Return by what it is seen that a robot, or its server, is another than before."""
    if presence is None or not presence.online:
        return (False,)
    return True, presence.session, presence.server and presence.server.get("boot")
