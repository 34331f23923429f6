"""The description of a robot for Home Assistant: its rules, templates and topic."""

from __future__ import annotations

import json
from itertools import product
from typing import Any

import pytest

from talkcli.fleet import topics
from talkcli.fleet.bridge.policy import ALLOWABLE_REQUESTS
from talkcli.fleet.payloads import homeassistant_device
from talkcli.goals.states import State
from tests.fleet.homeassistant import TOPIC, faults, rendered

STATUS: dict[str, Any] = {"active": None, "text": None, "pending": 0, "paused": False, "last": None}
ENDED = {"id": "door-17", "state": "ABORTED", "reason": "no_engine", "text": "it's <open>", "at": 1767225601.5}
ENDED_WITHOUT_TEXT = {name: value for name, value in ENDED.items() if name != "text"}


def announcement(name: str = "anna", allow: tuple[str, ...] = ALLOWABLE_REQUESTS) -> dict[str, Any]:
    message = homeassistant_device(name, allow, "0.1.0")
    assert message.retained
    assert faults(message.topic, message.payload) == []
    payload: dict[str, Any] = json.loads(message.payload)
    return payload


@pytest.mark.parametrize("name", ["anna", "wh-07", "A_1", "0", "r2.d2", "a.b_c..", "x" * 59])
def test_an_announcement_follows_home_assistants_rules(name: str) -> None:
    payload = announcement(name)
    assert payload["device"] == {
        "identifiers": [f"talk-{name}"], "name": name, "model": "talk", "sw_version": "0.1.0",
    }  # fmt: skip
    for key in ("say", "cancel"):
        topic = payload["components"][key]["command_topic"]
        assert topics.parse_request_topic(topic) == (key, "homeassistant")
        assert topic.startswith(f"talk/robot/{name}/")
        assert not payload["components"][key].get("retain")  # retained requests are never spoken
    assert {*payload["components"]["last"]["options"]} == {state.name for state in State if state.terminal}


@pytest.mark.parametrize("allow", [("say", "status"), ("cancel",), ()])
def test_an_entity_for_a_forbidden_request_is_removed(allow: tuple[str, ...]) -> None:
    components = announcement(allow=allow)["components"]
    for key, platform in (("say", "notify"), ("cancel", "button")):
        assert (components[key] == {"platform": platform}) == (key not in allow)


@pytest.mark.parametrize(
    ("presence", "wanted"),
    [
        ({"talk": 1, "online": True, "server": {"boot": "7r2z", "pid": 4711}}, "online"),
        ({"talk": 1, "online": True, "server": None}, "offline"),
        ({"talk": 1, "online": False, "session": "9b51"}, "offline"),
    ],
)
def test_a_device_is_available_if_its_robot_can_speak(presence: dict[str, Any], wanted: str) -> None:
    (availability,) = announcement()["availability"]
    assert availability["topic"] == "talk/robot/anna/presence"
    assert rendered(availability["value_template"], json.dumps(presence).encode()) == wanted


@pytest.mark.parametrize(
    ("status", "states"),
    [
        ({}, ["idle", "OFF", "0", "None"]),
        ({"active": "door-17", "pending": 7}, ["speaking", "ON", "7", "None"]),
        ({"active": "door-17", "paused": True}, ["paused", "OFF", "0", "None"]),
        ({"paused": True}, ["paused", "OFF", "0", "None"]),
        ({"last": ENDED}, ["idle", "OFF", "0", "ABORTED"]),
        ({"last": ENDED_WITHOUT_TEXT}, ["idle", "OFF", "0", "ABORTED"]),
    ],
)
def test_the_entities_show_the_status(status: dict[str, Any], states: list[str]) -> None:
    payload, components = json.dumps(STATUS | status).encode(), announcement()["components"]
    entities = [components[key] for key in ("state", "speaking", "pending", "last")]
    assert [rendered(entity["value_template"], payload) for entity in entities] == states
    assert {entity["state_topic"] for entity in entities} == {"talk/robot/anna/status"}
    assert components["last"]["json_attributes_topic"] == "talk/robot/anna/status"
    attributes = json.loads(rendered(components["last"]["json_attributes_template"], payload))
    assert attributes == status.get("last", {})


def test_each_name_has_its_own_topic() -> None:
    names = ["a" + "".join(characters) for length in range(5) for characters in product("._d", repeat=length)]
    assert len({topics.homeassistant_device(name) for name in names}) == len(names)
    assert all(TOPIC.fullmatch(topics.homeassistant_device(name)) for name in names)
    for name in ("anna", "A_1", "wh-07"):  # their topics match the pattern in the access rules
        assert topics.homeassistant_device(name) == topics.homeassistant_device("%u").replace("%u", name)
