"""The table of a fleet's robots at any terminal width."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.fleet.desk.table import COLUMN_NAMES, FleetTranscript, format_robots
from talkcli.fleet.payloads import LastGoal, Presence, RobotInfo, RobotStatus
from talkcli.frozen import replace
from talkcli.goals.states import State
from talkcli.protocol.events import StateChanged, from_json
from talkcli.terminal.text import MIN_COLUMNS, Screen, printable, width

NOW = 1_000_000.0
ANNA = RobotInfo(
    Presence("anna", online=True, since=NOW - 900, server={"version": "0.1.0"}),
    RobotStatus(
        "a-1", "please step back, the doors are closing now", 2, last=LastGoal("a-0", State.SUCCEEDED, at=NOW - 10)
    ),
)
GONE = RobotInfo(
    Presence("bert", online=False),
    RobotStatus("b-1", "said long ago", 3, last=LastGoal("b-0", State.ABORTED, at=NOW - 7200)),
)

#: The columns that are shown without --long.
SHORT_NAMES = ("ROBOT", "ONLINE", "SPEAKING", "QUEUE", "LAST")

TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=60)
TIMES = st.none() | st.floats(-1e9, 2 * NOW)
PRESENCES = st.builds(
    Presence, st.text("abcXYZ019._-", min_size=1, max_size=59), online=st.booleans(), since=TIMES,
    server=st.none() | st.fixed_dictionaries({"version": TEXTS}),
)  # fmt: skip
STATUSES = st.builds(
    RobotStatus, active=st.none() | TEXTS, text=st.none() | TEXTS, pending=st.integers(0, 10_000), paused=st.booleans(),
    last=st.none() | st.builds(LastGoal, st.just("a-0"), st.sampled_from(State), at=TIMES),
)  # fmt: skip
ROBOTS = st.builds(RobotInfo, PRESENCES, st.none() | STATUSES)


def anna(**changes: Any) -> RobotInfo:
    """Return ANNA with other values in the status."""
    return RobotInfo(ANNA.presence, replace(ANNA.status, **changes))


def cells(robot: RobotInfo) -> list[str]:
    """Return the cells of a robot's line in a table of unlimited width."""
    header, line = format_robots([robot], Screen(long=True), NOW)
    places = [*(header.index(name) for name in COLUMN_NAMES), None]
    return [line[start:end].strip() for start, end in pairwise(places)]


@given(st.lists(ROBOTS, max_size=3), st.integers(1, 200), st.booleans())
def test_no_line_is_wider_than_the_terminal(robots: list[RobotInfo], columns: int, colour: bool) -> None:
    lines = format_robots(robots, Screen(columns, colour), NOW)
    assert len(lines) == len(robots) + 1
    assert max(map(width, lines)) <= max(columns, MIN_COLUMNS)
    header, *lines = format_robots(robots, Screen(), NOW)  # in a pipe nothing is cut
    assert header.split() == list(SHORT_NAMES)
    for robot, line in zip(robots, lines, strict=True):
        presence, status = robot.presence, robot.status or RobotStatus()
        assert line.startswith(f"{presence.name} ")
        if presence.online and presence.server and status.active is not None and status.text is not None:
            assert f'"{printable(status.text)}"' in line


@pytest.mark.parametrize(
    ("robot", "shown"),
    [
        (anna(active=None, text=None), ["anna", "yes", "0.1.0", "-", "2", "SUCCEEDED 10 s", "15 min"]),
        (GONE, ["bert", "OFFLINE", "-", "-", "-", "ABORTED 2 h", "-"]),
        (
            RobotInfo(replace(ANNA.presence, server=None), replace(ANNA.status, last=None)),
            ["anna", "no server", "-", "-", "-", "-", "15 min"],
        ),
        (RobotInfo(ANNA.presence, None), ["anna", "yes", "0.1.0", "-", "0", "-", "15 min"]),
    ],
)
def test_a_robot_is_shown_with_all_known_facts(robot: RobotInfo, shown: list[str]) -> None:
    assert cells(robot) == shown


@pytest.mark.parametrize(
    ("robot", "shown"),
    [
        (anna(text="hello"), '"hello"'),
        (anna(text=None), "a-1"),
        (anna(text="hello", paused=True), 'PAUSED "hello"'),
        (anna(active=None, text=None, paused=True), "PAUSED"),
        (anna(text="\x1b[2J\n\u202e"), r'"\x1b[2J\n\u202e"'),
    ],
)
def test_the_speaking_column_shows_text_or_id_and_a_pause(robot: RobotInfo, shown: str) -> None:
    assert cells(robot)[3] == shown


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(-5, "0 s"), (0.9, "0 s"), (59.9, "59 s"), (60, "1 min"), (3599, "59 min"), (7200, "2 h"), (1e6, "11 d")],
)
def test_a_time_is_shown_as_its_age(seconds: float, shown: str) -> None:
    """A robot's clock may be ahead of the desk's."""
    robot = RobotInfo(replace(ANNA.presence, since=NOW - seconds), replace(ANNA.status, text=""))
    assert cells(robot)[-1] == shown


@pytest.mark.parametrize(
    ("columns", "long", "headers"),
    [
        (120, True, COLUMN_NAMES),
        (80, True, COLUMN_NAMES),
        (64, True, COLUMN_NAMES[:-1]),
        (48, True, COLUMN_NAMES[:-2]),
        (120, False, SHORT_NAMES),
        (80, False, SHORT_NAMES),
        (56, False, SHORT_NAMES),
        (40, False, ("ROBOT", "ONLINE", "SPEAKING", "QUEUE")),
    ],
)
def test_the_text_is_cut_first_and_then_columns_are_dropped(columns: int, long: bool, headers: tuple[str, ...]) -> None:
    header, first, bert = format_robots([ANNA, GONE], Screen(columns, long=long), NOW)
    assert tuple(header.split()) == headers
    assert '"please ste' in first
    assert ("doors are" in first) == (columns > 100 or (columns == 80 and not long))
    assert "OFFLINE" in bert


def test_columns_line_up_despite_wide_characters() -> None:
    lines = format_robots([ANNA, anna(text="请往后退，门即将关闭，请注意安全")], Screen(80), NOW)
    ends = {width(line[: line.index("2  ")]) for line in lines[1:]}
    assert len(ends) == 1


def test_states_have_their_colours() -> None:
    header, first, bert = format_robots([ANNA, GONE], Screen(120, colour=True), NOW)
    assert header.startswith("\x1b[1mROBOT")
    assert '\x1b[1;32m"please' in first
    assert "\x1b[31mOFFLINE\x1b[0m" in bert


@pytest.mark.parametrize("moment", [1e300, -1e300, 1e15, -1e15])
def test_a_robot_with_an_impossible_time_is_still_shown(moment: float) -> None:
    goal = {"id": "odd", "state": "SUCCEEDED", "text": "hello", "created_at": moment, "ended_at": moment, "at": moment}
    event = from_json({"event": "state", "id": "odd", "state": "SUCCEEDED", "at": moment, "n": 1, "goal": goal})
    presence = Presence.read("anna", json.dumps({"online": True, "since": moment}).encode())
    status = RobotStatus.read(json.dumps({"last": goal}).encode())
    assert presence
    assert status
    assert status.last
    assert isinstance(event, StateChanged)
    assert format_robots([RobotInfo(presence, status)], Screen(), NOW)[1].split()[:3] == ["anna", "no", "server"]
    transcript = FleetTranscript(full=True)
    assert "SUCCEEDED" in transcript.lines("anna", event, Screen(), NOW)[0]
    assert transcript.change_lines(None, presence, Screen(), NOW)
