"""Reading presence and status from arbitrary payloads, and the selection of robots by `--robot`."""

from __future__ import annotations

import json

import pytest

from talkcli.fleet import topics
from talkcli.fleet.desk.request import Selection, selects_several
from talkcli.fleet.payloads import LastGoal, Presence, RobotStatus, bridge_rank
from talkcli.goals.states import State

SERVER = {"boot": "7r2z", "pid": 4711, "version": "0.1.0"}
HERE = {
    "talk": 1, "version": "0.2.0", "online": True, "session": "9b51", "since": 1767225600.25,
    "groups": ["all", "warehouse"], "allow": ["say", "cancel"], "server": SERVER,
    "tokens": True, "later": "a field that is not known yet",
}  # fmt: skip
LAST = {"id": "door-17", "state": "ABORTED", "reason": "player", "text": "the door", "at": 1767225601.5}
STATUS = {"active": "a-1", "text": "hello", "pending": 3, "paused": True, "last": LAST}
#: Values that are neither a string nor a number.
OTHER_VALUES: tuple[object, ...] = (None, True, [], {})


def presence(fields: object) -> Presence | None:
    return Presence.read("anna", json.dumps(fields).encode() + b"\n")


def status(fields: object) -> RobotStatus | None:
    return RobotStatus.read(json.dumps(fields).encode() + b"\n")


def test_a_presence_is_read_and_written_back() -> None:
    parsed = presence(HERE)
    assert parsed == Presence(
        "anna", True, "9b51", 1767225600.25, ("all", "warehouse"), ("say", "cancel"), SERVER, "0.2.0", True
    )
    assert parsed.to_json() == {name: value for name, value in HERE.items() if name not in ("talk", "later")}
    will = {"talk": 1, "online": False, "session": "9b51", "groups": ["all", "night"]}
    assert presence(will) == Presence("anna", online=False, session="9b51", groups=("all", "night"))


def test_a_status_is_read_and_written_back() -> None:
    parsed = status({**STATUS, "later": "a field that is not known yet"})
    last = LastGoal("door-17", State.ABORTED, "player", "the door", 1767225601.5)
    assert parsed == RobotStatus("a-1", "hello", 3, paused=True, last=last)
    assert parsed.to_json() == STATUS


@pytest.mark.parametrize(
    "payload",
    [
        *(b"", b"\n", b"[]", b"anna", b"3", b'"online"', b"{", b"\xff", b'{"a": 1, "a": 2}'),
        *(b'{"online": true, "since": ' + number + b"}" for number in (b"NaN", b"-Infinity", b"1e999", b"7" * 5000)),
    ],
)
def test_a_payload_that_is_not_a_json_object_is_ignored(payload: bytes) -> None:
    assert (Presence.read("anna", payload), RobotStatus.read(payload)) == (None, None)


@pytest.mark.parametrize("name", ["", "_", "+", "a b", "a" * 60, "\x1b[2J"])
def test_an_invalid_robot_name_is_ignored(name: str) -> None:
    assert Presence.read(name, json.dumps(HERE).encode()) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"online": 1, "since": "today", "groups": "all", "allow": None, "server": [], "session": 3, "version": {}},
        {"online": "true", "since": True, "groups": {}, "server": "none"},
        {"groups": [1, None, ["all"]]},
        {"since": 10**19, "session": True, "server": 1e300, "version": 10**19, "allow": {"say": True}},
        {"since": -1e300, "session": ["9b51"], "server": False, "version": None, "allow": [[], {}, 1.5]},
        {"active": 3, "text": ["hello"], "pending": "many", "paused": "no", "last": "door-17"},
        {"pending": -1, "last": {"id": 3, "state": "ABORTED"}},
        {"pending": None, "last": {"id": "a", "state": "SUNG"}},
        {"last": {"id": "a", "state": ["ABORTED"]}},
        {},
    ],
)
def test_a_malformed_field_counts_as_missing(wrong: dict[str, object]) -> None:
    assert (presence(wrong), status(wrong)) == (Presence("anna", online=False), RobotStatus())


def test_the_valid_parts_of_a_field_are_used() -> None:
    assert presence({"groups": ["all", 7, "night"]}) == Presence("anna", online=False, groups=("all", "night"))
    minimal = {name: value for name, value in LAST.items() if name not in ("text", "reason", "at")}
    assert status({"active": "a", "last": minimal}) == RobotStatus("a", last=LastGoal("door-17", State.ABORTED))
    assert status({"last": {**minimal, "at": True}}) == RobotStatus(last=LastGoal("door-17", State.ABORTED))


@pytest.mark.parametrize(
    ("changed", "rank"),
    [
        ({}, (1767225600.25, "9b51")),
        ({"since": 0}, (0.0, "9b51")),
        ({"online": False}, None),
        *(({"since": wrong}, None) for wrong in (*OTHER_VALUES, "today", 10**19)),
        *(({"session": wrong}, None) for wrong in (*OTHER_VALUES, "", 7)),
    ],
)
def test_only_an_online_presence_with_time_and_session_has_a_rank(
    changed: dict[str, object], rank: tuple[float, str] | None
) -> None:
    assert bridge_rank(presence(HERE | changed)) == rank


# Selection by `--robot`


def robot(name: str, *groups: str, online: bool = True) -> Presence:
    return Presence(name, online, groups=(topics.ALL_ROBOTS, *groups))


CARL = Presence("carl", online=False)  # without groups
FLEET = [robot("anna", "warehouse"), robot("bert", "night", online=False), CARL, robot("wh-01", "warehouse")]
FLEET.append(robot("wh-12"))


@pytest.mark.parametrize(
    ("text", "selected"),
    [
        ("anna", "anna"),
        ("wh-*", "wh-01 wh-12"),
        ("wh-?1", "wh-01"),
        ("wh-[01]2", "wh-12"),
        ("[!a]*", "bert carl wh-01 wh-12"),
        ("*", "anna bert carl wh-01 wh-12"),
        ("*.?", ""),
        ("Anna", ""),
        ("A*", ""),
        ("nn*", ""),
        ("@all", "anna bert carl wh-01 wh-12"),
        ("@warehouse", "anna wh-01"),
        ("@night", "bert"),
        ("@anna", ""),
        ("@ware", ""),
    ],
)
def test_a_selection_matches_by_name_glob_or_group(text: str, selected: str) -> None:
    selection = Selection(text)
    assert (selection.fault, selection.name) == (None, None if selects_several(text) else text)
    assert [robot.name for robot in FLEET if selection.includes(robot)] == selected.split()
    assert selection.group == (text[1:] if text[0] == "@" else None)


@pytest.mark.parametrize(
    ("text", "several"),
    [
        *((text, True) for text in ("*", "wh-*", "a?", "[ab]c", "@all", "@", "a[")),
        *((text, False) for text in ("anna", "wh-01", "r2.d2", "", "a@b", "a]b", "!a")),
    ],
)
def test_a_glob_or_a_group_may_select_several_robots(text: str, several: bool) -> None:
    assert selects_several(text) == several


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("@", "invalid group name ''"),
        ("@a b", "invalid group name 'a b'"),
        ("@@a", "invalid group name '@a'"),
        ("@wh-*", "invalid group name 'wh-*'"),
        ("a b", "invalid robot name 'a b'"),
        ("", "invalid robot name ''"),
        ("a/*", "the pattern 'a/*' can't match any robot"),
        ("ä*", "the pattern 'ä*' can't match any robot"),
        ("wh-[12", "the pattern 'wh-[12' can't match any robot"),
        ("wh-[]", "the pattern 'wh-[]' can't match any robot"),
    ],
)
def test_a_selection_that_can_match_no_robot_is_invalid(text: str, message: str) -> None:
    assert message in str(Selection(text).fault)
