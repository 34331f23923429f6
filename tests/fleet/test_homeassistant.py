"""A robot as a device of Home Assistant's: what that is told, and what it then does, with a real robot and broker.

No Home Assistant is here: what it would make of what it is told is in `tests.fleet.homeassistant`, as it documents it.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest

from talkcli.fleet import topics
from tests.fleet.homeassistant import BIRTH, UNAVAILABLE, HomeAssistant
from tests.fleet.robot import Robot
from tests.support.bridge import Bridge
from tests.support.broker import Broker
from tests.support.mqtt import NO_SUBSCRIBERS, NOT_AUTHORIZED, SUCCESS, Listener, mosquitto
from tests.support.processes import Talk, run_talk
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge

ANNA = "homeassistant/device/talk/anna/config"
#: Long enough that a status says that it is spoken: there is at most one a second.
SENTENCE = "please keep clear of the lift, it comes down now, and it will be on its way up again in a moment"


@pytest.fixture(scope="module")
def told_of() -> Iterator[Robot]:
    """A robot that Home Assistant is told of, and that speaks with the real engine, without sound."""
    with Broker() as broker, contextlib.closing(Talk(["--player", "null", "--rate", "300"])) as talk:
        with Bridge(talk, broker, "anna", "--homeassistant") as bridge:
            bridge.await_online()
            yield Robot(talk, broker, bridge)
            assert bridge.terminate() == 0, bridge.log
        talk.stop()


def test_what_it_sends_is_spoken_and_it_sees_how_that_ends(told_of: Robot) -> None:
    with HomeAssistant(told_of.broker) as home:
        device = home.device()
        assert device.config["device"]["name"] == "anna"
        home.await_state(device, lambda state: state("state") == "idle")
        home.send_message(device, SENTENCE)
        home.await_state(device, lambda state: (state("state"), state("speaking")) == ("speaking", "ON"))
        home.press(device, "cancel")
        home.await_state(device, lambda state: (state("state"), state("last")) == ("idle", "PREEMPTED"))
        assert device.state("speaking", home.told()) == "OFF"
        home.send_message(device, '{"request": "cancel"}')
        home.await_state(device, lambda state: state("last") == "SUCCEEDED")
        last = device.attributes("last", home.told())
    assert told_of.spoken[-2:] == [SENTENCE, '{"request": "cancel"}']
    goal = told_of.talk.goal(last["id"])
    assert (goal["client"]["name"], goal["text"]) == ("mqtt:homeassistant", '{"request": "cancel"}')
    assert last == {"id": goal["id"], "reason": None, "text": goal["text"], "at": goal["ended_at"]}


@pytest.mark.slow
def test_it_sees_that_speech_is_held_and_how_many_wait(told_of: Robot) -> None:
    with HomeAssistant(told_of.broker) as home:
        device = home.device()
        told_of.talk.request("pause")
        try:
            for each in ("one", "two"):
                home.send_message(device, each)
            home.await_state(device, lambda state: (state("state"), state("pending")) == ("paused", "2"))
            home.press(device, "cancel")
            home.await_state(device, lambda state: (state("pending"), state("last")) == ("0", "RECALLED"))
        finally:
            told_of.talk.request("resume")
        home.await_state(device, lambda state: state("state") == "idle")


def test_it_is_told_by_what_the_broker_has_kept_and_anew_once_it_has_begun(told_of: Robot) -> None:
    with HomeAssistant(told_of.broker) as home:
        kept = home.await_message(lambda each: each.topic == ANNA)
        home.publish(*BIRTH)
        home.await_message(lambda each: each.topic == ANNA and each is not kept)
        told = home.announcements()
    assert [(each.payload, each.retain, each.qos, each.expiry) for each in told] == [(kept.payload, True, 1, None)] * 2


@pytest.mark.slow
def test_it_is_told_once_however_often_it_begins_meanwhile(told_of: Robot) -> None:
    with HomeAssistant(told_of.broker) as home:
        seen = [home.await_message(lambda each: each.topic == ANNA)]
        home.publish(BIRTH[0], "offline")
        for births in (5, 1):
            for _ in range(births):
                home.publish(*BIRTH)
            seen.append(home.await_message(lambda each: each.topic == ANNA and each not in seen))
        assert home.announcements() == seen


def test_a_broker_that_has_forgotten_it_is_told_again(told_of: Robot) -> None:
    told_of.broker.kill()
    told_of.broker.start()
    with HomeAssistant(told_of.broker) as home:
        device = home.device()
        home.await_state(device, lambda state: state("state") == "idle")


def test_a_device_is_unavailable_without_its_server_or_its_robot_and_stays_until_it_is_cleared(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    bridge = make_bridge(talk, broker, "anna", "--homeassistant")
    with HomeAssistant(broker) as home:
        device = home.device()
        home.await_state(device, lambda state: state("state") == "idle")
        talk.kill()
        home.await_state(device, lambda state: state("state") == UNAVAILABLE)
        talk.start_server()
        home.await_state(device, lambda state: state("state") == "idle")
        bridge.kill()
        home.await_state(device, lambda state: state("state") == UNAVAILABLE)
        bridge.start()
        home.await_state(device, lambda state: state("state") == "idle")
        assert bridge.terminate() == 0
        home.await_state(device, lambda state: state("state") == UNAVAILABLE)
    with HomeAssistant(broker) as later:
        device = later.device()
        later.await_state(device, lambda state: state("state") == UNAVAILABLE)
    assert mosquitto(broker, "pub", "-r", "-n", "-t", ANNA).code == 0
    with HomeAssistant(broker) as home:
        assert home.subscribe(BIRTH[0]) <= 1
        home.publish(BIRTH[0], "the last")
        home.await_message(lambda each: each.text == "the last")
        assert home.announcements() == []


def test_it_is_told_of_no_robot_that_is_not_to_be_a_device(robot: Robot) -> None:
    assert robot.desk("say", "--wait", "hello").code == 0
    assert "homeassistant" not in robot.broker.log  # neither published nor subscribed to
    with HomeAssistant(robot.broker) as home:
        assert home.publish(*BIRTH) == NO_SUBSCRIBERS
        assert home.announcements() == []


def test_with_no_text_it_hears_no_word(make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge) -> None:
    make_bridge(make_talk(scripted=True), broker, "anna", "--no-text", "--homeassistant")
    with HomeAssistant(broker) as home:
        device = home.device()
        home.send_message(device, "the secret word")
        home.await_state(device, lambda state: state("last") == "SUCCEEDED")
        assert device.attributes("last", home.told()).keys() == {"id", "reason", "at"}
        assert not [each for each in home.messages if "secret" in each.text]


def test_it_is_given_no_button_that_the_robot_would_not_obey(
    make_talk: MakeTalk, broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    make_bridge(talk, broker, "anna", "--homeassistant", "--allow", "say,status")
    with HomeAssistant(broker) as home:
        device = home.device()
        assert device.components["cancel"] == {"platform": "button"}
        home.send_message(device, "hello")
        talk.watcher.wait_for(None, "SUCCEEDED")


# What the broker has to let them do

#: Who logs in at the broker with the rules: two robots, and somebody else.
ROBOTS, OTHERS = ("anna", "r2.d2"), ("olga", "homeassistant")
DOTTED = "homeassistant/device/talk-dots/r2_dd2/config"
TOPICS = (
    *(f"talk/robot/{robot}/{kind}/homeassistant" for robot in ROBOTS for kind in ("say", "cancel", "request")),
    *(f"talk/robot/{robot}/{kind}" for robot in ROBOTS for kind in ("presence", "status", "event/state", "echo")),
    *("talk/group/all/request/homeassistant", "talk/reply/homeassistant/one/anna", "talk/robot/anna/say/olga"),
    *(ANNA, DOTTED, "homeassistant/device/talk/r2.d2/config", "homeassistant/device/anna/config", BIRTH[0]),
)
#: What of these each may write besides what a robot of its name says of itself.
MAY_WRITE = {
    "anna": {ANNA},
    "r2.d2": {DOTTED, "homeassistant/device/talk/r2.d2/config"},
    "olga": {"talk/robot/anna/say/olga"},
    "homeassistant": {
        *(f"talk/robot/{robot}/{kind}/homeassistant" for robot in ROBOTS for kind in ("say", "cancel")),
        *(each for each in TOPICS if each.startswith("homeassistant/")),
    },
}


@pytest.fixture
def guarded() -> Iterator[Broker]:
    """A broker with the rules that talk prints for Home Assistant."""
    users = {each: f"password of {each}" for each in (*ROBOTS, *OTHERS, "witness")}
    rules = topics.access(("olga",), homeassistant=True, name="r2.d2")
    with Broker(users=users, acl=f"{rules}\n\nuser witness\ntopic readwrite #\n") as broker:
        yield broker


def test_the_rules_are_those_that_the_command_prints() -> None:
    with short_directory() as home:
        env = clean_environment(home)
        code, out, err = run_talk(["bridge", "--name", "r2.d2", "--homeassistant", "--print-acl"], env, 20)
    assert (code, err) == (0, "")
    assert out == topics.access(homeassistant=True, name="r2.d2") + "\n"


@pytest.mark.parametrize("login", MAY_WRITE)
def test_each_does_there_what_is_its_own_and_nothing_else(guarded: Broker, login: str) -> None:
    with Listener(guarded, "homeassistant/#", user=login) as somebody, Listener(guarded, user="witness") as witness:
        answers = {each: somebody.publish(each, "x") for each in TOPICS}
        for each in TOPICS:
            witness.publish(each, "y")
        witness.publish(BIRTH[0], "the last")
        somebody.await_message(lambda each: each.text == "the last")
        heard = {each.topic for each in somebody.messages}
    assert set(answers.values()) <= {SUCCESS, NO_SUBSCRIBERS, NOT_AUTHORIZED}
    taken = {each for each, answer in answers.items() if answer != NOT_AUTHORIZED}
    own = {f"talk/robot/{login}/{each}" for each in ("presence", "status", "event/state", "echo")}
    replies = {each for each in TOPICS if each.startswith("talk/reply/") and each.endswith(f"/{login}")}
    assert taken == MAY_WRITE[login] | {each for each in TOPICS if each in own | replies}
    every = {each for each in TOPICS if each.startswith("homeassistant/")}
    assert heard == (every if login == "homeassistant" else {BIRTH[0]})


def test_robots_and_home_assistant_work_by_these_rules(
    make_talk: MakeTalk, guarded: Broker, make_bridge: MakeBridge
) -> None:
    for name in ROBOTS:
        make_bridge(make_talk(scripted=True), guarded, name, "--homeassistant", user=name, observer="olga")
    with HomeAssistant(guarded, user="homeassistant") as home:
        home.await_message(lambda each: each.topic == DOTTED)
        told = {each.topic: each for each in home.announcements()}
        assert told.keys() == {ANNA, DOTTED}
        device = home.device()
        home.send_message(device, "hello")
        home.await_state(device, lambda state: state("last") == "SUCCEEDED")


def test_a_robot_that_may_not_tell_of_itself_says_so(
    make_talk: MakeTalk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    talk = make_talk(scripted=True)
    bridge = make_bridge(talk, secure_broker, "anna", "--homeassistant", user="anna", observer="olga")
    bridge.await_log("'talk bridge --print-acl' has for these options")
