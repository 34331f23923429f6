"""`talk --robot anna doctor`: what stands between a desk, a broker and a robot, and what to do about it."""

from __future__ import annotations

import json
import socket
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import __version__
from talkcli.doctor import broker as judging
from talkcli.doctor.broker import Allowed, Way
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

#: Seconds in which it ends, whatever it finds: each of its steps has ten.
LIMIT = 60.0
#: What there is to be found where all is well.
WELL = ["broker", "login", "anonymous", "name", "rights", "bridge"]
PRESENCE: dict[str, Any] = {
    "talk": 1, "version": __version__, "online": True, "session": "5e55", "since": 1000.0, "groups": ["warehouse"],
    "allow": ["status"], "server": {"boot": "4k7f", "pid": 4711, "version": __version__},
}  # fmt: skip
TLS = Named("broker.example", 8883, tls=True)


@pytest.fixture(autouse=True)
def with_paho() -> None:
    needs_packages("paho")


def findings(done: Finished, code: int) -> dict[str, dict[str, str]]:
    """Return the findings by their checks, in their order, and assert how it ended."""
    assert (done.code, done.err) == (code, ""), done
    found = [json.loads(line) for line in done.out.splitlines()]
    for each in found:
        assert list(each) == ["check", "state", "message", "next"]
    return {each["check"]: each for each in found}


def doctor(
    at: Broker, name: str = "anna", *, code: int = 4, user: str | None = None, password: str | bool = True,
    cert: str | None = None, env: Mapping[str, str] | None = None,
) -> dict[str, dict[str, str]]:  # fmt: skip
    """Run it at a desk, and return what it finds."""
    with Desk(at, user=user, password=password, cert=cert, env=env) as desk:
        return findings(desk.run("--json", "--robot", name, "doctor", timeout=LIMIT), code)


def is_there(at: Broker, name: str, user: str | None = None, cert: str | None = None, **changed: object) -> None:
    """Have the broker keep that a robot is there."""
    with Listener(at, user=user, cert=cert) as listener:
        listener.publish(topics.robot(name, topics.PRESENCE), PRESENCE | changed, retain=True)


def last(found: Mapping[str, Mapping[str, str]]) -> Mapping[str, str]:
    return list(found.values())[-1]


# With a robot


def test_a_robot_that_answers_is_asked_by_all_that_is_between_and_nothing_is_left(robot: Robot) -> None:
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
    done = robot.desk("doctor")
    assert done.err == "talk: the robot answers; 1 warning\n"
    assert not robot.talk.run("log").out


def test_a_robot_whose_speech_is_paused_answers_with_a_warning(lasting_robot: Robot) -> None:
    lasting_robot.talk.run("pause")
    found = findings(lasting_robot.desk("--json", "doctor"), 0)
    lasting_robot.talk.run("resume")
    assert (found["bridge"]["state"], found["bridge"]["next"]) == ("warning", "talk --robot anna resume")


def test_a_bridge_goes_on_while_its_own_user_asks_the_doctor(robot: Robot) -> None:
    with Desk(robot.broker, env={"TALK_MQTT_USER": "anna"}) as desk:
        found = findings(desk.run("--json", "--robot", "anna", "doctor"), 0)
    assert list(found) == WELL[:-1]
    assert found["rights"]["state"] == "ok"
    assert robot.desk("status").code == 0
    assert "doctor" not in robot.bridge.log


def test_a_variable_names_the_robot_as_the_option_does(broker: Broker) -> None:
    is_there(broker, "anna", online=False)
    with Desk(broker, env={"TALK_ROBOT": "anna"}) as desk:
        assert "name" in findings(desk.run("--json", "doctor"), 4)
        assert "python" in findings(desk.run("--json", "--socket", "/nowhere", "doctor", timeout=LIMIT), 4)


@pytest.mark.slow
def test_a_bridge_that_says_nothing_is_told_from_a_robot_that_is_there(broker: Broker) -> None:
    is_there(broker, "anna")
    began = time.monotonic()
    found = doctor(broker)
    assert time.monotonic() - began < 20
    assert list(found) == WELL
    assert found["name"]["state"] == "ok"
    assert (found["bridge"]["state"], found["bridge"]["next"]) == (
        "failed", "see what the bridge's log says, on anna: journalctl -u talk-bridge",
    )  # fmt: skip


def test_a_robot_that_is_offline_or_has_no_server_is_not_asked(broker: Broker) -> None:
    is_there(broker, "anna", online=False)
    is_there(broker, "bert", server=None)
    for name, words in (("anna", "anna is offline"), ("bert", "it has no talk server")):
        found = doctor(broker, name)
        assert list(found) == WELL[:-1]
        assert found["name"]["state"] == "failed"
        assert found["name"]["message"].endswith(words)


def test_a_name_that_nobody_has_comes_with_those_that_are_near() -> None:
    """Asked both at once: each waits a second for what the broker may keep."""
    with Broker(users={"olga": "o"}, anonymous=True) as broker, Desk(broker, user="olga") as desk:
        is_there(broker, "anna")
        clients = [desk.start("--json", "--robot", name, "doctor") for name in ("Ana", "zebra")]
        near, far = (findings(desk.finish(each), 4) for each in clients)
    assert near["name"]["message"] == "the broker knows no robot 'Ana'; it knows anna"
    assert near["name"]["next"] == "talk --robot anna doctor"
    assert far["name"]["next"] == "on the robot: talk bridge --name zebra"
    assert near["anonymous"]["state"] == "warning"  # it lets users in, and anybody besides


# Rights


def test_an_operator_may_ask_and_a_login_without_the_lines_of_one_is_told_what_it_may_not(
    scripted: Talk, secure_broker: Broker, make_bridge: MakeBridge
) -> None:
    make_bridge(scripted, secure_broker, "anna", user="anna", observer=OPERATORS[0])
    found = doctor(secure_broker, user=OPERATORS[0], code=0)
    assert [each["state"] for each in found.values()] == ["ok", "warning", *["ok"] * 5]
    assert found["login"]["message"] == "as 'olga', with a password"
    assert "renew the certificate of localhost" in found["certificate"]["next"], "it is good for two days"
    found = doctor(secure_broker, user=ROBOTS[1])
    assert "write talk/reply/bert/" in found["rights"]["message"]
    assert "talk/robot/anna/request/bert" in found["rights"]["message"]
    assert (found["name"]["state"], found["rights"]["state"]) == ("warning", "failed")
    assert list(found) == ["broker", "certificate", *WELL[1:-1]]


def test_a_robot_itself_finds_out_whether_its_bridge_may_speak(secure_broker: Broker) -> None:
    with Listener(secure_broker, "talk/#", user="olga") as listener:
        with Desk(secure_broker, user="anna") as desk:
            done = desk.run("--robot", "anna", "doctor")
        assert (done.code, done.err) == (0, "talk: the broker takes what this robot's bridge says; 1 warning\n")
        assert "'anna' is free" in done.out
        is_there(secure_broker, "anna", user="anna")
        found = doctor(secure_broker, user="anna", code=0)
        assert found["name"]["message"].startswith("anna is online")
        assert not [each for each in listener.messages if each.retain and not each.topic.endswith("/presence")]


def test_what_a_robot_may_not_write_and_does_not_hear_is_named() -> None:
    acl = "pattern read talk/robot/%u/presence\npattern write talk/robot/%u/echo\npattern write talk/reply/+/+/%u\n"
    with Broker(users={"anna": "a"}, acl=acl) as broker:
        found = doctor(broker, user="anna")
    words = "write talk/robot/anna/status and talk/robot/anna/event/doctor, nor read talk/robot/anna/echo"
    assert found["rights"]["message"] == f"the broker does not let 'anna' {words}"
    assert found["rights"]["next"].endswith("talk bridge --print-acl")


# The way there, and who is let in


@pytest.mark.parametrize(
    ("changed", "words", "step"),
    [
        ({"TALK_BROKER": ""}, "TALK_BROKER is not set", "export TALK_BROKER=mqtts://broker.example"),
        ({"TALK_BROKER": "http://x"}, "TALK_BROKER is no broker's URL", "mend it where it is set"),
        ({"TALK_BROKER": "mqtts://x", "TALK_MQTT_CA": "/no/ca"}, "TALK_MQTT_CA: /no/ca: No such file", "mend it"),
        ({"TALK_MQTT_USER": "a/b"}, "the name 'a/b' can't be in a topic", "mend it where it is set"),
        ({"TALK_BROKER": "mqtt://no-such.invalid"}, ":1883: no such host", "spell the host in TALK_BROKER rightly"),
    ],
)
def test_variables_that_name_no_broker_are_told(broker: Broker, changed: dict[str, str], words: str, step: str) -> None:
    found = doctor(broker, env=changed)
    assert list(found) == ["broker"]
    assert found["broker"]["state"] == "failed"
    assert words in found["broker"]["message"]
    assert found["broker"]["next"].startswith(step)


def test_where_nobody_listens_the_connection_is_refused(broker: Broker) -> None:
    with Port() as port:
        found = doctor(broker, env={"TALK_BROKER": f"mqtt://{HOST}:{port.number}"})
    assert list(found) == ["broker"]
    assert found["broker"]["message"] == f"mqtt://{HOST}:{port.number}: connection refused"
    assert f"'listener {port.number}'" in found["broker"]["next"]


@pytest.mark.slow
def test_what_listens_and_says_nothing_is_no_broker(broker: Broker) -> None:
    with socket.create_server((HOST, 0)) as mute:
        found = doctor(broker, env={"TALK_BROKER": f"mqtt://{HOST}:{mute.getsockname()[1]}"})
    assert list(found) == ["broker", "login"]
    assert found["login"]["message"].endswith("does not answer: nothing in 5 s")


def test_a_certificate_that_is_not_to_be_trusted_ends_it(secure_broker: Broker, broker: Broker) -> None:
    found = doctor(secure_broker, user="olga", env={"TALK_MQTT_CA": stranger().file})
    assert list(found) == ["broker", "certificate"]
    assert "unable to get local issuer certificate" in found["certificate"]["message"]
    assert "another file of the CA" in found["certificate"]["next"]
    with Broker(expired=True) as expired:
        found = doctor(expired)
    assert "certificate has expired" in found["certificate"]["message"]
    assert "set this machine's clock" in found["certificate"]["next"]
    url = broker.url.replace("mqtt:", "mqtts:")
    assert (
        "name the port that has TLS"
        in doctor(secure_broker, user="olga", env={"TALK_BROKER": url})["certificate"]["next"]
    )


def test_a_login_that_is_refused_says_as_whom_and_what_to_set(secure_broker: Broker) -> None:
    found = doctor(secure_broker, user="olga", password="wrong")
    assert last(found)["check"] == "login"
    assert "does not let 'olga' in" in found["login"]["message"]
    assert found["login"]["next"].startswith("log in as somebody whom it knows: TALK_MQTT_USER")


def test_a_certificate_is_a_login_and_without_one_nobody_is_let_in() -> None:
    with Broker(certificates=True) as broker:
        is_there(broker, "anna", cert="anna", online=False)
        found = doctor(broker, cert="olga", env={"TALK_MQTT_USER": "olga"})
        assert found["login"]["message"] == "as 'olga', with a certificate"
        assert found["anonymous"]["state"] == "ok"
        found = doctor(broker)
        assert last(found)["check"] == "login"
        assert "TALK_MQTT_CERT and TALK_MQTT_KEY name " in found["login"]["next"]


def test_a_port_that_is_for_tls_is_told(secure_broker: Broker) -> None:
    url = secure_broker.url.replace("mqtts:", "mqtt:")
    found = doctor(secure_broker, env={"TALK_BROKER": url, "TALK_MQTT_CA": ""})
    assert last(found)["check"] == "login"
    assert found["login"]["next"].endswith(
        f"where port {secure_broker.port} is for TLS: TALK_BROKER={secure_broker.url}"
    )


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
    with pytest.raises(UsageError, match="no robot can be called 'a/b'"):
        judging.Examination("a/b", {})


@pytest.mark.parametrize(("days", "state"), [(13, "warning"), (15, "ok")])
def test_a_certificate_is_renewed_two_weeks_before_its_end(days: int, state: str) -> None:
    (found,) = judging.judge_certificate(TLS, Way(until=1e9 + days * 86400), 1e9, near=False)
    assert found.state == state
    assert "the system's CAs" in found.message


def test_another_host_s_certificate_is_a_matter_of_the_name() -> None:
    way = Way(untrusted="Hostname mismatch", fault=62)
    (found,) = judging.judge_certificate(TLS, way, 1e9, near=False)
    assert (found.state, found.next and found.next[:26]) == ("failed", "name the host in TALK_BROK")


def test_without_tls_another_machine_s_broker_is_warned_of() -> None:
    plain = Named("broker.example", 1883, tls=False)
    assert [each.state for each in judging.judge_certificate(plain, Way(), 1e9, near=False)] == ["warning"]
    assert judging.judge_certificate(plain, Way(), 1e9, near=True) == []


def test_a_broker_that_hangs_up_on_what_is_not_allowed_is_told_from_one_that_refuses() -> None:
    found = judging.judge_rights("olga", Allowed(None, (), ("talk/reply/olga/1/_",), "the broker went away"))
    assert (found.state, found.message) == ("failed", "what 'olga' may do can't be found out: the broker went away")


def test_an_engine_that_is_not_ready_is_a_warning() -> None:
    server: dict[str, object] = {"version": __version__, "engine": "failed", "pending": 0}
    assert judging.judge_bridge("anna", server, 0.001).state == "warning"
