"""Who is let in at a broker, and whom a robot and a desk trust there; that a password is given to nobody else."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from talkcli.fleet import topics
from tests.fleet.conftest import OPERATORS
from tests.support.bridge import Desk
from tests.support.broker import Broker
from tests.support.certificates import authority, stranger
from tests.support.mqtt import Listener
from tests.support.ports import HOST, Port
from tests.support.surroundings import command_line

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge

SECRET = "correct horse battery staple"
#: What a desk says that was let in, and finds no robot there.
LET_IN = 3


def status(broker: Broker, **who: object) -> tuple[int, str]:
    """Ask for the status of a robot that there is not; return the exit code and what was told."""
    with Desk(broker, **who) as somebody:  # type: ignore[arg-type]
        done = somebody.run("--robot", "nobody", "status")
    assert done.out == ""
    return done.code, done.err


def test_only_the_right_password_lets_in() -> None:
    with Broker(secure=True, users={"olga": SECRET}) as broker:
        assert status(broker, user="olga")[0] == LET_IN
        for who, whom in (
            ({"user": "olga", "password": "wrong"}, "'olga'"),
            ({"user": "olga", "password": False}, "'olga'"),
            ({"user": "otto", "password": "wrong"}, "'otto'"),
            ({}, "a client without a user"),
        ):
            code, told = status(broker, **who)
            assert code == 10, told
            assert f"does not let {whom} in" in told
            assert "TALK_MQTT_USER and TALK_MQTT_PASSWORD_FILE say who you are" in told
            assert SECRET not in told


def test_only_a_broker_is_trusted_whose_certificate_is_of_the_ca_and_of_today() -> None:
    untrusted = "the broker's certificate is not to be trusted"
    with Broker(secure=True) as broker:
        assert status(broker)[0] == LET_IN
        for env in ({"TALK_MQTT_CA": stranger().file}, {"TALK_MQTT_CA": ""}):
            code, told = status(broker, env=env)
            assert (code, untrusted in told, "TALK_MQTT_CA names" in told) == (10, True, True), told
        # The certificate is of localhost and 127.0.0.1, and this is the same machine by another name.
        code, told = status(broker, env={"TALK_BROKER": f"mqtts://127.0.0.2:{broker.port}"})
        assert (code, untrusted in told or "no broker" in told) in ((10, True), (3, True)), told
    with Broker(expired=True) as broker:
        code, told = status(broker)
        assert (code, untrusted in told, "expired" in told) == (10, True, True), told


def test_only_a_client_is_let_in_whose_certificate_is_of_the_brokers_ca() -> None:
    other = stranger().client("olga")
    with Broker(certificates=True) as broker:
        assert status(broker, cert="olga")[0] == LET_IN
        for env in ({}, {"TALK_MQTT_CERT": other.file, "TALK_MQTT_KEY": other.key}):
            code, told = status(broker, env=env)
            assert (code, "TALK_MQTT_CERT and TALK_MQTT_KEY name one that it takes" in told) == (10, True), told
        own = authority().client("olga")
        code, told = status(broker, env={"TALK_MQTT_CERT": own.file, "TALK_MQTT_KEY": other.key})
        assert (code, "TALK_MQTT_CERT and TALK_MQTT_KEY" in told) == (2, True), told


def test_from_a_certificate_at_the_desk_to_one_at_the_robot(make_talk: MakeTalk, make_bridge: MakeBridge) -> None:
    rules = topics.access(OPERATORS) + "\n\nuser watcher\ntopic read #\n"
    with Broker(certificates=True, acl=rules) as broker:
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, broker, "anna", cert="anna", online=False)
        with Listener(broker, "talk/robot/anna/presence", cert="watcher") as listener:
            listener.await_message(lambda each: bool(each.payload and each.json["server"]), within=10)
        with Desk(broker, cert="olga", env={"TALK_MQTT_USER": "olga"}) as somebody:
            done = somebody.run("--robot", "anna", "say", "--wait", "--feedback", "hello")
            assert done.code == 0, done
        with Desk(broker, cert="otto", env={"TALK_MQTT_USER": "olga"}) as somebody:  # who only says to be olga
            done = somebody.run("--robot", "anna", "say", "hello")
            assert done.code == 10, done
        assert talk.watcher.texts("ACTIVE") == ["hello"]
        assert talk.request("log", count=5)["ok"]
        assert bridge.terminate() == 0


def test_a_password_goes_in_clear_text_to_another_machine_only_where_that_is_said() -> None:
    """0.0.0.0 is this machine, which no rule says: it may be any."""
    with Broker(users={"olga": SECRET}) as broker:
        elsewhere = {"TALK_BROKER": f"mqtt://0.0.0.0:{broker.port}"}
        assert status(broker, user="olga")[0] == LET_IN  # at 127.0.0.1 nobody listens in between
        assert "olga" in broker.log
        before = broker.log.count("New connection")
        code, told = status(broker, user="olga", env=elsewhere)
        assert (code, "in clear text" in told, "--insecure" in told) == (2, True, True), told
        assert broker.log.count("New connection") == before
        with Desk(broker, user="olga", env=elsewhere) as somebody:
            assert somebody.run("--robot", "nobody", "--insecure", "status").code == LET_IN


@pytest.mark.parametrize("command", [["--robot", "anna", "status"], ["bridge", "--name", "anna"]])
def test_a_url_with_a_password_is_refused_and_not_repeated(command: list[str]) -> None:
    with Port() as port, Broker() as broker:
        url = f"mqtts://olga:hunter2@{HOST}:{port.number}"
        with Desk(broker, env={"TALK_BROKER": url}) as somebody:
            done = somebody.run(*command)
    assert (done.code, done.out) == (2, ""), done
    assert "holds a user or a password" in done.err
    assert "hunter2" not in done.err


def test_a_password_is_shown_nowhere(make_talk: MakeTalk, make_bridge: MakeBridge) -> None:
    with Broker(users={"anna": SECRET, "watcher": "other"}) as broker:
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, broker, "anna", user="anna", observer="watcher")
        with Listener(broker, "#", user="watcher", password="other") as listener:
            with Desk(broker, user="anna") as somebody:
                done = somebody.run("--robot", "anna", "--json", "say", "--wait", "hello")
                assert done.code == 0, done
            listener.await_message(lambda each: each.topic.endswith("/state") and b"SUCCEEDED" in each.payload)
            listener.await_message(lambda each: each.topic.endswith("/status"))
            published = b"".join(each.topic.encode() + each.payload for each in listener.messages)
        assert SECRET not in command_line(bridge.pid)
        with open(f"/proc/{bridge.pid}/environ", "rb") as environ:
            assert SECRET.encode() not in environ.read()
        assert bridge.terminate() == 0
        for shown in (done.out, done.err, bridge.log, talk.log, os.fsdecode(published)):
            assert SECRET not in shown


def test_a_robot_with_a_wrong_password_says_why_and_is_online_once_it_has_the_right_one(
    make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    """The broker may be mended, or the password, and nobody may be there to start the bridge again."""
    with Broker(users={"anna": SECRET, "watcher": "other"}) as broker:
        talk = make_talk(scripted=True)
        bridge = make_bridge(talk, broker, "anna", user="anna", password="wrong", observer="watcher", online=False)
        bridge.await_log("does not let 'anna' in")
        assert bridge.running
        broker.env("anna")  # writes the right one into the file
        bridge.await_online(15)


def test_a_robot_that_finds_no_password_any_more_goes_on_with_the_one_that_it_had(
    make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    with Broker(users={"anna": SECRET, "watcher": "other"}) as broker:
        bridge = make_bridge(make_talk(scripted=True), broker, "anna", user="anna", observer="watcher")
        os.remove(broker.env("anna")["TALK_MQTT_PASSWORD_FILE"])
        broker.kill()
        bridge.await_log("TALK_MQTT_PASSWORD_FILE: ")
        broker.start()
        bridge.await_online(15)
        assert SECRET not in bridge.log
