"""Two bridges of one name: the older stays online, the younger ends with 11."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.fleet.robot import Robot
from tests.support.proxy import Proxy

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge
    from tests.support.bridge import Bridge
    from tests.support.broker import Broker

#: Seconds in which both bridges are back, and the younger has ended.
SETTLED = 15.0


def assert_ends(younger: Bridge) -> None:
    assert younger.wait(SETTLED) == 11, younger.log
    assert f"another bridge is '{younger.name}' already" in younger.log
    assert "Traceback" not in younger.log


def assert_answers(robot: Robot) -> None:
    """Assert that the robot's first bridge answers."""
    assert robot.bridge.running, robot.bridge.log
    assert robot.desk("say", "--wait", "still here").code == 0
    assert robot.spoken == ["still here"]


def test_the_younger_of_two_bridges_ends_and_the_older_goes_on(
    robot: Robot, make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    another = make_talk(scripted=True)
    with robot.listen() as listener:
        assert_ends(make_bridge(another, robot.broker, "anna", online=False))
        assert_answers(robot)
        told = [each.json for each in listener.messages]
    assert {(each["online"], each["server"]["pid"]) for each in told} == {(True, robot.talk.pid)}
    assert another.watcher.goals() == []


def test_of_two_bridges_that_find_the_broker_together_the_younger_ends(
    robot: Robot, make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    another = make_talk(scripted=True)
    robot.broker.kill()
    younger = make_bridge(another, robot.broker, "anna", online=False)
    younger.await_log("no broker")  # so it has begun
    robot.broker.start()
    assert_ends(younger)
    robot.bridge.await_online(SETTLED)
    assert_answers(robot)
    assert another.watcher.goals() == []


def test_a_bridge_that_began_while_the_older_had_no_network_ends_when_that_is_back(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    with Proxy(broker.port) as proxy:
        talk, another = make_talk(scripted=True), make_talk(scripted=True)
        older = make_bridge(talk, broker, "anna", port=proxy.port)
        robot = Robot(talk, broker, older)
        with robot.listen() as listener:
            proxy.refuse()
            proxy.cut()
            listener.await_message(robot.is_offline)
            younger = make_bridge(another, broker, "anna")
            proxy.accept()
            assert_ends(younger)
            first = listener.messages[0]
            listener.await_message(
                lambda each: robot.is_online(each) and each is not first and each.json["server"]["pid"] == talk.pid
            )
        assert_answers(robot)
        assert another.watcher.goals() == []


def test_what_a_bridge_has_left_behind_without_a_word_keeps_no_other_from_its_name(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    with Proxy(broker.port) as proxy:
        lost = make_bridge(make_talk(scripted=True), broker, "anna", port=proxy.port)
        proxy.hold()  # so that the broker doesn't hear of its end
        lost.kill()
        robot = Robot(talk, broker, make_bridge(talk, broker, "anna"))
        assert_answers(robot)
        with robot.listen() as listener:
            proxy.cut()  # now it does, and publishes the will of the one that is gone
            will = listener.await_message(robot.is_offline)
            listener.await_message(lambda each: robot.is_online(each) and each.arrived > will.arrived)
        assert robot.desk("status").code == 0
