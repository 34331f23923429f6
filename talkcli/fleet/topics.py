"""The topics of a fleet: what is where on the broker, and who may do what there. Pure: names in, names out.

Rules for this file: a topic may be added, never renamed or given another meaning; who is asked for something stands in
the levels before the last, and who asks in the last, since that one an ordinary ACL can tie to a login.
"""

from __future__ import annotations

import re

from talkcli.frozen import frozen
from talkcli.goals.option import MAX_NAME

PREFIX = "talk"
#: What stands below it.
ROBOT, GROUP, REPLY = "robot", "group", "reply"
#: The group that every robot is in.
EVERYBODY = "all"
#: Stands for any level in what is subscribed to.
ANY = "+"
#: What a session's own marker is called, in the place of a robot: no robot can be.
MARKER = "_"
#: Characters of a robot's, a group's or a user's name: a bridge calls itself "mqtt:" and that name at its server.
LONGEST = MAX_NAME - len("mqtt:")
_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{LONGEST - 1}}}")

#: What stands under a robot's name, beside its events and its own presence, status and echo: all that one may ask.
REQUEST, SAY, CANCEL = "request", "say", "cancel"
PRESENCE, STATUS, EVENT, ECHO = "presence", "status", "event", "echo"

#: What Home Assistant logs in as, and so who asks in the topics that it is told of; and the prefix of its own topics.
HOMEASSISTANT = "homeassistant"
#: Where it says that it has begun, or that it is gone.
BIRTH = f"{HOMEASSISTANT}/status"


def fault(name: str) -> str | None:
    """Return what is wrong with a name of a robot, a group or a user, for people; None where it can be one level."""
    if _NAME.fullmatch(name):
        return None
    return f"must be 1 to {LONGEST} of A-Z a-z 0-9 . _ -, the first of them a letter or a digit"


def robot(name: str, *levels: str) -> str:
    """Return a topic of a robot's."""
    return "/".join((PREFIX, ROBOT, name, *levels))


def group(name: str, *levels: str) -> str:
    """Return a topic of a group's."""
    return "/".join((PREFIX, GROUP, name, *levels))


def reply(user: str, session: str, *name: str) -> str:
    """Return where a robot answers a session of this user's; without a name what stands for any robot."""
    return "/".join((PREFIX, REPLY, user, session, *name))


def device(name: str) -> str:
    """Return where Home Assistant is told of a robot: a topic of each robot's own, in none of whose levels is a dot.

    The name is a level of its own, since that alone can an ACL's pattern tie to a login. One with a dot is written in
    another way, below another level, and no two of these alike.
    """
    if "." not in name:
        return "/".join((HOMEASSISTANT, "device", PREFIX, name, "config"))
    written = name.replace("_", "__").replace(".", "_d")
    return "/".join((HOMEASSISTANT, "device", f"{PREFIX}-dots", written, "config"))


@frozen
class Asked:
    """What a topic says of a message that asks a robot for something."""

    #: REQUEST, or SAY or CANCEL, of which the payload is plain text
    kind: str
    #: who asks, as the broker's ACL lets nobody else write there
    user: str


def asked(topic: str) -> Asked | None:
    """Return what a topic that a robot listens to asks for; None where it asks for nothing."""
    prefix, _, rest = topic.partition("/")
    levels = rest.split("/")
    if prefix != PREFIX or len(levels) != 4 or fault(levels[3]):
        return None
    whose, _, kind, user = levels
    known = {"robot": (REQUEST, SAY, CANCEL), "group": (REQUEST,)}.get(whose, ())
    return Asked(kind, user) if kind in known else None


def answer(response: str, user: str, name: str) -> str | None:
    """Return where a robot answers this user, who named this response topic; None where that is not the user's own.

    Nobody may have a robot publish anywhere else: not to another user, and not to another robot.
    """
    levels = response.split("/")
    if levels[:3] != [PREFIX, "reply", user] or len(levels) not in (4, 5) or fault(levels[3]):
        return None
    return reply(user, levels[3], name) if levels[4:] in ([], [name]) else None


def access(operators: tuple[str, ...] = ("OPERATOR",), *, homeassistant: bool = False, name: str | None = None) -> str:
    """Return what mosquitto's `acl_file` has for all robots, each of which logs in by its own name, and for these.

    An operator's lines are by name: mosquitto applies its patterns to everybody who logs in, so that with a pattern for
    operators each robot could command the others. What the patterns for robots give to an operator is a robot of the
    operator's own name, which there is none of, and to read what groups are asked.

    `homeassistant`: with what Home Assistant does, and the robots that it is told of; `name`: one of these, which has a
    line of its own where its name has a dot, since no pattern is for it.
    """
    lines = [
        "# Robots: each logs in by its own name, %u, and is heard under that alone.",
        f"pattern read {robot('%u', REQUEST, '+')}",
        f"pattern read {robot('%u', SAY, '+')}",
        f"pattern read {robot('%u', CANCEL, '+')}",
        f"pattern read {group('+', REQUEST, '+')}",
        f"pattern readwrite {robot('%u', PRESENCE)}",
        f"pattern readwrite {robot('%u', ECHO)}",
        f"pattern write {robot('%u', STATUS)}",
        f"pattern write {robot('%u', EVENT, '+')}",
        f"pattern write {reply('+', '+', '%u')}",
    ]
    if homeassistant:
        lines += [f"pattern write {device('%u')}", f"pattern read {BIRTH}"]
    for each in operators:
        lines += [
            "",
            "# An operator, who may ask every robot, and hear what each says: such lines for each login.",
            f"user {each}",
            f"topic write {robot('+', REQUEST, each)}",
            f"topic write {robot('+', SAY, each)}",
            f"topic write {robot('+', CANCEL, each)}",
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
            f"topic write {robot('+', SAY, HOMEASSISTANT)}",
            f"topic write {robot('+', CANCEL, HOMEASSISTANT)}",
            f"topic read {robot('+', PRESENCE)}",
            f"topic read {robot('+', STATUS)}",
            f"topic readwrite {HOMEASSISTANT}/#",
        ]
    if homeassistant and name is not None and "." in name:
        words = "# A robot of which Home Assistant is told elsewhere: no level of a topic there may have a dot."
        lines += ["", words, f"user {name}", f"topic write {device(name)}"]
    return "\n".join(lines)
