"""`talk set` changes and prints the running server's settings; `talk serve` starts with some."""

from __future__ import annotations

import contextlib
import json
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK, environment, run
from tests.golden import surface
from tests.support.processes import Talk
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk

DEFAULTS = {"rate": "200", "volume": "1", "voice": "default", "pitch": "50", "preempt": "no", "ttl": "0"}


@pytest.fixture(scope="module")
def server() -> Iterator[Talk]:
    """A server for all tests that leave its settings as they were, or as they were by `shared`."""
    with contextlib.closing(Talk(scripted=True)) as talk:
        assert talk.run("voices").code == 0  # now they are known
        yield talk
        talk.stop()


@pytest.fixture
def shared(server: Talk) -> Talk:
    """The same server, with the settings of the start."""
    assert server.request("set", rate=200, volume=1.0, voice="default", pitch=50, preempt=False, ttl=0)["ok"]
    return server


def settings(talk: Talk) -> dict[str, str]:
    """Return what `talk set` prints."""
    done = talk.run("set")
    assert (done.code, done.err) == (0, "")
    return dict(each.split() for each in done.out.splitlines())


def test_alone_it_prints_the_settings(shared: Talk) -> None:
    assert settings(shared) == DEFAULTS
    done = shared.run("set", "--json")
    assert json.loads(done.out) == {
        "rate": 200, "volume": 1.0, "voice": None, "pitch": 50, "preempt": False, "ttl": None,
    }  # fmt: skip
    assert done.out.count("\n") == 1
    done = shared.run("set", "--rate", "200")
    assert (done.code, done.out, done.err) == (0, "", "")


@pytest.mark.parametrize(
    ("words", "name", "value", "shown"),
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
def test_one_setting_is_changed_and_the_others_stay(
    shared: Talk, words: list[str], name: str, value: object, shown: str
) -> None:
    changed = json.loads(shared.run("--json", "set", *words).out)
    assert changed[name] == value
    assert settings(shared) == {**DEFAULTS, name: shown}
    described = shared.request("status")["server"]
    assert {each: described[each] for each in changed} == changed


def test_the_printed_settings_can_be_given_back(shared: Talk) -> None:
    shared.run("set", "--rate", "150", "--volume", str(0.1 + 0.2), "--ttl", "1.5", "--pitch", "60", "--voice", "en")
    assert "volume 0.3, " in shared.log
    before = settings(shared)
    words = [word for name, value in before.items() if name != "preempt" for word in (f"--{name}", value)]
    assert shared.run("set", *words).code == 0
    assert settings(shared) == before


def test_a_wrong_value_changes_nothing(shared: Talk) -> None:
    for words in (["--rate", "79"], ["--volume", "nan"], ["--ttl", "inf"], ["--voice", ""], ["60"]):
        done = shared.run("set", "--pitch", "60", *words)
        assert (done.code, done.out, words[0] in done.err) == (2, "", True)
    assert settings(shared) == DEFAULTS


def test_an_unknown_voice_is_told_with_one_that_comes_near(shared: Talk) -> None:
    done = shared.run("set", "--rate", "150", "--voice", "scirpted")
    assert (done.code, done.out) == (2, "")
    assert "did you mean 'scripted'?" in done.err
    error = json.loads(shared.run("--json", "set", "--voice", "x\x1b[31my").err)["error"]
    assert (error["code"], error["exit"]) == ("unknown_voice", 2)
    assert "\x1b" not in error["message"]
    assert settings(shared) == DEFAULTS


def test_the_variables_of_serve_change_nothing(shared: Talk) -> None:
    env = {**shared.env, "TALK_RATE": "100", "TALK_VOLUME": "0.1", "TALK_VOICE": "none"}
    assert run([*TALK, "set", "--pitch", "50"], env).code == 0
    assert settings(shared) == DEFAULTS


def test_changes_hold_for_later_goals(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null")
    talk.run("set", "--rate", "450", "--ttl", "30")
    fast = json.loads(talk.run("--json", "say", "--wait", "one two three").out)
    talk.run("set", "--rate", "200", "--ttl", "0")
    slow = json.loads(talk.run("--json", "say", "--wait", "one two three").out)
    assert (fast["ttl"], slow["ttl"]) == (30, None)
    assert slow["duration"] > fast["duration"] * 1.5


def test_preempt_holds_for_later_goals(scripted: Talk) -> None:
    first = scripted.run("say", "never-ends").id
    scripted.watcher.wait_for_word(first)
    scripted.run("set", "--preempt")
    scripted.run("say", "--wait", "length=0")
    assert scripted.goal(first)["state"] == "PREEMPTED"


def test_serve_starts_with_its_options(make_talk: MakeTalk) -> None:
    talk = make_talk("--ttl", "0.5", "--rate", "100", "--pitch", "40", "--preempt", "--lead-in", "250", scripted=True)
    assert settings(talk) == {**DEFAULTS, "ttl": "0.5", "rate": "100", "pitch": "40", "preempt": "yes"}
    server = json.loads(talk.run("--json", "status").out)["server"]
    assert (server["ttl"], server["lead_in"]) == (0.5, 250)
    status = talk.run("status").out
    assert "ttl 0.5 s" in status
    assert "lead-in 250 ms" in status
    talk.run("set", "--no-preempt")
    active = talk.run("say", "never-ends").id
    talk.watcher.wait_for_word(active)
    late = talk.run("say", "too late").id
    assert talk.watcher.wait_for_terminal(late) == "RECALLED"
    assert talk.goal(late)["reason"] == "expired"
    talk.run("cancel")


@pytest.mark.parametrize("words", [["--ttl", "nan"], ["--lead-in", "-1"], ["--voice", ""]])
def test_serve_refuses_wrong_values(words: list[str]) -> None:
    with short_directory() as home:
        done = run([*TALK, "serve", *words], environment(home, TALK_SOCKET=f"{home}/s"))
    assert (done.code, done.out, words[0] in done.err) == (2, "", True)


def test_help_of_serve_names_the_devices_that_swallow_a_beginning() -> None:
    words = " ".join((surface.HERE / "help-serve.txt").read_text("utf-8").split())
    for each in ("HDMI", "USB", "Bluetooth", "aplay -L", "pactl list short sinks", "[default: 0"):
        assert each in words
