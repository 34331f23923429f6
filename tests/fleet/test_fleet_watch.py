"""`FleetWatch` sees robots and their goals, also after the broker was away. A publisher speaks for the robots."""

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
from tests.fleet import told
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.fleet.desk.watch import FleetEvent
    from tests.support.broker import Broker


class Looking(contextlib.AbstractContextManager["Looking"]):
    """A watch in a thread of its own, which `with` starts and ends."""

    def __init__(self, broker: Broker, selection: str | None = None) -> None:
        self._watch = FleetWatch(from_environment(broker.env()), Selection(selection) if selection else None)
        self._queue: queue.SimpleQueue[FleetEvent | Exception] = queue.SimpleQueue()
        self._wake, self._write = os.pipe()
        self._thread = threading.Thread(target=self._look, daemon=True)
        #: all events after the first, as far as `find` has looked
        self.seen: list[FleetEvent] = []

    def __enter__(self) -> Looking:
        self._thread.start()
        self.begun = self.find(FleetSnapshot)
        self.seen.clear()
        return self

    def __exit__(self, *_error: object) -> None:
        os.write(self._write, b"\0")
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()
        os.close(self._wake)
        os.close(self._write)

    def find(self, kind: type[Any], wanted: Callable[[Any], bool] = lambda _: True) -> Any:
        """Wait for the first event of a kind, and return it; raise the error that has ended the watch."""
        found = [each for each in self.seen if isinstance(each, kind) and wanted(each)]
        while not found:
            each = self._queue.get(timeout=PATIENCE)
            if isinstance(each, Exception):
                raise each
            self.seen.append(each)
            found = [each] if isinstance(each, kind) and wanted(each) else []
        return found[0]

    def _look(self) -> None:
        try:
            for each in self._watch.events({self._wake: select.POLLIN}):
                self._queue.put(each)
        except Interrupted:
            pass
        except Exception as error:  # noqa: BLE001 - the test's own thread raises it
            self._queue.put(error)


@pytest.fixture
def robots(broker: Broker) -> Iterator[Listener]:
    """A publisher for the robots."""
    with Listener(broker) as publisher:
        yield publisher


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A desk that reconnects soon after its broker is back."""
    monkeypatch.setattr(link, "_MAX_BROKER_PAUSE_S", 0.1)


def names(events: list[FleetEvent]) -> list[str]:
    return [each.name for each in events if isinstance(each, RobotChanged | RobotEvent)]


def test_it_begins_with_the_standing_of_each_robot(broker: Broker, robots: Listener) -> None:
    with Looking(broker) as looking:
        assert looking.begun.robots == ()
        told.presence(robots, "anna")
        change = looking.find(RobotChanged)
        assert (change.name, change.before, change.now.online) == ("anna", None, True)
    told.presence(robots, "bert", online=False)
    told.status(robots, "anna", active="a-2", text="hello", last="a-1")
    with Looking(broker) as looking:
        anna, bert = looking.begun.robots
        assert (anna.presence.name, anna.presence.online, anna.status.text) == ("anna", True, "hello")
        assert (bert.presence.name, bert.presence.online, bert.status) == ("bert", False, None)


def test_it_sees_robots_and_servers_come_and_go_but_not_a_renewed_presence(broker: Broker, robots: Listener) -> None:
    told.presence(robots, "anna")
    with Looking(broker) as looking:
        told.presence(robots, "anna")  # as a bridge does every minute
        told.presence(robots, "anna", server=None)
        told.presence(robots, "anna", server={**told.SERVER, "boot": "8abc"})
        told.presence(robots, "anna", online=False)
        robots.publish("talk/robot/anna/presence", "", retain=True)  # cleared: it is gone already
        told.presence(robots, "anna", session="6666")
        looking.find(RobotChanged, lambda each: each.now and each.now.session == "6666")
        changes = [each.now for each in looking.seen if isinstance(each, RobotChanged)]
        assert [(each and each.online, bool(each and each.server)) for each in changes] == [
            (True, False), (True, True), (False, False), (True, True),
        ]  # fmt: skip


def test_it_sees_each_event_and_leaves_malformed_ones_out(broker: Broker, robots: Listener) -> None:
    told.presence(robots, "anna")
    malformed = ["", "hello", "[]", "{}", '{"event": "state"}', '{"event": "snapshot"}', '{"event": "state", "id": 3}']
    with Looking(broker) as looking:
        for payload in malformed:
            robots.publish("talk/robot/anna/event/state", payload)
        robots.publish("talk/robot/anna/event/more/levels", '{"event": "state", "id": "a-0", "state": "ACTIVE"}')
        told.event(robots, "anna", "a-1", "PENDING", "hello")
        told.event(robots, "anna", "a-1", "ACTIVE")
        told.event(robots, "anna", "a-1", "SUCCEEDED", "hello")
        ended = looking.find(RobotEvent, lambda each: each.event.state.terminal)
        assert (ended.name, ended.event.id, ended.message["goal"]["text"]) == ("anna", "a-1", "hello")
        events = [each.event for each in looking.seen if isinstance(each, RobotEvent)]
        states = [each.state for each in events if isinstance(each, StateChanged)]
        assert (len(looking.seen), states) == (3, [State.PENDING, State.ACTIVE, State.SUCCEEDED])


@pytest.mark.parametrize(("text", "picked"), [("anna", ["anna"]), ("wh-*", ["wh-1"]), ("@night", ["anna", "wh-1"])])
def test_it_sees_the_robots_that_are_picked(broker: Broker, robots: Listener, text: str, picked: list[str]) -> None:
    told.presence(robots, "anna", groups=["night"])
    with Looking(broker, text) as looking:
        told.presence(robots, "bert")
        told.presence(robots, "wh-1", groups=["night"])
        for name in ("bert", "anna", "wh-1"):
            told.event(robots, name, "a-1", "ACTIVE")
        looking.find(RobotEvent, lambda each: each.name == picked[-1])
        assert {*names(looking.seen)} == {*picked}


@pytest.mark.usefixtures("quick")
def test_after_a_break_it_tells_what_has_changed_and_nothing_twice(broker: Broker, robots: Listener) -> None:
    for name in ("anna", "bert", "carl", "dora"):
        told.presence(robots, name)
        told.status(robots, name, last=f"{name}-1")
    with Looking(broker) as looking:
        told.event(robots, "bert", "bert-2", "SUCCEEDED", "heard of")
        looking.find(RobotEvent)
        broker.kill()
        away = looking.find(BrokerAway)
        assert "was lost" in away.why
        broker.start()
        with Listener(broker) as again:
            told.presence(again, "anna")
            told.status(again, "anna", last="anna-2", active="anna-3", text="now")
            told.presence(again, "bert", server=None)
            told.status(again, "bert", last="bert-2")
            told.presence(again, "dora")
            told.status(again, "dora", last="dora-1")
            told.presence(again, "carl", online=False)
            looking.find(RobotChanged, lambda each: each.name == "carl" and not each.now.online)
            looking.find(EventsMissed)
            told.event(again, "dora", "dora-2", "ACTIVE")
            looking.find(RobotEvent, lambda each: each.name == "dora")
        missed = [each for each in looking.seen if isinstance(each, EventsMissed)]
        (events,) = ([(one.id, one.state.name) for one in each.events] for each in missed)
        assert events == [("anna-2", "SUCCEEDED"), ("anna-3", "ACTIVE")]
        assert looking.find(BrokerBack).after > 0
        changes = [each for each in looking.seen if isinstance(each, RobotChanged)]
        assert sorted(each.name for each in changes) == ["bert", "carl"]


@pytest.mark.usefixtures("quick")
def test_a_robot_that_does_not_come_back_with_its_broker_is_gone(
    broker: Broker, robots: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch, "BRIDGES_BACK_LIMIT_S", 0.5)
    told.presence(robots, "anna")
    told.presence(robots, "bert", online=False)
    with Looking(broker) as looking:
        broker.kill()
        broker.start()
        gone = looking.find(RobotChanged)
        assert (gone.name, gone.before.online, gone.now) == ("anna", True, None)
        with Listener(broker) as again:
            told.presence(again, "anna")
            assert looking.find(RobotChanged, lambda each: each.now).before is None
        assert names(looking.seen) == ["anna", "anna"]


def test_a_robot_that_was_away_tells_what_it_has_spoken_meanwhile(broker: Broker, robots: Listener) -> None:
    told.presence(robots, "anna")
    told.status(robots, "anna", last="a-1")
    with Looking(broker) as looking:
        told.presence(robots, "anna", online=False)
        told.presence(robots, "anna")
        told.status(robots, "anna", last="a-2", state="ABORTED")
        missed = looking.find(EventsMissed)
        assert [(each.id, each.state) for each in missed.events] == [("a-2", State.ABORTED)]
        told.event(robots, "anna", "a-3", "ACTIVE")
        told.status(robots, "anna", last="a-2", active="a-3")
        told.event(robots, "anna", "a-3", "SUCCEEDED", "hello")
        looking.find(RobotEvent, lambda each: each.event.state.terminal)
        assert sum(isinstance(each, EventsMissed) for each in looking.seen) == 1


@pytest.mark.usefixtures("quick")
def test_a_broker_that_stays_away_is_lost(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "ABSENCE_LIMIT_S", 0.5)
    with Looking(broker) as looking:
        broker.kill()
        # The second if a busy machine has not tried once by then.
        why = "(can't connect to the broker at .*refused|the connection to the broker at .* was lost)"
        with pytest.raises(Lost, match=rf"was unreachable for 0\.5 s: {why}$"):
            looking.find(BrokerBack)
        assert looking.find(BrokerAway).limit == 0.5
