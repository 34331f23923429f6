"""A robot as a device of Home Assistant, with a real robot and broker (see `tests.fleet.homeassistant`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.fleet import topics
from tests.fleet.homeassistant import BIRTH, HomeAssistant
from tests.fleet.robot import LONG, Robot
from tests.support.broker import Broker
from tests.support.mqtt import NO_SUBSCRIBERS

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge, MakeRobot

ANNA = "homeassistant/device/talk/anna/config"
#: The topic for the name r2.d2. A dot is not allowed in such a topic.
DOTTED = "homeassistant/device/talk-dots/r2_dd2/config"


@pytest.fixture
def announced(make_robot: MakeRobot) -> Robot:
    return make_robot("anna", "--homeassistant")


def test_a_message_is_spoken_and_the_entities_show_its_state(announced: Robot) -> None:
    with HomeAssistant(announced.broker) as home:
        device = home.device()
        home.await_states(device, state="idle")
        home.command(device, "say", LONG)
        home.await_states(device, state="speaking", speaking="ON")
        home.command(device, "cancel")
        home.await_states(device, state="idle", last="PREEMPTED", speaking="OFF")
        home.command(device, "say", '{"request": "cancel"}')
        home.await_states(device, last="SUCCEEDED")
    assert announced.spoken == [LONG, '{"request": "cancel"}']


def test_an_interrupted_sentence_that_continues_counts_as_speaking(announced: Robot) -> None:
    with HomeAssistant(announced.broker) as home:
        device = home.device()
        home.command(device, "say", "never-ends words=1")
        home.await_states(device, state="speaking", speaking="ON", pending="0")
        announced.talk.run("say", "--wait", "--interject", "length=0")
        home.await_states(device, state="speaking", speaking="ON", pending="0", last="SUCCEEDED")
        home.command(device, "cancel")
        home.await_states(device, state="idle", last="PREEMPTED", speaking="OFF")


def test_a_flood_of_announcements_reports_each_lost_one(announced: Robot) -> None:
    with HomeAssistant(announced.broker) as home:
        device = home.device()
        home.command(device, "paused", payload="payload_on")
        home.await_states(device, paused="ON")
        for number in range(18):
            home.command(device, "say", f"number {number}")
        home.await_states(device, pending="15", last="REJECTED")
        home.command(device, "cancel")
        home.await_message(lambda _: len(home.end_events(device)) == 18)
        ended = {event["text"]: (event["event_type"], event["reason"]) for event in home.end_events(device)}
        home.command(device, "paused", payload="payload_off")
        home.await_states(device, paused="OFF")
    assert ended == {
        f"number {number}": ("RECALLED", "canceled") if number < 15 else ("REJECTED", "queue_full")
        for number in range(18)
    }
    announced.bridge.await_log("rejected a goal of homeassistant: 15 goals of remote clients are already waiting")


def test_the_announcement_is_repeated_when_home_assistant_starts(announced: Robot) -> None:
    with HomeAssistant(announced.broker) as home:
        kept = home.await_message(lambda message: message.topic == ANNA)
        home.publish(*BIRTH)
        home.await_message(lambda message: message is not kept)
        messages = home.messages
    assert [(message.payload, message.retain, message.qos, message.expiry) for message in messages] == [
        (kept.payload, True, 1, None)
    ] * 2


@pytest.mark.slow
def test_many_starts_within_seconds_cause_few_announcements(announced: Robot) -> None:
    with HomeAssistant(announced.broker) as home:
        home.await_message(lambda message: message.topic == ANNA)
        for _ in range(30):
            home.publish(*BIRTH)
        assert not home.find(lambda _: len(home.messages) > 10, within=3)
        before = home.messages
        home.publish(*BIRTH)
        home.await_message(lambda message: message not in before)


def test_a_device_is_announced_again_to_a_broker_that_has_forgotten_it(announced: Robot) -> None:
    announced.broker.kill()
    announced.broker.start()
    with HomeAssistant(announced.broker) as home:
        home.await_states(home.device(), state="idle")


def test_a_device_is_unavailable_without_its_server_or_its_robot(make_robot: MakeRobot) -> None:
    robot = make_robot("anna", "--homeassistant", "--allow", "say,status")
    with HomeAssistant(robot.broker) as home:
        device = home.device()
        assert device["components"]["cancel"] == {"platform": "button"}
        home.await_states(device, state="idle")
        robot.talk.kill()
        home.await_states(device, state="unavailable")
        home.command(device, "say", "hello")
        robot.bridge.await_log("refused a request of homeassistant: ")
        robot.talk.start_server()
        home.await_states(device, state="idle")
        robot.bridge.kill()
        home.await_states(device, state="unavailable")
        robot.bridge.start()
        home.await_states(device, state="idle")
        assert robot.bridge.terminate() == 0
    with HomeAssistant(robot.broker) as later:
        later.await_states(later.device(), state="unavailable")


def test_a_robot_without_the_option_is_not_announced(robot: Robot) -> None:
    assert robot.desk("say", "--wait", "hello").code == 0
    assert "homeassistant" not in robot.broker.log  # the bridge neither published nor subscribed
    with HomeAssistant(robot.broker) as home:
        assert home.publish(*BIRTH) == NO_SUBSCRIBERS


def test_the_printed_access_rules_suffice_for_home_assistant(make_talk: MakeTalk, make_bridge: MakeBridge) -> None:
    users = {user: f"password of {user}" for user in ("anna", "r2.d2", "homeassistant", "olga")}
    rules = topics.access_rules(("olga",), homeassistant=True, name="r2.d2")
    with Broker(users=users, acl=f"{rules}\n") as broker:
        for name in ("anna", "r2.d2"):
            make_bridge(make_talk(scripted=True), broker, name, "--homeassistant", user=name, observer="olga")
        with HomeAssistant(broker, user="homeassistant") as home:
            announced = home.await_message(lambda message: message.topic == DOTTED)
            home.await_message(lambda message: message.topic == ANNA)
            home.publish(*BIRTH)
            device = home.device()
            home.command(device, "say", "hello")
            home.await_states(device, last="SUCCEEDED")
            home.await_message(lambda _: bool(home.end_events(device)))
            home.await_message(lambda message: message.topic == DOTTED and message is not announced)


def test_a_bridge_that_may_not_announce_its_robot_logs_the_next_step(
    make_talk: MakeTalk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    bridge = make_bridge(talk, secure_broker, "anna", "--homeassistant", user="anna", observer="olga")
    bridge.await_log("'talk bridge --print-acl' (with the same options)")
