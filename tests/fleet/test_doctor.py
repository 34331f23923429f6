"""`talk --robot anna doctor` names the obstacles between a desk, a broker and a robot, and the next step."""

from __future__ import annotations

import json
import socket
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import __version__
from talkcli.cli.ask import _create_examination
from talkcli.cli.show import CommonOptions
from talkcli.doctor import broker as judging
from talkcli.errors import UsageError
from talkcli.fleet import topics
from talkcli.fleet.broker import Broker as Named
from tests.fleet.conftest import OPERATORS, ROBOTS
from tests.support.bridge import Desk
from tests.support.broker import Broker
from tests.support.certificates import stranger
from tests.support.mqtt import Listener
from tests.support.ports import HOST, Port
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tests.fleet.conftest import MakeBridge
    from tests.fleet.robot import Robot
    from tests.support.processes import Finished, Talk

#: Seconds in which the doctor ends, whatever it finds: each of its steps has ten.
LIMIT = 60.0
#: The checks if all is well.
WELL = ["broker", "login", "anonymous", "name", "rights", "bridge"]
PRESENCE: dict[str, Any] = {
    "talk": 1, "version": __version__, "online": True, "session": "5e55", "since": 1000.0, "groups": ["warehouse"],
    "allow": ["status"], "server": {"boot": "4k7f", "pid": 4711, "version": __version__},
}  # fmt: skip
TLS = Named("broker.example", 8883, tls=True)
SERVER: dict[str, object] = {"version": __version__, "engine": "ready", "pending": 0}


@pytest.fixture(autouse=True)
def with_paho() -> None:
    needs_packages("paho")


def findings(done: Finished, code: int) -> dict[str, dict[str, str]]:
    """Return the findings by their checks, in their order, and assert the exit code."""
    assert (done.code, done.err) == (code, ""), done
    found = [json.loads(line) for line in done.out.splitlines()]
    for each in found:
        assert list(each) == ["check", "state", "message", "next"]
    return {each["check"]: each for each in found}


def doctor(
    at: Broker, name: str = "anna", *, code: int = 4, user: str | None = None, password: str | bool = True,
    cert: str | None = None, env: Mapping[str, str] | None = None,
) -> dict[str, dict[str, str]]:  # fmt: skip
    """Run the doctor at a desk, and return its findings."""
    with Desk(at, user=user, password=password, cert=cert, env=env) as desk:
        return findings(desk.run("--json", "--robot", name, "doctor", timeout=LIMIT), code)


def is_there(at: Broker, name: str, user: str | None = None, cert: str | None = None, **changed: object) -> None:
    """Have the broker keep the presence of a robot."""
    with Listener(at, user=user, cert=cert) as listener:
        listener.publish(topics.robot(name, topics.PRESENCE), PRESENCE | changed, retain=True)


# With a robot


def test_a_robot_that_answers_is_asked_and_nothing_is_left_behind(robot: Robot) -> None:
    with Listener(robot.broker, "talk/#") as listener:
        found = findings(robot.desk("--json", "doctor", timeout=LIMIT), 0)
        assert list(found) == WELL
        assert {each["check"] for each in found.values() if each["state"] != "ok"} == {"anonymous"}
        assert "allow_anonymous false" in found["anonymous"]["next"]
        assert found["name"]["message"].startswith("anna is online for ")
        assert f"its server is talk {__version__}, process {robot.talk.pid}" in found["name"]["message"]
        assert "player none; 0 waiting" in found["bridge"]["message"]
        assert {each.topic for each in listener.messages if each.retain} <= {
            topics.robot("anna", each) for each in (topics.PRESENCE, topics.STATUS)
        }
    assert robot.bridge.running
    assert robot.desk("doctor").err == "talk: the robot answers; 1 warning\n"
    assert not robot.talk.run("log").out


def test_a_bridge_is_not_disturbed_if_its_own_user_runs_the_doctor(robot: Robot) -> None:
    with Desk(robot.broker, env={"TALK_MQTT_USER": "anna"}) as desk:
        found = findings(desk.run("--json", "--robot", "anna", "doctor"), 0)
    assert list(found) == WELL[:-1]
    assert found["rights"]["state"] == "ok"
    assert robot.desk("status").code == 0
    assert "doctor" not in robot.bridge.log


def test_a_variable_names_the_robot_as_the_option_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TALK_ROBOT", "anna")
    options = CommonOptions()
    assert isinstance(_create_examination(options, {}, silent=False), judging.BrokerExamination)
    options.socket = "/nowhere"
    assert not isinstance(_create_examination(options, {}, silent=False), judging.BrokerExamination)


@pytest.mark.slow
def test_a_silent_bridge_is_told_from_an_online_robot(broker: Broker) -> None:
    is_there(broker, "anna")
    began = time.monotonic()
    found = doctor(broker)
    assert time.monotonic() - began < 20
    assert list(found) == WELL
    assert (found["name"]["state"], found["bridge"]["state"]) == ("ok", "failed")
    assert found["bridge"]["next"] == "read the bridge's log on anna: journalctl -u talk-bridge"


def test_a_robot_that_is_offline_or_has_no_server_is_not_asked(broker: Broker) -> None:
    is_there(broker, "anna", online=False)
    is_there(broker, "bert", server=None)
    for name, words in (("anna", "anna is offline"), ("bert", "it has no talk server")):
        found = doctor(broker, name)
        assert list(found) == WELL[:-1]
        assert found["name"]["state"] == "failed"
        assert found["name"]["message"].endswith(words)


def test_an_unknown_name_is_told_with_those_that_come_near() -> None:
    """Both doctors run at once, as each waits a second for the broker's retained messages."""
    with Broker(users={"olga": "o"}, anonymous=True) as broker, Desk(broker, user="olga") as desk:
        is_there(broker, "anna")
        clients = [desk.start("--json", "--robot", name, "doctor") for name in ("Ana", "zebra")]
        near, far = (findings(desk.finish(each), 4) for each in clients)
    assert near["name"]["message"] == "the broker knows no robot named 'Ana'; known robots: anna"
    assert near["name"]["next"] == "talk --robot anna doctor"
    assert far["name"]["next"] == "on the robot, run: talk bridge --name zebra"
    assert near["anonymous"]["state"] == "warning"  # it lets its users in, and anybody else


# Rights


def test_a_login_is_told_its_missing_rights(scripted: Talk, secure_broker: Broker, make_bridge: MakeBridge) -> None:
    make_bridge(scripted, secure_broker, "anna", user="anna", observer=OPERATORS[0])
    found = doctor(secure_broker, user=OPERATORS[0], code=0)
    assert [each["state"] for each in found.values()] == ["ok", "warning", *["ok"] * 5]
    assert found["login"]["message"] == "as 'olga', with a password"
    assert "renew the certificate of localhost" in found["certificate"]["next"], "it is good for two days"
    found = doctor(secure_broker, user=ROBOTS[1])
    assert "write to talk/reply/bert/" in found["rights"]["message"]
    assert "talk/robot/anna/request/bert" in found["rights"]["message"]
    assert (found["name"]["state"], found["rights"]["state"]) == ("warning", "failed")
    assert list(found) == ["broker", "certificate", *WELL[1:-1]]


def test_a_robot_itself_learns_whether_its_bridge_may_speak(secure_broker: Broker) -> None:
    with Listener(secure_broker, "talk/#", user="olga") as listener:
        with Desk(secure_broker, user="anna") as desk:
            done = desk.run("--robot", "anna", "doctor")
        assert (done.code, done.err) == (0, "talk: the broker accepts this robot's messages; 1 warning\n")
        assert "'anna' is free" in done.out
        is_there(secure_broker, "anna", user="anna")
        found = doctor(secure_broker, user="anna", code=0)
        assert found["name"]["message"].startswith("anna is online")
        assert not [each for each in listener.messages if each.retain and not each.topic.endswith("/presence")]


def test_topics_that_a_robot_may_not_write_or_read_are_named() -> None:
    acl = "pattern read talk/robot/%u/presence\npattern write talk/robot/%u/echo\npattern write talk/reply/+/+/%u\n"
    with Broker(users={"anna": "a"}, acl=acl) as broker:
        found = doctor(broker, user="anna")
    words = "write to talk/robot/anna/status and talk/robot/anna/event/doctor, or to read talk/robot/anna/echo"
    assert found["rights"]["message"] == f"the broker does not allow 'anna' to {words}"
    assert found["rights"]["next"].endswith("talk bridge --print-acl")


# The way to the broker, and the login


@pytest.mark.parametrize(
    ("changed", "words", "step"),
    [
        ({"TALK_BROKER": ""}, "TALK_BROKER is not set", "export TALK_BROKER=mqtts://broker.example"),
        ({"TALK_BROKER": "http://x"}, "TALK_BROKER is not the URL of a broker", "correct it in the shell's start file"),
        ({"TALK_BROKER": "mqtts://x", "TALK_MQTT_CA": "/no/ca"}, "TALK_MQTT_CA: /no/ca: No such file", "correct it"),
        ({"TALK_MQTT_USER": "a/b"}, "invalid user name 'a/b'", "correct it in the shell's start file"),
        ({"TALK_BROKER": "mqtt://no-such.invalid"}, ":1883: no such host", "correct the host in TALK_BROKER"),
        ({"TALK_BROKER": "mqtt://no..such"}, ":1883: no such host", "correct the host in TALK_BROKER"),
    ],
)
def test_variables_that_name_no_broker_are_told(changed: dict[str, str], words: str, step: str) -> None:
    (found,) = judging.BrokerExamination("anna", {"TALK_BROKER": f"mqtt://{HOST}", **changed}).findings()
    assert (found.check, found.state) == ("broker", "failed")
    assert words in found.message
    assert str(found.next).startswith(step)


def test_a_refused_connection_is_named() -> None:
    with Port() as port:
        (found,) = judging.BrokerExamination("anna", {"TALK_BROKER": f"mqtt://{HOST}:{port.number}"}).findings()
    assert (found.check, found.message) == ("broker", f"mqtt://{HOST}:{port.number}: connection refused")
    assert f"'listener {port.number}'" in str(found.next)


@pytest.mark.slow
def test_a_silent_port_is_no_broker() -> None:
    with socket.create_server((HOST, 0)) as mute:
        found = list(
            judging.BrokerExamination("anna", {"TALK_BROKER": f"mqtt://{HOST}:{mute.getsockname()[1]}"}).findings()
        )
    assert [each.check for each in found] == ["broker", "login"]
    assert found[-1].message.endswith("did not answer within 5 s")


def test_an_untrusted_certificate_ends_the_examination(secure_broker: Broker, broker: Broker) -> None:
    found = doctor(secure_broker, user="olga", env={"TALK_MQTT_CA": stranger().file})
    assert list(found) == ["broker", "certificate"]
    assert "unable to get local issuer certificate" in found["certificate"]["message"]
    assert "another file, of the CA" in found["certificate"]["next"]
    with Broker(expired=True) as expired:
        found = doctor(expired)
    assert "certificate has expired" in found["certificate"]["message"]
    assert "set this machine's clock" in found["certificate"]["next"]
    url = broker.url.replace("mqtt:", "mqtts:")
    found = doctor(secure_broker, user="olga", env={"TALK_BROKER": url})
    assert "use its TLS port" in found["certificate"]["next"]


def test_a_refused_login_is_told_with_the_variables_to_set(secure_broker: Broker) -> None:
    found = doctor(secure_broker, user="olga", password="wrong")
    assert [*found][-1] == "login"
    assert "rejected the login of 'olga'" in found["login"]["message"]
    assert found["login"]["next"].startswith("set TALK_MQTT_USER")
    url = secure_broker.url.replace("mqtts:", "mqtt:")
    found = doctor(secure_broker, env={"TALK_BROKER": url, "TALK_MQTT_CA": ""})
    assert [*found][-1] == "login"
    where = f"if port {secure_broker.port} is for TLS, set TALK_BROKER={secure_broker.url}"
    assert found["login"]["next"].endswith(where)


def test_a_certificate_is_a_login_and_a_client_without_one_is_not_let_in() -> None:
    with Broker(certificates=True) as broker:
        is_there(broker, "anna", cert="anna", online=False)
        found = doctor(broker, cert="olga", env={"TALK_MQTT_USER": "olga"})
        assert found["login"]["message"] == "as 'olga', with a certificate"
        assert found["anonymous"]["state"] == "ok"
        found = doctor(broker)
        assert [*found][-1] == "login"
        assert "TALK_MQTT_CERT and TALK_MQTT_KEY " in found["login"]["next"]


def test_an_interrupt_ends_it_while_it_waits() -> None:
    with socket.create_server((HOST, 0)) as mute, Broker() as broker:
        mute.settimeout(LIMIT)
        with Desk(broker, env={"TALK_BROKER": f"mqtt://{HOST}:{mute.getsockname()[1]}"}) as desk:
            client = desk.start("--robot", "anna", "doctor")
            mute.accept()[0].close()
            with mute.accept()[0]:  # it waits for the answer to its login
                client.terminate()
                done = desk.finish(client, 3)
    assert done.code == 143


# Judgements


def test_a_name_that_no_robot_can_have_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="invalid robot name 'a/b'"):
        judging.BrokerExamination("a/b", {})


PLAIN = Named("broker.example", 1883, tls=False)


@pytest.mark.parametrize(
    ("broker", "expires_at", "state", "words", "step"),
    [
        (TLS, 1e9 + 13 * 86400, "warning", "the system's CAs", "renew the certificate"),
        (TLS, 1e9 + 15 * 86400, "ok", "the system's CAs", "None"),
        (PLAIN, None, "warning", "no TLS: ", "give the broker a certificate"),
    ],
)
def test_a_certificate_is_judged_by_its_end(
    broker: Named, expires_at: float | None, state: str, words: str, step: str
) -> None:
    found = judging.judge_certificate(broker, expires_at, 1e9)
    assert found.state == state
    assert words in found.message
    assert str(found.next).startswith(step)


def test_a_certificate_of_another_host_is_told_with_the_host_s_name() -> None:
    found = judging.judge_tls_error(TLS, "Hostname mismatch", 62, 1e9)
    assert (found.state, found.message) == ("failed", "Hostname mismatch (checked against the system's CAs)")
    assert str(found.next).startswith("use the host name of its certificate in TALK_BROKER")


def test_a_broker_that_hangs_up_on_a_forbidden_topic_is_told_from_one_that_refuses_it() -> None:
    found = judging.judge_rights("olga", (), ("talk/reply/olga/1/_",), "the connection was lost")
    assert (found.state, found.message) == (
        "failed",
        "the rights of 'olga' could not be tested: the connection was lost",
    )


@pytest.mark.parametrize(
    ("change", "state", "step"),
    [
        ({}, "ok", None),
        ({"engine": "failed"}, "warning", "on anna, run: talk doctor"),
        ({"paused": True}, "warning", "talk --robot anna resume"),
    ],
)
def test_the_server_s_own_words_are_judged(change: dict[str, object], state: str, step: str | None) -> None:
    found = judging.judge_server_status("anna", SERVER | change, 0.001)
    assert (found.state, found.next) == (state, step)
