"""Logins, certificates, secrets and access rules at a broker."""

from __future__ import annotations

import glob
import hashlib
import json
import os
from base64 import b64encode
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.fleet import topics
from tests.fleet.conftest import OPERATORS, OTHERS, ROBOTS
from tests.fleet.remote_client import RemoteClient
from tests.fleet.robot import Robot
from tests.support.bridge import Desk, desk
from tests.support.broker import Broker
from tests.support.certificates import authority, stranger
from tests.support.mqtt import Listener
from tests.support.surroundings import command_line, needs

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge

SECRET = "correct horse battery staple"
#: The exit code of a desk that can log in, but finds no robot.
LOGGED_IN = 3


def assert_refused(broker: Broker, code: int, expected: str, **login: Any) -> None:
    """Assert the exit code and the error message of a desk with this login."""
    with Desk(broker, **login) as operator:
        done = operator.run("--robot", "nobody", "status")
    assert (done.code, done.out, expected in done.err) == (code, "", True), done
    assert SECRET not in done.err


def assert_logged_in(broker: Broker, **login: Any) -> None:
    assert_refused(broker, LOGGED_IN, "no robot 'nobody'", **login)


def test_a_login_needs_the_right_password() -> None:
    hint = "set TALK_MQTT_USER and TALK_MQTT_PASSWORD_FILE for your login"
    with Broker(secure=True, users={"olga": SECRET}) as broker:
        assert_logged_in(broker, user="olga")
        assert_refused(broker, 10, "rejected the login of 'olga'", user="olga", password="wrong")
        assert_refused(broker, 10, hint, user="olga", password=False)
        assert_refused(broker, 10, "rejected the login of an anonymous user")


def test_a_broker_needs_a_valid_certificate_of_the_ca() -> None:
    untrusted = "the broker's certificate is not trusted"
    with Broker(secure=True) as broker:
        assert_logged_in(broker)
        for env in ({"TALK_MQTT_CA": stranger().file}, {"TALK_MQTT_CA": ""}):
            assert_refused(broker, 10, untrusted, env=env)
            assert_refused(broker, 10, "set TALK_MQTT_CA", env=env)
        # The certificate is only for localhost and 127.0.0.1.
        assert_refused(broker, 10, untrusted, env={"TALK_BROKER": f"mqtts://0.0.0.0:{broker.port}"})
    with Broker(expired=True) as broker:
        assert_refused(broker, 10, "expired")


def test_robots_and_desks_can_log_in_with_a_certificate(make_talk: MakeTalk, make_bridge: MakeBridge) -> None:
    rules = topics.access_rules(OPERATORS) + "\n\nuser watcher\ntopic read #\n"
    other, own = stranger().client("olga"), authority().client("olga")
    hint = "set TALK_MQTT_CERT and TALK_MQTT_KEY to a certificate that it accepts"
    with Broker(certificates=True, acl=rules) as broker:
        assert_refused(broker, 10, hint)
        assert_refused(broker, 10, hint, env={"TALK_MQTT_CERT": other.file, "TALK_MQTT_KEY": other.key})
        mixed = {"TALK_MQTT_CERT": own.file, "TALK_MQTT_KEY": other.key}
        assert_refused(broker, 2, "TALK_MQTT_CERT and TALK_MQTT_KEY", env=mixed)
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, broker, "anna", cert="anna", online=False)
        with Listener(broker, "talk/robot/anna/presence", cert="watcher") as listener:
            listener.await_message(lambda message: bool(message.payload and message.json["server"]), within=10)
        with Desk(broker, cert="olga", env={"TALK_MQTT_USER": "olga"}) as operator:
            done = operator.run("--robot", "anna", "say", "--wait", "--feedback", "hello")
            assert done.code == 0, done
        with Desk(broker, cert="otto", env={"TALK_MQTT_USER": "olga"}) as operator:  # otto claims to be olga
            done = operator.run("--robot", "anna", "say", "hello")
            assert done.code == 10, done
        assert talk.watcher.texts("ACTIVE") == ["hello"]
        assert bridge.terminate() == 0


def test_a_password_is_sent_without_tls_only_with_insecure() -> None:
    """0.0.0.0 is this machine, but isn't treated as local."""
    with Broker(users={"olga": SECRET}) as broker:
        elsewhere = {"TALK_BROKER": f"mqtt://0.0.0.0:{broker.port}"}
        assert_logged_in(broker, user="olga")  # no one can eavesdrop on 127.0.0.1
        before = broker.log.count("New connection")
        assert_refused(broker, 2, "in clear text", user="olga", env=elsewhere)
        assert broker.log.count("New connection") == before
        with Desk(broker, user="olga", env=elsewhere) as operator:
            assert operator.run("--robot", "nobody", "--insecure", "status").code == LOGGED_IN


def test_a_password_is_shown_nowhere(make_talk: MakeTalk, make_bridge: MakeBridge) -> None:
    with Broker(users={"anna": SECRET, "watcher": "other"}) as broker:
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, broker, "anna", user="anna", observer="watcher")
        with Listener(broker, "#", user="watcher", password="other") as listener:
            with Desk(broker, user="anna") as operator:
                done = operator.run("--robot", "anna", "--json", "say", "--wait", "hello")
                assert done.code == 0, done
            listener.await_message(lambda message: message.topic.endswith("/state") and b"SUCCEEDED" in message.payload)
            listener.await_message(lambda message: message.topic.endswith("/status"))
            published = b"".join(message.topic.encode() + message.payload for message in listener.messages)
        assert SECRET not in command_line(bridge.pid)
        with open(f"/proc/{bridge.pid}/environ", "rb") as environ:
            assert SECRET.encode() not in environ.read()
        assert bridge.terminate() == 0
        for shown in (done.out, done.err, bridge.log, talk.log, os.fsdecode(published)):
            assert SECRET not in shown


def test_the_password_file_is_read_again_and_the_last_password_is_kept(
    make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    """The login or the password file may be repaired later, and the bridge must not need a restart."""
    with Broker(users={"anna": SECRET, "watcher": "other"}) as broker:
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, broker, "anna", user="anna", password="wrong", observer="watcher", online=False)
        bridge.await_log("rejected the login of 'anna'")
        assert bridge.running
        file = broker.env("anna")["TALK_MQTT_PASSWORD_FILE"]  # the file has the right password now
        bridge.await_online(15)
        os.remove(file)
        broker.kill()
        bridge.await_log("TALK_MQTT_PASSWORD_FILE: ")
        broker.start()
        bridge.await_online(15)
        assert SECRET not in bridge.log


# The access rules. `tests/unit/test_fleet_topics.py` tests each rule.


def test_the_printed_access_rules_allow_only_what_a_login_needs(
    make_talk: MakeTalk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    robots = []
    for name in ROBOTS:
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, secure_broker, name, user=name, observer="olga", groups=["warehouse"])
        robots.append(Robot(talk, secure_broker, bridge))
    anna, bert = robots
    for arguments in (["say", "--wait", "--feedback", "hello"], ["status"], ["log"], ["cancel"]):
        assert desk(secure_broker, "anna", *arguments, user="olga").code == 0
    for user in (*OTHERS, "bert"):  # a login without rules, and another robot's
        done = desk(secure_broker, "anna", "say", "hello", user=user)
        assert (done.code, done.out) == (10, ""), done
        assert f"does not allow '{user}'" in done.err
        assert "access rules" in done.err
        assert "talk bridge --print-acl" in done.err
    with RemoteClient(secure_broker, "olga", login="olga") as olga:
        olga.send("plain", to="talk/robot/bert", kind="say", response=None)
        assert olga.ask("hello", to="talk/robot/bert")["ok"]
    bert.talk.watcher.wait_for(None, "SUCCEEDED")
    assert (anna.spoken, bert.spoken) == (["hello"], ["plain"])
    for robot in robots:
        assert "right" not in robot.bridge.log, robot.bridge.log


@pytest.mark.slow
def test_a_bridge_with_the_login_of_another_robot_reports_missing_rights(
    make_talk: MakeTalk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    """The bridge notices because the messages that it sends to itself don't return."""
    talk = make_talk(scripted=True)
    with Listener(secure_broker, "talk/robot/+/presence", user="olga") as olga:
        bridge = make_bridge(talk, secure_broker, "anna", user="bert", online=False)
        bridge.await_log("talk bridge --print-acl", within=30)
        assert bridge.running
        assert olga.messages == []


def test_a_robot_or_a_desk_that_may_not_read_its_topics_says_so_at_once(
    tmp_path: Path, make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    """mosquitto's plugin refuses subscriptions. With an `acl_file`, it accepts them, and then sends no messages."""
    plugin = next(iter(glob.glob("/usr/lib/*/mosquitto_dynamic_security.so")), None)
    if plugin is None:
        needs("mosquitto_dynamic_security.so")
    hashed = hashlib.pbkdf2_hmac("sha512", SECRET.encode(), b"twelve bytes", 1)
    password = {"password": b64encode(hashed).decode(), "salt": b64encode(b"twelve bytes").decode(), "iterations": 1}
    denied = ("talk/robot/anna/request/+", "talk/reply/#")
    rules = [{"acltype": "subscribePattern", "topic": topic, "allow": False} for topic in denied]
    rights = {
        "defaultACLAccess": dict.fromkeys(("publishClientSend", "publishClientReceive", "subscribe"), True),
        "roles": [{"rolename": "limited", "acls": rules}],
        "clients": [{"username": "anna", "roles": [{"rolename": "limited"}], **password}],
    }
    (tmp_path / "rights").write_text(json.dumps(rights), encoding="ascii")
    with Broker(settings=[f"plugin {plugin}", f"plugin_opt_config_file {tmp_path}/rights"]) as broker:
        bridge = make_bridge(make_talk(scripted=True), broker, "anna", online=False, user="anna", password=SECRET)
        bridge.await_log("does not allow this robot to read talk/robot/anna/request/+ (reason 0x87)")
        bridge.await_log("disconnected from the broker: the connection was closed")
        assert "online at" not in bridge.log
        with Desk(broker, user="anna", password=SECRET) as operator:
            done = operator.run("--robot", "bert", "status")
            assert (done.code, "to read talk/reply/anna/+/_;" in done.err) == (10, True), done
            done = operator.run("--robot", "anna", "doctor")
            assert "to read talk/robot/anna/request/+" in done.out, done
