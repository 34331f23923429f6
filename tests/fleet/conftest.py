"""Fixtures: brokers, bridges, and a robot that has both."""

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

    #: Starts a bridge for a test, and returns it, online unless that is False: `make_bridge(talk, broker, "anna")`.
    MakeBridge = Callable[..., Bridge]
    MakeRobot = Callable[..., Robot]

    from tests.conftest import MakeTalk

_P = ParamSpec("_P")

#: Logins at a secure broker, each with a password of its own: robots, an operator, and one without rights.
ROBOTS, OPERATORS, OTHERS = ("anna", "bert"), ("olga",), ("otto",)


def in_loop(test: Callable[_P, Coroutine[Any, Any, None]]) -> Callable[_P, None]:
    """Run a test that is a coroutine."""

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
    """A broker with TLS, passwords, and the rules that talk prints for its robots and the operator."""
    users = {name: f"password of {name}" for name in (*ROBOTS, *OPERATORS, *OTHERS)}
    with Broker(secure=True, users=users, acl=topics.access_rules(OPERATORS) + "\n") as result:
        yield result


@pytest.fixture
def make_bridge() -> Iterator[MakeBridge]:
    """Starts bridges; those that still run at the end must end well by SIGTERM. A test asks for its broker before."""
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
                assert code == 0, f"the bridge {bridge.name} ended with {code}: {bridge.log}"


@pytest.fixture
def make_robot(make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge) -> MakeRobot:
    """Starts robots that speak by a script: `make_robot("anna", "--allow", "say", groups=["warehouse"])`."""

    def make(name: str, *options: str, **named: Any) -> Robot:
        talk = make_talk(scripted=True)
        return Robot(talk, broker, make_bridge(talk, broker, name, *options, **named))

    return make


@pytest.fixture
def robot(scripted: Talk, broker: Broker, make_bridge: MakeBridge) -> Robot:
    """A robot, anna, online, that speaks by a script: for a tenth of a second, or as its texts say."""
    return Robot(scripted, broker, make_bridge(scripted, broker, "anna"))


@pytest.fixture(scope="module")
def lasting_robot() -> Iterator[Robot]:
    """A robot as `robot` is one, for all tests of a module that leave it as it is."""
    with Broker() as broker, contextlib.closing(Talk(scripted=True)) as talk:
        with Bridge(talk, broker, "anna") as bridge:
            bridge.await_online()
            yield Robot(talk, broker, bridge)
            assert bridge.terminate() == 0, bridge.log
        talk.stop()


@pytest.fixture(scope="module")
def pair() -> Iterator[RealRobots]:
    """Two robots of the group warehouse, wh-1 and wh-2, that allow all requests, with a broker of their own.

    All tests of a module share them: each leaves them silent, and with nothing to say.
    """
    allowed = ("--allow", ",".join(sorted(ALLOWABLE_REQUESTS)))
    with Broker() as broker, RealRobots(broker, ["wh-1", "wh-2"], ["warehouse"], allowed) as result:
        yield result


@pytest.fixture
def desk(pair: RealRobots) -> Iterator[Desk]:
    """A desk that asks both robots of the pair; all their goals are cancelled in the end."""
    with Desk(pair.broker, env={"TALK_ROBOT": "wh-*"}) as result:
        yield result
    request(pair, "resume")
    request(pair, "cancel")


@pytest.fixture
def fleet(pair: RealRobots, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    """The library for the pair; all their goals are cancelled in the end."""
    yield fleet_of(pair.broker, monkeypatch)
    request(pair, "resume")
    request(pair, "cancel")


def fleet_of(broker: Broker, monkeypatch: pytest.MonkeyPatch, *, grace: float = 0.05, user: str | None = None) -> Fleet:
    """Return the library for a broker; `grace`: seconds in which the broker may still tell what it keeps."""
    needs_packages("paho")
    from talkcli.fleet.desk import link

    monkeypatch.setattr(link, "RETAINED_GRACE_S", grace)  # mosquitto tells at once all that it keeps
    for name in [name for name in os.environ if name.startswith("TALK_") and not name.startswith("TALK_TEST_")]:
        monkeypatch.delenv(name)
    if user:
        monkeypatch.setenv("TALK_MQTT_USER", user)
    return Fleet(broker.url)
