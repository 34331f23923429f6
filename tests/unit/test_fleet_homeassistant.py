"""The description of a robot for Home Assistant: its rules, templates and topic."""

from __future__ import annotations

import json
from itertools import product
from typing import Any

import pytest

from talkcli.fleet import topics
from talkcli.fleet.bridge.policy import ALLOWABLE_REQUESTS
from talkcli.fleet.payloads import homeassistant_device
from talkcli.goals.goal import By, Goal, Sender
from talkcli.goals.options import Cancel, Pause, Say
from talkcli.goals.states import State
from talkcli.protocol.events import StateChanged
from talkcli.protocol.lines import decode, encode
from talkcli.protocol.requests import Resume, read_request
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
        "identifiers": [f"talk-{name}"], "name": name, "manufacturer": "talk", "model": "Speaking robot",
        "sw_version": "0.1.0",
    }  # fmt: skip
    for key in ("say", "interrupt", "cancel", "paused"):
        assert payload["components"][key]["command_topic"] == f"talk/robot/{name}/request/homeassistant"
        assert not payload["components"][key].get("retain")  # retained requests are never spoken
    ends = {state.name for state in State if state.terminal}
    assert {*payload["components"]["last"]["options"]} == {*payload["components"]["ended"]["event_types"]} == ends
    assert all("icon" in component for component in payload["components"].values())


@pytest.mark.parametrize("allow", [("say", "status"), ("cancel", "pause"), ("pause", "resume"), ()])
def test_an_entity_for_a_forbidden_request_is_removed(allow: tuple[str, ...]) -> None:
    components = announcement(allow=allow)["components"]
    for key, platform, needed in (
        ("say", "notify", {"say"}),
        ("interrupt", "notify", {"say"}),
        ("cancel", "button", {"cancel"}),
        ("paused", "switch", {"pause", "resume"}),
    ):
        assert (components[key] == {"platform": platform}) == (not needed <= {*allow})


@pytest.mark.parametrize(
    ("key", "field", "request_"),
    [
        ("say", "command_template", Say("it's <open>", ttl=30)),
        ("interrupt", "command_template", Say("it's <open>", preempt=True, priority=10, ttl=10)),
        ("cancel", "payload_press", Cancel()),
        ("paused", "payload_on", Pause()),
        ("paused", "payload_off", Resume()),
    ],
)
def test_each_command_is_a_valid_request(key: str, field: str, request_: object) -> None:
    payload = announcement()["components"][key][field]
    line = rendered(payload, b"{}", "it's <open>") if field == "command_template" else payload
    assert read_request(decode(line.encode())) == request_


@pytest.mark.parametrize("text", ["it's <open>", "x" * 1001, None])
def test_only_the_end_of_a_goal_is_an_event(text: str | None) -> None:
    template = announcement()["components"]["ended"]["value_template"]
    ended = Goal("door-17", State.RECALLED, text, "canceled", By(client=Sender(name="olga")), "not spoken", key="door")
    event = json.loads(rendered(template, encode(StateChanged("door-17", ended.state, 1.5, 7, ended).to_json())))
    assert (event.pop("by")["client"]["name"], event) == ("olga", {
        "event_type": "RECALLED", "id": "door-17", "key": "door", "text": (text or "")[:1000], "reason": "canceled",
        "message": "not spoken",
    })  # fmt: skip
    for other in (StateChanged("door-17", State.ACTIVE), StateChanged("door-17", State.PENDING, goal=ended)):
        assert rendered(template, encode(other.to_json())) == "{}"


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
        ({}, ["idle", "OFF", "0", "None", "OFF"]),
        ({"active": "door-17", "pending": 7}, ["speaking", "ON", "7", "None", "OFF"]),
        ({"active": "door-17", "paused": True}, ["paused", "OFF", "0", "None", "ON"]),
        ({"paused": True}, ["paused", "OFF", "0", "None", "ON"]),
        ({"last": ENDED}, ["idle", "OFF", "0", "ABORTED", "OFF"]),
        ({"last": ENDED_WITHOUT_TEXT}, ["idle", "OFF", "0", "ABORTED", "OFF"]),
    ],
)
def test_the_entities_show_the_status(status: dict[str, Any], states: list[str]) -> None:
    payload, components = json.dumps(STATUS | status).encode(), announcement()["components"]
    entities = [components[key] for key in ("state", "speaking", "pending", "last", "paused")]
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
