"""`talk serve --pronounce`, `talk say --dry-run` and the field `said`."""

from __future__ import annotations

import json
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, State
from talkcli.errors import UsageError
from tests.conformance.bareserve import alone

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk

TERMS = "Xylophor Q7 = zai lo four queue seven\ncharger = [[tS'A@dZ3]]\n"
TEXT = "Xylophor Q7 goes to the charger"
SAID = "zai lo four queue seven goes to the [[tS'A@dZ3]]"


@pytest.fixture
def names(tmp_path: Path) -> Path:
    path = tmp_path / "names.txt"
    path.write_text(TERMS)
    return path


def test_a_dry_run_shows_what_would_be_said_and_queues_nothing(make_talk: MakeTalk, names: Path) -> None:
    talk = make_talk("--pronounce", str(names), scripted=True)
    assert talk.run("say", "--dry-run", "-w", "--preempt", TEXT).out == f"{SAID}\n"
    markdown = talk.run("say", "--dry-run", "--markdown", "# The *charger*\n- now\x1b")
    assert markdown.out == "The [[tS'A@dZ3]] 。 now\\x1b\n"
    assert json.loads(talk.run("--json", "say", "--dry-run", "hi").out)["said"] is None
    refused = talk.run("say", "--dry-run", "--voice", "parrot", "hi")
    assert (refused.code, refused.out) == (5, "")
    assert 'unknown voice "parrot"' in refused.err
    assert "--dry-run prints a single text" in talk.run("say", "--dry-run", "--lines").err
    with Client(talk.socket) as client:
        assert client.dry_run(TEXT, id="mine", throttle=60).said == SAID
        assert client.dry_run("\0").reason == "invalid_text"
        assert client.dry_run("hi" * 10_000).reason == "text_too_long"
        with pytest.raises(UsageError, match="rate"):
            client.dry_run("hi", rate=1)
        status = client.status()
    assert (status.active, *status.pending, *status.recent) == (None,)
    assert talk.watcher.events() == []


def test_status_shows_a_text_as_it_was_said_when_it_started(make_talk: MakeTalk, names: Path) -> None:
    """A goal that hasn't started shows how it would be said now. The other requests don't show this."""
    talk = make_talk("--pronounce", str(names), scripted=True)
    with Client(talk.socket) as client:
        client.pause()
        first, second = client.say(TEXT), client.say("hi Charger-charger")
        assert client.goal(first.id).said == SAID
        client.resume()
        first.wait(10)
        second.wait(10)
        names.write_text("hi = hello\nfaulty")
        assert client.goal(first.id).said == SAID
        assert client.goal(second.id).said == "hi [[tS'A@dZ3]] - [[tS'A@dZ3]]"
        third = client.say("hi")
        assert third.wait(10).said is None
        assert client.goal(third.id).said == "hello"
        assert {goal.said for goal in client.log()} == {None}
        described = client.status().server["pronunciations"]
    assert described["terms"] == 1  # type: ignore[index]
    assert f"{names}, line 2: write it like this" in talk.log


def test_a_growing_text_in_two_pieces_is_said_as_a_whole(make_talk: MakeTalk, names: Path) -> None:
    talk = make_talk("--pronounce", str(names), "--player", "null", "--rate", "450")
    with Client(talk.socket) as client:
        whole = client.say(TEXT + ".", feedback=True)
        words = [(each.start, each.end) for each in whole.feedback(20)]
        with client.stream(feedback=True) as stream:
            for piece in ("Xylo", "phor ", "Q7 goes to the char", "ger."):
                stream.write(piece)
        assert stream.goal
        grown = stream.goal.wait(20)
        assert grown.state is State.SUCCEEDED
        assert grown.duration == pytest.approx(whole.goal.duration, abs=0.05)
        plain = client.say(SAID.replace("[[tS'A@dZ3]]", "charger."), rate=450).wait(20)
        assert plain.duration == pytest.approx(grown.duration, abs=0.05)
        assert client.goal(grown.id).said == client.goal(whole.id).said == SAID + " ."
        assert [(each.start, each.end) for each in stream.goal.feedback(1)] == words


def test_a_file_of_speech_is_pronounced_alike(names: Path, tmp_path: Path) -> None:
    names.write_text(TERMS + "faulty\n")
    pronounce = ("--pronounce", str(names))
    lengths = []
    for text, options in (("the charger", ()), ("a Xylophor Q7", pronounce), ("a zai lo four queue seven", ())):
        done = alone("say", "-o", f"{tmp_path}/x.wav", *options, text)
        assert (done.code, "line 3: write it like this" in done.err) == (0, bool(options))
        with wave.open(f"{tmp_path}/x.wav") as file:
            lengths.append(file.getnframes() / file.getframerate())
    assert lengths[1] == pytest.approx(lengths[2], abs=0.03)
    dry = alone("say", "-q", "-o", f"{tmp_path}/y.wav", "--dry-run", *pronounce, TEXT)
    assert (dry.code, dry.out, (tmp_path / "y.wav").exists()) == (0, f"{SAID}\n", False)
    assert alone("say", "-o", f"{tmp_path}/y.wav", "--dry-run", "--voice", "parrot", TEXT).code == 5
    assert json.loads(alone("--json", "say", "-o", "/dev/null", "hi").out)["output"] == "/dev/null"
    assert "talk serve --pronounce FILE" in alone("say", *pronounce, TEXT).err


@pytest.mark.parametrize("command", [("serve",), ("say", "-o", "x.wav", "hi")])
def test_a_missing_file_is_a_usage_error(command: tuple[str, ...]) -> None:
    done = alone(*command, "--pronounce", "/nowhere/names.txt")
    assert (done.code, done.out) == (2, "")
    assert "--pronounce: /nowhere/names.txt can't be read: No such file or directory" in done.err
