"""The topics of a fleet: valid names, request topics, reply topics, and access rules."""

from __future__ import annotations

import re

import pytest

from talkcli.fleet import topics
from talkcli.goals.options import MAX_SENDER_NAME_CHARS


@pytest.mark.parametrize("name", ["a", "anna", "wh-07", "r2.d2", "A_1", "0", "a" * 59])
def test_a_valid_name_is_accepted_and_fits_into_a_sender_name(name: str) -> None:
    assert topics.name_fault(name) is None
    assert len(f"mqtt:{name}") <= MAX_SENDER_NAME_CHARS


@pytest.mark.parametrize(
    "name", ["", "_", "-a", ".a", "a/b", "+", "#", "a+", "$SYS", "a b", "ä", "a\n", "a\0", "a" * 60, "%u"]
)
def test_a_name_that_is_not_a_plain_topic_level_is_refused(name: str) -> None:
    assert topics.name_fault(name)


@pytest.mark.parametrize(
    ("topic", "parsed"),
    [
        ("talk/robot/anna/request/olga", ("request", "olga")),
        ("talk/robot/anna/say/olga", ("say", "olga")),
        ("talk/robot/anna/cancel/olga", ("cancel", "olga")),
        ("talk/group/all/request/olga", ("request", "olga")),
        ("talk/group/all/say/olga", None),
        ("talk/robot/anna/echo", None),
        ("talk/robot/anna/event/state", None),
        ("talk/robot/anna/request/olga/more", None),
        ("talk/robot/anna/request/", None),
        ("talk/robot/anna/request/ol ga", None),
        ("talk/reply/olga/request/anna", None),
        ("talks/robot/anna/request/olga", None),
        ("", None),
    ],
)
def test_a_topic_contains_the_request_and_the_user(topic: str, parsed: tuple[str, str] | None) -> None:
    assert topics.parse_request_topic(topic) == parsed


@pytest.mark.parametrize(
    ("response", "answer"),
    [
        ("talk/reply/olga/7f", "talk/reply/olga/7f/anna"),
        ("talk/reply/olga/7f/anna", "talk/reply/olga/7f/anna"),
        ("talk/reply/olga/7f/bert", None),
        ("talk/reply/olga/7f/anna/more", None),
        ("talk/reply/olga", None),
        ("talk/reply/olga/", None),
        ("talk/reply/olga//anna", None),
        ("talk/reply/otto/7f", None),
        ("talk/robot/bert/request/anna", None),
        ("talk/robot/anna/presence", None),
        ("talk/reply/olga/+", None),
        ("talk/reply/olga/7f/#", None),
        ("homeassistant/light", None),
    ],
)
def test_a_robot_replies_only_to_the_remote_clients_own_topic(response: str, answer: str | None) -> None:
    assert topics.checked_reply_topic(response, "olga", "anna") == answer


# The access control list

ROBOT = {
    "read": "robot/%u/request/+ robot/%u/say/+ robot/%u/cancel/+ robot/%u/presence robot/%u/echo group/+/request/+",
    "write": "robot/%u/presence robot/%u/status robot/%u/event/+ robot/%u/echo reply/+/+/%u",
}
OPERATOR = {
    "read": "robot/+/presence robot/+/status robot/+/event/+ reply/olga/+/+",
    "write": "robot/+/request/olga robot/+/say/olga robot/+/cancel/olga group/+/request/olga reply/olga/+/+",
}
HOME = {
    "read": "robot/+/presence robot/+/status robot/+/event/+",
    "write": "robot/+/request/homeassistant robot/+/say/homeassistant robot/+/cancel/homeassistant",
}


def may(way: str, login: str | None, rules: str) -> set[str]:
    """Return the topics that a login may read or write. If the login is None, return the patterns."""
    allowed, user = set(), None
    for kind, *words in (line.split() for line in rules.splitlines() if line):
        if kind == "user":
            (user,) = words
        elif kind in ("pattern", "topic"):
            assert (kind == "topic") == (user is not None)  # mosquitto would apply a later pattern to that user only
            allowed |= {words[1]} if user == login and words[0] in (way, "readwrite") else set()
    return allowed


def full_topics(names: str) -> set[str]:
    return {f"talk/{topic}" for topic in names.split()}


@pytest.mark.parametrize("way", ["read", "write"])
def test_each_login_may_use_only_its_own_topics(way: str) -> None:
    """If a pattern had %u in the place of the user, each robot could command the others."""
    rules = topics.access_rules(("olga",), name="r2.d2")
    assert may(way, None, rules) == full_topics(ROBOT[way])
    assert may(way, "olga", rules) == full_topics(OPERATOR[way])
    assert may(way, "homeassistant", rules) == may(way, "r2.d2", rules) == set()
    rules = topics.access_rules(("olga",), homeassistant=True, name="r2.d2")
    own = {"read": topics.HOMEASSISTANT_STATUS, "write": "homeassistant/device/talk/%u/config"}
    assert may(way, None, rules) == full_topics(ROBOT[way]) | {own[way]}
    assert may(way, "olga", rules) == full_topics(OPERATOR[way])
    assert may(way, "homeassistant", rules) == full_topics(HOME[way]) | {"homeassistant/#"}
    dotted = {"homeassistant/device/talk-dots/r2_dd2/config"} if way == "write" else set()
    assert may(way, "r2.d2", rules) == dotted


def test_home_assistants_logins_are_unrestricted_on_its_add_on() -> None:
    rules = topics.access_rules(("olga",), addon=True, name="r2.d2")
    for login in ("homeassistant", "addons"):
        assert may("read", login, rules) == may("write", login, rules) == {"#"}
    for robot_or_operator in (None, "olga", "r2.d2"):
        plain = topics.access_rules(("olga",), homeassistant=True, name="r2.d2")
        assert may("write", robot_or_operator, rules) == may("write", robot_or_operator, plain)


def test_all_operators_have_the_same_rules() -> None:
    robots, olga, ha = topics.access_rules(("olga", "ha")).split("\n\n")
    assert f"{robots}\n\n{olga}" == topics.access_rules(("olga",))
    assert ha == olga.replace("olga", "ha")


def test_only_a_name_with_a_dot_has_its_own_rule() -> None:
    rules = topics.access_rules(("olga",), homeassistant=True, name="anna")
    assert rules == topics.access_rules(("olga",), homeassistant=True)
    assert {*topics.access_rules(("olga",), name="r2.d2").splitlines()} < {*rules.splitlines()}
    # mosquitto's manual: %u must be the only text of its level.
    assert {level for line in rules.splitlines()[1:] for level in re.findall(r"[^/ ]*%u[^/ ]*", line)} == {"%u"}
