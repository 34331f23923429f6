"""What Home Assistant is told of a robot: held against what it documents, and what becomes of what the robot says."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.fleet import homeassistant, topics
from talkcli.fleet.policy import ASKABLE
from talkcli.goals.states import State
from tests.fleet.homeassistant import TOPIC, device_faults, rendered

if TYPE_CHECKING:
    from collections.abc import Callable

NAMES = ["anna", "wh-07", "A_1", "0", "r2.d2", "a.b_c..", "x" * 59]
#: What a robot says of itself that has just begun, and of a goal that has ended.
STATUS: dict[str, Any] = {"active": None, "text": None, "pending": 0, "paused": False, "last": None}
ENDED = {"id": "door-17", "state": "ABORTED", "reason": "no_engine", "text": "it's <open>", "at": 1767225601.5}


def announced(name: str = "anna", allow: tuple[str, ...] = ASKABLE) -> dict[str, Any]:
    found = json.loads(homeassistant.device(name, allow, "0.1.0")[1])
    assert isinstance(found, dict)
    return found


def state(key: str, template: str = "value_template", **status: object) -> str:
    return rendered(announced()["components"][key][template], json.dumps({**STATUS, **status}).encode())


@pytest.mark.parametrize("allow", [ASKABLE, ("say",), ("cancel",), ()])
@pytest.mark.parametrize("name", NAMES)
def test_a_device_is_as_home_assistant_documents_it(name: str, allow: tuple[str, ...]) -> None:
    assert device_faults(*homeassistant.device(name, allow, "0.1.0")) == []


def _each(device: dict[str, Any], change: Callable[[dict[str, Any]], object]) -> None:
    for each in device["components"].values():
        change(each)


#: What somebody who changes the payload may get wrong.
WRONG: dict[str, Callable[[dict[str, Any]], object]] = {
    "a key that is not documented": lambda device: device.update(icon="mdi:robot"),
    "one of a component's": lambda device: device["components"]["say"].update(title="hello"),
    "one of another platform": lambda device: device["components"]["state"].update(payload_press="now"),
    "no origin": lambda device: device.pop("origin"),
    "a device that nothing identifies": lambda device: device["device"].update(identifiers=[]),
    "a component without a unique id": lambda device: device["components"]["last"].pop("unique_id"),
    "unique ids that are not": lambda device: _each(device, lambda each: each.update(unique_id="one")),
    "a component of no platform": lambda device: device["components"]["say"].pop("platform"),
    "a platform that it is not told of": lambda device: device["components"]["say"].update(platform="speaker"),
    "a sensor of nothing": lambda device: device["components"]["pending"].pop("state_topic"),
    "a number as a text": lambda device: device["components"]["say"].update(qos="1"),
    "a truth as a number": lambda device: device["components"]["say"].update(qos=True),
    "a quality that there isn't": lambda device: device["components"]["say"].update(qos=3),
    "a wildcard to publish to": lambda device: device["components"]["say"].update(command_topic="talk/+"),
    "options of a number": lambda device: device["components"]["pending"].update(options=["1"]),
    "no options": lambda device: device["components"]["state"].update(options=[]),
    "no topic that says whether it is there": lambda device: device["availability"][0].pop("topic"),
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG)
def test_the_schema_finds_what_is_wrong(change: Callable[[dict[str, Any]], object]) -> None:
    device = announced()
    change(device)
    assert device_faults(topics.device("anna"), json.dumps(device).encode())


@pytest.mark.parametrize("topic", ["homeassistant/device/r2.d2/config", "homeassistant/anna/config", "talk/anna"])
def test_a_topic_that_home_assistant_does_not_take_is_found(topic: str) -> None:
    assert device_faults(topic, homeassistant.device("anna", ASKABLE, "0.1.0")[1])


@given(st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,58}", fullmatch=True), st.data())
def test_each_name_has_a_topic_of_its_own(name: str, data: st.DataObject) -> None:
    alike = st.text("._-d" + name, min_size=1, max_size=59).filter(lambda each: not topics.fault(each))
    other = data.draw(st.one_of(alike, st.just(name.replace(".", "_d")), st.just(name.replace("_d", "."))))
    assert topics.fault(name) is None
    assert TOPIC.fullmatch(topics.device(name))
    assert topics.fault(other) or (topics.device(name) == topics.device(other)) == (name == other)


def test_names_that_might_be_taken_for_each_other_are_not() -> None:
    names = ["a.b", "a_b", "a-b", "a_db", "a__b", "a._b", "a_.b", "a..b", "a__.b", "a_d.b", "a.db", "a_ddb"]
    assert len({topics.device(each) for each in names}) == len(names)
    for name in ("anna", "A_1", "wh-07"):  # so that a pattern of an ACL is enough
        assert topics.device(name) == topics.device("%u").replace("%u", name)


def test_what_it_asks_for_is_asked_for_as_home_assistant() -> None:
    components = announced("r2.d2")["components"]
    for key in ("say", "cancel"):
        topic = components[key]["command_topic"]
        assert topics.asked(topic) == topics.Asked(key, "homeassistant")
        assert topic.startswith("talk/robot/r2.d2/")
        assert components[key].get("retain", False) is False  # what is kept is never spoken


def test_what_a_robot_does_not_take_is_taken_away() -> None:
    components = announced(allow=("say", "status"))["components"]
    assert components["cancel"] == {"platform": "button"}
    assert components["say"]["command_topic"]
    assert announced(allow=())["components"]["say"] == {"platform": "notify"}


@pytest.mark.parametrize(
    ("presence", "wanted"),
    [
        ({"talk": 1, "online": True, "server": {"boot": "7r2z", "pid": 4711}}, "online"),
        ({"talk": 1, "online": True, "server": None}, "offline"),
        ({"talk": 1, "online": False, "session": "9b51"}, "offline"),
    ],
)
def test_it_is_available_where_a_sentence_would_be_spoken(presence: dict[str, Any], wanted: str) -> None:
    (each,) = announced()["availability"]
    assert each["topic"] == "talk/robot/anna/presence"
    assert rendered(each["value_template"], json.dumps(presence).encode()) == wanted
    assert each.keys() == {"topic", "value_template"}  # that these are the words for it is Home Assistant's default


@pytest.mark.parametrize(
    ("status", "state_then", "speaking"),
    [
        ({}, "idle", "OFF"),
        ({"active": "door-17"}, "speaking", "ON"),
        ({"active": "door-17", "paused": True}, "paused", "OFF"),
        ({"paused": True}, "paused", "OFF"),
    ],
)
def test_status_says_what_it_does(status: dict[str, Any], state_then: str, speaking: str) -> None:
    assert (state("state", **status), state("speaking", **status)) == (state_then, speaking)
    assert state("pending", pending=7, **status) == "7"


def test_the_last_result_has_its_reason_and_its_text() -> None:
    assert (state("last"), state("last", last=ENDED)) == ("None", "ABORTED")
    assert state("last", "json_attributes_template") == "{}"
    assert json.loads(state("last", "json_attributes_template", last=ENDED)) == ENDED


def test_a_text_that_is_told_to_nobody_is_no_attribute() -> None:
    untold = {name: each for name, each in ENDED.items() if name != "text"}
    assert json.loads(state("last", "json_attributes_template", last=untold)) == untold
    status = {name: each for name, each in STATUS.items() if name != "text"} | {"last": untold}
    for each in announced()["components"].values():
        if "state_topic" in each:  # nothing else needs one
            assert rendered(each["value_template"], json.dumps(status).encode())


def test_each_end_of_a_goal_is_known() -> None:
    assert {*announced()["components"]["last"]["options"]} == {each.name for each in State if each.terminal}


@pytest.mark.parametrize(
    "template",
    [
        "{{ value_json.pending + 1 }}",
        "{{ value_json.items }}",
        "{{ value_json['state'] }}",
        "{{ states('sensor.anna') }}",
        "{{ value_json.last or {} | tojson }}",
        "value_json.last",
    ],
)
def test_a_template_that_jinja_may_read_otherwise_is_not_read_here(template: str) -> None:
    with pytest.raises(AssertionError):
        rendered(template, b'{"pending": 0, "items": 0, "state": 0, "last": 0}')


def test_the_rules_for_home_assistant_are_printed_where_it_is_asked_for() -> None:
    assert "homeassistant" not in topics.access(name="r2.d2")
    rules = topics.access(("olga",), homeassistant=True, name="anna")
    assert rules == topics.access(("olga",), homeassistant=True)
    assert {*topics.access(("olga",)).splitlines()} < {*rules.splitlines()}
    # mosquitto's manual: what is filled in must be the only text of its level.
    assert all(set(re.findall(r"[^/ ]*%u[^/]*", each)) <= {"%u"} for each in rules.splitlines() if "pattern" in each)
    dotted = topics.access(("olga",), homeassistant=True, name="r2.d2")
    own = ["user r2.d2", "topic write homeassistant/device/talk-dots/r2_dd2/config"]
    assert dotted.splitlines()[-2:] == own
