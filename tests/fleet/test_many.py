"""Many robots at once: each speaks once, and its end is told once."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from tests.fleet.many import RealRobots, Roll, SimulatedRobots, alike, assert_told
from tests.fleet.remote_client import RemoteClient
from tests.support.bridge import Desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener, mosquitto
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator

FIVE = [f"robot-{number}" for number in range(1, 6)]
GROUP = "warehouse"
#: Seconds in which all robots are back after the broker, and after which an absent robot is LOST.
BACK, ABSENCE = 15.0, 30.0
#: Seconds of a cancel, and of a sentence of one second.
CANCEL, SENTENCE = 1.0, 3.0


@pytest.fixture(scope="module")
def broker() -> Iterator[Broker]:
    with Broker() as result:
        yield result


@pytest.fixture(scope="module")
def robots(broker: Broker) -> Iterator[RealRobots]:
    """Five robots that are online after each test. Each test has texts of its own."""
    with RealRobots(broker, FIVE, [GROUP]) as result:
        yield result


@pytest.fixture
def desk(broker: Broker) -> Iterator[Desk]:
    """A desk that asks all robots."""
    with Desk(broker, env={"TALK_ROBOT": "@all"}) as result:
        yield result


def await_active(robots: RealRobots, goal_id: str) -> None:
    robots.each(lambda each: each.talk.watcher.wait_for(goal_id, "ACTIVE"))


def counts(robots: RealRobots, text: str) -> Counter[str]:
    """Return how often each robot has spoken a text."""
    return Counter({name: texts.count(text) for name, texts in robots.spoken().items() if text in texts})


def test_what_comes_to_a_group_several_times_is_spoken_once_by_each(robots: RealRobots, broker: Broker) -> None:
    line = '{"seq": %d, "request": "say", "id": "once", "text": "once by each", "wait": true}'
    with RemoteClient(broker, "olga") as olga:
        response = ["-D", "publish", "response-topic", olga.response]
        for seq in (1, 2):
            words = ["-q", "1", "-t", f"talk/group/{GROUP}/request/olga", *response, "-m", line % seq]
            assert mosquitto(broker, "pub", *words).code == 0
        robots.each(lambda each: each.talk.watcher.wait_for_terminal("once"))

        def replies() -> Counter[tuple[int, bool]]:
            found = [each for each in olga.lines if "ok" in each]
            assert all(each["ok"] and each["goal"]["id"] == "once" for each in found), found
            return Counter((each["seq"], each.get("attached", False)) for each in found)

        olga.listener.find(lambda _: replies().total() == 2 * len(FIVE), 5)
        assert replies() == {(1, False): len(FIVE), (2, True): len(FIVE)}
    assert counts(robots, "once by each") == Counter(FIVE)


def test_robots_that_come_and_go_are_told_as_they_are(robots: RealRobots, desk: Desk, broker: Broker) -> None:
    gone, killed, *_ = FIVE
    text, there = "length=1 some come and go", [each for each in FIVE if each != gone]
    with Roll(broker) as roll:
        assert robots[gone].bridge.terminate() == 0
        roll.await_gone(gone)
        waiting = desk.start("say", "--wait", "--id", "come-and-go", "--", text)
        for each in there:
            robots[each].talk.watcher.wait_for("come-and-go", "ACTIVE")
        robots[killed].bridge.kill()
        roll.await_gone(killed)
        robots[killed].bridge.start()
        robots[gone].bridge.start()
        done = desk.finish(waiting, timeout=BACK + 10)
        wanted = alike(there, "come-and-go", "SUCCEEDED", 0) | {gone: ("-", "OFFLINE", 3)}
        assert_told(done, 3, wanted, "4 of 5 robots succeeded")
    with Roll(broker) as roll:
        roll.await_there(FIVE)
    assert counts(robots, text) == Counter(there)
    done = desk.run("say", "--wait", "--id", "all-again", "--", "all are here again")
    assert_told(done, 0, alike(FIVE, "all-again", "SUCCEEDED", 0), "5 of 5 robots succeeded")


@pytest.mark.slow
def test_a_robot_that_goes_in_mid_sentence_and_stays_away_is_lost(
    robots: RealRobots, desk: Desk, broker: Broker
) -> None:
    killed, *others = FIVE
    with Listener(broker, f"talk/reply/+/+/{killed}") as answers:
        waiting = desk.start("say", "--wait", "--id", "stays-away", "--", "length=1 one stays away")
        answers.await_message(lambda each: b'"ok": true' in each.payload)
    await_active(robots, "stays-away")
    robots[killed].bridge.kill()
    done = desk.finish(waiting, timeout=ABSENCE + 10)
    wanted = alike(others, "stays-away", "SUCCEEDED", 0) | {killed: ("stays-away", "LOST", 12)}
    assert_told(done, 12, wanted, "4 of 5 robots succeeded")
    robots[killed].bridge.start()
    with Roll(broker) as roll:
        roll.await_there(FIVE)


def test_a_hundred_simulated_robots_beside_three_real_ones() -> None:
    names = ["anna", "bert", "carl"]
    with Broker() as broker, SimulatedRobots(broker, 100) as simulated, RealRobots(broker, names) as real:
        simulated.await_there()
        everybody = [*names, *simulated.names]
        with Desk(broker, env={"TALK_ROBOT": "@all"}) as desk, limits():
            waiting = desk.start("say", "--wait", "--id", "long", "--", "length=60 long")
            await_active(real, "long")
            simulated.await_spoken("long")
            cancelled = desk.run("cancel")
            assert_told(cancelled, 0, alike(everybody, "long", "PREEMPTED", 0), "103 of 103 robots succeeded")
            assert_within(cancelled.seconds, CANCEL, "a cancel of 103 robots")
            assert_told(desk.finish(waiting), 7, alike(everybody, "long", "PREEMPTED", 7), "0 of 103 robots succeeded")
            said = desk.run("say", "--wait", "--id", "short", "--", "length=1 short")
            assert_told(said, 0, alike(everybody, "short", "SUCCEEDED", 0), "103 of 103 robots succeeded")
            assert_within(said.seconds, SENTENCE, "a sentence of a second by 103 robots")
            waiting = desk.start("say", "--wait", "--id", "meanwhile", "--", "length=2 meanwhile")
            await_active(real, "meanwhile")
            broker.kill()
            real.each(lambda each: each.bridge.await_log("can't connect to the broker"))  # it has tried to connect
            broker.start()
            up = time.monotonic()
            with Roll(broker) as roll:
                assert_within(roll.await_there(everybody) - up, BACK, "103 robots after the broker was back")
            done = desk.finish(waiting, timeout=BACK + 10)
            assert_told(done, 0, alike(everybody, "meanwhile", "SUCCEEDED", 0), "103 of 103 robots succeeded")
        for goal_id in ("long", "short", "meanwhile"):
            simulated.assert_spoken_once(goal_id)
        spoken = ["length=60 long", "length=1 short", "length=2 meanwhile"]
        assert real.spoken() == dict.fromkeys(names, spoken)
        simulated.stop()
