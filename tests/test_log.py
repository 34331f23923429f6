"""`talk log` shows ended goals with their times, senders and reasons."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from talkcli import peers
from talkcli.goals.options import MAX_LOG_GOALS
from tests.test_watch import number

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.processes import Talk

LONG = "please step back from the door and from the lift " * 5


@pytest.fixture
def history(scripted: Talk) -> list[str]:
    """The ids of one goal for each terminal state, in the order in which they ended."""
    talk = scripted
    succeeded = talk.run("say", "--wait", "--as", "patrol\x1b[m", "length=0").id
    aborted = talk.run("say", "--wait", "fail=audio_lost message=no_cable").id
    rejected = json.loads(talk.run("--json", "say", "").out)["id"]
    active = talk.run("say", "--", f"never-ends {LONG}").id
    talk.watcher.wait_for_word(active)
    pending = talk.run("say", "waits").id
    talk.run("cancel", pending)
    talk.run("cancel")
    return [succeeded, aborted, rejected, pending, active]


def test_a_line_shows_time_state_text_sender_and_reason(scripted: Talk, history: list[str]) -> None:
    done = scripted.run("log")
    assert (done.code, done.err) == (0, "")
    lines = done.out.splitlines()
    assert [line.split()[2] for line in lines] == [*map(number, history)]
    states = ["SUCCEEDED", "ABORTED", "REJECTED", "RECALLED", "PREEMPTED"]
    assert [line.split()[1] for line in lines] == states
    assert all(re.match(r"\d\d:\d\d:\d\d  \w", line) for line in lines)
    script = re.escape(sys.executable.split("/")[-1][:6])
    assert re.search(r'"length=0" +"patrol\\x1b\[m"$', lines[0])
    assert re.search(r" +audio_lost: no cable$", lines[1])
    assert re.search(r'"" .* +invalid_text: the text is empty$', lines[2])
    assert re.search(r'"waits" .* +cancelled by \S+$', lines[3])
    long = scripted.run("log", "--long").out.splitlines()
    assert [line.split()[2] for line in long] == history
    assert re.search(rf'"length=0" +"patrol\\x1b\[m" \(\S*{script}.*, pid \d+\)  0\.0 s$', long[0])
    assert re.search(r", pid \d+ +audio_lost: no cable$", long[1])
    assert re.search(rf'"waits" .*, pid \d+ +cancelled by \S*{script}.*, pid \d+$', long[3])
    assert f'"never-ends {LONG}"' in lines[4]  # a pipe gets the whole text
    assert "\x1b" not in done.out
    goals = [json.loads(line) for line in scripted.run("--json", "log").out.splitlines()]
    assert [goal["id"] for goal in goals] == history
    assert goals[-1] == scripted.goal(history[-1])


def test_log_shows_the_latest_goals_oldest_first(scripted: Talk) -> None:
    assert (scripted.run("log").out, scripted.run("log").code, scripted.run("--json", "log").out) == ("", 0, "")
    goals = [scripted.request("say", text=f"length=0 {each}", wait=True)["goal"] for each in range(22)]
    history = [goal["id"] for goal in goals]
    scripted.run("wait")
    for options, ids in (([], history[-20:]), (["-n", "2"], history[-2:]), (["--count", str(MAX_LOG_GOALS)], history)):
        lines = scripted.run("log", *options).out.splitlines()
        assert [line.split()[2] for line in lines] == [*map(number, ids)]


def test_a_script_that_starts_talk_through_another_program_is_shown(tmp_path: Path) -> None:
    (tmp_path / "talk").write_text("#!/bin/sh\necho $$\nread -r _\n")
    (tmp_path / "talk").chmod(0o755)
    script = tmp_path / "patrol.sh"
    script.write_text(f"nice timeout 20 {tmp_path}/talk say hello\ntrue\n")
    with subprocess.Popen(["sh", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as started:
        assert started.stdin
        assert started.stdout
        assert peers.parent_command_line(int(started.stdout.readline())) == f"sh {script}"
        started.stdin.write("\n")
