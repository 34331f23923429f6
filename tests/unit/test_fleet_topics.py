"""The topics of a fleet: what a name may be, what a topic asks for, and where an answer may go."""

from __future__ import annotations

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
def test_what_would_be_another_topic_is_no_name(name: str) -> None:
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
        ("talk/robot/anna/presence", None),
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
        ("talk/reply/otto/7f", None),
        ("talk/robot/bert/request/anna", None),
        ("talk/reply/olga/+", None),
        ("talk/reply/olga/7f/#", None),
        ("homeassistant/light", None),
    ],
)
def test_a_robot_answers_nobody_but_who_asked(response: str, answer: str | None) -> None:
    assert topics.answer(response, "olga", "anna") == answer


def test_an_operator_is_let_in_by_name_and_a_robot_by_its_own() -> None:
    lines = topics.access(("olga", "ha")).splitlines()
    assert [each for each in lines if each.startswith("user ")] == ["user olga", "user ha"]
    before, _, behind = "\n".join(lines).partition("user olga")
    assert "topic" not in before.replace("# ", "")
    assert "pattern" not in behind
    assert "topic write talk/robot/+/request/olga" in lines
