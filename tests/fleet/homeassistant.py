"""Home Assistant's rules for MQTT device discovery, and a client that follows them.

The rules are those of www.home-assistant.io/integrations/mqtt. Home Assistant itself is not installed here.
"""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from tests.support.broker import Broker

#: A topic on which a device is announced to Home Assistant.
TOPIC = re.compile(r"homeassistant/device/(?:[a-zA-Z0-9_-]+/)?[a-zA-Z0-9_-]+/config")
#: The topic and the message that Home Assistant publishes when it has started.
BIRTH = ("homeassistant/status", "online")
_ANY = {
    "platform",
    "unique_id",
    "name",
    "qos",
    "icon",
    "json_attributes_topic",
    "json_attributes_template",
    "entity_category",
}
_COMMAND = {*_ANY, "command_topic", "retain"}
_STATE = {*_ANY, "state_topic", "value_template", "device_class"}
#: The required and the allowed keys of each part of the payload.
KEYS = {
    "payload": ({"device", "origin", "components"}, {"device", "origin", "components", "availability", "qos"}),
    "device": ({"identifiers", "name"}, {"identifiers", "name", "manufacturer", "model", "sw_version"}),
    "origin": ({"name"}, {"name", "sw_version", "support_url"}),
    "availability": ({"topic"}, {"topic", "value_template"}),
    "notify": ({"unique_id", "command_topic"}, {*_COMMAND, "command_template"}),
    "switch": (
        {"unique_id", "command_topic"},
        {*_COMMAND, *_STATE, "payload_on", "payload_off", "state_on", "state_off"},
    ),
    "event": ({"unique_id", "state_topic", "event_types"}, {*_STATE, "event_types"}),
    "button": ({"unique_id", "command_topic"}, {*_COMMAND, "payload_press"}),
    "sensor": ({"unique_id", "state_topic"}, {*_STATE, "options", "state_class"}),
    "binary_sensor": ({"unique_id", "state_topic"}, {*_STATE, "payload_on", "payload_off"}),
}
#: A template that means the same in Jinja and Python. In Jinja, names such as `items` are methods.
_WORD = (
    r"value_json(?:\.(?!items\b|keys\b|values\b|get\b|pop\b|copy\b)\w+)*|'\w*'|if|else|and|or|not|in|None|True"
    r"|\{\}|\| tojson|dict|\w+=|\d+|value|[][(),:]"
)
_TEMPLATE = rf'"\{{\{{ (?:(?:{_WORD}) ?)+\}}\}}"'
_TEXT, _TEXTS = '".+"', r'\[".+"\]'
#: The JSON form of a value. Values that are not listed are texts.
VALUES = {
    "icon": '"mdi:[a-z-]+"', "entity_category": '"diagnostic"', "event_types": _TEXTS,
    "qos": "[012]", "retain": "true|false", "name": f"{_TEXT}|null", "identifiers": _TEXTS, "options": _TEXTS,
    "device_class": '"(enum|running|sound)"', "state_class": '"measurement"', "command_topic": '"[^+#]+"',
    "value_template": _TEMPLATE, "command_template": _TEMPLATE, "json_attributes_template": _TEMPLATE,
    **dict.fromkeys(("device", "origin", "components", "availability"), ".+"),
}  # fmt: skip


def faults(topic: str, payload: bytes) -> list[str]:
    """Return the errors that Home Assistant would find in the announcement of a device."""
    device = json.loads(payload)
    entities = [component for component in device["components"].values() if len(component) > 1]
    parts = [("payload", device), *((key, device[key]) for key in ("device", "origin"))]
    parts += [("availability", availability) for availability in device["availability"]]
    parts += [(entity["platform"], entity) for entity in entities]
    errors = [] if TOPIC.fullmatch(topic) else [topic]
    for kind, part in parts:
        required, allowed = KEYS[kind]
        errors += [f"{kind}: {key}" for key in (required - part.keys()) | (part.keys() - allowed)]
        texts = {key: json.dumps(value) for key, value in part.items()}
        errors += [
            f"{kind}: {key}: {text}" for key, text in texts.items() if not re.fullmatch(VALUES.get(key, _TEXT), text)
        ]
    if len({entity["unique_id"] for entity in entities}) < len(entities):
        errors.append("two entities have the same unique_id")
    errors += [entity["name"] for entity in entities if ("options" in entity) != (entity.get("device_class") == "enum")]
    return errors


def rendered(template: str, payload: bytes, value: str = "") -> str:
    """Return the result of a template for a message, or for the value of a command."""
    expression, filtered, _ = template.removeprefix("{{ ").removesuffix(" }}").partition(" | tojson")
    message = json.loads(payload, object_hook=lambda fields: SimpleNamespace(**fields))
    result = eval(expression, {"value_json": message, "value": value})
    return json.dumps(result, default=vars) if filtered else str(result)


class HomeAssistant(Listener):
    """A Home Assistant that has started, and listens for devices."""

    def __init__(self, broker: Broker, **more: Any) -> None:
        super().__init__(broker, "homeassistant/device/#", **more)

    def __enter__(self) -> HomeAssistant:
        return self

    def device(self) -> dict[str, Any]:
        """Wait for a device, subscribe to its states, and return its announcement."""
        message = self.await_message(lambda message: bool(TOPIC.fullmatch(message.topic) and message.payload))
        assert faults(message.topic, message.payload) == []
        parts = [*message.json["availability"], *message.json["components"].values()]
        for topic in {part[key] for part in parts for key in ("topic", "state_topic") if key in part}:
            assert self.subscribe(topic) <= 1
        return message.json

    def await_states(self, device: dict[str, Any], **expected: str) -> None:
        """Wait until the entities are in these states."""
        self.await_message(lambda _: all(self._state(device, key) == state for key, state in expected.items()))

    def command(self, device: dict[str, Any], key: str, text: str = "", payload: str = "payload_press") -> int:
        """Press a button or a switch, or send a message to a notifier, and return the broker's reason code."""
        entity = device["components"][key]
        template = entity.get("command_template")
        message = rendered(template, b"{}", text) if template else entity[payload]
        return self.publish(entity["command_topic"], message, entity["qos"], entity.get("retain", False))

    def end_events(self, device: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the events of the event entity so far, oldest first."""
        entity = device["components"]["ended"]
        payloads = [message.payload for message in self.messages if message.topic == entity["state_topic"]]
        return [event for each in payloads if (event := json.loads(rendered(entity["value_template"], each)))]

    def _state(self, device: dict[str, Any], key: str) -> str | None:
        payloads = {message.topic: message.payload for message in self.messages}
        (presence,) = device["availability"]
        if rendered(presence["value_template"], payloads.get(presence["topic"]) or b'{"online": false}') != "online":
            return "unavailable"
        entity = device["components"][key]
        payload = payloads.get(entity["state_topic"])
        return rendered(entity["value_template"], payload) if payload else None
