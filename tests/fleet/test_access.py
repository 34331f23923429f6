"""The access control list that talk prints, at a real broker; `tests/unit/test_fleet_topics.py` has its rules."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.fleet.asker import Asker
from tests.fleet.conftest import OTHERS, ROBOTS
from tests.fleet.robot import Robot
from tests.support.bridge import desk
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge
    from tests.support.broker import Broker


def test_a_fleet_works_by_the_rules_and_a_login_without_rights_is_told_what_is_missing(
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
    for user in (*OTHERS, "bert"):  # a login without rules, and another robot's
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
    for each in robots:
        assert "right" not in each.bridge.log, each.bridge.log


@pytest.mark.slow
def test_a_bridge_that_logs_in_as_another_robot_says_that_it_has_no_rights(
    make_talk: MakeTalk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    """The bridge notices because nothing that it sends to itself comes back."""
    talk = make_talk(scripted=True)
    with Listener(secure_broker, "talk/robot/+/presence", user="olga") as olga:
        bridge = make_bridge(talk, secure_broker, "anna", user="bert", online=False)
        bridge.await_log("talk bridge --print-acl", within=30)
        assert bridge.running
        assert olga.messages == []
