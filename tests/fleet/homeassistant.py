"""Home Assistant's rules for MQTT device discovery, and a client that follows them.

The rules are those of www.home-assistant.io/integrations/mqtt: device discovery payload, notify, button, sensor, binary
sensor. Home Assistant itself is not installed here.
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
_ANY = {"platform", "unique_id", "name", "qos", "icon", "json_attributes_topic", "json_attributes_template"}
_COMMAND = {*_ANY, "command_topic", "retain"}
_STATE = {*_ANY, "state_topic", "value_template", "device_class"}
#: The required and the allowed keys of each part of the payload.
KEYS = {
    "payload": ({"device", "origin", "components"}, {"device", "origin", "components", "availability", "qos"}),
    "device": ({"identifiers", "name"}, {"identifiers", "name", "manufacturer", "model", "sw_version"}),
    "origin": ({"name"}, {"name", "sw_version", "support_url"}),
    "availability": ({"topic"}, {"topic", "value_template"}),
    "notify": ({"unique_id", "command_topic"}, _COMMAND),
    "button": ({"unique_id", "command_topic"}, {*_COMMAND, "payload_press"}),
    "sensor": ({"unique_id", "state_topic"}, {*_STATE, "options", "state_class"}),
    "binary_sensor": ({"unique_id", "state_topic"}, {*_STATE, "payload_on", "payload_off"}),
}
#: A template that means the same in Jinja and Python. In Jinja, names such as `items` are methods.
_WORD = (
    r"value_json(?:\.(?!items\b|keys\b|values\b|get\b|pop\b|copy\b)\w+)*|'\w+'|if|else|and|or|not|None|\{\}|\| tojson"
)
_TEMPLATE = rf'"\{{\{{ (?:\(?(?:{_WORD})\)? )+\}}\}}"'
_TEXT, _TEXTS = '".+"', r'\[".+"\]'
#: The JSON form of a value. Values that are not listed are texts.
VALUES = {
    "qos": "[012]", "retain": "true|false", "name": f"{_TEXT}|null", "identifiers": _TEXTS, "options": _TEXTS,
    "device_class": '"(enum|running|sound)"', "state_class": '"measurement"', "command_topic": '"[^+#]+"',
    "value_template": _TEMPLATE, "json_attributes_template": _TEMPLATE,
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


def rendered(template: str, payload: bytes) -> str:
    """Return the result of a template for a message."""
    expression, filtered, _ = template.removeprefix("{{ ").removesuffix(" }}").partition(" | tojson")
    message = json.loads(payload, object_hook=lambda fields: SimpleNamespace(**fields))
    value = eval(expression, {"value_json": message})
    return json.dumps(value, default=vars) if filtered else str(value)


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
        topics = {availability["topic"] for availability in message.json["availability"]}
        for topic in topics | {message.json["components"]["state"]["state_topic"]}:
            assert self.subscribe(topic) <= 1
        return message.json

    def await_states(self, device: dict[str, Any], **expected: str) -> None:
        """Wait until the entities are in these states."""
        self.await_message(lambda _: all(self._state(device, key) == state for key, state in expected.items()))

    def command(self, device: dict[str, Any], key: str, text: str = "PRESS") -> int:
        """Press a button or send a message to the notifier, and return the broker's reason code."""
        entity = device["components"][key]
        return self.publish(entity["command_topic"], text, entity["qos"], entity.get("retain", False))

    def _state(self, device: dict[str, Any], key: str) -> str | None:
        payloads = {message.topic: message.payload for message in self.messages}
        (presence,) = device["availability"]
        if rendered(presence["value_template"], payloads.get(presence["topic"]) or b'{"online": false}') != "online":
            return "unavailable"
        entity = device["components"][key]
        payload = payloads.get(entity["state_topic"])
        return rendered(entity["value_template"], payload) if payload else None
