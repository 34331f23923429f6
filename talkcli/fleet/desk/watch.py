"""Functions and classes that read the state of a fleet or watch it for changes.

Nothing is sent to the robots. If the connection to the broker was lost for a while, FleetWatch compares the retained
messages with the state before that. They contain each robot's presence, its active goal, and the goal that ended last.
If several goals of a robot ended in the meantime, only the last one is reported.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.errors import BadRequest, Lost
from talkcli.fleet import topics
from talkcli.fleet.desk.link import ABSENCE_LIMIT_S, DeskLink
from talkcli.fleet.payloads import Message, Presence, RobotInfo, RobotStatus
from talkcli.frozen import frozen
from talkcli.goals.states import State
from talkcli.polling import run_blocking
from talkcli.protocol.events import GoalInterrupted, PausedChanged, StateChanged, from_json
from talkcli.protocol.lines import decode

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Mapping
    from typing import Any

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.desk.request import Selection
    from talkcli.fleet.link import Link
    from talkcli.goals.goal import JsonObject

#: After the broker is back, bridges have this much time to reconnect. A robot that hasn't reported its presence by then
#: counts as gone.
BRIDGES_BACK_LIMIT_S = 15.0
#: How often to check whether a time limit has passed.
_LIMIT_CHECK_INTERVAL_S = 0.5


@frozen
class FleetSnapshot:
    """The watched robots and their states at the start of the watch, sorted by name."""

    robots: tuple[RobotInfo, ...]


@frozen
class RobotChanged:
    """Reports that a robot or its server has started or stopped.

    `before` and `now` are the robot's presence before and after the change, or None if it is unknown.
    """

    name: str
    before: Presence | None
    now: Presence | None


@frozen
class RobotEvent:
    """An event of one robot, with the JSON message from which it was read."""

    name: str
    event: StateChanged | GoalInterrupted | PausedChanged
    message: JsonObject


@frozen
class EventsMissed:
    """Reports that some events of a robot were missed.

    It contains the robot's current state, and those of the missed events that can be derived from it.
    """

    robot: RobotInfo
    events: tuple[StateChanged, ...]


@frozen
class BrokerAway:
    """Reports that the connection to the broker was lost.

    The watch fails if it isn't back within `limit` seconds.
    """

    why: str
    limit: float


@frozen
class BrokerBack:
    """Reports that the broker is connected again, after an absence of `after` seconds."""

    after: float


FleetEvent = FleetSnapshot | RobotChanged | RobotEvent | EventsMissed | BrokerAway | BrokerBack


async def read_robots(
    broker: Broker, timeout: float, name: str | None = None, *, with_status: bool = True, **options: Any
) -> list[RobotInfo]:
    """Read the presence and status of a fleet's robots from the broker, sorted by name.

    This includes robots that are offline.

    Args:
        broker: the broker of the fleet.
        timeout: the time in seconds within which the broker must answer.
        name: the name of a robot, to return only this one.
        with_status: whether to read the status of the robots, too.
        options: other arguments of `DeskLink`.

    Raises:
        ServerUnavailable: The broker can't be reached, or doesn't answer in time.
        AccessDenied: The broker rejected the login, or its access rules don't allow the request.
    """
    kinds = (topics.PRESENCE, topics.STATUS) if with_status else (topics.PRESENCE,)
    reader = _RetainedReader([topics.robot(name or topics.ANY, each) for each in kinds])
    desk = DeskLink(broker, **options)
    desk.handler = reader
    try:
        await desk.wait_for_retained(timeout, lambda: bool(reader.messages))
    finally:
        desk.close()
    return _read_states(reader.messages)


class _RetainedReader:
    """Subscribes to some topics on each new connection, and collects all their messages."""

    def __init__(self, wanted: list[str]) -> None:
        self._wanted = wanted
        self.messages: list[Message] = []

    def on_connected(self, link: Link) -> None:
        """Subscribe to the topics."""
        link.subscribe(*self._wanted, retained=True)

    def on_disconnected(self, why: str) -> None:
        """Do nothing. `wait_for_retained` raises the error."""

    def on_message(self, message: Message) -> None:
        """Store a message in `messages`."""
        self.messages.append(message)


def _read_states(messages: list[Message]) -> list[RobotInfo]:
    """Read each robot's presence and status from these messages, sorted by name.

    Omit robots without a presence.
    """
    payloads: dict[str, dict[str, bytes]] = {}
    for message in messages:
        _, _, name, kind, *_ = message.topic.split("/")
        payloads.setdefault(name, {})[kind] = message.payload
    robots = []
    for name, found in sorted(payloads.items()):
        if presence := Presence.read(name, found.get(topics.PRESENCE, b"")):
            robots.append(RobotInfo(presence, RobotStatus.read(found.get(topics.STATUS, b""))))
    return robots


class FleetWatch:
    """Watches some or all robots in a fleet. Only one thread may use this object."""

    def __init__(self, broker: Broker, selection: Selection | None = None) -> None:
        """Prepare to watch robots. `events` connects to the broker.

        Raises:
            UsageError: The user name can't be part of a topic.
        """
        self._broker, self._selection = broker, selection
        self._desk = DeskLink(broker)
        self._desk.handler = self
        self._events: deque[FleetEvent] = deque()
        self._presences: dict[str, Presence] = {}
        #: for each robot, the ids of the last goals that were reported as ended (key True) and as started (key False)
        self._reported: dict[str, dict[bool, str]] = {}
        #: the robots whose events may have been missed. Their next status message shows the goals that were missed.
        self._maybe_missed: set[str] = set()
        #: the messages that have arrived on a new connection; None once all retained messages have arrived
        self._retained: list[Message] | None = None
        #: when the connection to the broker was lost (monotonic time) and why, or None if the broker is connected
        self._away_since: float | None = time.monotonic()
        self._away_why = ""
        #: the robots that haven't reconnected since the broker came back, with their time limits (monotonic time)
        self._missing: dict[str, float] = {}

    def events(self, interrupt: Mapping[int, int] | None = None) -> Iterator[FleetEvent]:
        """Yield events until one of the `interrupt` descriptors is ready.

        The first event is a FleetSnapshot.

        Raises:
            Interrupted: One of the descriptors is ready, see `wait_ready`.
            ServerUnavailable: The broker can't be reached when the watch starts.
            AccessDenied: The broker rejected the login, or its access rules don't allow the request.
            Lost: The connection to the broker was lost later, and the broker wasn't back in time.
        """
        try:
            run_blocking(self._desk.wait_for_retained(ANSWER_LIMIT_S, lambda: False, interrupt))
            self._process_retained(self._retained or [], time.monotonic(), first=True)
            while True:
                now = time.monotonic()
                if self._retained is not None and self._desk.retained_received:
                    self._process_retained(self._retained, now)
                self._check_time_limits(now)
                while self._events:
                    yield self._events.popleft()
                run_blocking(self._desk.poll(_LIMIT_CHECK_INTERVAL_S, interrupt))
        finally:
            self._desk.close()

    # -- messages from the broker

    def on_connected(self, link: Link) -> None:
        """Subscribe to the robots' presence, status and events."""
        self._retained = []
        robot = (self._selection and self._selection.name) or topics.ANY
        link.subscribe(topics.robot(robot, topics.EVENT, topics.ANY), retained=False)
        link.subscribe(*(topics.robot(robot, each) for each in (topics.PRESENCE, topics.STATUS)), retained=True)

    def on_disconnected(self, why: str) -> None:
        """Report once that the connection to the broker was lost."""
        self._retained, self._away_why = None, why
        if self._away_since is None:
            self._away_since = time.monotonic()
            self._events.append(BrokerAway(why, ABSENCE_LIMIT_S))

    def on_message(self, message: Message) -> None:
        """Report the change or the event that a robot's message contains.

        On a new connection, first collect all retained messages.
        """
        if self._retained is not None:
            self._retained.append(message)
            return
        _, _, name, kind, *_ = message.topic.split("/")
        if kind == topics.PRESENCE:
            presence = Presence.read(name, message.payload)
            if presence or not message.payload:  # Ignore malformed messages.
                self._missing.pop(name, None)
                self._set_presence(name, presence if presence and self._selects(presence) else None)
        elif kind == topics.STATUS:
            if name in self._maybe_missed:  # Otherwise, events have already reported the goals, with more details.
                self._report_missed(name, RobotStatus.read(message.payload))
        elif (event := _read_event(message)) is not None:
            self._report(event)

    def _selects(self, presence: Presence) -> bool:
        """Return whether the watch includes this robot."""
        return self._selection is None or self._selection.includes(presence)

    # -- time limits

    def _check_time_limits(self, now: float) -> None:
        """Report robots that haven't come back in time. Raise Lost if the broker is still away."""
        too_long = self._away_since is not None and now - self._away_since >= ABSENCE_LIMIT_S
        if too_long and not self._events:  # All events must be reported before the watch fails.
            raise Lost(f"the broker at {self._broker.url} was unreachable for {ABSENCE_LIMIT_S:g} s: {self._away_why}")
        for name in [name for name, until in self._missing.items() if now >= until]:
            del self._missing[name]
            self._set_presence(name, None)

    # -- changes

    def _process_retained(self, messages: list[Message], now: float, *, first: bool = False) -> None:
        """Report the first snapshot, or the changes that happened while the connection was lost."""
        self._retained = None
        robots = {each.presence.name: each for each in _read_states(messages) if self._selects(each.presence)}
        events = [event for each in messages if (event := _read_event(each))]
        if first:
            self._presences = {name: each.presence for name, each in robots.items()}
            self._events.append(FleetSnapshot(tuple(robots.values())))
        else:
            self._events.append(BrokerBack(now - (self._away_since or now)))
            gone = [name for name, each in self._presences.items() if each.online and name not in robots]
            self._missing = dict.fromkeys(gone, now + BRIDGES_BACK_LIMIT_S)
            for name, robot in robots.items():
                self._set_presence(name, robot.presence)
        self._away_since = None
        self._maybe_missed = set(self._presences)
        arrived = {each.event.id for each in events}
        for name, robot in robots.items():
            self._report_missed(name, robot.status, arrived)
        for event in events:
            self._report(event)

    def _set_presence(self, name: str, presence: Presence | None) -> None:
        """Store a robot's presence, and report if the robot or its server started or stopped."""
        before = self._presences.pop(name, None)
        if presence:
            self._presences[name] = presence
            if before is None or not before.online:
                self._maybe_missed.add(name)
        if _identity(before) != _identity(presence):
            self._events.append(RobotChanged(name, before, presence))

    def _report_missed(self, name: str, status: RobotStatus | None, skip_ids: Container[str | None] = ()) -> None:
        """Report missed events if a robot's status shows goals that haven't been reported.

        Args:
            name: the name of the robot.
            status: the status of the robot, or None if unknown.
            skip_ids: the ids of goals to leave out, because their events have arrived and will be reported later.
        """
        if status is None:
            return
        events, is_known, presence = status.events(), name in self._reported, self._presences.get(name)
        reported = self._reported.setdefault(name, {})
        missed = [each for each in events if reported.get(each.state.terminal) != each.id and each.id not in skip_ids]
        reported.update({each.state.terminal: each.id for each in events})
        if events:  # A bridge that has just started may not know any goals yet.
            self._maybe_missed.discard(name)
        if is_known and missed and presence and presence.online:
            self._events.append(EventsMissed(RobotInfo(presence, status), tuple(missed)))

    def _report(self, robot_event: RobotEvent) -> None:
        """Report a robot's event. Remember the event's goal to detect missed events later."""
        name, event = robot_event.name, robot_event.event
        if self._selection and name not in self._presences:
            return
        if isinstance(event, StateChanged) and (event.state.terminal or event.state is State.ACTIVE):
            self._reported.setdefault(name, {})[event.state.terminal] = event.id
        self._events.append(robot_event)


def _read_event(message: Message) -> RobotEvent | None:
    """Read an event from a message. Return None if the message contains no known event."""
    _, _, name, kind, *_ = message.topic.split("/")
    if kind != topics.EVENT or topics.name_fault(name):
        return None
    try:
        content = decode(message.payload.strip())
        event = from_json(content)
    except (BadRequest, ValueError):
        return None
    if not isinstance(event, StateChanged | GoalInterrupted | PausedChanged):
        return None
    return RobotEvent(name, event, content)


def _identity(presence: Presence | None) -> tuple[object, ...]:
    """Return a value that identifies the current run of a robot, its bridge and its server."""
    if presence is None or not presence.online:
        return (False,)
    return True, presence.session, presence.server and presence.server.get("boot")
