"""`talk watch`: a transcript for people, and a feed of events for programs."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from typing import TYPE_CHECKING

from talkcli.terminal.text import width
from tests.conformance.bareserve import TALK
from tests.support.screen import Terminal

if TYPE_CHECKING:
    from tests.support.processes import Talk

LONG = "moving to the charger on the second floor, please step back from the door and from the lift never-ends"


class Lines:
    """A `talk watch` whose standard output is a pipe."""

    def __init__(self, talk: Talk, *arguments: str) -> None:
        self.process = talk.start("watch", *arguments)
        self.lines: list[str] = []
        self.next("")  # the first line confirms that it watches

    def next(self, text: str) -> str:
        """Read up to the line that contains this text, and return it."""
        assert self.process.stdout
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if text in line:
                return self.lines[-1]
        raise AssertionError(f"no line with {text!r} in {self.lines}")

    def end(self) -> int:
        """Send SIGINT, and return the exit code. Nothing more may be printed."""
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(10)
        assert self.process.stdout
        assert self.process.stderr
        assert (self.process.stdout.read(), self.process.stderr.read()) == ("", "")
        return code


def number(goal_id: str) -> str:
    """Return the short form of a goal's id."""
    return goal_id.partition("-")[2]


def at_terminal(talk: Talk, columns: int, *arguments: str, **env: str) -> Terminal:
    return Terminal([*TALK, *arguments], {"TERM": "xterm", **talk.env, **env}, columns)


def test_in_a_pipe_every_event_is_printed_at_once_as_a_full_line(scripted: Talk) -> None:
    watch = Lines(scripted, "-l")
    assert re.fullmatch(rf"\d\d:\d\d:\d\d  watching    silent; server {scripted.pid} on \S+", watch.lines[0])
    goal_id = scripted.run("say", "--as", "patrol", "--", LONG).id
    assert re.search(r'  "patrol" \(.*, pid \d+\)$', watch.next("PENDING"))
    active = watch.next("ACTIVE")
    assert re.match(rf'\d\d:\d\d:\d\d  ACTIVE      {goal_id} +"{LONG}"  "patrol" \(.*, pid \d+\)$', active)
    scripted.watcher.wait_for_word(goal_id)
    scripted.run("cancel", goal_id)
    watch.next("PREEMPTING")
    assert re.search(rf'PREEMPTED   {goal_id} +"{LONG}"  cancelled by .*, pid \d+$', watch.next("PREEMPTED"))
    assert watch.end() == 130
    assert not any("\x1b" in line or "never-ends  " in line or " word " in line for line in watch.lines)


def test_watch_starts_with_the_current_goals(scripted: Talk) -> None:
    active = scripted.run("say", "never-ends").id
    pending = scripted.run("say", "waits").id
    scripted.watcher.wait_for_word(active)
    watch = Lines(scripted)
    watch.next(f"PENDING     {number(pending)} ")
    assert "  speaking, 1 waiting; " in watch.lines[0]
    assert ["ACTIVE" in watch.lines[1], f"  {number(active)} " in watch.lines[1], '"never-ends"' in watch.lines[1]] == [
        True
    ] * 3
    assert ["PENDING" in watch.lines[2], '"waits"' in watch.lines[2], len(watch.lines)] == [True, True, 3]
    scripted.run("cancel")
    assert re.search(r'"never-ends" +cancelled by ', watch.next("PREEMPTED"))
    assert watch.end() == 130


def test_json_prints_the_protocols_events(scripted: Talk) -> None:
    watch = Lines(scripted, "--json")
    snapshot = json.loads(watch.lines[0])
    assert list(snapshot) == ["event", "server", "active", "interrupted", "pending", "recent"]
    assert (snapshot["event"], snapshot["active"], snapshot["pending"]) == ("snapshot", None, [])
    goal_id = scripted.run("say", "length=0.1 and more").id
    watch.next("SUCCEEDED")
    assert watch.end() == 130
    scripted.watcher.wait_for_terminal(goal_id)
    assert [json.loads(line) for line in watch.lines[1:]] == scripted.watcher.events()


def test_the_clients_that_paused_and_resumed_are_shown(scripted: Talk) -> None:
    talk = scripted
    goal_id = talk.run("say", "never-ends").id
    talk.watcher.wait_for_word(goal_id)
    watch, feed = Lines(talk, "--long"), Lines(talk, "--json")
    talk.run("pause")
    assert re.search(rf"  paused      {goal_id} +by .*, pid \d+$", watch.next("paused"))
    event = json.loads(feed.next("paused"))
    assert (event["event"], event["paused"], event["id"]) == ("paused", True, goal_id)
    late = Lines(talk)
    assert "  paused; " in late.lines[0]
    assert "  ACTIVE  " in late.next(f" {number(goal_id)} ")
    talk.run("resume")
    late.next("resumed")
    assert re.search(rf"  resumed     {goal_id} +by .*, pid \d+$", watch.next("resumed"))
    assert json.loads(feed.next('"paused": false'))["by"]["client"]["pid"]
    assert (watch.end(), feed.end(), late.end()) == (130, 130, 130)
    talk.run("cancel")


def test_lines_adapt_to_a_resized_window(scripted: Talk) -> None:
    with at_terminal(scripted, 80, "watch", COLUMNS="200") as watch:
        watch.wait_for("silent")
        first = scripted.run("say", "--", LONG).id
        watch.wait_for(f"ACTIVE +{number(first)} .*\n")
        for columns in (120, 60):
            watch.resize(columns)
            goal_id = scripted.run("say", "--", f"{LONG}").id
            line = watch.wait_for(f".*PENDING +{number(goal_id)} .*(?=\n)")[0]
            assert width(line) == columns
            text = line[line.index('"') : line.rindex('"') + 1]
            assert len(text) >= (columns - width(line[: line.index('"')])) // 2
        scripted.run("cancel")


def test_a_server_that_goes_away_is_reported(scripted: Talk) -> None:
    watch = Lines(scripted)
    goal_id = scripted.run("say", "never-ends").id
    watch.next("ACTIVE")
    scripted.watcher.wait_for_word(goal_id)
    scripted.stop()
    assert watch.next("PREEMPTED").endswith("  shutdown: the server was stopped")
    done = scripted.finish(watch.process)
    assert (done.code, done.out, "connection to the server was lost" in done.err) == (12, "", True), done


def test_watch_ends_with_its_reader_even_without_events(scripted: Talk) -> None:
    reader, writer = os.pipe()
    with os.fdopen(writer, "wb") as stdout, os.fdopen(reader, "rb") as lines:
        watch = subprocess.Popen([*TALK, "watch"], env=scripted.env, stdout=stdout, stderr=subprocess.PIPE)
        assert lines.readline()
    assert watch.stderr
    with watch.stderr:
        assert (watch.wait(10), watch.stderr.read()) == (141, b"")


def test_an_idle_watcher_uses_no_processor_time(scripted: Talk) -> None:
    watch = Lines(scripted)
    before = _switches(watch.process.pid)
    scripted.run("voices")  # time passes, and no goal is sent
    scripted.run("status")
    assert _switches(watch.process.pid) - before <= 1  # the server may report once that it is alive
    assert watch.end() == 130


def _switches(pid: int) -> int:
    with open(f"/proc/{pid}/status", encoding="utf-8") as status:
        return int(re.findall(r"(?m)^voluntary_ctxt_switches:\s+(\d+)", status.read())[0])
