"""What is made of a robot's presence, whoever wrote it."""

from __future__ import annotations

import json

import pytest

from talkcli.fleet.presence import Presence, rank

SERVER = {"boot": "7r2z", "pid": 4711, "version": "0.1.0"}
HERE = {
    "talk": 1,
    "version": "0.2.0",
    "online": True,
    "session": "9b51",
    "since": 1767225600.25,
    "groups": ["all", "warehouse"],
    "allow": ["say", "cancel"],
    "server": SERVER,
    "later": "a field that is not known yet",
}
#: Values that are neither a string nor a number.
OTHER_VALUES: tuple[object, ...] = (None, True, [], {})


def test_what_a_bridge_says_is_taken_up() -> None:
    found = Presence.read("anna", json.dumps(HERE).encode() + b"\n")
    assert found == Presence(
        "anna", True, "9b51", 1767225600.25, ("all", "warehouse"), ("say", "cancel"), SERVER, "0.2.0"
    )
    known = {name: value for name, value in HERE.items() if name not in ("talk", "later")}
    assert found is not None
    assert found.to_json() == known


def test_what_the_will_says_is_that_it_is_gone_and_of_which_groups_it_was() -> None:
    will = {"talk": 1, "online": False, "session": "9b51", "groups": ["all", "night"]}
    found = Presence.read("anna", json.dumps(will).encode())
    assert found == Presence("anna", online=False, session="9b51", groups=("all", "night"))


@pytest.mark.parametrize(
    "payload",
    [
        *(b"", b"\n", b"[]", b"anna", b'"online"', b"{", b"\xff", b'{"a": 1, "a": 2}'),
        *(b'{"online": true, "since": ' + each + b"}" for each in (b"NaN", b"-Infinity", b"1e999", b"7" * 5000)),
    ],
)
def test_what_is_cleared_or_is_no_object_is_no_presence(payload: bytes) -> None:
    assert Presence.read("anna", payload) is None


@pytest.mark.parametrize("name", ["", "_", "+", "a b", "a" * 60, "\x1b[2J"])
def test_a_name_that_no_robot_can_have_is_none(name: str) -> None:
    assert Presence.read(name, json.dumps(HERE).encode()) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"online": 1, "since": "today", "groups": "all", "allow": None, "server": [], "session": 3, "version": {}},
        {"online": "true", "since": True, "groups": {}, "server": "none"},
        {"groups": [1, None, ["all"]]},
        {"since": 10**19, "session": True, "server": 1e300, "version": 10**19, "allow": {"say": True}},
        {"since": -1e300, "session": ["9b51"], "server": False, "version": None, "allow": [[], {}, 1.5]},
        {},
    ],
)
def test_what_is_not_of_its_form_is_not_said(wrong: dict[str, object]) -> None:
    assert Presence.read("anna", json.dumps(wrong).encode()) == Presence("anna", online=False)


def test_of_groups_those_are_taken_that_can_be_read() -> None:
    found = Presence.read("anna", b'{"online": true, "groups": ["all", 7, "night"]}')
    assert found is not None
    assert found.groups == ("all", "night")


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        ({}, (1767225600.25, "9b51")),
        ({"since": 0}, (0.0, "9b51")),
        ({"online": False}, None),
        *(({"since": wrong}, None) for wrong in (*OTHER_VALUES, "today", 10**19)),
        *(({"session": wrong}, None) for wrong in (*OTHER_VALUES, "", 7)),
    ],
)
def test_only_a_presence_with_a_time_and_a_session_is_compared_with_other_bridges(
    changed: dict[str, object], found: tuple[float, str] | None
) -> None:
    assert rank(Presence.read("anna", json.dumps(HERE | changed).encode())) == found
