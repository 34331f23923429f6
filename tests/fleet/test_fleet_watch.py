"""`FleetWatch`, also with a broker that was away. A publisher stands in for the robots."""

from __future__ import annotations

import contextlib
import os
import queue
import select
import threading
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.errors import Lost
from talkcli.fleet.broker import from_environment
from talkcli.fleet.desk import link, watch
from talkcli.fleet.desk.request import Selection
from talkcli.fleet.desk.watch import (
    BrokerAway,
    BrokerBack,
    EventsMissed,
    FleetSnapshot,
    FleetWatch,
    RobotChanged,
    RobotEvent,
)
from talkcli.goals.states import State
from talkcli.polling import Interrupted
from talkcli.protocol.events import StateChanged
from tests.fleet import publish
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.fleet.desk.watch import FleetEvent
    from tests.support.broker import Broker


class BackgroundWatch(contextlib.AbstractContextManager["BackgroundWatch"]):
    """A `FleetWatch` in its own thread, which `with` starts and ends."""

    def __init__(self, broker: Broker, selection: str | None = None) -> None:
        self._watch = FleetWatch(from_environment(broker.env()), Selection(selection) if selection else None)
        self._queue: queue.SimpleQueue[FleetEvent | Exception] = queue.SimpleQueue()
        self._wake, self._write = os.pipe()
        self._thread = threading.Thread(target=self._read, daemon=True)
        #: all events after the snapshot that `find` has inspected
        self.seen: list[FleetEvent] = []

    def __enter__(self) -> BackgroundWatch:
        self._thread.start()
        self.snapshot = self.find(FleetSnapshot)
        self.seen.clear()
        return self

    def __exit__(self, *_error: object) -> None:
        os.write(self._write, b"\0")
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()
        os.close(self._wake)
        os.close(self._write)

    def find(self, kind: type[Any], wanted: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return the first matching event of a kind, or raise the error that ended the watch."""
        matches = [event for event in self.seen if isinstance(event, kind) and wanted(event)]
        while not matches:
            event = self._queue.get(timeout=PATIENCE)
            if isinstance(event, Exception):
                raise event
            self.seen.append(event)
            matches = [event] if isinstance(event, kind) and wanted(event) else []
        return matches[0]

    def _read(self) -> None:
        try:
            for event in self._watch.events({self._wake: select.POLLIN}):
                self._queue.put(event)
        except Interrupted:
            pass
        except Exception as error:  # noqa: BLE001 - `find` raises it
            self._queue.put(error)


@pytest.fixture
def robots(broker: Broker) -> Iterator[Listener]:
    """A publisher of the robots' messages."""
    with Listener(broker) as publisher:
        yield publisher


@pytest.fixture
def fast_reconnect(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes a watch reconnect soon after its broker is back."""
    monkeypatch.setattr(link, "_MAX_BROKER_PAUSE_S", 0.1)


def names(events: list[FleetEvent]) -> list[str]:
    return [event.name for event in events if isinstance(event, RobotChanged | RobotEvent)]


def test_the_snapshot_contains_each_robot(broker: Broker, robots: Listener) -> None:
    with BackgroundWatch(broker) as watcher:
        assert watcher.snapshot.robots == ()
        publish.presence(robots, "anna")
        change = watcher.find(RobotChanged)
        assert (change.name, change.before, change.now.online) == ("anna", None, True)
    publish.presence(robots, "bert", online=False)
    publish.status(robots, "anna", active="a-2", text="hello", last="a-1")
    with BackgroundWatch(broker) as watcher:
        anna, bert = watcher.snapshot.robots
        assert (anna.presence.name, anna.presence.online, anna.status.text) == ("anna", True, "hello")
        assert (bert.presence.name, bert.presence.online, bert.status) == ("bert", False, None)


def test_changed_presences_are_reported_and_renewed_ones_are_not(broker: Broker, robots: Listener) -> None:
    publish.presence(robots, "anna")
    with BackgroundWatch(broker) as watcher:
        publish.presence(robots, "anna")  # as a bridge does every minute
        publish.presence(robots, "anna", server=None)
        publish.presence(robots, "anna", server={**publish.SERVER, "boot": "8abc"})
        publish.presence(robots, "anna", online=False)
        robots.publish("talk/robot/anna/presence", "", retain=True)  # cleared, but the robot is gone already
        publish.presence(robots, "anna", session="6666")
        watcher.find(RobotChanged, lambda event: event.now and event.now.session == "6666")
        changes = [event.now for event in watcher.seen if isinstance(event, RobotChanged)]
        assert [(presence and presence.online, bool(presence and presence.server)) for presence in changes] == [
            (True, False), (True, True), (False, False), (True, True),
        ]  # fmt: skip


def test_malformed_events_are_left_out(broker: Broker, robots: Listener) -> None:
    publish.presence(robots, "anna")
    malformed = ["", "hello", "[]", "{}", '{"event": "state"}', '{"event": "snapshot"}', '{"event": "state", "id": 3}']
    with BackgroundWatch(broker) as watcher:
        for payload in malformed:
            robots.publish("talk/robot/anna/event/state", payload)
        robots.publish("talk/robot/anna/event/more/levels", '{"event": "state", "id": "a-0", "state": "ACTIVE"}')
        publish.event(robots, "anna", "a-1", "PENDING", "hello")
        publish.event(robots, "anna", "a-1", "ACTIVE")
        publish.event(robots, "anna", "a-1", "SUCCEEDED", "hello")
        ended = watcher.find(RobotEvent, lambda event: event.event.state.terminal)
        assert (ended.name, ended.event.id, ended.message["goal"]["text"]) == ("anna", "a-1", "hello")
        events = [event.event for event in watcher.seen if isinstance(event, RobotEvent)]
        states = [event.state for event in events if isinstance(event, StateChanged)]
        assert (len(watcher.seen), states) == (3, [State.PENDING, State.ACTIVE, State.SUCCEEDED])


@pytest.mark.parametrize(("text", "selected"), [("anna", ["anna"]), ("wh-*", ["wh-1"]), ("@night", ["anna", "wh-1"])])
def test_only_selected_robots_are_watched(broker: Broker, robots: Listener, text: str, selected: list[str]) -> None:
    publish.presence(robots, "anna", groups=["night"])
    with BackgroundWatch(broker, text) as watcher:
        publish.presence(robots, "bert")
        publish.presence(robots, "wh-1", groups=["night"])
        for name in ("bert", "anna", "wh-1"):
            publish.event(robots, name, "a-1", "ACTIVE")
        watcher.find(RobotEvent, lambda event: event.name == selected[-1])
        assert {*names(watcher.seen)} == {*selected}


@pytest.mark.usefixtures("fast_reconnect")
def test_after_a_disconnect_each_change_is_reported_once(broker: Broker, robots: Listener) -> None:
    for name in ("anna", "bert", "carl", "dora"):
        publish.presence(robots, name)
        publish.status(robots, name, last=f"{name}-1")
    with BackgroundWatch(broker) as watcher:
        publish.event(robots, "bert", "bert-2", "SUCCEEDED", "known")
        watcher.find(RobotEvent)
        broker.kill()
        away = watcher.find(BrokerAway)
        assert "was lost" in away.why
        broker.start()
        with Listener(broker) as again:
            publish.presence(again, "anna")
            publish.status(again, "anna", last="anna-2", active="anna-3", text="now")
            publish.presence(again, "bert", server=None)
            publish.status(again, "bert", last="bert-2")
            publish.presence(again, "dora")
            publish.status(again, "dora", last="dora-1")
            publish.presence(again, "carl", online=False)
            watcher.find(RobotChanged, lambda event: event.name == "carl" and not event.now.online)
            watcher.find(EventsMissed)
            publish.event(again, "dora", "dora-2", "ACTIVE")
            watcher.find(RobotEvent, lambda event: event.name == "dora")
        missed = [event for event in watcher.seen if isinstance(event, EventsMissed)]
        (events,) = ([(one.id, one.state.name) for one in event.events] for event in missed)
        assert events == [("anna-2", "SUCCEEDED"), ("anna-3", "ACTIVE")]
        assert watcher.find(BrokerBack).after > 0
        changes = [event for event in watcher.seen if isinstance(event, RobotChanged)]
        assert sorted(event.name for event in changes) == ["bert", "carl"]


@pytest.mark.usefixtures("fast_reconnect")
def test_a_robot_that_does_not_return_with_its_broker_is_gone(
    broker: Broker, robots: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch, "BRIDGES_BACK_LIMIT_S", 0.5)
    publish.presence(robots, "anna")
    publish.presence(robots, "bert", online=False)
    with BackgroundWatch(broker) as watcher:
        broker.kill()
        broker.start()
        gone = watcher.find(RobotChanged)
        assert (gone.name, gone.before.online, gone.now) == ("anna", True, None)
        with Listener(broker) as again:
            publish.presence(again, "anna")
            assert watcher.find(RobotChanged, lambda event: event.now).before is None
        assert names(watcher.seen) == ["anna", "anna"]


def test_goals_spoken_while_a_robot_was_offline_are_reported_later(broker: Broker, robots: Listener) -> None:
    publish.presence(robots, "anna")
    publish.status(robots, "anna", last="a-1")
    with BackgroundWatch(broker) as watcher:
        publish.presence(robots, "anna", online=False)
        publish.presence(robots, "anna")
        publish.status(robots, "anna", last="a-2", state="ABORTED")
        missed = watcher.find(EventsMissed)
        assert [(event.id, event.state) for event in missed.events] == [("a-2", State.ABORTED)]
        publish.event(robots, "anna", "a-3", "ACTIVE")
        publish.status(robots, "anna", last="a-2", active="a-3")
        publish.event(robots, "anna", "a-3", "SUCCEEDED", "hello")
        watcher.find(RobotEvent, lambda event: event.event.state.terminal)
        assert sum(isinstance(event, EventsMissed) for event in watcher.seen) == 1


@pytest.mark.usefixtures("fast_reconnect")
def test_a_watch_fails_if_the_broker_stays_away(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "ABSENCE_LIMIT_S", 0.5)
    with BackgroundWatch(broker) as watcher:
        broker.kill()
        # The second reason, if a busy machine hasn't tried to reconnect by then.
        why = "(can't connect to the broker at .*refused|the connection to the broker at .* was lost)"
        with pytest.raises(Lost, match=rf"was unreachable for 0\.5 s: {why}$"):
            watcher.find(BrokerBack)
        assert watcher.find(BrokerAway).limit == 0.5
