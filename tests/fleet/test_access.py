"""Who may do what at a broker with the rules that talk prints: each robot is heard as itself, each operator, too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.fleet import topics
from tests.fleet.asker import Asker
from tests.fleet.conftest import OPERATORS, OTHERS, ROBOTS
from tests.fleet.robot import Robot
from tests.support.bridge import desk
from tests.support.broker import Broker
from tests.support.mqtt import NO_SUBSCRIBERS, NOT_AUTHORIZED, SUCCESS, Listener
from tests.support.processes import run_talk
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge

#: A login that may do everything, by which is seen what the others may.
WITNESS = "witness"
LOGINS = (*ROBOTS, *OPERATORS, *OTHERS)
#: What there is to write and to read: whose it is, is below.
_LEVELS = (
    *(f"robot/{robot}/{kind}/{user}" for robot in ROBOTS for kind in ("request", "say", "cancel") for user in LOGINS),
    *(f"robot/{robot}/{kind}" for robot in ROBOTS for kind in ("presence", "status", "event/state", "echo")),
    *(f"group/{group}/request/{user}" for group in ("all", "warehouse") for user in LOGINS),
    *(f"reply/{user}/session/{robot}" for user in LOGINS for robot in (*ROBOTS, "_")),
)
TOPICS = (*(f"talk/{each}" for each in _LEVELS), "talk", "talk/robot/anna", "elsewhere")


def may_write(login: str, topic: str) -> bool:
    """Whether this is a login's to write, as the table of topics says it."""
    levels = topic.split("/")
    if login in ROBOTS:
        own = [f"talk/robot/{login}/{each}" for each in ("presence", "status", "event/state", "echo")]
        return topic in own or (levels[:2] == ["talk", "reply"] and levels[-1] == login)
    if login in OPERATORS:
        asks = levels[1:2] in (["robot"], ["group"]) and levels[-2:-1] != ["event"] and levels[-1] == login
        return asks or topic.startswith(f"talk/reply/{login}/")
    return False


def may_read(login: str, topic: str) -> bool:
    """Whether this is a login's to read; by the patterns each hears what groups are asked, as a robot does."""
    levels = topic.split("/")
    if levels[1:2] == ["group"]:
        return True
    if login in ROBOTS:
        asked = [f"talk/robot/{login}/{each}" for each in ("request", "say", "cancel", "presence", "echo")]
        return any(topic.startswith(each) for each in asked)
    if login in OPERATORS:
        told = levels[1:2] == ["robot"] and "/".join(levels[3:]) in ("presence", "status", "event/state")
        return told or topic.startswith(f"talk/reply/{login}/")
    return False


@pytest.fixture
def guarded() -> Iterator[Broker]:
    """A broker with the rules, and with a witness."""
    users = {each: f"password of {each}" for each in (*LOGINS, WITNESS)}
    # In the order of mosquitto's file what is for all comes first, behind the first user it is that user's.
    rules = f"{topics.access(OPERATORS)}\n\nuser {WITNESS}\ntopic readwrite #\n"
    with Broker(users=users, acl=rules) as broker:
        yield broker


def test_the_rules_are_those_that_the_command_prints() -> None:
    with short_directory() as home:
        code, out, err = run_talk(["bridge", "--print-acl"], clean_environment(home), 20)
    assert (code, err) == (0, "")
    assert out.replace("OPERATOR", *OPERATORS) == topics.access(OPERATORS) + "\n"


@pytest.mark.parametrize("login", LOGINS)
def test_everybody_writes_what_is_theirs_and_nothing_else(guarded: Broker, login: str) -> None:
    with Listener(guarded, user=login) as somebody:
        answers = {each: somebody.publish(each, "x") for each in TOPICS}
    assert set(answers.values()) <= {SUCCESS, NO_SUBSCRIBERS, NOT_AUTHORIZED}
    taken = [each for each, answer in answers.items() if answer != NOT_AUTHORIZED]
    assert taken == [each for each in TOPICS if may_write(login, each)]
    assert bool(taken) == (login not in OTHERS)


@pytest.mark.parametrize("login", LOGINS)
def test_everybody_reads_what_is_theirs_and_nothing_else(guarded: Broker, login: str) -> None:
    own = f"talk/robot/{login}/request/{WITNESS}"
    with Listener(guarded, "#", user=login) as somebody, Listener(guarded, user=WITNESS) as witness:
        for each in TOPICS:
            witness.publish(each, "x")
        witness.publish(own, "the last")
        somebody.await_message(lambda each: each.text == "the last")
        heard = [each.topic for each in somebody.messages[:-1]]
    assert heard == [each for each in TOPICS if may_read(login, each)]


def test_a_fleet_works_by_these_rules_and_who_has_none_is_told_which_he_lacks(
    make_talk: MakeTalk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    robots = []
    for name in ROBOTS:
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, secure_broker, name, user=name, observer="olga", groups=["warehouse"])
        robots.append(Robot(talk, secure_broker, bridge))
    anna, bert = robots
    for words in (["say", "--wait", "--feedback", "hello"], ["status"], ["log"], ["cancel"]):
        assert desk(secure_broker, "anna", *words, user="olga").code == 0
    for user in (*OTHERS, "bert"):  # one who has no rules, and one who has a robot's
        done = desk(secure_broker, "anna", "say", "hello", user=user)
        assert (done.code, done.out) == (10, ""), done
        assert f"does not let '{user}'" in done.err
        assert "ACL" in done.err
        assert "talk bridge --print-acl" in done.err
    with Asker(secure_broker, "olga", login="olga") as olga:
        olga.send("plain", to="talk/robot/bert", kind="say", response=None)
        assert olga.ask("hello", to="talk/robot/bert")["ok"]
    bert.talk.watcher.wait_for(None, "SUCCEEDED")
    assert (anna.spoken, bert.spoken) == (["hello"], ["plain"])
    assert [each.talk.request("log", count=5)["ok"] for each in robots] == [True, True]
    for each in robots:
        assert "NOT" not in each.bridge.log
        assert "right" not in each.bridge.log, each.bridge.log


@pytest.mark.slow
def test_a_bridge_that_logs_in_as_another_robot_says_what_it_may_not(
    make_talk: MakeTalk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    """It is found out where nothing comes back of what it sends itself."""
    talk = make_talk(scripted=True)
    with Listener(secure_broker, "talk/robot/+/presence", user="olga") as olga:
        bridge = make_bridge(talk, secure_broker, "anna", user="bert", online=False)
        bridge.await_log("talk bridge --print-acl", within=30)
        assert bridge.running
        assert olga.messages == []
