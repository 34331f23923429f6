"""`talk cancel --key`: what was sent with a key, whether it is spoken or waits."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK, run

if TYPE_CHECKING:
    from tests.support.processes import Talk


@pytest.fixture
def ids(scripted: Talk) -> list[str]:
    """One goal that is spoken and two that wait, with the keys battery, door and battery."""
    active = scripted.run("say", "--key", "battery", "never-ends").id
    scripted.watcher.wait_for_word(active)
    return [active, *(scripted.run("say", "--key", key, "waits").id for key in ("door", "battery"))]


def test_key_cancels_what_is_spoken_and_what_waits(scripted: Talk, ids: list[str]) -> None:
    done = scripted.run("cancel", "--key", "battery")
    assert (done.code, set(done.out.split()), done.err) == (0, {ids[0], ids[2]}, "")
    assert scripted.goal(ids[0])["state"] == "PREEMPTED"
    assert scripted.goal(ids[2])["state"] == "RECALLED"
    assert scripted.watcher.wait_for_terminal(ids[1]) == "SUCCEEDED"


def test_selectors_add_up(scripted: Talk, ids: list[str]) -> None:
    done = scripted.run("--json", "cancel", "--key", "door", ids[2])
    assert {json.loads(each)["id"] for each in done.out.splitlines()} == {ids[1], ids[2]}
    assert scripted.goal(ids[0])["state"] == "ACTIVE"
    assert scripted.run("cancel", "--key", "nothing", "--current").id == ids[0]


def test_nothing_with_that_key_is_success(scripted: Talk, ids: list[str]) -> None:
    for key in ("nothing", "batter", "BATTERY", "-"):
        done = scripted.run("cancel", "--key", key)
        assert (done.code, done.out, done.err) == (0, "", "")
    assert scripted.goal(ids[0])["state"] == "ACTIVE"
    scripted.run("cancel")


@pytest.mark.parametrize("words", [["--key", ""], ["--before", ""], ["--key="], ["--key", "k" * 65]])
def test_a_selector_that_selects_nothing_is_no_cancel_of_everything(
    scripted: Talk, ids: list[str], words: list[str]
) -> None:
    done = scripted.run("cancel", *words)
    assert (done.code, done.out) == (2, "")
    assert "key" in done.err or "--before" in done.err
    assert scripted.goal(ids[0])["state"] == "ACTIVE"
    scripted.run("cancel")


def test_help_tells_of_it(scripted: Talk) -> None:
    done = run([*TALK, "cancel", "--help"], {**scripted.env, "COLUMNS": "80"})
    assert "--key KEY" in done.out
    assert all(len(each) <= 80 for each in done.out.splitlines())
