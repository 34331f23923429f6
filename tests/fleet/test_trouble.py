"""A desk whose broker takes less than it should, or loses an answer."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, State
from talkcli.errors import Lost
from talkcli.fleet.broker import from_environment
from talkcli.fleet.robot import reach
from tests.support.bridge import Bridge, Desk, desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener
from tests.support.proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.fleet.robot import Robot

#: Longer than the broker takes, shorter than a robot takes.
TOO_LONG = "word " * 1_200


@pytest.fixture
def client(lasting_robot: Robot) -> Iterator[Client]:
    """A client of the robot in this process."""
    broker = from_environment(lasting_robot.broker.env())
    with Client.over(reach("anna", broker)) as client:
        yield client


def test_a_sentence_that_the_broker_does_not_take_is_refused_before_it_is_sent(make_talk: MakeTalk) -> None:
    with Broker(max_packet=4096) as broker, Bridge(make_talk(scripted=True), broker, "anna") as bridge:
        bridge.await_online()
        done = desk(broker, "anna", "say", "--wait", "--", TOO_LONG)
        assert (done.code, done.out) == (1, "")
        assert "the broker takes 3,072: nothing was sent" in done.err
        with Desk(broker, env={"TALK_MQTT_USER": "o" * 59}) as somebody:  # a name as long as may be
            assert somebody.run("--robot", "anna", "say", "--wait", "--rate", "450", "--", "short").code == 0


def test_a_cancel_whose_answer_is_lost_ends_nothing_that_came_later(robot: Robot) -> None:
    robot.talk.request("pause")
    robot.talk.run("say", "--id", "old", "old")
    with Proxy(robot.broker.port) as proxy, Desk(robot.broker, port=proxy.port) as somebody:
        broker = from_environment(somebody.env)
        with Client.over(reach("anna", broker)) as client, ThreadPoolExecutor(1) as thread:
            with Listener(robot.broker, "talk/reply/+/+/anna") as listener:
                proxy.hold("to_client")
                asked = thread.submit(client.cancel)
                listener.await_message(lambda each: b'"count": 1' in each.payload)
            robot.talk.run("say", "--id", "new", "new")
            proxy.cut()
            proxy.release()
            with pytest.raises(Lost, match="it may have been carried out"):
                asked.result(30)
            assert client.goal("old").state is State.RECALLED
            assert client.goal("new").state is State.PENDING


def test_goals_with_a_time_to_live_and_data_go_out_from_any_thread(client: Client) -> None:
    with ThreadPoolExecutor(4) as threads:
        said = [
            threads.submit(client.say, "a", ttl=60, data={"number": [1]}, id="the-same", follow=False)
            for _ in range(20)
        ]
    handles = [each.result() for each in said]
    assert {each.id for each in handles} == {"the-same"}
    assert sum(not each.attached for each in handles) == 1


@pytest.mark.slow  # a broker doesn't tell that it keeps something back, so the whole patience of 5 s is waited for
def test_who_may_not_read_the_answers_is_told_before_anything_is_sent(make_talk: MakeTalk) -> None:
    rules = "user anna\ntopic readwrite #\n\nuser olga\ntopic write talk/#\ntopic read talk/robot/+/presence\n"
    with (
        Broker(users={"anna": "a", "olga": "b"}, acl=rules) as broker,
        Bridge(make_talk("--player", "null"), broker, "anna", user="anna", observer="anna") as bridge,
    ):
        bridge.await_online()
        done = desk(broker, "anna", "say", "--", "hello", user="olga")
        assert (done.code, "does not let 'olga' read talk/reply/olga" in done.err) == (10, True), done
        log = desk(broker, "anna", "--json", "log", user="anna")
        assert (log.code, log.out) == (0, "")


def test_a_child_that_closes_its_copy_leaves_the_connection_to_its_parent(client: Client) -> None:
    child = os.fork()
    if child == 0:
        client.close()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert client.status().server["pid"]
