"""Many robots at the same time. Each speaks a goal once, and each result is reported once."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from tests.fleet.many import PresenceListener, RealRobots, SimulatedRobots, alike, assert_outcomes
from tests.fleet.remote_client import RemoteClient
from tests.support.bridge import Desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener, mosquitto
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator

FIVE = [f"robot-{number}" for number in range(1, 6)]
GROUP = "warehouse"
#: Seconds until all robots have reconnected, and until the goal of an absent robot is LOST.
BACK, ABSENCE = 15.0, 30.0
#: Time limits in seconds for a cancel, and for a goal of one second.
CANCEL, SENTENCE = 1.0, 3.0


@pytest.fixture(scope="module")
def broker() -> Iterator[Broker]:
    with Broker() as result:
        yield result


@pytest.fixture(scope="module")
def robots(broker: Broker) -> Iterator[RealRobots]:
    """Five robots that are online after each test. Each test uses different texts."""
    with RealRobots(broker, FIVE, [GROUP]) as result:
        yield result


@pytest.fixture
def desk(broker: Broker) -> Iterator[Desk]:
    """A desk that selects all robots."""
    with Desk(broker, env={"TALK_ROBOT": "@all"}) as result:
        yield result


def await_active(robots: RealRobots, goal_id: str) -> None:
    robots.each(lambda robot: robot.talk.watcher.wait_for(goal_id, "ACTIVE"))


def counts(robots: RealRobots, text: str) -> Counter[str]:
    """Return how often each robot has spoken a text."""
    return Counter({name: texts.count(text) for name, texts in robots.spoken().items() if text in texts})


def test_each_robot_speaks_a_repeated_group_goal_once(robots: RealRobots, broker: Broker) -> None:
    line = '{"seq": %d, "request": "say", "id": "once", "text": "spoken once", "wait": true}'
    with RemoteClient(broker, "olga") as olga:
        response = ["-D", "publish", "response-topic", olga.response]
        for seq in (1, 2):
            arguments = ["-q", "1", "-t", f"talk/group/{GROUP}/request/olga", *response, "-m", line % seq]
            assert mosquitto(broker, "pub", *arguments).code == 0
        robots.each(lambda robot: robot.talk.watcher.wait_for_terminal("once"))

        def replies() -> Counter[tuple[int, bool]]:
            lines = [line for line in olga.lines if "ok" in line]
            assert all(line["ok"] and line["goal"]["id"] == "once" for line in lines), lines
            return Counter((line["seq"], line.get("attached", False)) for line in lines)

        olga.listener.find(lambda _: replies().total() == 2 * len(FIVE), 5)
        assert replies() == {(1, False): len(FIVE), (2, True): len(FIVE)}
    assert counts(robots, "spoken once") == Counter(FIVE)


def test_robots_that_come_and_go_have_the_right_results(robots: RealRobots, desk: Desk, broker: Broker) -> None:
    gone, killed, *_ = FIVE
    text, present = "length=1 some come and go", [name for name in FIVE if name != gone]
    with PresenceListener(broker) as presences:
        assert robots[gone].bridge.terminate() == 0
        presences.await_offline(gone)
        waiting = desk.start("say", "--wait", "--id", "come-and-go", "--", text)
        for name in present:
            robots[name].talk.watcher.wait_for("come-and-go", "ACTIVE")
        robots[killed].bridge.kill()
        presences.await_offline(killed)
        robots[killed].bridge.start()
        robots[gone].bridge.start()
        done = desk.finish(waiting, timeout=BACK + 10)
        expected = alike(present, "come-and-go", "SUCCEEDED", 0) | {gone: ("-", "OFFLINE", 3)}
        assert_outcomes(done, 3, expected, "4 of 5 robots succeeded")
    with PresenceListener(broker) as presences:
        presences.await_online(FIVE)
    assert counts(robots, text) == Counter(present)
    done = desk.run("say", "--wait", "--id", "all-again", "--", "all are here again")
    assert_outcomes(done, 0, alike(FIVE, "all-again", "SUCCEEDED", 0), "5 of 5 robots succeeded")


@pytest.mark.slow
def test_a_robot_that_disconnects_in_mid_sentence_and_stays_away_is_lost(
    robots: RealRobots, desk: Desk, broker: Broker
) -> None:
    killed, *others = FIVE
    with Listener(broker, f"talk/reply/+/+/{killed}") as answers:
        waiting = desk.start("say", "--wait", "--id", "stays-away", "--", "length=1 one stays away")
        answers.await_message(lambda message: b'"ok": true' in message.payload)
    await_active(robots, "stays-away")
    robots[killed].bridge.kill()
    done = desk.finish(waiting, timeout=ABSENCE + 10)
    expected = alike(others, "stays-away", "SUCCEEDED", 0) | {killed: ("stays-away", "LOST", 12)}
    assert_outcomes(done, 12, expected, "4 of 5 robots succeeded")
    robots[killed].bridge.start()
    with PresenceListener(broker) as presences:
        presences.await_online(FIVE)


def test_a_desk_can_command_103_robots() -> None:
    names = ["anna", "bert", "carl"]
    with Broker() as broker, SimulatedRobots(broker, 100) as simulated, RealRobots(broker, names) as real:
        simulated.await_online()
        fleet = [*names, *simulated.names]
        with Desk(broker, env={"TALK_ROBOT": "@all"}) as desk, limits():
            waiting = desk.start("say", "--wait", "--id", "long", "--", "length=60 long")
            await_active(real, "long")
            simulated.await_spoken("long")
            cancelled = desk.run("cancel")
            assert_outcomes(cancelled, 0, alike(fleet, "long", "PREEMPTED", 0), "103 of 103 robots succeeded")
            assert_within(cancelled.seconds, CANCEL, "a cancel of 103 robots")
            assert_outcomes(desk.finish(waiting), 7, alike(fleet, "long", "PREEMPTED", 7), "0 of 103 robots succeeded")
            done = desk.run("say", "--wait", "--id", "short", "--", "length=1 short")
            assert_outcomes(done, 0, alike(fleet, "short", "SUCCEEDED", 0), "103 of 103 robots succeeded")
            assert_within(done.seconds, SENTENCE, "a goal of a second on 103 robots")
            waiting = desk.start("say", "--wait", "--id", "meanwhile", "--", "length=2 meanwhile")
            await_active(real, "meanwhile")
            broker.kill()
            real.each(lambda robot: robot.bridge.await_log("can't connect to the broker"))
            broker.start()
            up = time.monotonic()
            with PresenceListener(broker) as presences:
                assert_within(presences.await_online(fleet) - up, BACK, "the reconnection of 103 robots")
            done = desk.finish(waiting, timeout=BACK + 10)
            assert_outcomes(done, 0, alike(fleet, "meanwhile", "SUCCEEDED", 0), "103 of 103 robots succeeded")
        for goal_id in ("long", "short", "meanwhile"):
            simulated.assert_spoken_once(goal_id)
        spoken = ["length=60 long", "length=1 short", "length=2 meanwhile"]
        assert real.spoken() == dict.fromkeys(names, spoken)
        simulated.stop()
