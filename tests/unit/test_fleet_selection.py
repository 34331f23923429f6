"""The robots that `--robot` means: by a name, a glob, or a group."""

from __future__ import annotations

import pytest

from talkcli.fleet import topics
from talkcli.fleet.presence import Presence
from talkcli.fleet.selection import Selection, several


def robot(name: str, *groups: str, online: bool = True) -> Presence:
    return Presence(name, online, groups=(topics.EVERYBODY, *groups))


CARL = Presence("carl", online=False)  # which says nothing of its groups
FLEET = [robot("anna", "warehouse"), robot("bert", "night", online=False), CARL, robot("wh-01", "warehouse")]
FLEET.append(robot("wh-12"))


@pytest.mark.parametrize(
    ("text", "picked"),
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
def test_a_selection_picks_by_name_by_glob_and_by_group(text: str, picked: str) -> None:
    selection = Selection(text)
    assert (selection.fault, selection.only) == (None, None if several(text) else text)
    assert [each.name for each in FLEET if selection.picks(each)] == picked.split()
    assert selection.group == (text[1:] if text[0] == "@" else None)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        *((text, True) for text in ("*", "wh-*", "a?", "[ab]c", "@all", "@", "a[")),
        *((text, False) for text in ("anna", "wh-01", "r2.d2", "", "a@b", "a]b", "!a")),
    ],
)
def test_a_glob_or_a_group_may_mean_several(text: str, found: bool) -> None:
    assert several(text) == found


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("@", "no group can be called ''"),
        ("@a b", "no group can be called 'a b'"),
        ("@@a", "no group can be called '@a'"),
        ("@wh-*", "no group can be called 'wh-*'"),
        ("a b", "no robot can be called 'a b'"),
        ("", "no robot can be called ''"),
        ("a/*", "the glob 'a/*' matches no robot's name"),
        ("ä*", "the glob 'ä*' matches no robot's name"),
        ("wh-[12", "the glob 'wh-[12' matches no robot's name"),
        ("wh-[]", "the glob 'wh-[]' matches no robot's name"),
    ],
)
def test_a_selection_that_can_pick_no_robot_has_a_fault(text: str, words: str) -> None:
    assert words in str(Selection(text).fault)
