"""`talk cancel --key`: cancels the goals with a key, whether they are being spoken or wait."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.support.processes import Talk


@pytest.fixture
def ids(scripted: Talk) -> list[str]:
    """Return the ids of a goal that is being spoken and of two that wait, with the keys battery, door and battery."""
    active = scripted.run("say", "--key", "battery", "never-ends").id
    scripted.watcher.wait_for_word(active)
    return [active, *(scripted.run("say", "--key", key, "waits").id for key in ("door", "battery"))]


def test_a_key_cancels_the_goal_being_spoken_and_those_that_wait(scripted: Talk, ids: list[str]) -> None:
    for key in ("nothing", "batter", "BATTERY", "-"):
        done = scripted.run("cancel", "--key", key)
        assert (done.code, done.out, done.err) == (0, "", "")
    assert scripted.goal(ids[0])["state"] == "ACTIVE"
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


def test_a_wrong_selector_cancels_nothing(scripted: Talk, ids: list[str]) -> None:
    for words in (["--key", ""], ["--before", ""], ["--key="], ["--key", "k" * 65]):
        done = scripted.run("cancel", *words)
        assert (done.code, done.out) == (2, "")
        assert "key" in done.err or "--before" in done.err
    assert scripted.goal(ids[0])["state"] == "ACTIVE"
    scripted.run("cancel")
