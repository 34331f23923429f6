"""What may be asked of a goal: ranges of options and the form of ids, at their limits and just outside."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals.admission import MAX_KEY, MAX_PRIORITY, bad_option, bad_setting, is_clients_id
from talkcli.goals.requests import Say, Set
from talkcli.server import run

NO_SECONDS: list[object] = [-1, -0.001, math.nan, math.inf, -math.inf, 10**400, -(10**400)]
GOOD: list[tuple[str, list[object]]] = [
    ("rate", [80, 200, 450]),
    ("volume", [0, 0.0, 0.5, 1, 1.0]),
    ("pitch", [0, 50, 100]),
    ("voice", ["en", "default", "French (France)"]),
    ("ttl", [0, 0.0, 0.001, 5, 86_400.0]),
    ("throttle", [0, 0.0, 0.5, 60]),
    ("priority", [0, -1, 1, MAX_PRIORITY, -MAX_PRIORITY]),
    ("key", ["b", "a" * MAX_KEY, "battery low!", "é日"]),
]
BAD: list[tuple[str, list[object]]] = [
    ("rate", [79, 451, 0, -200, 10**400]),
    ("volume", [-0.001, 1.001, 2, -1, math.nan, math.inf, 10**400]),
    ("pitch", [-1, 101, 10**400]),
    ("voice", [""]),
    ("ttl", NO_SECONDS),
    ("throttle", NO_SECONDS),
    ("priority", [MAX_PRIORITY + 1, -MAX_PRIORITY - 1, 10**400]),
    ("key", ["", "a" * (MAX_KEY + 1)]),
]
SETTINGS = {"rate", "volume", "pitch", "voice", "ttl"}
OWN_IDS = [
    *("a", "A", ".", "_", ":", "/", "a" * 64, "1.", "1-1", "_-_", "a/b", "/patrol/goal-1", "/arm-1-1712.5"),
    *("arm-1", "goal-1", "task-2", "move-10", "wp01-3", "2024-12", "k3fz-12"),  # of four characters and a number
    *("4K7F-1", "4k7f-", "4k7f-x", "4k7f", "4k7-1", "4k7ff-1", "4k7f-1-1", "a4k7f-1", "44k7-1", "4k77-1", "4kf7-1"),
]
OTHER_IDS = [
    *("", "1", "007", "4k7f-1", "0a0a-0", "9z9z-00012", "-", "-a", "-1", "a" * 65),
    *("a b", "a\n", "4k7f-1\n", "é", "a\0", "１", "٣", "ａ", "a,b", "a\\b", "\ud800"),
]


def short(value: object) -> str:
    return ascii(value)[:24]


def options(table: list[tuple[str, list[object]]]) -> list[tuple[str, object]]:
    return [(name, value) for name, values in table for value in values]


@pytest.mark.parametrize(("name", "value"), [*options(GOOD), *[("id", each) for each in OWN_IDS]], ids=short)
def test_an_option_within_its_limits_is_taken(name: str, value: object) -> None:
    assert bad_option(Say("hi", **{name: value})) is None  # type: ignore[arg-type]
    if name in SETTINGS:
        assert bad_setting(Set(**{name: value})) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "value"), [*options(BAD), *[("id", each) for each in OTHER_IDS]], ids=short)
def test_an_option_out_of_its_limits_is_refused_and_named(name: str, value: object) -> None:
    for preempt in (None, True):
        words = bad_option(Say("hi", preempt=preempt, **{name: value}))  # type: ignore[arg-type]
        assert words is not None
        assert name in words
    if name in SETTINGS:
        assert name in str(bad_setting(Set(**{name: value})))  # type: ignore[arg-type]


def test_nothing_asked_for_is_nothing_wrong() -> None:
    assert bad_option(Say("hi")) is None
    assert bad_setting(Set()) is None


def test_flush_without_preempt_is_a_contradiction() -> None:
    assert bad_option(Say("hi", flush=True)) is None
    assert bad_option(Say("hi", flush=True, preempt=True)) is None
    assert "flush" in str(bad_option(Say("hi", flush=True, preempt=False)))


@pytest.mark.parametrize("format_", ["ssml", "", "TEXT", "a" * 5_000])
def test_no_other_format_than_text(format_: str) -> None:
    words = bad_option(Say("hi", format=format_))
    assert words is not None
    assert len(words) < 200


@given(
    st.text(alphabet=st.sampled_from("aZ09._:/-") | st.characters(), max_size=70)
    | st.from_regex(r"[0-9a-z]{4}-[0-9]{1,3}", fullmatch=True)
)
def test_an_id_is_the_servers_or_a_clients_and_never_both(goal_id: str) -> None:
    plain = re.fullmatch(r"[A-Za-z0-9._:/-]{1,64}", goal_id) is not None and not goal_id.startswith("-")
    servers = re.fullmatch(r"[0-9][a-z][0-9][a-z]-[0-9]+|[0-9]+", goal_id) is not None
    assert is_clients_id(goal_id) == (plain and not servers)


def test_an_id_of_a_server_is_no_client_s() -> None:
    assert not [boot for boot in (run._boot() for _ in range(1_000)) if is_clients_id(f"{boot}-1")]
