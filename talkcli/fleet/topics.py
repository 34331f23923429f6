"""The MQTT topics of a fleet, and the broker's access rules for them.

Rules for this file: no I/O. Topics may be added, but an existing topic is never renamed or reused. The last level of a
request topic is the sender's user name, because MQTT doesn't tell the receiver who sent a message. The access rules tie
that level to the sender's login. The levels before it name the receiving robot or group.
"""

from __future__ import annotations

import re

from talkcli.goals.options import MAX_SENDER_NAME_CHARS

PREFIX = "talk"
ROBOT_LEVEL, _GROUP, _REPLY = "robot", "group", "reply"
#: The group that every robot belongs to.
ALL_ROBOTS = "all"
#: Wildcard that matches any single level of a topic in a subscription.
ANY = "+"
#: Stands for the robot's name in topics on which a client sends messages to itself. It isn't a valid robot name.
MARKER = "_"
#: Prefix of the name under which the server knows a remote client. The client's user name follows.
REMOTE_PREFIX = "mqtt:"
#: Maximum length of a robot, group or user name.
MAX_NAME_CHARS = MAX_SENDER_NAME_CHARS - len(REMOTE_PREFIX)
_NAME_PATTERN = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME_CHARS - 1}}}")

# Topic levels below a robot's name. Clients publish requests to the first three.
REQUEST_LEVELS = REQUEST, PLAIN_SAY, PLAIN_CANCEL = "request", "say", "cancel"
PRESENCE, STATUS, EVENT, ECHO = "presence", "status", "event", "echo"

#: Home Assistant's user name at the broker, and also the prefix of its topics.
HOMEASSISTANT = "homeassistant"
#: Topic on which Home Assistant publishes `online` when it starts.
HOMEASSISTANT_STATUS = f"{HOMEASSISTANT}/status"


def name_fault(name: str) -> str | None:
    """Return why the name of a robot, group or user is invalid. Return None if it is valid."""
    if _NAME_PATTERN.fullmatch(name):
        return None
    return f"must have 1 to {MAX_NAME_CHARS} characters (A-Z a-z 0-9 . _ -), and begin with a letter or a digit"


def robot(name: str, *levels: str) -> str:
    """Build a topic from a robot's name and the levels below it."""
    return "/".join((PREFIX, ROBOT_LEVEL, name, *levels))


def group(name: str, *levels: str) -> str:
    """Build a topic from a group's name and the levels below it."""
    return "/".join((PREFIX, _GROUP, name, *levels))


def reply(user: str, session: str, *robot_name: str) -> str:
    """Return the topic for a robot's replies to one session of a user.

    Without a robot's name, return the response topic for a request to a group.
    """
    return "/".join((PREFIX, _REPLY, user, session, *robot_name))


def homeassistant_device(name: str) -> str:
    """Return the topic of a robot's device description for Home Assistant.

    The robot's name is a whole level, because a pattern in access rules can match a login only against a whole level.
    Home Assistant allows no dots in this level, so a name with a dot is escaped and put below a different level.
    """
    if "." not in name:
        return "/".join((HOMEASSISTANT, "device", PREFIX, name, "config"))
    escaped = name.replace("_", "__").replace(".", "_d")
    return "/".join((HOMEASSISTANT, "device", f"{PREFIX}-dots", escaped, "config"))


def parse_request_topic(topic: str) -> tuple[str, str] | None:
    """Return the kind of request and the user name in a request topic, or None for other topics.

    Returns:
        REQUEST, PLAIN_SAY or PLAIN_CANCEL, and the client's user name. The broker's access rules verify the name.
    """
    levels = topic.split("/")
    if len(levels) != 5 or levels[0] != PREFIX or name_fault(levels[4]):
        return None
    _, receiver, _, kind, user = levels
    kinds = {ROBOT_LEVEL: REQUEST_LEVELS, _GROUP: (REQUEST,)}.get(receiver, ())
    return (kind, user) if kind in kinds else None


def checked_reply_topic(response_topic: str, user: str, robot_name: str) -> str | None:
    """Return the topic for a robot's reply, or None if the user may not choose `response_topic`.

    This prevents users from making a robot publish to other users or to another robot's topic.
    """
    levels = response_topic.split("/")
    if levels[:3] != [PREFIX, _REPLY, user] or len(levels) not in (4, 5) or name_fault(levels[3]):
        return None
    return reply(user, levels[3], robot_name) if levels[4:] in ([], [robot_name]) else None


def access_rules(
    operators: tuple[str, ...] = ("OPERATOR",),
    *,
    homeassistant: bool = False,
    addon: bool = False,
    name: str | None = None,
) -> str:
    """Return the content of mosquitto's `acl_file` for a fleet.

    Robots are covered by patterns, because each robot logs in under its own name. Operators are listed by name, because
    mosquitto applies patterns to all users. With a pattern for operators, each robot could command the others. The
    patterns for robots also apply to operators, which is harmless. They only let operators read requests to groups, and
    use the topics of a nonexistent robot with the operator's name.

    Args:
        operators: the users who may command every robot.
        homeassistant: whether to add the rules for Home Assistant.
        addon: whether the broker is Home Assistant's Mosquitto add-on. The add-on and Home Assistant need unrestricted
            access to it, as its documentation says.
        name: a robot that is shown in Home Assistant. A name with a dot gets its own rule, because the pattern for the
            other robots doesn't match its topic.
    """
    lines = [
        "# Robots: each robot logs in with its own name (%u), and may only publish under this name.",
        *(f"pattern read {robot('%u', level, '+')}" for level in REQUEST_LEVELS),
        f"pattern read {group('+', REQUEST, '+')}",
        f"pattern readwrite {robot('%u', PRESENCE)}",
        f"pattern readwrite {robot('%u', ECHO)}",
        f"pattern write {robot('%u', STATUS)}",
        f"pattern write {robot('%u', EVENT, '+')}",
        f"pattern write {reply('+', '+', '%u')}",
    ]
    if homeassistant or addon:
        lines += [f"pattern write {homeassistant_device('%u')}", f"pattern read {HOMEASSISTANT_STATUS}"]
    for each in operators:
        lines += [
            "",
            "# An operator may send requests to all robots and read their messages. Add these lines for each operator.",
            f"user {each}",
            *(f"topic write {robot('+', level, each)}" for level in REQUEST_LEVELS),
            f"topic write {group('+', REQUEST, each)}",
            f"topic read {robot('+', PRESENCE)}",
            f"topic read {robot('+', STATUS)}",
            f"topic read {robot('+', EVENT, '+')}",
            f"topic readwrite {reply(each, '+', '+')}",
        ]
    if addon:
        lines += [
            "",
            "# Home Assistant's own logins need unrestricted access. Every other login needs its own rules, too.",
            *(line for user in (HOMEASSISTANT, "addons") for line in (f"user {user}", "topic readwrite #")),
        ]
    elif homeassistant:
        lines += [
            "",
            "# Home Assistant may send requests to robots, read their messages, and use topics under homeassistant/.",
            f"user {HOMEASSISTANT}",
            *(f"topic write {robot('+', level, HOMEASSISTANT)}" for level in REQUEST_LEVELS),
            f"topic read {robot('+', PRESENCE)}",
            f"topic read {robot('+', STATUS)}",
            f"topic read {robot('+', EVENT, '+')}",
            f"topic readwrite {HOMEASSISTANT}/#",
        ]
    if (homeassistant or addon) and name is not None and "." in name:
        words = "# Home Assistant does not allow dots in names, so this robot uses a different topic."
        lines += ["", words, f"user {name}", f"topic write {homeassistant_device(name)}"]
    return "\n".join(lines)
