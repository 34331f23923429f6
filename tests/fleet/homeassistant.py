"""What Home Assistant would make of a device that it is told of: a stand-in by its documentation, since it is not here.

A device is held against the stored schema. Its templates are read as Python, which they are as well, within what is
allowed below: names of what came, `and`, `or`, `not`, `if … else`, texts and empty objects mean the same in both.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from tests.support.broker import Broker
    from tests.support.mqtt import Message

SCHEMA: dict[str, Any] = json.loads((Path(__file__).parent / "homeassistant_schema.json").read_text(encoding="utf-8"))
#: A topic on which it hears of a device.
TOPIC = re.compile(r"homeassistant/device/(?:[a-zA-Z0-9_-]+/)?[a-zA-Z0-9_-]+/config")
#: What it says once it has begun.
BIRTH = ("homeassistant/status", "online")
#: What an entity is while its device is not available.
UNAVAILABLE = "unavailable"
_TYPES = {"object": dict, "array": list, "string": str, "integer": int, "boolean": bool, "null": type(None)}
#: What of a template means the same in Jinja and in Python.
_ALIKE = (
    *(ast.Expression, ast.IfExp, ast.BoolOp, ast.And, ast.Or, ast.UnaryOp, ast.Not),
    *(ast.Attribute, ast.Name, ast.Load, ast.Constant, ast.Dict),
)
#: Attributes of messages that it keeps to itself, since they are its own.
_ITS_OWN = {"state", "name", "icon", "unique_id", "device_class", "friendly_name", "unit_of_measurement"}


def faults(value: object, schema: Mapping[str, Any] = SCHEMA, where: str = "") -> list[str]:
    """Return what of a value is not as a schema has it; of JSON Schema this knows what the stored one uses."""
    if "$ref" in schema:
        return faults(value, SCHEMA["$defs"][schema["$ref"].removeprefix("#/$defs/")], where)
    if "anyOf" in schema:
        tried = [faults(value, each, where) for each in schema["anyOf"]]
        return [] if [] in tried else [f"{where}: none of {tried}"]
    types = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
    if type(value) not in [_TYPES[each] for each in types]:
        return [f"{where}: {value!r} is no {' or '.join(types)}"]
    found = []
    if value not in schema.get("enum", [value]):
        found.append(f"{where}: {value!r} is not among {schema['enum']}")
    if isinstance(value, str) and not re.search(schema.get("pattern", ""), value):
        found.append(f"{where}: {value!r} is not as {schema['pattern']}")
    if isinstance(value, list) and len(value) < schema.get("minItems", 0):
        found.append(f"{where}: too short")
    return found + _faults_within(value, schema, where)


def _faults_within(value: object, schema: Mapping[str, Any], where: str) -> list[str]:
    if isinstance(value, list):
        return [fault for each in value for fault in faults(each, schema["items"], f"{where}/[]")]
    if not isinstance(value, dict):
        return []
    known, others = schema.get("properties", {}), schema["additionalProperties"]
    found = [f"{where}: {each} is missing" for each in schema.get("required", []) if each not in value]
    for name, each in value.items():
        if name not in known and others is False:
            found.append(f"{where}: {name} is not documented")
        else:
            found += faults(each, known.get(name, others), f"{where}/{name}")
    return found


def device_faults(topic: str, payload: bytes) -> list[str]:
    """Return what Home Assistant would not take of a device, or would take for something else."""
    device = json.loads(payload)
    found = [] if TOPIC.fullmatch(topic) else [f"{topic} is no topic of a device's"]
    found += faults(device)
    if found:
        return found
    entities = [each for each in device["components"].values() if len(each) > 1]
    names = [(each["platform"], each["unique_id"]) for each in entities]
    if len(set(names)) < len(names):
        found.append("two of a platform have one unique_id")
    for each in entities:
        of_a_number = each.keys() & {"state_class", "unit_of_measurement"}
        if "options" in each and (each.get("device_class") != "enum" or of_a_number):
            found.append(f"{each['unique_id']}: options are for the class enum alone")
    return found


def rendered(template: str, payload: bytes) -> str:
    """Return what a template makes of a message."""
    inner = re.fullmatch(r"\{\{ (.*) \}\}", template)
    assert inner, template
    words, filtered = re.subn(r"^(\(.*\)) \| tojson$", r"\1", inner[1])
    tree = ast.parse(words, mode="eval")
    for each in ast.walk(tree):
        assert isinstance(each, _ALIKE), f"{template}: {ast.dump(each)} may be read otherwise"
        # Jinja would find a method of the object instead of what came.
        assert not isinstance(each, ast.Attribute) or not hasattr(dict, each.attr), f"{template}: {each.attr}"
        assert not isinstance(each, ast.Dict) or not each.keys, f"{template}: an object that is not empty"
    value = _value(tree.body, json.loads(payload))
    return json.dumps(value) if filtered else str(value)


def _value(node: ast.expr, said: object) -> Any:
    if isinstance(node, ast.IfExp):
        return _value(node.body if _value(node.test, said) else node.orelse, said)
    if isinstance(node, ast.BoolOp):
        value: Any = None
        for each in node.values:
            value = _value(each, said)
            if bool(value) == isinstance(node.op, ast.Or):
                break
        return value
    if isinstance(node, ast.UnaryOp):
        return not _value(node.operand, said)
    if isinstance(node, ast.Attribute):
        return _value(node.value, said)[
            node.attr
        ]  # one that is missing would be an error there, too, or an empty state
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Dict):
        return {}
    assert isinstance(node, ast.Name), node
    assert node.id == "value_json", node.id
    return said


class Device:
    """A device, by the last that Home Assistant was told of it."""

    def __init__(self, message: Message) -> None:
        assert device_faults(message.topic, message.payload) == []
        self.config = message.json
        self.components: dict[str, dict[str, Any]] = self.config["components"]

    def available(self, told: Mapping[str, bytes]) -> bool:
        """Whether it is available; `told`: the last payload of each topic."""
        (each,) = self.config["availability"]
        return each["topic"] in told and rendered(each["value_template"], told[each["topic"]]) == "online"

    def state(self, key: str, told: Mapping[str, bytes]) -> str | None:
        """Return the state of an entity; None where it is not known."""
        entity = self.components[key]
        if not self.available(told):
            return UNAVAILABLE
        if entity["state_topic"] not in told:
            return None
        found = rendered(entity["value_template"], told[entity["state_topic"]])
        assert found in (*entity.get("options", [found]), "None"), f"{key}: {found} is no option"
        assert entity["platform"] != "binary_sensor" or found in ("ON", "OFF")
        assert "state_class" not in entity or found.isdecimal()
        return None if found == "None" else found

    def attributes(self, key: str, told: Mapping[str, bytes]) -> dict[str, Any]:
        """Return the attributes of an entity."""
        entity = self.components[key]
        found = json.loads(rendered(entity["json_attributes_template"], told[entity["json_attributes_topic"]]))
        return {name: each for name, each in found.items() if name not in _ITS_OWN}


class HomeAssistant(Listener):
    """One that has begun, and hears of devices. It knows of robots what it is told of them, and nothing else."""

    def __init__(self, broker: Broker, **more: Any) -> None:
        super().__init__(broker, "homeassistant/device/+/config", "homeassistant/device/+/+/config", **more)
        self._followed: set[str] = set()

    def __enter__(self) -> HomeAssistant:
        return self

    def announcements(self) -> list[Message]:
        """Return all that it was told of devices, in the order of their coming."""
        return [each for each in self.messages if TOPIC.fullmatch(each.topic)]

    def device(self) -> Device:
        """Wait for a device, and return it; it hears what becomes of it."""
        device = Device(self.await_message(lambda each: bool(TOPIC.fullmatch(each.topic) and each.payload)))
        wanted = {each["topic"] for each in device.config["availability"]}
        wanted |= {each["state_topic"] for each in device.components.values() if "state_topic" in each}
        for each in wanted - self._followed:
            assert self.subscribe(each) <= 1
            self._followed.add(each)
        return device

    def told(self) -> dict[str, bytes]:
        """Return the last payload of each topic."""
        return {each.topic: each.payload for each in self.messages}

    def await_state(self, device: Device, wanted: Callable[[Callable[[str], str | None]], bool]) -> None:
        """Wait until the device's entities are in the states that are wanted; they change with each message."""
        self.await_message(lambda _: wanted(lambda key: device.state(key, self.told())))

    def send_message(self, device: Device, text: str) -> int:
        """Do what the action notify.send_message does, and return the broker's answer."""
        return self._command(device.components["say"], text)

    def press(self, device: Device, key: str) -> int:
        """Press a button, and return the broker's answer."""
        entity = device.components[key]
        return self._command(entity, entity.get("payload_press", "PRESS"))

    def _command(self, entity: Mapping[str, Any], payload: str) -> int:
        assert "command_template" not in entity
        return self.publish(entity["command_topic"], payload, entity.get("qos", 0), entity.get("retain", False))
