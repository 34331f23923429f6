"""Row 13: texts that cannot be spoken, on the wire and on the command line, and texts that are spoken unchanged."""

from __future__ import annotations

import json
import os
import subprocess
from typing import TYPE_CHECKING

from tests.conformance.bareserve import TALK

if TYPE_CHECKING:
    from tests.support.processes import Finished, Talk
WHOLE = ["😀" * 10_000, 'it\'s "$(touch hacked)"; `id`\n& done']


class Bystanders:
    """An active and a pending goal, which a REJECTED goal must not affect."""

    def __init__(self, talk: Talk) -> None:
        self._talk = talk
        with talk.connect() as wire:
            goals = [wire.request("say", text=f"never-ends {key}", key=key)["goal"] for key in ("active", "pending")]
        self._ids = [goal["id"] for goal in goals]
        talk.watcher.wait_for_word(self._ids[0])

    def assert_untouched(self) -> None:
        assert [self._talk.goal(goal_id)["state"] for goal_id in self._ids] == ["ACTIVE", "PENDING"]
        active = {event["id"] for event in self._talk.watcher.events() if event.get("state") == "ACTIVE"}
        assert active == {self._ids[0]}


def assert_rejected(done: Finished, reason: str) -> None:
    """Assert the output and the exit code of a client whose goal was REJECTED."""
    goal = json.loads(done.out)
    assert (done.code, goal["state"], goal["reason"]) == (5, "REJECTED", reason), done
    assert "not spoken: " in done.err


def test_row_13_a_rejected_text_has_no_other_effect(scripted: Talk) -> None:
    bystanders = Bystanders(scripted)
    for option in ("preempt", "flush"):
        request = {"request": "say", "text": "battery \ud83d low", "key": "pending", option: True}
        with scripted.connect() as wire:
            wire.send_raw(json.dumps(request).encode() + b"\n")
            goal = wire.receive()["goal"]
        assert (goal["state"], goal["reason"]) == ("REJECTED", "invalid_text")
        bystanders.assert_untouched()


def test_row_13_a_text_that_cannot_be_spoken_is_rejected_by_say(scripted: Talk) -> None:
    bystanders = Bystanders(scripted)
    for text in ("", "  ", "\u200b"):
        assert_rejected(scripted.run("--json", "say", "--preempt", "--wait", "--", text), "invalid_text")
    for text in ("", "\n", "\u200b\r\n", "battery\0low"):
        assert_rejected(scripted.run("--json", "say", "--preempt", "-", stdin=text), "invalid_text")
    for text in ("é" * 50_000, "a" * 10_001):
        assert_rejected(scripted.run("--json", "say", "--preempt", "-", stdin=text), "text_too_long")
        assert_rejected(scripted.run("--json", "say", "--preempt", text), "text_too_long")
    plain = scripted.run("say", "--preempt", "--wait", "--", "")
    assert (plain.code, plain.out) == (5, "")  # no id, because there is nothing to wait for
    assert plain.err.endswith("not spoken: the text is empty\n")
    bystanders.assert_untouched()


def test_the_error_for_an_oversized_input_is_accurate(scripted: Talk) -> None:
    longest = "😀" * 10_000
    for text in (f"{longest}\n", f"{longest}\r\n"):
        assert json.loads(scripted.run("--json", "say", "-", stdin=text).out)["text"] == longest
    for text in (f"{longest}\nand more", "a" * 300_000):
        done = scripted.run("say", "-", stdin=text)
        assert (done.code, done.out) == (5, "")
        error = "not spoken: standard input is too long (more than 40,000 bytes; a text has at most 10,000 characters"
        assert error in done.err
        assert "talk say --lines" in done.err
    assert "talk say --lines" in scripted.run("say", "-", stdin="one two. " * 2_000).err
    for text in ("one two. " * 2_000, "a" * 300_000):
        assert scripted.run("-q", "say", "-", stdin=text).err == ""
    done = scripted.run("--json", "say", "-f", "-", stdin="a" * 300_000)
    (event,) = map(json.loads, done.out.splitlines())
    assert (event["event"], event["goal"]["reason"], done.code) == ("result", "text_too_long", 5)


def test_invalid_utf8_bytes_are_skipped_and_reported(scripted: Talk) -> None:
    data = "length=0 Grüße:\n日本\n".encode() + "Grüße".encode("latin-1") + b" \xed\xa0\x80!"
    text = "length=0 Grüße:\n日本\nGr\ufffd\ufffde \ufffd\ufffd\ufffd!"
    note = "talk: line 3, column 3: the byte 0xfc is not valid UTF-8 and is skipped (4 more like it)\n"
    for options, expected in ((["--json"], note), (["--json", "-q"], "")):
        for args, stdin in (([b"--", data], b""), ([b"-"], data)):
            command: list[str | bytes] = [*TALK, *options, "say", "--wait", *args]
            done = subprocess.run(command, input=stdin, env=scripted.env, capture_output=True, timeout=20, check=False)
            goal = json.loads(done.stdout)
            assert (done.returncode, goal["state"], goal["text"]) == (0, "SUCCEEDED", text)
            assert done.stderr.decode() == expected


def test_invalid_utf8_bytes_are_silent_and_are_not_words(soundless: Talk) -> None:
    command: list[str | bytes] = [*TALK, "say", "--feedback", "--", b"battery \xff low, it\xffs \xff", "now"]
    done = subprocess.run(command, env=soundless.env, capture_output=True, text=True, timeout=20, check=False)
    words = [line.split()[-1] for line in done.stdout.splitlines() if " word " in line]
    assert (done.returncode, words) == (0, ["battery", "low", "it", "s", "now"])
    alone = soundless.run("say", "--wait", "--", "\udcff")
    assert (alone.code, alone.err.splitlines()[-1].endswith("nothing in the text can be spoken")) == (4, True)


def test_texts_are_spoken_unchanged(scripted: Talk) -> None:
    for text in WHOLE:
        by_wire = scripted.request("say", text=text)["goal"]
        by_input = json.loads(scripted.run("--json", "say", "--wait", "-", stdin=f"{text}\n").out)
        by_words = json.loads(scripted.run("--json", "say", "--wait", "--", text).out)
        for goal in (scripted.goal(by_wire["id"]), by_input, by_words):
            assert (goal["state"], goal["text"], goal["spoken"]) == ("SUCCEEDED", text, text)
    assert not os.path.exists("hacked")
