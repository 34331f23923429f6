"""`talk --robot anna doctor` checks the broker, the login and the robot, and names the next step."""

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
from talkcli.fleet.broker import Broker as BrokerAddress
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

#: Time for the doctor to end. Each of its steps takes at most 10 s.
LIMIT = 60.0
#: The checks if none fails.
WELL = ["broker", "login", "anonymous", "name", "rights", "bridge"]
PRESENCE: dict[str, Any] = {
    "talk": 1, "version": __version__, "online": True, "session": "5e55", "since": 1000.0, "groups": ["warehouse"],
    "allow": ["status"], "server": {"boot": "4k7f", "pid": 4711, "version": __version__},
}  # fmt: skip
TLS = BrokerAddress("broker.example", 8883, tls=True)
SERVER: dict[str, object] = {"version": __version__, "engine": "ready", "pending": 0}


@pytest.fixture(autouse=True)
def with_paho() -> None:
    needs_packages("paho")


def findings(done: Finished, code: int) -> dict[str, dict[str, str]]:
    """Assert the exit code, and return the findings by the name of their check."""
    assert (done.code, done.err) == (code, ""), done
    results = [json.loads(line) for line in done.out.splitlines()]
    for finding in results:
        assert list(finding) == ["check", "state", "message", "next", "measured"]
    return {finding["check"]: finding for finding in results}


def doctor(
    at: Broker, name: str = "anna", *, code: int = 4, user: str | None = None, password: str | bool = True,
    cert: str | None = None, env: Mapping[str, str] | None = None,
) -> dict[str, dict[str, str]]:  # fmt: skip
    """Run the doctor at a desk, and return its findings by the name of their check."""
    with Desk(at, user=user, password=password, cert=cert, env=env) as desk:
        return findings(desk.run("--json", "--robot", name, "doctor", timeout=LIMIT), code)


def publish_robot(at: Broker, name: str, user: str | None = None, cert: str | None = None, **changed: object) -> None:
    """Publish the presence of a robot."""
    with Listener(at, user=user, cert=cert) as listener:
        listener.publish(topics.robot(name, topics.PRESENCE), PRESENCE | changed, retain=True)


# With a robot


def test_an_online_robot_passes_and_nothing_is_left_behind(robot: Robot) -> None:
    with Listener(robot.broker, "talk/#") as listener:
        results = findings(robot.desk("--json", "doctor", timeout=LIMIT), 0)
        assert list(results) == WELL
        assert {finding["check"] for finding in results.values() if finding["state"] != "ok"} == {"anonymous"}
        assert "allow_anonymous false" in results["anonymous"]["next"]
        assert results["name"]["message"].startswith("anna is online for ")
        assert f"its server is talk {__version__}, process {robot.talk.pid}" in results["name"]["message"]
        assert "player none; 0 waiting" in results["bridge"]["message"]
        assert {message.topic for message in listener.messages if message.retain} <= {
            topics.robot("anna", kind) for kind in (topics.PRESENCE, topics.STATUS)
        }
    assert robot.bridge.running
    assert robot.desk("doctor").err == "talk: the robot answers; 1 warning\n"
    assert not robot.talk.run("log").out


def test_a_doctor_with_the_bridges_own_login_does_not_disturb_it(robot: Robot) -> None:
    with Desk(robot.broker, env={"TALK_MQTT_USER": "anna"}) as desk:
        results = findings(desk.run("--json", "--robot", "anna", "doctor"), 0)
    assert list(results) == WELL[:-1]
    assert results["rights"]["state"] == "ok"
    assert robot.desk("status").code == 0
    assert "doctor" not in robot.bridge.log


def test_the_robot_may_be_named_by_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TALK_ROBOT", "anna")
    options = CommonOptions()
    assert isinstance(_create_examination(options, {}, silent=False), judging.BrokerExamination)
    options.socket = "/nowhere"
    assert not isinstance(_create_examination(options, {}, silent=False), judging.BrokerExamination)


@pytest.mark.slow
def test_a_silent_bridge_fails_although_its_robot_seems_online(broker: Broker) -> None:
    publish_robot(broker, "anna")
    started_at = time.monotonic()
    results = doctor(broker)
    assert time.monotonic() - started_at < 20
    assert list(results) == WELL
    assert (results["name"]["state"], results["bridge"]["state"]) == ("ok", "failed")
    assert results["bridge"]["next"].startswith("on anna, read the bridge's log: journalctl -u talk-bridge; ")


def test_a_robot_that_is_offline_or_has_no_server_gets_no_request(broker: Broker) -> None:
    publish_robot(broker, "anna", online=False)
    publish_robot(broker, "bert", server=None)
    for name, expected in (("anna", "anna is offline"), ("bert", "it has no talk server")):
        results = doctor(broker, name)
        assert list(results) == WELL[:-1]
        assert results["name"]["state"] == "failed"
        assert results["name"]["message"].endswith(expected)


def test_similar_names_are_suggested_for_an_unknown_robot() -> None:
    """Both doctors run at once because each waits a second for retained messages."""
    with Broker(users={"olga": "o"}, anonymous=True) as broker, Desk(broker, user="olga") as desk:
        publish_robot(broker, "anna")
        clients = [desk.start("--json", "--robot", name, "doctor") for name in ("Ana", "zebra")]
        near, far = (findings(desk.finish(client), 4) for client in clients)
    assert near["name"]["message"] == "the broker knows no robot named 'Ana'; known robots: anna"
    assert near["name"]["next"] == "talk --robot anna doctor"
    assert far["name"]["next"] == "on the robot, run: talk bridge --name zebra"
    assert near["anonymous"]["state"] == "warning"  # the broker also accepts clients without a login


# Rights


def test_missing_rights_of_a_login_are_listed(scripted: Talk, secure_broker: Broker, make_bridge: MakeBridge) -> None:
    make_bridge(scripted, secure_broker, "anna", user="anna", observer=OPERATORS[0])
    results = doctor(secure_broker, user=OPERATORS[0], code=0)
    assert [finding["state"] for finding in results.values()] == ["ok", "warning", *["ok"] * 5]
    assert results["login"]["message"] == "as 'olga', with a password"
    assert "renew the certificate of localhost" in results["certificate"]["next"], "it is good for two days"
    results = doctor(secure_broker, user=ROBOTS[1])
    assert "write to talk/reply/bert/" in results["rights"]["message"]
    assert "talk/robot/anna/request/bert" in results["rights"]["message"]
    assert (results["name"]["state"], results["rights"]["state"]) == ("warning", "failed")
    assert list(results) == ["broker", "certificate", *WELL[1:-1]]


def test_a_robot_can_check_the_rights_of_its_own_login(secure_broker: Broker) -> None:
    with Listener(secure_broker, "talk/#", user="olga") as listener:
        with Desk(secure_broker, user="anna") as desk:
            done = desk.run("--robot", "anna", "doctor")
        assert (done.code, done.err) == (0, "talk: the broker accepts this robot's messages; 1 warning\n")
        assert "'anna' is free" in done.out
        publish_robot(secure_broker, "anna", user="anna")
        results = doctor(secure_broker, user="anna", code=0)
        assert results["name"]["message"].startswith("anna is online")
        assert not [item for item in listener.messages if item.retain and not item.topic.endswith("/presence")]


def test_topics_that_a_robot_may_not_write_or_read_are_listed() -> None:
    acl = "pattern read talk/robot/%u/presence\npattern write talk/robot/%u/echo\npattern write talk/reply/+/+/%u\n"
    with Broker(users={"anna": "a"}, acl=acl) as broker:
        results = doctor(broker, user="anna")
    expected = "write to talk/robot/anna/status and talk/robot/anna/event/doctor, or to read talk/robot/anna/echo"
    assert results["rights"]["message"] == f"the broker does not allow 'anna' to {expected}"
    assert results["rights"]["next"].endswith("talk bridge --print-acl")


# The connection to the broker, and the login


@pytest.mark.parametrize(
    ("changed", "expected", "step"),
    [
        ({"TALK_BROKER": ""}, "TALK_BROKER is not set", "export TALK_BROKER=mqtts://broker.example"),
        ({"TALK_BROKER": "http://x"}, "TALK_BROKER is not the URL of a broker", "correct it in the shell's startup"),
        ({"TALK_BROKER": "mqtts://x", "TALK_MQTT_CA": "/no/ca"}, "TALK_MQTT_CA: /no/ca: No such file", "correct it"),
        ({"TALK_MQTT_USER": "a/b"}, "invalid user name 'a/b'", "correct it in the shell's startup"),
        ({"TALK_BROKER": "mqtt://no-such.invalid"}, ":1883: no such host", "correct the host in TALK_BROKER"),
        ({"TALK_BROKER": "mqtt://no..such"}, ":1883: no such host", "correct the host in TALK_BROKER"),
    ],
)
def test_wrong_variables_are_reported_with_the_next_step(changed: dict[str, str], expected: str, step: str) -> None:
    (finding,) = judging.BrokerExamination("anna", {"TALK_BROKER": f"mqtt://{HOST}", **changed}).findings()
    assert (finding.check, finding.state) == ("broker", "failed")
    assert expected in finding.message
    assert str(finding.next).startswith(step)


def test_a_refused_connection_is_reported() -> None:
    with Port() as port:
        (finding,) = judging.BrokerExamination("anna", {"TALK_BROKER": f"mqtt://{HOST}:{port.number}"}).findings()
    assert (finding.check, finding.message) == ("broker", f"mqtt://{HOST}:{port.number}: connection refused")
    assert f"'listener {port.number}'" in str(finding.next)


@pytest.mark.slow
def test_a_silent_port_is_not_taken_for_a_broker() -> None:
    with socket.create_server((HOST, 0)) as mute:
        results = list(
            judging.BrokerExamination("anna", {"TALK_BROKER": f"mqtt://{HOST}:{mute.getsockname()[1]}"}).findings()
        )
    assert [finding.check for finding in results] == ["broker", "login"]
    assert results[-1].message.endswith("did not answer within 4.5 s")


def test_no_check_follows_an_untrusted_certificate(secure_broker: Broker, broker: Broker) -> None:
    results = doctor(secure_broker, user="olga", env={"TALK_MQTT_CA": stranger().file})
    assert list(results) == ["broker", "certificate"]
    assert "unable to get local issuer certificate" in results["certificate"]["message"]
    assert "another file with the certificate of the CA" in results["certificate"]["next"]
    with Broker(expired=True) as expired:
        results = doctor(expired)
    assert "certificate has expired" in results["certificate"]["message"]
    assert "set this machine's clock" in results["certificate"]["next"]
    url = broker.url.replace("mqtt:", "mqtts:")
    results = doctor(secure_broker, user="olga", env={"TALK_BROKER": url})
    assert "use its TLS port" in results["certificate"]["next"]


def test_a_refused_login_is_reported_with_the_variables_to_set(secure_broker: Broker) -> None:
    results = doctor(secure_broker, user="olga", password="wrong")
    assert [*results][-1] == "login"
    assert "rejected the login of 'olga'" in results["login"]["message"]
    assert results["login"]["next"].startswith("set TALK_MQTT_USER")
    url = secure_broker.url.replace("mqtts:", "mqtt:")
    results = doctor(secure_broker, env={"TALK_BROKER": url, "TALK_MQTT_CA": ""})
    assert [*results][-1] == "login"
    expected = f"if port {secure_broker.port} is for TLS, set TALK_BROKER={secure_broker.url}"
    assert results["login"]["next"].endswith(expected)


def test_only_a_client_with_a_certificate_can_log_in() -> None:
    with Broker(certificates=True) as broker:
        publish_robot(broker, "anna", cert="anna", online=False)
        results = doctor(broker, cert="olga", env={"TALK_MQTT_USER": "olga"})
        assert results["login"]["message"] == "as 'olga', with a certificate"
        assert results["anonymous"]["state"] == "ok"
        results = doctor(broker)
        assert [*results][-1] == "login"
        assert "TALK_MQTT_CERT and TALK_MQTT_KEY " in results["login"]["next"]


def test_a_signal_ends_a_doctor_that_waits_for_a_login() -> None:
    with socket.create_server((HOST, 0)) as mute, Broker() as broker:
        mute.settimeout(LIMIT)
        with Desk(broker, env={"TALK_BROKER": f"mqtt://{HOST}:{mute.getsockname()[1]}"}) as desk:
            client = desk.start("--robot", "anna", "doctor")
            mute.accept()[0].close()
            with mute.accept()[0]:  # the doctor waits for the reply to its login
                client.terminate()
                done = desk.finish(client, 3)
    assert done.code == 143


# Judgements of results


def test_an_invalid_robot_name_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="invalid robot name 'a/b'"):
        judging.BrokerExamination("a/b", {})


PLAIN = BrokerAddress("broker.example", 1883, tls=False)


@pytest.mark.parametrize(
    ("broker", "expires_at", "state", "expected", "step"),
    [
        (TLS, 1e9 + 13 * 86400, "warning", "the system's CAs", "renew the certificate"),
        (TLS, 1e9 + 15 * 86400, "ok", "the system's CAs", "None"),
        (PLAIN, None, "warning", "no TLS: ", "give the broker a certificate"),
    ],
)
def test_a_certificate_that_expires_soon_is_a_warning(
    broker: BrokerAddress, expires_at: float | None, state: str, expected: str, step: str
) -> None:
    finding = judging.judge_certificate(broker, expires_at, 1e9)
    assert finding.state == state
    assert expected in finding.message
    assert str(finding.next).startswith(step)


def test_a_certificate_of_another_host_fails_with_advice() -> None:
    finding = judging.judge_tls_error(TLS, "Hostname mismatch", 62, 1e9)
    assert (finding.state, finding.message) == ("failed", "Hostname mismatch (checked against the system's CAs)")
    assert str(finding.next).startswith("use the host name of its certificate in TALK_BROKER")


def test_rights_cannot_be_tested_if_the_broker_disconnects() -> None:
    finding = judging.judge_rights("olga", (), ("talk/reply/olga/1/_",), "the connection was lost")
    assert (finding.state, finding.message) == (
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
def test_a_failed_engine_and_a_pause_are_warnings(change: dict[str, object], state: str, step: str | None) -> None:
    finding = judging.judge_server_status("anna", SERVER | change, 0.001)
    assert (finding.state, finding.next) == (state, step)
