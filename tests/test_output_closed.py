"""Standard output that is closed, or full: the exit code says so, no traceback does, and nothing is spoken twice."""

from __future__ import annotations

import shlex
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.support.surroundings import needs

if TYPE_CHECKING:
    from tests.support.processes import Talk

TALK = f"{shlex.quote(sys.executable)} -m talkcli"
CLOSED = 141


def bash(talk: Talk, script: str) -> subprocess.CompletedProcess[str]:
    needs("bash")
    done = subprocess.run(
        ["bash", "-c", script.replace("talk ", f"{TALK} ")],
        env=talk.env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert "Traceback" not in done.stderr, done
    return done


@pytest.mark.parametrize("command", ["status", "voices", "--json voices", "log", "set", "say -wf length=0.3 one two"])
def test_reader_that_has_enough_ends_it_with_141(scripted: Talk, command: str) -> None:
    if command == "log":
        scripted.run("say", "--wait", "length=0")
    done = bash(scripted, f"talk {command} | (exec <&-; true); echo ${{PIPESTATUS[0]}}")
    assert (done.stdout, done.stderr) == (f"{CLOSED}\n", "")


def test_watch_ends_when_its_reader_does(scripted: Talk) -> None:
    talks = "while talk say -q --wait length=0; do true; done & "
    done = bash(scripted, talks + "talk watch | head -n 1; echo ${PIPESTATUS[0]}; kill $!; wait 2> /dev/null")
    assert done.stdout.splitlines()[-1] == str(CLOSED)
    assert done.stderr == ""


def test_first_line_is_whole(scripted: Talk) -> None:
    done = bash(scripted, "talk status | head -n 1; echo ${PIPESTATUS[0]}")
    first, code = done.stdout.splitlines()
    assert first.startswith("server   pid ")
    assert code in {"0", str(CLOSED)}  # the rest may have been written before the reader was gone
    assert done.stderr == ""


def test_output_that_was_closed_from_the_beginning(scripted: Talk) -> None:
    done = bash(scripted, "talk status >&-; echo $?")
    assert (done.stdout, done.stderr) == (f"{CLOSED}\n", "")


@pytest.mark.parametrize("command", ["status", "--json status", "say -w length=0", "voices"])
def test_full_disk_is_told_in_plain_words(scripted: Talk, command: str) -> None:
    done = bash(scripted, f"talk {command} >/dev/full; echo $?")
    assert (done.stdout, done.stderr) == ("1\n", "talk: standard output can't be written: No space left on device\n")


def test_a_goal_is_spoken_whatever_becomes_of_its_id(scripted: Talk) -> None:
    for closed in (">&-", ">/dev/full", "| true"):
        bash(scripted, f"talk say length=0 {closed}")
    assert [scripted.watcher.wait_for_terminal(each) for each in scripted.watcher.goals()] == ["SUCCEEDED"] * 3


def test_closed_standard_error_changes_no_exit_code(scripted: Talk) -> None:
    done = bash(scripted, "talk status 4k7f-99 2>&-; echo $?; talk say -w fail=audio_lost 2>&-; echo $?")
    assert [each for each in done.stdout.splitlines() if "-" not in each] == ["8", "4"]
