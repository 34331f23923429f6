"""The asyncio library over a broker: one robot, several robots, and the threads that it needs."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import State
from talkcli.aio import Fleet
from talkcli.errors import ServerUnavailable, UsageError
from talkcli.fleet.desk.robot import RobotConnection
from tests.fleet.conftest import fleet_of
from tests.fleet.robot import LONG
from tests.support.connection import PATIENCE
from tests.support.loop import in_loop
from tests.support.ports import HOST
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from talkcli.client.core import Exchange
    from tests.fleet.many import RealRobots
    from tests.fleet.robot import Robot

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def own_fleet(pair: RealRobots, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """The asyncio library for the pair."""
    fleet_of(pair.broker, monkeypatch)
    return Fleet(pair.broker.url)


@in_loop
async def test_one_robot_is_a_client_without_a_thread(own_fleet: Fleet, pair: RealRobots) -> None:
    threads = threading.active_count()
    async with own_fleet.robot("wh-1") as client:
        goal = await client.say("the door opens", feedback=True)
        assert [word.word async for word in goal.feedback(PATIENCE)] == ["the", "door", "opens"]
        assert (await goal.wait(PATIENCE)).state is State.SUCCEEDED
        assert threading.active_count() == threads  # the thread that connected has ended
        assert (await client.status()).server["pid"] == pair["wh-1"].talk.pid
        async with client.saying(LONG) as goal:
            pass
        assert goal.state in {State.PREEMPTED, State.RECALLED}
    assert [robot.name for robot in await own_fleet.robots()] == ["wh-1", "wh-2"]


@in_loop
async def test_the_loop_watches_no_descriptor_that_a_call_may_close(
    own_fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = []
    send = RobotConnection._send

    def observe(connection: RobotConnection, exchange: Exchange) -> None:
        assert connection._desk.link
        watched.append(asyncio.get_running_loop().remove_reader(connection._desk.link.fileno()))
        send(connection, exchange)

    async with own_fleet.robot("wh-1") as client:
        await asyncio.sleep(0.01)
        monkeypatch.setattr(RobotConnection, "_send", observe)
        await client.status()
    assert watched == [False]


@in_loop
async def test_a_request_is_sent_to_several_robots_when_its_iteration_begins(
    own_fleet: Fleet, pair: RealRobots
) -> None:
    for to in ("wh-*", "@warehouse"):
        assert {each.robot: each.state async for each in own_fleet.say(to, "hello")} == {
            "wh-1": "SUCCEEDED",
            "wh-2": "SUCCEEDED",
        }
    request = own_fleet.say("wh-*", LONG, id="canceled-later")
    with pytest.raises(UsageError, match="not been sent"):
        request.cancel()
    with pytest.raises(TimeoutError, match=r"0 of 2 robots have finished after 0\.1 s"):
        _ = [each async for each in request.results(0.1)]
    pair.each(lambda robot: robot.talk.watcher.wait_for("canceled-later", "ACTIVE"))
    request.cancel()
    assert [each.state async for each in request] == ["PREEMPTED"] * 2
    with pytest.raises(UsageError, match="has ended"):
        request.cancel()
    async with own_fleet.status("nobody-*") as request:
        with pytest.raises(ServerUnavailable, match="no robot matches"):
            _ = [each async for each in request]


@in_loop
async def test_a_client_survives_an_absence_of_the_broker(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet_of(robot.broker, monkeypatch)
    async with Fleet(robot.broker.url).robot("anna") as client:
        goal = await client.say("never-ends")
        waiting = asyncio.create_task(goal.wait())
        await asyncio.to_thread(robot.broker.kill)
        with pytest.raises(TimeoutError):
            await goal.wait(0.3)
        await asyncio.to_thread(robot.broker.start)
        assert len((await client.cancel()).canceled) == 1
        assert (await waiting).state is State.PREEMPTED


@in_loop
async def test_a_broker_that_does_not_answer_holds_up_no_other_task(monkeypatch: pytest.MonkeyPatch) -> None:
    needs_packages("paho")
    monkeypatch.setattr("talkcli.fleet.link.LOGIN_LIMIT_S", 1.0)
    with socket.create_server((HOST, 0)) as silent, limits():
        connecting = asyncio.create_task(Fleet(f"mqtt://{HOST}:{silent.getsockname()[1]}").robots())
        latest = 0.0
        while not connecting.done():
            began = time.monotonic()
            await asyncio.sleep(0.005)
            latest = max(latest, time.monotonic() - began)
        assert_within(latest, 0.5, "the latest turn of a task while paho blocks")
    with pytest.raises(ServerUnavailable, match="did not answer"):
        await connecting
