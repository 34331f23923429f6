"""The output of `talk status` and `talk set` for people and scripts."""

from __future__ import annotations

import contextlib
import json
import re
from typing import TYPE_CHECKING

import pytest

from talkcli.terminal.text import width
from tests.conformance.bareserve import TALK
from tests.support.processes import Talk
from tests.support.screen import Terminal

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk

LONG = "please step back from the door and from the lift " * 3
DEFAULTS = {"rate": "200", "volume": "1", "voice": "default", "pitch": "50", "preempt": "no", "ttl": "0"}


# talk status


@pytest.fixture
def busy(scripted: Talk) -> Talk:
    """A server with two ended goals, an active one and two pending ones."""
    scripted.run("say", "--wait", "length=0")
    scripted.run("say", "--wait", "--", f"fail=audio_lost {LONG}")
    active = scripted.run("say", "--", f"never-ends {LONG}").id
    scripted.watcher.wait_for_word(active)
    scripted.run("say", "--priority", "7", "--key", "battery, low", "--ttl", "90", "battery low")
    scripted.run("say", "--id", "door:open", "--as", "patrol", "the door is open")
    return scripted


def test_status_shows_the_settings_and_the_details_of_each_goal(busy: Talk) -> None:
    done = busy.run("status")
    lines = done.out.splitlines()
    assert (done.code, done.err) == (0, "")
    assert [line[:9].rstrip() for line in lines] == ["server", "engine", "settings", "now", "queue", "", "said", ""]
    assert re.match(r'now      \d+ +ACTIVE     "never-ends please .*"  from \S.*, for \d+\.\d s$', lines[3])
    assert re.search(r'"battery low" +from \S.*, priority 7, key "battery, low", (1 min )?\d+ s left$', lines[4])
    assert re.search(r'door:open +PENDING    "the door is open"  from "patrol"$', lines[5])
    assert "SUCCEEDED" in lines[6]
    assert lines[7].endswith("audio_lost: scripted audio_lost")
    assert LONG in lines[7]  # a pipe gets up to 200 characters of each text
    long = busy.run("status", "-l").out.splitlines()
    assert re.match(r"now      \w{4}-\d+ +ACTIVE ", long[3])
    assert re.search(r'"the door is open" +from "patrol" \(\S.*, pid \d+\)$', long[5])


def test_status_of_one_goal_shows_all_its_details(busy: Talk) -> None:
    pending = json.loads(busy.run("--json", "status").out)["pending"][0]
    lines = dict(line.split(None, 1) for line in busy.run("status", pending["id"]).out.splitlines())
    assert lines["state"] == "PENDING"
    assert (lines["priority"], lines["key"], lines["text"]) == ("7", '"battery, low"', '"battery low"')
    assert re.fullmatch(r"90 s, (1 min \d+ s|\d+\.\d s) left", lines["ttl"])
    busy.request("say", text="x" * 300)
    assert f'"{"x" * 200}…"' in busy.run("status").out
    busy.request("say", text="with data", id="d", data={"room": "d'été\x1b"})
    lines = dict(line.split(None, 1) for line in busy.run("status", "d").out.splitlines())
    assert lines["data"] == r'{"room": "d' + "'" + r'été\\u001b"}'
    assert lines["priority"] == "0"
    assert not {"key", "ttl", "started", "reason"} & lines.keys()
    number = pending["id"].partition("-")[2]
    assert f"id       {pending['id']}\n" in busy.run("status", number).out


def test_status_of_one_goal_wraps_its_whole_text_to_the_terminal(scripted: Talk) -> None:
    text = f"length=0 {'ten words of which none may be broken by a line ' * 6}".strip()
    scripted.run("say", "--id", "long", "--wait", text)
    with Terminal([*TALK, "status", "long"], {"TERM": "xterm", **scripted.env}, 60) as shown:
        assert shown.finish() == 0
        lines = shown.lines
    assert max(map(width, lines)) <= 60
    first = next(number for number, line in enumerate(lines) if line.startswith("text "))
    more = [line for line in lines[first + 1 :] if line.startswith(" ")]
    assert {line[:9] for line in more} == {" " * 9}
    assert f'"{text}"' in " ".join(line[9:].rstrip() for line in lines)
    assert f'text     "{text}"' in scripted.run("status", "long").out.splitlines()


# talk set


@pytest.fixture(scope="module")
def server() -> Iterator[Talk]:
    """A server for all tests that change only settings. `shared` restores the settings."""
    with contextlib.closing(Talk(scripted=True)) as talk:
        assert talk.run("voices").code == 0  # now the server knows its voices
        yield talk
        talk.stop()


@pytest.fixture
def shared(server: Talk) -> Talk:
    """The same server, with its initial settings."""
    assert server.request("set", rate=200, volume=1.0, voice="default", pitch=50, preempt=False, ttl=0)["ok"]
    return server


def settings(talk: Talk) -> dict[str, str]:
    """Return the settings as `talk set` prints them."""
    done = talk.run("set")
    assert (done.code, done.err) == (0, "")
    return dict(line.split() for line in done.out.splitlines())


def test_set_without_options_prints_the_settings(shared: Talk) -> None:
    assert settings(shared) == DEFAULTS
    done = shared.run("set", "--json")
    assert json.loads(done.out) == {
        "rate": 200, "volume": 1.0, "voice": None, "pitch": 50, "preempt": False, "ttl": None,
    }  # fmt: skip
    assert done.out.count("\n") == 1
    done = shared.run("set", "--rate", "200")
    assert (done.code, done.out, done.err) == (0, "", "")


@pytest.mark.parametrize(
    ("options", "name", "value", "shown"),
    [
        (["--rate", "80"], "rate", 80, "80"),
        (["--volume", "0.25"], "volume", 0.25, "0.25"),
        (["--volume", "0"], "volume", 0.0, "0"),
        (["--voice", "en"], "voice", "en", "en"),
        (["--voice", "default"], "voice", None, "default"),
        (["--pitch", "100"], "pitch", 100, "100"),
        (["--preempt"], "preempt", True, "yes"),
        (["--no-preempt"], "preempt", False, "no"),
        (["--ttl", "2.5"], "ttl", 2.5, "2.5"),
        (["--ttl", "0"], "ttl", None, "0"),
    ],
)
def test_set_changes_only_this_setting(shared: Talk, options: list[str], name: str, value: object, shown: str) -> None:
    changed = json.loads(shared.run("--json", "set", *options).out)
    assert changed[name] == value
    assert settings(shared) == {**DEFAULTS, name: shown}
    described = shared.request("status")["server"]
    assert {setting: described[setting] for setting in changed} == changed


def test_an_unknown_voice_is_refused_with_a_suggestion(shared: Talk) -> None:
    done = shared.run("set", "--rate", "150", "--voice", "scirpted")
    assert (done.code, done.out) == (2, "")
    assert "did you mean 'scripted'?" in done.err
    error = json.loads(shared.run("--json", "set", "--voice", "x\x1b[31my").err)["error"]
    assert (error["code"], error["exit"]) == ("unknown_voice", 2)
    assert "\x1b" not in error["message"]
    assert settings(shared) == DEFAULTS


def test_serve_starts_with_the_settings_from_its_options(make_talk: MakeTalk) -> None:
    talk = make_talk("--ttl", "0.5", "--rate", "100", "--pitch", "40", "--preempt", "--lead-in", "250", scripted=True)
    assert settings(talk) == {**DEFAULTS, "ttl": "0.5", "rate": "100", "pitch": "40", "preempt": "yes"}
    server = json.loads(talk.run("--json", "status").out)["server"]
    assert (server["ttl"], server["lead_in"]) == (0.5, 250)
    status = talk.run("status").out
    assert "ttl 0.5 s" in status
    assert "lead-in 250 ms" in status
