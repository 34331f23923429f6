"""The state of all robots of a fleet: read it once, or watch it change. Nothing is sent to the robots.

After its connection to the broker has broken, a watch compares the retained messages with what it knew before: each
robot's presence, the goal that it is speaking, and the goal that ended last. It misses goals that ended before that.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.errors import BadRequest, Lost
from talkcli.fleet import topics
from talkcli.fleet.desk.desk import ABSENCE_LIMIT_S, DeskLink
from talkcli.fleet.payloads import Presence, RobotInfo, RobotStatus
from talkcli.frozen import frozen
from talkcli.goals.states import State
from talkcli.protocol.events import PausedChanged, StateChanged, from_json
from talkcli.protocol.lines import decode

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Mapping

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.desk.request import Selection
    from talkcli.fleet.link import Link
    from talkcli.fleet.payloads import Message
    from talkcli.goals.goal import JsonObject

#: Time for bridges to reconnect after the broker has come back. Robots without a presence count as gone after it.
BRIDGES_BACK_LIMIT_S = 15.0


@frozen
class FleetSnapshot:
    """The state of all robots when the watch starts, sorted by name."""

    robots: tuple[RobotInfo, ...]


@frozen
class RobotChanged:
    """A robot or its server has come or gone; `before` or `now` is None if the broker doesn't know the robot."""

    name: str
    before: Presence | None
    now: Presence | None


@frozen
class RobotEvent:
    """An event of one robot, and the message it was read from."""

    name: str
    event: StateChanged | PausedChanged
    message: JsonObject


@frozen
class EventsMissed:
    """The state of a robot whose events were missed for a while, and those events that its state reveals."""

    robot: RobotInfo
    events: tuple[StateChanged, ...]


@frozen
class BrokerAway:
    """The connection to the broker has broken. The watch fails if it is not back within `limit` seconds."""

    why: str
    limit: float


@frozen
class BrokerBack:
    """The broker is connected again, after so many seconds."""

    after: float


FleetEvent = FleetSnapshot | RobotChanged | RobotEvent | EventsMissed | BrokerAway | BrokerBack


def read_robots(
    broker: Broker, timeout: float, name: str | None = None, *, with_status: bool = True
) -> list[RobotInfo]:
    """Return the robots that the broker knows, online or not, sorted by name.

    Args:
        broker: the broker of the fleet.
        timeout: seconds in which the broker must answer.
        name: the only robot to return; None for all.
        with_status: whether to read the robots' statuses, too.

    Raises:
        ServerUnavailable: There is no broker, or it doesn't answer in time.
        AccessDenied: The broker doesn't let this user log in, or ask.
    """
    kinds = (topics.PRESENCE, topics.STATUS) if with_status else (topics.PRESENCE,)
    reader = _RetainedReader([topics.robot(name or topics.ANY, each) for each in kinds])
    desk = DeskLink(broker)
    desk.handler = reader
    try:
        desk.wait_for_retained(timeout, lambda: bool(reader.payloads))
    finally:
        desk.close()
    robots = []
    for each, payloads in sorted(reader.payloads.items()):
        presence = Presence.read(each, payloads.get(topics.PRESENCE, b""))
        if presence:
            robots.append(RobotInfo(presence, RobotStatus.read(payloads.get(topics.STATUS, b""))))
    return robots


class _RetainedReader:
    """A handler that collects the payloads of retained messages, by robot and kind."""

    def __init__(self, wanted: list[str]) -> None:
        self._wanted = wanted
        self.payloads: dict[str, dict[str, bytes]] = {}

    def on_connected(self, link: Link) -> None:
        link.subscribe(*self._wanted, retained=True)

    def on_disconnected(self, why: str) -> None:
        pass  # the desk has it as `failure`

    def on_message(self, message: Message) -> None:
        _, _, name, kind = message.topic.split("/")
        self.payloads.setdefault(name, {})[kind] = message.payload


class FleetWatch:
    """A watch over all robots of a fleet, or over a selection of them. Only one thread may use it."""

    def __init__(self, broker: Broker, selection: Selection | None = None) -> None:
        """Prepare the watch. `events` will connect to the broker.

        Raises:
            UsageError: The user's name can't be part of a topic.
        """
        self._broker, self._selection = broker, selection
        self._desk = DeskLink(broker)
        self._desk.handler = self
        self._events: deque[FleetEvent] = deque()
        self._presences: dict[str, Presence] = {}
        #: for each robot, the id of the goal that was last reported as ended (True) and as started (False)
        self._reported: dict[str, dict[bool, str]] = {}
        #: robots that may have spoken while their events were missed; their next status tells
        self._unheard: set[str] = set()
        #: the messages on a new connection, until all retained messages are there; then None
        self._retained: _Retained | None = None
        self._began = False
        #: since when (monotonic) there is no broker, and why; None if it is connected
        self._away_since: float | None = time.monotonic()
        self._away_why = ""
        #: robots that have not come back with the broker, and how long to wait for them (monotonic)
        self._missing: dict[str, float] = {}

    def events(self, interrupt: Mapping[int, int] | None = None) -> Iterator[FleetEvent]:
        """Yield events, beginning with a FleetSnapshot, until one of the `interrupt` descriptors ends it.

        Raises:
            Interrupted: One of the descriptors is ready, see `wait_ready`.
            ServerUnavailable: There is no broker when the watch starts.
            AccessDenied: The broker doesn't let this user log in, or ask.
            Lost: The broker was away for too long later on.
        """
        try:
            while True:
                now = time.monotonic()
                self._check_limits(now)
                while self._events:
                    yield self._events.popleft()
                self._desk.poll(self._until_next_limit(now), interrupt)
        finally:
            self._desk.close()

    # -- messages from the broker

    def on_connected(self, link: Link) -> None:
        """Subscribe to the retained messages, and to events."""
        self._retained = _Retained()
        robot = (self._selection and self._selection.name) or topics.ANY
        link.subscribe(topics.robot(robot, topics.EVENT, topics.ANY), retained=False)
        link.subscribe(*(topics.robot(robot, each) for each in (topics.PRESENCE, topics.STATUS)), retained=True)

    def on_disconnected(self, why: str) -> None:
        """Report that the broker is away, once for each absence."""
        self._retained, self._away_why = None, why
        if self._away_since is None:
            self._away_since = time.monotonic()
            self._events.append(BrokerAway(why, ABSENCE_LIMIT_S))

    def on_message(self, message: Message) -> None:
        """Process a robot's presence, status or event."""
        _, _, name, kind, *_ = message.topic.split("/")
        if kind == topics.PRESENCE:
            self._on_presence(name, message.payload)
        elif kind == topics.STATUS:
            if self._retained:
                self._retained.statuses[name] = RobotStatus.read(message.payload)
            elif name in self._unheard:  # otherwise its events say more
                self._report_missed(name, RobotStatus.read(message.payload))
        elif (event := _read_event(name, message.payload)) is not None:
            if self._retained:
                self._retained.events.append(event)
            else:
                self._report(event)

    def _on_presence(self, name: str, payload: bytes) -> None:
        presence = Presence.read(name, payload)
        if payload and presence is None:
            return  # malformed
        if presence and self._selection and not self._selection.includes(presence):
            presence = None
        if self._retained:
            self._retained.presences[name] = presence
        else:
            self._missing.pop(name, None)
            self._set_presence(name, presence)

    # -- time limits

    def _check_limits(self, now: float) -> None:
        """Do everything that is due."""
        if self._retained and self._desk.retained_received:
            self._process_retained(self._retained, now)
        if not self._began and self._desk.failure:
            raise self._desk.failure
        if self._away_since is not None:
            away = now - self._away_since
            if not self._began and away >= ANSWER_LIMIT_S:
                raise self._desk.no_answer_error(ANSWER_LIMIT_S)
            if away >= ABSENCE_LIMIT_S:
                raise Lost(f"the broker at {self._broker.url} was away for {ABSENCE_LIMIT_S:g} s: {self._away_why}")
        for name in [name for name, until in self._missing.items() if now >= until]:
            del self._missing[name]
            self._set_presence(name, None)

    def _until_next_limit(self, now: float) -> float:
        """Return the seconds until `_check_limits` has something to do."""
        limits = list(self._missing.values())
        if self._away_since is not None:
            limits.append(self._away_since + (ABSENCE_LIMIT_S if self._began else ANSWER_LIMIT_S))
        return max(0.0, min(limits, default=now + ABSENCE_LIMIT_S) - now)

    # -- changes

    def _process_retained(self, retained: _Retained, now: float) -> None:
        """Report the first snapshot, or the changes since the connection broke."""
        self._retained = None
        present = {name: each for name, each in sorted(retained.presences.items()) if each}
        if self._began:
            self._events.append(BrokerBack(now - (self._away_since or now)))
            gone = [name for name, each in self._presences.items() if each.online and name not in present]
            self._missing = dict.fromkeys(gone, now + BRIDGES_BACK_LIMIT_S)
            for name, presence in present.items():
                self._set_presence(name, presence)
        else:
            self._began = True
            self._presences = present
            robots = (RobotInfo(each, retained.statuses.get(name)) for name, each in present.items())
            self._events.append(FleetSnapshot(tuple(robots)))
        self._away_since = None
        self._unheard = set(self._presences)
        coming = {each.event.id for each in retained.events}
        for name in present:
            self._report_missed(name, retained.statuses.get(name), coming)
        for event in retained.events:
            self._report(event)

    def _set_presence(self, name: str, now: Presence | None) -> None:
        """Store a robot's presence, and report it if the robot or its server has changed."""
        before = self._presences.pop(name, None)
        if now:
            self._presences[name] = now
            if before is None or not before.online:
                self._unheard.add(name)
        if _identity(before) != _identity(now):
            self._events.append(RobotChanged(name, before, now))

    def _report_missed(self, name: str, status: RobotStatus | None, coming: Container[str | None] = ()) -> None:
        """Report the events that a robot's status reveals, if they were missed.

        Args:
            name: the robot's name.
            status: its status; None if unknown.
            coming: ids of goals whose events have been received and will be reported next.
        """
        if status is None:
            return
        events, is_known, presence = status.events(), name in self._reported, self._presences.get(name)
        reported = self._reported.setdefault(name, {})
        missed = [each for each in events if reported.get(each.state.terminal) != each.id and each.id not in coming]
        reported.update({each.state.terminal: each.id for each in events})
        if events:  # a bridge that has just started may not know any goals yet
            self._unheard.discard(name)
        if is_known and missed and presence and presence.online:
            self._events.append(EventsMissed(RobotInfo(presence, status), tuple(missed)))

    def _report(self, robot_event: RobotEvent) -> None:
        """Report a robot's event, unless the robot isn't selected."""
        name, event = robot_event.name, robot_event.event
        if self._selection and name not in self._presences:
            return
        if isinstance(event, StateChanged) and (event.state.terminal or event.state is State.ACTIVE):
            self._reported.setdefault(name, {})[event.state.terminal] = event.id
        self._events.append(robot_event)


class _Retained:
    """Messages on a new connection, before all retained messages are there."""

    def __init__(self) -> None:
        self.presences: dict[str, Presence | None] = {}
        self.statuses: dict[str, RobotStatus | None] = {}
        self.events: list[RobotEvent] = []


def _read_event(name: str, payload: bytes) -> RobotEvent | None:
    """Return the event in a payload; None if it is malformed or of an unknown kind."""
    if topics.name_fault(name):
        return None
    try:
        message = decode(payload.strip())
        event = from_json(message)
    except (BadRequest, ValueError):
        return None
    return RobotEvent(name, event, message) if isinstance(event, StateChanged | PausedChanged) else None


def _identity(presence: Presence | None) -> tuple[object, ...]:
    """Return a value that differs if a robot has come or gone, or has another bridge or server."""
    if presence is None or not presence.online:
        return (False,)
    return True, presence.session, presence.server and presence.server.get("boot")
