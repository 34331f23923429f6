"""The messages that robots of a fleet publish.

Rules for this file: no I/O. Any client of the broker may have written a received payload, so invalid fields are treated
as missing.

Rules for `homeassistant_device`: use only keys that Home Assistant documents, and values from presence, status or
events. Write templates that mean the same in Jinja and in Python, because tests evaluate them in Python. Never rename a
component, because Home Assistant would treat it as a new one.
"""

from __future__ import annotations

from talkcli.errors import BadRequest
from talkcli.fleet import topics
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.goal import Goal, read_fields
from talkcli.goals.states import EXIT_CODES, State
from talkcli.protocol.events import StateChanged
from talkcli.protocol.lines import decode, encode

if TYPE_CHECKING:
    from collections.abc import Collection

    from talkcli.goals.goal import JsonObject


@frozen
class Message:
    """An MQTT message."""

    topic: str
    payload: bytes
    #: whether the publisher asked the broker to retain the message
    retained: bool = False
    #: topic for the reply; None if the sender doesn't want one
    response: str | None = None
    #: data that the reply must repeat; None if the message has none
    correlation: bytes | None = None
    #: seconds until the message expires; None if it never does
    expiry: float | None = None
    #: a token of the robot, which shows how old a request is; None if there is none
    token: str | None = None


@frozen
class Presence:
    """A robot's presence: whether it is online, and details of its bridge and server."""

    name: str
    online: bool = False
    #: random id of the bridge process; "" if unknown
    session: str = ""
    #: Unix timestamp of the bridge's start, by the robot's clock; None if the robot is offline
    since: float | None = None
    groups: tuple[str, ...] = ()
    #: requests that remote clients may send to the robot, such as `say`
    allow: tuple[str, ...] = ()
    #: boot id, pid, version and features of the robot's server; None if the server isn't running
    server: JsonObject | None = None
    #: version of the bridge; "" if the robot is offline
    version: str = ""
    #: whether the robot's replies to `hello` contain tokens
    tokens: bool = False

    @classmethod
    def read(cls, name: str, payload: bytes) -> Presence | None:
        """Parse a presence message. Return None if it is invalid.

        An empty payload, which clears a retained presence, also counts as invalid.
        """
        said = _decode_object(payload)
        if said is None or topics.name_fault(name):
            return None
        return cls(**{**read_fields(cls, said), "name": name})

    def to_json(self) -> JsonObject:
        """Return the presence as a JSON object, without the robot's name."""
        said = {**fields(self), "groups": list(self.groups), "allow": list(self.allow)}
        del said["name"]
        return said


def bridge_rank(presence: Presence | None) -> tuple[float, str] | None:
    """Return a bridge's rank. Of several bridges with the same name, the one with the lowest rank stays.

    The other bridges exit. Return None if the bridge is offline.
    """
    if presence is None or presence.since is None or not (presence.online and presence.session):
        return None
    return presence.since, presence.session


@frozen
class LastGoal:
    """The goal that ended most recently on a robot."""

    id: str
    state: State
    reason: str | None = None
    #: the goal's text; None if the robot keeps texts private
    text: str | None = None
    #: Unix timestamp of the goal's end, by the robot's clock
    at: float | None = None


@frozen
class RobotStatus:
    """A robot's active goal, the number of pending goals, and the goal that ended last."""

    #: id of the active goal; None if there is none
    active: str | None = None
    #: the active goal's text; None if the robot keeps texts private
    text: str | None = None
    #: number of pending goals
    pending: int = 0
    paused: bool = False
    last: LastGoal | None = None

    @classmethod
    def read(cls, payload: bytes) -> RobotStatus | None:
        """Parse a status message. Return None if it is invalid."""
        said = _decode_object(payload)
        if said is None:
            return None
        last = read_fields(LastGoal, said.pop("last", None))
        found = read_fields(cls, said)
        found["pending"] = max(0, found.get("pending", 0))
        return cls(**found, last=LastGoal(**last) if "id" in last and "state" in last else None)

    def events(self) -> list[StateChanged]:
        """Return events that describe the last goal and the active goal in this status."""
        last, found = self.last, []
        if last:
            ended = Goal(last.id, last.state, last.text, last.reason, ended_at=last.at)
            found.append(StateChanged(last.id, last.state, last.at, goal=ended))
        if self.active is not None:
            spoken = Goal(self.active, State.ACTIVE, self.text)
            found.append(StateChanged(self.active, State.ACTIVE, goal=spoken))
        return found

    def to_json(self) -> JsonObject:
        """Return the status as a JSON object."""
        last = self.last
        return {**fields(self), "last": None if last is None else {**fields(last), "state": last.state.name}}


@frozen
class RobotInfo:
    """A robot's presence and its latest status."""

    presence: Presence
    #: the latest status, even if the robot is offline now; None if unknown
    status: RobotStatus | None

    def to_json(self) -> JsonObject:
        """Return the robot's name, presence and status as a JSON object."""
        status = None if self.status is None else self.status.to_json()
        return {"robot": self.presence.name, "presence": self.presence.to_json(), "status": status}


def _decode_object(payload: bytes) -> JsonObject | None:
    """Decode a JSON object. Return None if the payload contains anything else."""
    try:
        return decode(payload.strip())
    except BadRequest:
        return None


# -- Home Assistant

#: Template that shows whether the robot can speak, based on the presence payload.
_AVAILABLE = "{{ 'online' if value_json.online and value_json.server else 'offline' }}"
# These templates extract values from the status payload. Home Assistant shows `None` as unknown.
_STATE_TEMPLATE = "{{ 'paused' if value_json.paused else 'speaking' if value_json.active else 'idle' }}"
_SPEAKING_TEMPLATE = "{{ 'ON' if value_json.active and not value_json.paused else 'OFF' }}"
_LAST_TEMPLATE = "{{ value_json.last.state if value_json.last else None }}"
_PAUSED_TEMPLATE = "{{ 'ON' if value_json.paused else 'OFF' }}"
#: Names of all end states.
_END_STATES = [each.name for each in EXIT_CODES]
#: Maximum length of a text in an event. Home Assistant doesn't record events with more than 16 KiB.
_MAX_EVENT_TEXT_CHARS = 1_000
#: Template that turns a `state` event into an event of Home Assistant if the goal has ended. Home Assistant ignores an
#: empty object.
_END_TEMPLATE = (
    "{{ (dict(event_type=value_json.state, id=value_json.id, key=value_json.goal.key, "
    f"text=(value_json.goal.text or '')[:{_MAX_EVENT_TEXT_CHARS}], reason=value_json.goal.reason, "
    f"message=value_json.goal.message, by=value_json.goal.by) if value_json.state in {_END_STATES} else {{}}) "
    "| tojson }}"
)
# Home Assistant inserts the message of the action `notify.send_message` as `value`. It can't set a TTL for the message.
_SAY_TEMPLATE = "{{ dict(request='say', text=value, ttl=30) | tojson }}"
_INTERRUPT_TEMPLATE = "{{ dict(request='say', text=value, preempt=True, priority=10, ttl=10) | tojson }}"
#: The requests that each component sends. The other components send none.
_NEEDED_REQUESTS = {
    "say": ("say",),
    "interrupt": ("say",),
    "cancel": ("cancel",),
    "paused": ("pause", "resume"),
}


def homeassistant_device(name: str, allow: Collection[str], version: str) -> Message:
    """Return the message that adds a robot to Home Assistant.

    Args:
        name: the robot's name.
        allow: requests that the robot accepts. The components for other requests are sent empty, so that Home Assistant
            removes them.
        version: the bridge's version.
    """
    identifier, status, allowed = f"{topics.PREFIX}-{name}", topics.robot(name, topics.STATUS), frozenset(allow)
    components = {
        "say": _component("notify", None, "bullhorn", command_template=_SAY_TEMPLATE),
        "interrupt": _component("notify", "Interrupt", "bullhorn-variant", command_template=_INTERRUPT_TEMPLATE),
        "cancel": _component("button", "Cancel", "stop", payload_press='{"request": "cancel"}'),
        "paused": _component(
            "switch",
            "Paused",
            "pause",
            state_topic=status,
            value_template=_PAUSED_TEMPLATE,
            state_on="ON",
            state_off="OFF",
            payload_on='{"request": "pause"}',
            payload_off='{"request": "resume"}',
        ),
        "state": _component(
            "sensor",
            "State",
            "account-voice",
            state_topic=status,
            value_template=_STATE_TEMPLATE,
            device_class="enum",
            options=["idle", "speaking", "paused"],
        ),
        "speaking": _component(
            "binary_sensor", "Speaking", "volume-high", state_topic=status, value_template=_SPEAKING_TEMPLATE
        ),
        "pending": _component(
            "sensor",
            "Pending",
            "tray-full",
            state_topic=status,
            value_template="{{ value_json.pending }}",
            state_class="measurement",
            entity_category="diagnostic",
        ),
        "last": _component(
            "sensor",
            "Last result",
            "message-check",
            state_topic=status,
            value_template=_LAST_TEMPLATE,
            device_class="enum",
            options=_END_STATES,
            entity_category="diagnostic",
            json_attributes_topic=status,
            json_attributes_template="{{ (value_json.last or {}) | tojson }}",
        ),
        "ended": _component(
            "event",
            "Sentence ended",
            "message-text-clock",
            state_topic=topics.robot(name, topics.EVENT, "state"),
            value_template=_END_TEMPLATE,
            event_types=_END_STATES,
        ),
    }
    for key, component in components.items():
        needed = _NEEDED_REQUESTS.get(key, ())
        if needed:
            component["command_topic"] = topics.robot(name, topics.REQUEST, topics.HOMEASSISTANT)
        component["unique_id"] = f"{identifier}-{key}"
        if not allowed.issuperset(needed):
            components[key] = {"platform": component["platform"]}
    payload: JsonObject = {
        "device": {
            "identifiers": [identifier],
            "name": name,
            "manufacturer": "talk",
            "model": "Speaking robot",
            "sw_version": version,
        },
        "origin": {"name": "talk", "sw_version": version},
        "availability": [{"topic": topics.robot(name, topics.PRESENCE), "value_template": _AVAILABLE}],
        "components": components,
    }
    return Message(topics.homeassistant_device(name), encode(payload), retained=True)


def _component(platform: str, name: str | None, icon: str, **keys: object) -> JsonObject:
    """Return a component of a Home Assistant device, with these keys."""
    return {"platform": platform, "name": name, "icon": f"mdi:{icon}", "qos": 1, **keys}
