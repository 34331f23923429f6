"""The messages that robots of a fleet publish.

Rules for this file: no I/O. Any client of the broker may have written a received payload, so invalid fields are treated
as missing.

Rules for `homeassistant_device`: use only keys that Home Assistant documents, and values from presence or status. Write
templates that mean the same in Jinja and in Python, because tests evaluate them in Python. Never rename a component,
because Home Assistant would treat it as a new one.
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


def homeassistant_device(name: str, allow: Collection[str], version: str) -> Message:
    """Return the message that adds a robot to Home Assistant.

    Args:
        name: the robot's name.
        allow: requests that the robot accepts. The components for other requests are sent empty, so that Home Assistant
            removes them.
        version: the bridge's version.
    """
    identifier = f"{topics.PREFIX}-{name}"
    components = {
        "say": _command(name, topics.PLAIN_SAY, "notify", None, allowed="say" in allow),
        "cancel": _command(name, topics.PLAIN_CANCEL, "button", "Cancel", allowed="cancel" in allow),
        "state": _sensor(name, "State", _STATE_TEMPLATE, device_class="enum", options=["idle", "speaking", "paused"]),
        "speaking": _sensor(name, "Speaking", _SPEAKING_TEMPLATE, platform="binary_sensor"),
        "pending": _sensor(name, "Pending", "{{ value_json.pending }}", state_class="measurement"),
        "last": _sensor(
            name,
            "Last result",
            _LAST_TEMPLATE,
            device_class="enum",
            options=[each.name for each in EXIT_CODES],
            json_attributes_topic=topics.robot(name, topics.STATUS),
            json_attributes_template="{{ (value_json.last or {}) | tojson }}",
        ),
    }
    for key, component in components.items():
        if len(component) > 1:
            component["unique_id"] = f"{identifier}-{key}"
    payload: JsonObject = {
        "device": {"identifiers": [identifier], "name": name, "model": "talk", "sw_version": version},
        "origin": {"name": "talk", "sw_version": version},
        "availability": [{"topic": topics.robot(name, topics.PRESENCE), "value_template": _AVAILABLE}],
        "components": components,
    }
    return Message(topics.homeassistant_device(name), encode(payload), retained=True)


def _command(robot: str, topic_level: str, platform: str, label: str | None, *, allowed: bool) -> JsonObject:
    """Return a Home Assistant component that sends a request to the robot.

    If the request isn't allowed, the component is empty.
    """
    if not allowed:
        return {"platform": platform}
    topic = topics.robot(robot, topic_level, topics.HOMEASSISTANT)
    return {"platform": platform, "command_topic": topic, "qos": 1, "name": label}


def _sensor(robot: str, label: str, template: str, platform: str = "sensor", **more: object) -> JsonObject:
    """Return a Home Assistant component that shows part of the robot's status."""
    topic = topics.robot(robot, topics.STATUS)
    return {"platform": platform, "name": label, "state_topic": topic, "value_template": template, "qos": 1, **more}
