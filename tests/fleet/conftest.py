"""Fixtures for brokers, bridges, robots and desks."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
from typing import TYPE_CHECKING, Any, ParamSpec

import pytest

from talkcli import Fleet
from talkcli.fleet import topics
from talkcli.fleet.bridge.policy import ALLOWABLE_REQUESTS
from tests.fleet.many import RealRobots, request
from tests.fleet.robot import Robot
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.support.processes import Talk
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator

    #: Starts a bridge, and waits until it is online unless `online=False`: `make_bridge(talk, broker, "anna")`.
    MakeBridge = Callable[..., Bridge]
    MakeRobot = Callable[..., Robot]

    from tests.conftest import MakeTalk

_P = ParamSpec("_P")

#: Users of a secure broker, each with its own password: robots, an operator, and a user without rights.
ROBOTS, OPERATORS, OTHERS = ("anna", "bert"), ("olga",), ("otto",)


def in_loop(test: Callable[_P, Coroutine[Any, Any, None]]) -> Callable[_P, None]:
    """Run a coroutine as a test."""

    @functools.wraps(test)
    def run(*args: _P.args, **named: _P.kwargs) -> None:
        asyncio.run(test(*args, **named))

    return run


@pytest.fixture
def broker() -> Iterator[Broker]:
    """A broker without TLS, logins or rules."""
    with Broker() as result:
        yield result


@pytest.fixture
def secure_broker() -> Iterator[Broker]:
    """A broker with TLS, passwords, and the access rules that `talk bridge` prints."""
    users = {name: f"password of {name}" for name in (*ROBOTS, *OPERATORS, *OTHERS)}
    with Broker(secure=True, users=users, acl=topics.access_rules(OPERATORS) + "\n") as result:
        yield result


@pytest.fixture
def make_bridge() -> Iterator[MakeBridge]:
    """A function that starts bridges. Bridges that still run at the end must exit with 0 after SIGTERM.

    A test must request its broker fixture before this one.
    """
    bridges: list[Bridge] = []
    with contextlib.ExitStack() as stack:

        def make(*arguments: Any, online: bool = True, **named: Any) -> Bridge:
            bridges.append(bridge := stack.enter_context(Bridge(*arguments, **named)))
            if online:
                bridge.await_online()
            return bridge

        yield make
        for bridge in bridges:
            if bridge.running:
                code = bridge.terminate()
                assert code == 0, f"the bridge {bridge.name} exited with {code}: {bridge.log}"


@pytest.fixture
def make_robot(make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge) -> MakeRobot:
    """A function that starts robots with the scripted engine: `make_robot("anna", "--allow", "say", groups=[])`."""

    def make(name: str, *options: str, **named: Any) -> Robot:
        talk = make_talk(scripted=True)
        return Robot(talk, broker, make_bridge(talk, broker, name, *options, **named))

    return make


@pytest.fixture
def robot(scripted: Talk, broker: Broker, make_bridge: MakeBridge) -> Robot:
    """The robot anna, online, with the scripted engine."""
    return Robot(scripted, broker, make_bridge(scripted, broker, "anna"))


@pytest.fixture(scope="module")
def shared_robot() -> Iterator[Robot]:
    """A robot like `robot`, for all tests of a module that don't change it."""
    with Broker() as broker, contextlib.closing(Talk(scripted=True)) as talk:
        with Bridge(talk, broker, "anna") as bridge:
            bridge.await_online()
            yield Robot(talk, broker, bridge)
            assert bridge.terminate() == 0, bridge.log
        talk.stop()


@pytest.fixture(scope="module")
def pair() -> Iterator[RealRobots]:
    """The robots wh-1 and wh-2 of the group warehouse, which allow all requests, and their broker.

    All tests of a module share them. Each test must leave them without goals.
    """
    allowed = ("--allow", ",".join(sorted(ALLOWABLE_REQUESTS)))
    with Broker() as broker, RealRobots(broker, ["wh-1", "wh-2"], ["warehouse"], allowed) as result:
        yield result


@pytest.fixture
def desk(pair: RealRobots) -> Iterator[Desk]:
    """A desk that selects both robots of the pair. All their goals are cancelled afterwards."""
    with Desk(pair.broker, env={"TALK_ROBOT": "wh-*"}) as result:
        yield result
    request(pair, "resume")
    request(pair, "cancel")


@pytest.fixture
def fleet(pair: RealRobots, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    """The library for the pair. All their goals are cancelled afterwards."""
    yield fleet_of(pair.broker, monkeypatch)
    request(pair, "resume")
    request(pair, "cancel")


def fleet_of(broker: Broker, monkeypatch: pytest.MonkeyPatch, *, grace: float = 0.05, user: str | None = None) -> Fleet:
    """Return the library for a broker. `grace` is the time to wait for retained messages, in seconds."""
    needs_packages("paho")
    from talkcli.fleet.desk import link

    monkeypatch.setattr(link, "RETAINED_GRACE_S", grace)  # mosquitto sends all retained messages at once
    for name in [name for name in os.environ if name.startswith("TALK_") and not name.startswith("TALK_TEST_")]:
        monkeypatch.delenv(name)
    if user:
        monkeypatch.setenv("TALK_MQTT_USER", user)
    return Fleet(broker.url)
