"""Which robots `--robot` means: names, globs, groups, and what picks nobody."""

from __future__ import annotations

import pytest

from talkcli.fleet import topics
from talkcli.fleet.presence import Presence
from talkcli.fleet.selection import Selection, several


def robot(name: str, *groups: str, online: bool = True) -> Presence:
    return Presence(name, online, groups=(topics.EVERYBODY, *groups))


FLEET = [robot("anna", "warehouse"), robot("bert", "night", online=False), robot("wh-01", "warehouse"), robot("wh-12")]


@pytest.mark.parametrize(
    ("text", "picked"),
    [
        ("anna", ["anna"]),
        ("wh-*", ["wh-01", "wh-12"]),
        ("wh-?1", ["wh-01"]),
        ("wh-[01]2", ["wh-12"]),
        ("[!a]*", ["bert", "wh-01", "wh-12"]),
        ("*", ["anna", "bert", "wh-01", "wh-12"]),
        ("*.?", []),
        ("Anna", []),
        ("A*", []),
        ("nn*", []),
        ("@all", ["anna", "bert", "wh-01", "wh-12"]),
        ("@warehouse", ["anna", "wh-01"]),
        ("@night", ["bert"]),
        ("@anna", []),
        ("@ware", []),
    ],
)
def test_it_picks_by_name_by_glob_and_by_group(text: str, picked: list[str]) -> None:
    selection = Selection(text)
    assert selection.fault is None
    assert [each.name for each in FLEET if selection.picks(each)] == picked


def test_everybody_is_of_all_also_one_that_says_nothing_of_groups() -> None:
    assert Selection("@all").picks(Presence("carl", online=False))
    assert not Selection("@night").picks(Presence("carl", online=False))


@pytest.mark.parametrize("text", ["*", "wh-*", "a?", "[ab]c", "@all", "@warehouse", "@", "a["])
def test_what_may_be_several(text: str) -> None:
    assert several(text)


@pytest.mark.parametrize("text", ["anna", "wh-01", "r2.d2", "", "a@b", "a]b", "!a"])
def test_what_is_one_at_most(text: str) -> None:
    assert not several(text)


@pytest.mark.parametrize(("text", "group"), [("@all", "all"), ("@a", "a"), ("all", None), ("a*", None)])
def test_a_group_is_known_by_its_name(text: str, group: str | None) -> None:
    assert Selection(text).group == group


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("@", "no group can be called ''"),
        ("@a b", "no group can be called 'a b'"),
        ("@wh-*", "no group can be called 'wh-*'"),
        ("a b", "no robot can be called 'a b'"),
        ("", "no robot can be called ''"),
        ("a/*", "the glob 'a/*' matches no robot's name"),
        ("ä*", "the glob 'ä*' matches no robot's name"),
        ("wh-[12", "the glob 'wh-[12' matches no robot's name"),
        ("wh-[]", "the glob 'wh-[]' matches no robot's name"),
    ],
)
def test_what_can_pick_nobody_is_a_fault(text: str, words: str) -> None:
    fault = Selection(text).fault
    assert fault
    assert words in fault
