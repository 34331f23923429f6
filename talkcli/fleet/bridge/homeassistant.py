"""How Home Assistant is told of a robot: one payload of its MQTT discovery, of which it makes a device. Pure.

Rules for this file: every key is one that Home Assistant documents, and of a robot it is told nothing that presence and
status don't have; what becomes of those there is a template, in words that Jinja and Python read alike. A component
is never renamed: what was made of it there would be another's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.fleet import topics
from talkcli.goals.states import EXIT_CODES
from talkcli.protocol.lines import encode

if TYPE_CHECKING:
    from collections.abc import Collection

    from talkcli.goals.goal import JsonObject

#: What Home Assistant says of itself once it has begun.
ONLINE = b"online"

#: What becomes of presence: whether a sentence would be spoken.
_AVAILABLE = "{{ 'online' if value_json.online and value_json.server else 'offline' }}"
#: What becomes of status. `None` is a state that isn't known.
_STATE = "{{ 'paused' if value_json.paused else 'speaking' if value_json.active else 'idle' }}"
_SPEAKING = "{{ 'ON' if value_json.active and not value_json.paused else 'OFF' }}"
_PENDING = "{{ value_json.pending }}"
_LAST = "{{ value_json.last.state if value_json.last else None }}"
_LAST_IN_FULL = "{{ (value_json.last or {}) | tojson }}"


def device(name: str, allow: Collection[str], version: str) -> tuple[str, bytes]:
    """Return where Home Assistant is told of a robot, and what.

    `allow`: the kinds of requests that it takes. What it doesn't take is told, too, as a component without anything:
    Home Assistant forgets the one that it may have had.
    """
    known = f"{topics.PREFIX}-{name}"
    components = {
        "say": _asking(name, topics.SAY, "notify", {"name": None}, told="say" in allow),
        "cancel": _asking(name, topics.CANCEL, "button", {"name": "Cancel"}, told="cancel" in allow),
        "state": _telling(name, "State", _STATE, device_class="enum", options=["idle", "speaking", "paused"]),
        "speaking": _telling(name, "Speaking", _SPEAKING, platform="binary_sensor"),
        "pending": _telling(name, "Pending", _PENDING, state_class="measurement"),
        "last": _telling(
            name,
            "Last result",
            _LAST,
            device_class="enum",
            options=[each.name for each in EXIT_CODES],
            json_attributes_topic=topics.robot(name, topics.STATUS),
            json_attributes_template=_LAST_IN_FULL,
        ),
    }
    for key, each in components.items():
        if len(each) > 1:
            each["unique_id"] = f"{known}-{key}"
    found: JsonObject = {
        "device": {"identifiers": [known], "name": name, "model": "talk", "sw_version": version},
        "origin": {"name": "talk", "sw_version": version},
        "availability": [{"topic": topics.robot(name, topics.PRESENCE), "value_template": _AVAILABLE}],
        "components": components,
    }
    return topics.device(name), encode(found)


def _asking(name: str, kind: str, platform: str, more: JsonObject, *, told: bool) -> JsonObject:
    """Return a component by which Home Assistant asks for something; without anything, where it is not to be `told`."""
    if not told:
        return {"platform": platform}
    return {"platform": platform, "command_topic": topics.robot(name, kind, topics.HOMEASSISTANT), "qos": 1, **more}


def _telling(name: str, shown: str, template: str, platform: str = "sensor", **more: object) -> JsonObject:
    """Return a component that shows something of the status."""
    topic = topics.robot(name, topics.STATUS)
    return {"platform": platform, "name": shown, "state_topic": topic, "value_template": template, "qos": 1, **more}
