"""The topics of a fleet: names, what a topic asks for, where an answer may go, and who may use which topic."""

from __future__ import annotations

import re

import pytest

from talkcli.fleet import topics
from talkcli.fleet.topics import Asked
from talkcli.goals.option import MAX_NAME


@pytest.mark.parametrize("name", ["a", "anna", "wh-07", "r2.d2", "A_1", "0", "a" * 59])
def test_a_name_is_one_level_of_a_topic(name: str) -> None:
    assert topics.fault(name) is None
    assert len(f"mqtt:{name}") <= MAX_NAME


@pytest.mark.parametrize(
    "name", ["", "_", "-a", ".a", "a/b", "+", "#", "a+", "$SYS", "a b", "ä", "a\n", "a\0", "a" * 60, "%u"]
)
def test_a_name_that_would_be_another_topic_is_refused(name: str) -> None:
    assert topics.fault(name)


@pytest.mark.parametrize(
    ("topic", "asked"),
    [
        ("talk/robot/anna/request/olga", Asked("request", "olga")),
        ("talk/robot/anna/say/olga", Asked("say", "olga")),
        ("talk/robot/anna/cancel/olga", Asked("cancel", "olga")),
        ("talk/group/all/request/olga", Asked("request", "olga")),
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
def test_a_topic_says_what_is_asked_and_by_whom(topic: str, asked: Asked | None) -> None:
    assert topics.asked(topic) == asked


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
def test_a_robot_answers_nobody_but_the_asker(response: str, answer: str | None) -> None:
    assert topics.answer(response, "olga", "anna") == answer


# Who may use which topic, by the rules for mosquitto

ROBOTS, USERS = ("anna", "r2.d2"), ("anna", "r2.d2", "olga", "homeassistant", "otto")
ASKS, TOLD, GROUPS = ("request", "say", "cancel"), ("presence", "status", "event/state"), ("all", "warehouse")
DEVICES = {"anna": "homeassistant/device/talk/anna/config", "r2.d2": "homeassistant/device/talk-dots/r2_dd2/config"}
TOPICS = {
    *(f"talk/robot/{robot}/{kind}/{user}" for robot in ROBOTS for kind in ASKS for user in USERS),
    *(f"talk/robot/{robot}/{kind}" for robot in ROBOTS for kind in (*TOLD, "echo")),
    *(f"talk/group/{group}/request/{user}" for group in GROUPS for user in USERS),
    *(f"talk/reply/{user}/session/{name}" for user in USERS for name in (*ROBOTS, "_")),
    *(*DEVICES.values(), topics.BIRTH, "talk", "talk/robot/anna", "elsewhere"),
}


def may(way: str, login: str, rules: str) -> set[str]:
    """Return the topics that mosquitto would let this login write or read by these rules."""
    found: list[str] = []
    user = None
    for kind, *words in (each.split() for each in rules.splitlines() if each):
        if kind == "user":
            (user,) = words
        elif kind == "pattern" or (kind == "topic" and user == login):
            assert kind == "topic" or user is None  # what comes after a user would be read as that user's
            found += [words[1].replace("%u", login)] if words[0] in (way, "readwrite") else []
    levels = [each.replace(".", r"\.").replace("+", "[^/]+").replace("#", ".*") for each in found]
    return {topic for topic in TOPICS if any(re.fullmatch(each, topic) for each in levels)}


def writes(login: str, *, homeassistant: bool) -> set[str]:
    found = set()
    if login in ROBOTS:
        found |= {f"talk/robot/{login}/{kind}" for kind in (*TOLD, "echo")}
        found |= {DEVICES[login]} if homeassistant else set()
    if login == "olga":
        found |= {f"talk/robot/{robot}/{kind}/olga" for robot in ROBOTS for kind in ASKS}
        found |= {f"talk/group/{group}/request/olga" for group in GROUPS}
        found |= {f"talk/reply/olga/session/{name}" for name in (*ROBOTS, "_")}
    if login == "homeassistant" and homeassistant:
        found |= {f"talk/robot/{robot}/{kind}/{login}" for robot in ROBOTS for kind in ("say", "cancel")}
        found |= {*DEVICES.values(), topics.BIRTH}
    return found | {each for each in TOPICS if each.startswith("talk/reply/") and each.endswith(f"/{login}")}


def reads(login: str, *, homeassistant: bool) -> set[str]:
    """By the patterns anybody hears what groups are asked, as a robot does."""
    found = {f"talk/group/{group}/request/{user}" for group in GROUPS for user in USERS}
    if login in ROBOTS:
        found |= {f"talk/robot/{login}/{kind}/{user}" for kind in ASKS for user in USERS}
        found |= {f"talk/robot/{login}/{kind}" for kind in ("presence", "echo")}
    if login == "olga":
        found |= {f"talk/robot/{robot}/{kind}" for robot in ROBOTS for kind in TOLD}
        found |= {f"talk/reply/olga/session/{name}" for name in (*ROBOTS, "_")}
    if login == "homeassistant" and homeassistant:
        found |= {f"talk/robot/{robot}/{kind}" for robot in ROBOTS for kind in ("presence", "status")}
        found |= set(DEVICES.values())
    return found | ({topics.BIRTH} if homeassistant else set())


@pytest.mark.parametrize("homeassistant", [False, True])
@pytest.mark.parametrize("login", USERS)
def test_each_login_may_use_its_own_topics_and_no_others(login: str, homeassistant: bool) -> None:
    rules = topics.access(("olga",), homeassistant=homeassistant, name="r2.d2")
    assert may("write", login, rules) == writes(login, homeassistant=homeassistant)
    assert may("read", login, rules) == reads(login, homeassistant=homeassistant)


def test_each_operator_has_the_same_lines() -> None:
    robots, olga, ha = topics.access(("olga", "ha")).split("\n\n")
    assert f"{robots}\n\n{olga}" == topics.access(("olga",))
    assert ha == olga.replace("olga", "ha")


def test_only_a_name_with_a_dot_has_a_line_of_its_own() -> None:
    rules = topics.access(("olga",), homeassistant=True, name="anna")
    assert rules == topics.access(("olga",), homeassistant=True)
    assert {*topics.access(("olga",), name="r2.d2").splitlines()} < {*rules.splitlines()}
    # mosquitto's manual: %u must be the only text of its level.
    assert {each for line in rules.splitlines()[1:] for each in re.findall(r"[^/ ]*%u[^/ ]*", line)} == {"%u"}
