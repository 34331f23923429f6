"""`say --stream`: standard input is one text, which is spoken while it arrives."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK, alone
from tests.support.screen import Terminal
from tests.support.timing import assert_within
from tests.test_say_lines import Typing

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: Takes about half an hour.
LONG = "one two three four. " * 600


def test_speaking_begins_before_the_text_has_ended(soundless: Talk) -> None:
    typing = Typing(soundless, "say", "--stream", "-wf", "-")
    typing.type("Hel")
    typing.type("lo. How ar")
    while " word " not in (line := typing.line()):
        assert line
    assert line.endswith(" word 1 0-5 0.000 Hello")
    typing.type("e you?\n")
    code, out, err = typing.end()
    assert (code, err) == (0, "")
    assert [line.split()[-1] for line in out if " word " in line] == ["How", "are", "you"]
    assert out[-1].endswith(" SUCCEEDED")
    (goal_id,) = soundless.watcher.goals()
    assert soundless.goal(goal_id)["text"] == "Hello. How are you?"


def test_without_wait_the_command_ends_when_all_was_sent(soundless: Talk) -> None:
    soundless.run("pause")
    done = soundless.run("say", "--stream", "--as", "model", "--key", "k", "--stall", "9", stdin="One.\nTwo.\n\n")
    assert (done.code, len(done.out.split())) == (0, 1)
    goal = soundless.goal(done.out.strip())
    assert (goal["state"], goal["text"], goal["more"], goal["key"]) == ("PENDING", "One.\nTwo.", False, "k")
    done = soundless.run("--json", "say", "--stream", stdin="Three.")
    assert [json.loads(line)["text"] for line in done.out.splitlines()] == ["Three."]
    assert soundless.run("cancel").code == 0
    assert soundless.run("resume").code == 0


@pytest.mark.parametrize("text", ["", "\n", " \n", "\0"])
def test_a_text_that_cannot_be_spoken_is_rejected_as_without_stream(soundless: Talk, text: str) -> None:
    done, plain = (soundless.run("say", "-w", *words, "-", stdin=text) for words in (["--stream"], []))
    assert (done.code, done.out) == (plain.code, plain.out) == (5, "")
    assert done.err.partition(": ")[2].partition(": ")[2] == plain.err.partition(": ")[2].partition(": ")[2] != ""


def test_invalid_bytes_are_reported_once(soundless: Talk) -> None:
    client = soundless.start("say", "--stream", "-w", stdin=subprocess.PIPE)
    assert client.stdin
    for data in (b"One \xc3", b"\xa4", b"\n\xff two \xfe", b"\xff"):
        client.stdin.buffer.write(data)  # type: ignore[attr-defined]
        client.stdin.flush()
        time.sleep(0.05)
    _, err = client.communicate(timeout=20)
    assert client.returncode == 0
    assert err == "talk: line 2, column 1: the byte 0xff is not valid UTF-8 and is skipped (1 more like it)\n"
    assert soundless.goal(soundless.watcher.goals()[0])["text"] == "One ä\n\ufffd two \ufffd\ufffd"


def test_the_producer_is_stopped_if_the_goal_ends(soundless: Talk) -> None:
    """The producer never stops writing, so only SIGPIPE can end it."""
    code = (
        "import signal, sys; signal.signal(signal.SIGPIPE, signal.SIG_DFL)\nwhile True: sys.stdout.write('one two. ')"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as producer:
        assert producer.stdout
        client = soundless.start("say", "--stream", "-w", stdin=producer.stdout.fileno())
        producer.stdout.close()
        assert client.stdout
        goal_id = client.stdout.readline().strip()
        soundless.watcher.wait_for(goal_id, "ACTIVE")
        assert soundless.run("say", "--preempt", "-w", "other").code == 0
        _, err = client.communicate(timeout=20)
        assert client.returncode == 7
        assert err.startswith(f"talk: {goal_id}: ")
        assert producer.wait(5) == -signal.SIGPIPE


def test_a_signal_ends_the_command_before_there_is_text(soundless: Talk) -> None:
    connected = soundless.request("status")["server"]["clients"]
    typing = Typing(soundless, "say", "--stream", "-w")
    while soundless.request("status")["server"]["clients"] <= connected:
        time.sleep(0.01)
    assert typing.end(signal.SIGTERM) == (128 + signal.SIGTERM, [], "")


def test_ctrl_c_cancels_the_goal(soundless: Talk) -> None:
    for options, text in (([], "One. Two"), (["-f"], LONG)):
        typing = Typing(soundless, "say", "--stream", "-w", *options)
        typing.type(text)
        goal_id = typing.line().split()[0]
        soundless.watcher.wait_for(goal_id, "ACTIVE")
        started_at = time.monotonic()
        code, _, err = typing.end(signal.SIGINT)
        assert_within(time.monotonic() - started_at, 1, "the end after Ctrl-C")
        assert code == 128 + signal.SIGINT
        assert err.startswith(f"talk: {goal_id}: ")
        assert soundless.goal(goal_id)["state"] == "PREEMPTED"


def test_a_goal_is_cancelled_after_the_timeout(soundless: Talk) -> None:
    for text, details in (("", ": nothing was sent"), ("One. ", "")):
        typing = Typing(soundless, "say", "--stream", "-w", "-t", "0.5")
        typing.type(text)
        code, err = typing.client.wait(20), typing.errors.read()
        assert code == 124
        assert err.splitlines()[-1] == f"talk: timed out after 0.5 s{details}"
        typing.client.stdin.close()  # type: ignore[union-attr]
    assert [soundless.goal(each)["state"] for each in soundless.watcher.goals()] == ["PREEMPTED"]


def test_the_limit_for_missing_text_can_be_set(soundless: Talk) -> None:
    typing = Typing(soundless, "say", "--stream", "-w", "--stall", "1")
    typing.type("One. ")
    assert typing.client.wait(20) == 4
    assert "no more text arrived for 1 s" in typing.errors.read()
    typing.client.stdin.close()  # type: ignore[union-attr]


def test_a_lost_server_is_reported(soundless: Talk) -> None:
    typing = Typing(soundless, "say", "--stream", "-w")
    typing.type("One. ")
    typing.line()
    soundless.kill()
    assert typing.client.wait(20) == 12
    assert "the sentence may still be spoken" in typing.errors.read()


def test_the_whole_text_must_not_be_too_long(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null", "--rate", "450", "--max-text", "4")
    typing = Typing(talk, "say", "--stream", "-w")
    typing.type("One. " * 4)
    goal_id = typing.line()
    talk.watcher.wait_for(goal_id, "ACTIVE")
    typing.type("x")
    assert typing.client.wait(20) == 4
    assert "the text is too long: 21 characters (at most 20)" in typing.errors.read()
    assert (talk.goal(goal_id)["state"], talk.goal(goal_id)["reason"]) == ("ABORTED", "broken_off")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--stream", "hello"], "--stream speaks standard input as one text; leave out TEXT and --lines"),
        (["--stream", "-", "hello"], "--stream speaks standard input as one text"),
        (["--stream", "--lines"], "--stream speaks standard input as one text"),
        (["--stream", "-o", "x.wav"], "--output writes a file without a server; leave out --stream"),
        (["--stall", "5", "hello"], "--stall only works with --stream; add --stream, or leave out --stall"),
        (["--stream", "--stall", "0"], "--stall: must be 1 to 60 seconds, got 0"),
        (["--stream", "--robot", "@all"], "'talk say --stream' only works with one robot"),
    ],
)
def test_options_that_cannot_be_combined_are_refused(words: list[str], message: str) -> None:
    done = alone("say", *words)
    assert (done.code, done.out) == (2, "")
    assert message in done.err


def test_wait_shows_a_growing_text_as_far_as_it_was_heard(soundless: Talk) -> None:
    typing = Typing(soundless, "say", "--stream", "-w")
    typing.type("One. ")
    terminal = Terminal([*TALK, "wait", "-f", typing.line()], soundless.env, 80)
    try:
        terminal.wait_until(lambda screen: "WAITING    One." in screen.last)
        typing.type("Two three. ")
        terminal.wait_until(lambda screen: screen.last.rstrip().endswith("One. Two three"))
        assert typing.end()[0] == terminal.finish() == 0
        assert terminal.screen.lines[-2].endswith("  SUCCEEDED  One. Two three.")
    finally:
        terminal.close()
