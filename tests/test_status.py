"""`talk status` shows people the server, its queue and one goal, at the width of the terminal."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest

from talkcli.terminal.text import width
from tests.conformance.bareserve import TALK
from tests.support.terminal import Terminal

if TYPE_CHECKING:
    from tests.support.processes import Talk

LONG = "please step back from the door and from the lift " * 3


@pytest.fixture
def busy(scripted: Talk) -> Talk:
    """A server with goals that have ended, one that is being spoken and two that wait."""
    scripted.run("say", "--wait", "length=0")
    scripted.run("say", "--wait", "--", f"fail=audio_lost {LONG}")
    active = scripted.run("say", "--", f"never-ends {LONG}").id
    scripted.watcher.wait_for_word(active)
    scripted.run("say", "--priority", "7", "--key", "battery, low", "--ttl", "90", "battery low")
    scripted.run("say", "--id", "door:open", "--as", "patrol", "the door is open")
    return scripted


def test_it_shows_the_settings_and_all_that_is_known_of_each_goal(busy: Talk) -> None:
    done = busy.run("status")
    lines = done.out.splitlines()
    assert (done.code, done.err) == (0, "")
    assert [each[:9].rstrip() for each in lines] == ["server", "engine", "settings", "now", "queue", "", "said", ""]
    assert re.match(r'now      \w{4}-\d+ +ACTIVE     "never-ends please .*"  from \S.*, for \d+\.\d s$', lines[3])
    assert re.search(r'"battery low"  from \S.*, priority 7, key "battery, low", (1 min )?\d+ s left$', lines[4])
    assert re.search(r'door:open +PENDING    "the door is open"  from "patrol" \(\S.*, pid \d+\)$', lines[5])
    assert "SUCCEEDED" in lines[6]
    assert lines[7].endswith("audio_lost: scripted audio_lost")
    assert LONG in lines[7]  # in a pipe no text is cut that has fewer than 200 characters


@pytest.mark.parametrize("columns", [60, 120])
def test_it_fits_the_terminal(busy: Talk, columns: int) -> None:
    with Terminal([*TALK, "status"], {"TERM": "xterm", **busy.env}, columns) as shown:
        assert shown.finish() == 0
        lines = shown.lines
    assert max(map(width, lines)) <= columns
    words = " ".join(" ".join(lines).split())
    for each in (f"pid {busy.pid} on {busy.socket}", "256 clients", "driver scripted", "voice default", "audio_l"):
        assert each in words
    assert 'from "patrol"' in words
    assert columns < 120 or "priority" in words  # what does not fit is cut at its end
    goals = [each for each in lines if "PENDING" in each]
    assert goals[0].index('"') == goals[1].index('"')
    assert b"\x1b[1;32mACTIVE" in shown.raw


def test_one_goal_is_shown_with_all_that_is_known(busy: Talk) -> None:
    pending = json.loads(busy.run("--json", "status").out)["pending"][0]
    lines = dict(each.split(None, 1) for each in busy.run("status", pending["id"]).out.splitlines())
    assert lines["state"] == "PENDING"
    assert (lines["priority"], lines["key"], lines["text"]) == ("7", '"battery, low"', '"battery low"')
    assert re.fullmatch(r"90 s, (1 min \d+ s|\d+\.\d s) left", lines["ttl"])
    busy.request("say", text="with data", id="d", data={"room": "d'été\x1b"})
    lines = dict(each.split(None, 1) for each in busy.run("status", "d").out.splitlines())
    assert lines["data"] == r'{"room": "d' + "'" + r'été\\u001b"}'
    assert lines["priority"] == "0"
    assert not {"key", "ttl", "started", "reason"} & lines.keys()
    number = pending["id"].partition("-")[2]
    assert f"id       {pending['id']}\n" in busy.run("status", number).out


def test_a_foreign_key_is_escaped_and_a_long_text_is_cut_at_200_characters(scripted: Talk) -> None:
    active = scripted.run("say", "never-ends").id
    scripted.watcher.wait_for_word(active)
    goal_id = scripted.request("say", text="x" * 300, key="a\x1b[31m\n\u202eb")["goal"]["id"]
    for words in (["status"], ["status", goal_id]):
        shown = scripted.run(*words).out
        assert r'"a\x1b[31m\n\u202eb"' in shown
        assert "\x1b" not in shown
    assert f'"{"x" * 200}…"' in scripted.run("status").out
    scripted.run("cancel")


def test_ids_as_long_as_they_may_be_leave_room_for_the_text(scripted: Talk) -> None:
    scripted.run("say", "--id", "i" * 64, "--wait", "length=0")
    for command in ("status", "log"):
        with Terminal([*TALK, command], {"TERM": "xterm", **scripted.env}, 80) as shown:
            shown.finish()
            line = next(each for each in shown.lines if "SUCCEEDED" in each)
        assert width(line) <= 80
        assert '"length=0"' in line
        assert "i" * 64 in scripted.run(command).out


@pytest.mark.parametrize("columns", [60, 120])
def test_one_goal_fits_the_terminal_with_all_of_its_text(scripted: Talk, columns: int) -> None:
    text = f"length=0 {'ten words of which none may be broken by a line ' * 6}".strip()
    scripted.run("say", "--id", "long", "--wait", text)
    with Terminal([*TALK, "status", "long"], {"TERM": "xterm", **scripted.env}, columns) as shown:
        assert shown.finish() == 0
        lines = shown.lines
    assert max(map(width, lines)) <= columns
    first = next(number for number, each in enumerate(lines) if each.startswith("text "))
    more = [each for each in lines[first + 1 :] if each.startswith(" ")]
    assert {each[:9] for each in more} == {" " * 9}
    assert f'"{text}"' in " ".join(each[9:].rstrip() for each in lines)
    assert f'text     "{text}"' in scripted.run("status", "long").out.splitlines()
