"""The topics of a fleet on the broker, and the access rules for them.

Pure. Rules for this file: topics may be added, but never renamed or given another meaning. The last level of a topic
names the client that asks, because a broker's access rules can tie only that level to a login. The levels before it
name the robot or group that is asked.
"""

from __future__ import annotations

import re

from talkcli.frozen import frozen
from talkcli.goals.options import MAX_SENDER_NAME_CHARS

PREFIX = "talk"
ROBOT_LEVEL, _GROUP, _REPLY = "robot", "group", "reply"
#: The group of all robots.
ALL_ROBOTS = "all"
#: Matches any level in a subscription.
ANY = "+"
#: Takes the place of the robot in the topic that a desk publishes to itself. No robot can have this name.
MARKER = "_"
#: Beginning of the name by which the server knows a remote client; the client's user name follows.
REMOTE_PREFIX = "mqtt:"
#: Longest name of a robot, a group or a user.
MAX_NAME_CHARS = MAX_SENDER_NAME_CHARS - len(REMOTE_PREFIX)
_NAME_PATTERN = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME_CHARS - 1}}}")

# The levels below a robot's name. A client sends to the first three.
REQUEST, PLAIN_SAY, PLAIN_CANCEL = "request", "say", "cancel"
PRESENCE, STATUS, EVENT, ECHO = "presence", "status", "event", "echo"

#: Home Assistant's user name at the broker, and the prefix of its own topics.
HOMEASSISTANT = "homeassistant"
#: Where Home Assistant says whether it is running.
HOMEASSISTANT_STATUS = f"{HOMEASSISTANT}/status"


def name_fault(name: str) -> str | None:
    """Return why a robot, a group or a user can't have this name, in words for people. None if it can."""
    if _NAME_PATTERN.fullmatch(name):
        return None
    return f"must be 1 to {MAX_NAME_CHARS} of A-Z a-z 0-9 . _ -, the first of them a letter or a digit"


def robot(name: str, *levels: str) -> str:
    """Return the topic with these levels below a robot's name."""
    return "/".join((PREFIX, ROBOT_LEVEL, name, *levels))


def group(name: str, *levels: str) -> str:
    """Return the topic with these levels below a group's name."""
    return "/".join((PREFIX, _GROUP, name, *levels))


def reply(user: str, session: str, *robot_name: str) -> str:
    """Return the topic on which a robot answers a session of this user.

    Without a robot's name, return the response topic for a request to several robots.
    """
    return "/".join((PREFIX, _REPLY, user, session, *robot_name))


def homeassistant_device(name: str) -> str:
    """Return the topic where Home Assistant reads the description of a robot.

    The name is a level of its own, because a pattern in access rules can tie only a whole level to a login. Home
    Assistant allows no dots in these levels, so a name with a dot is escaped and put below another level.
    """
    if "." not in name:
        return "/".join((HOMEASSISTANT, "device", PREFIX, name, "config"))
    escaped = name.replace("_", "__").replace(".", "_d")
    return "/".join((HOMEASSISTANT, "device", f"{PREFIX}-dots", escaped, "config"))


@frozen
class RequestTopic:
    """The parts of a topic on which a client sends requests to a robot."""

    #: REQUEST, PLAIN_SAY or PLAIN_CANCEL
    kind: str
    #: the client's user name, which the broker's access rules check
    user: str


def parse_request(topic: str) -> RequestTopic | None:
    """Return the parts of a topic for requests, None if it is another topic."""
    prefix, _, rest = topic.partition("/")
    levels = rest.split("/")
    if prefix != PREFIX or len(levels) != 4 or name_fault(levels[3]):
        return None
    receiver, _, kind, user = levels
    kinds = {ROBOT_LEVEL: (REQUEST, PLAIN_SAY, PLAIN_CANCEL), _GROUP: (REQUEST,)}.get(receiver, ())
    return RequestTopic(kind, user) if kind in kinds else None


def checked_reply(response: str, user: str, robot_name: str) -> str | None:
    """Return the topic on which a robot answers this user, None if the response topic is not the user's own.

    So nobody can make a robot publish to another user or to another robot.
    """
    levels = response.split("/")
    if levels[:3] != [PREFIX, _REPLY, user] or len(levels) not in (4, 5) or name_fault(levels[3]):
        return None
    return reply(user, levels[3], robot_name) if levels[4:] in ([], [robot_name]) else None


def access_rules(
    operators: tuple[str, ...] = ("OPERATOR",), *, homeassistant: bool = False, name: str | None = None
) -> str:
    """Return the content of mosquitto's `acl_file` for a fleet.

    Robots are covered by patterns, because each logs in by its own name. Operators are listed by name: mosquitto
    applies patterns to everybody, so a pattern for operators would let each robot command the others. The patterns for
    robots do no harm to that: they let operators read requests to groups, and use the topics of a robot that has the
    operator's name, which doesn't exist.

    Args:
        operators: the users who may command every robot.
        homeassistant: whether to add the rules for Home Assistant.
        name: a robot that Home Assistant knows. If its name has a dot, no pattern matches, so it gets its own rule.
    """
    lines = [
        "# Robots: each logs in by its own name, %u, and is heard under that alone.",
        f"pattern read {robot('%u', REQUEST, '+')}",
        f"pattern read {robot('%u', PLAIN_SAY, '+')}",
        f"pattern read {robot('%u', PLAIN_CANCEL, '+')}",
        f"pattern read {group('+', REQUEST, '+')}",
        f"pattern readwrite {robot('%u', PRESENCE)}",
        f"pattern readwrite {robot('%u', ECHO)}",
        f"pattern write {robot('%u', STATUS)}",
        f"pattern write {robot('%u', EVENT, '+')}",
        f"pattern write {reply('+', '+', '%u')}",
    ]
    if homeassistant:
        lines += [f"pattern write {homeassistant_device('%u')}", f"pattern read {HOMEASSISTANT_STATUS}"]
    for each in operators:
        lines += [
            "",
            "# An operator, who may ask every robot, and hear what each says: such lines for each login.",
            f"user {each}",
            f"topic write {robot('+', REQUEST, each)}",
            f"topic write {robot('+', PLAIN_SAY, each)}",
            f"topic write {robot('+', PLAIN_CANCEL, each)}",
            f"topic write {group('+', REQUEST, each)}",
            f"topic read {robot('+', PRESENCE)}",
            f"topic read {robot('+', STATUS)}",
            f"topic read {robot('+', EVENT, '+')}",
            f"topic readwrite {reply(each, '+', '+')}",
        ]
    if homeassistant:
        lines += [
            "",
            "# Home Assistant, which may have every robot speak and be silent; its own topics are its own.",
            f"user {HOMEASSISTANT}",
            f"topic write {robot('+', PLAIN_SAY, HOMEASSISTANT)}",
            f"topic write {robot('+', PLAIN_CANCEL, HOMEASSISTANT)}",
            f"topic read {robot('+', PRESENCE)}",
            f"topic read {robot('+', STATUS)}",
            f"topic readwrite {HOMEASSISTANT}/#",
        ]
    if homeassistant and name is not None and "." in name:
        words = "# A robot of which Home Assistant is told elsewhere: no level of a topic there may have a dot."
        lines += ["", words, f"user {name}", f"topic write {homeassistant_device(name)}"]
    return "\n".join(lines)
