"""Standard output that is closed, or full: the exit code says so, no traceback does, and nothing is spoken twice."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.support.forking import Forked
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


@pytest.mark.parametrize("command", ["status", "voices", "--json voices", "log", "set"])
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


def unread(talk: Talk, *words: str) -> tuple[int, str]:
    """Run `talk` with its output in a pipe whose reader has gone; return its exit code and what it noted."""
    reader, writer = os.pipe()
    os.close(reader)
    client = Forked(words, talk.env, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    err = client.communicate(timeout=20)[1]
    return client.wait(), err


@pytest.mark.parametrize("words", ["say", "say -w", "--json say -w", "say -wf", "--json say -wf", "say -wq"])
def test_output_that_was_closed_from_the_start_matters_to_nothing(scripted: Talk, words: str) -> None:
    done = bash(scripted, f"talk {words} length=0.2 >&-; echo $?")
    assert (done.stdout, done.stderr) == ("0\n", "")
    assert unread(scripted, *words.split(), "length=0.2") == (0, "")
    for goal in scripted.watcher.goals():
        if words == "say":
            scripted.watcher.wait_for_terminal(goal)
        assert scripted.goal(goal)["state"] == "SUCCEEDED"  # so it had ended when the command did
    code, err = unread(scripted, *words.split(), "fail=audio_lost")
    assert (code, "Talk aborted" in err) == ((0, False) if words == "say" else (4, words != "say -wq"))


def test_a_wait_whose_output_was_closed_from_the_start_waits(scripted: Talk) -> None:
    for words in ("wait", "--json wait -f"):
        goal = scripted.run("say", "fail=audio_lost length=0.2").id
        done = bash(scripted, f"talk {words} {goal} >&-; echo $?")
        assert done.stdout == "4\n"
        assert scripted.goal(goal)["state"] == "ABORTED"


def test_a_goal_is_waited_for_though_there_is_no_room_for_what_is_shown(scripted: Talk) -> None:
    told = "talk: standard output can't be written: No space left on device\n"
    for words in ("say -w", "say -wf", "--json say -wf"):
        done = bash(scripted, f"talk {words} length=0.2 >/dev/full; echo $?")
        assert (done.stdout, done.stderr) == ("1\n", told)
        assert scripted.goal(scripted.watcher.goals()[-1])["state"] == "SUCCEEDED"
    failed = bash(scripted, "talk say -w fail=audio_lost >/dev/full; echo $?")
    assert failed.stdout == "4\n"


class Reader:
    """Reads what a client writes, until it goes away."""

    def __init__(self, talk: Talk, *words: str, errors: bool = False, terminal: bool = False) -> None:
        """`errors`: it has standard error, too; `terminal`: it is one, and not the client's own."""
        self.descriptor, theirs = os.openpty() if terminal else os.pipe()
        self.client = Forked(
            words, talk.env, stdout=theirs, stderr=theirs if errors else subprocess.PIPE, start_new_session=True
        )
        os.close(theirs)
        _wait_until_caught(self.client.pid, signal.SIGHUP)  # which comes after its first look at its output

    def leave(self) -> int:
        """Go away, and return the client's exit code."""
        os.close(self.descriptor)
        with self.client:
            return self.client.wait(10)


ENDLESS = "never-ends words=1"


@pytest.mark.parametrize("way", [{}, {"errors": True}, {"terminal": True}, {"terminal": True, "errors": True}])
@pytest.mark.parametrize("words", [["say", "-w"], ["--json", "say", "-w"], ["-q", "say", "-w"], ["say", "-wf"]])
def test_a_reader_that_goes_away_while_it_waits_cancels_the_goal(
    scripted: Talk, words: list[str], way: dict[str, bool]
) -> None:
    reader = Reader(scripted, *words, ENDLESS, **way)
    goal = scripted.watcher.wait_until(lambda each: each.get("event") == "word")["id"]
    assert reader.leave() == CLOSED
    assert scripted.goal(goal)["state"] == "PREEMPTED"  # and it was waited for
    assert scripted.goal(goal)["by"]["client"]["pid"] == reader.client.pid


def test_a_reader_that_goes_away_while_its_goal_is_in_the_queue_recalls_it(scripted: Talk) -> None:
    first = scripted.run("say", ENDLESS).id
    reader = Reader(scripted, "say", "-w", "second")
    scripted.watcher.wait_until(lambda each: bool(each.get("goal")) and each["goal"]["text"] == "second")
    assert reader.leave() == CLOSED
    assert scripted.watcher.wait_for_terminal(scripted.watcher.goals()[-1]) == "RECALLED"
    assert scripted.goal(first)["state"] == "ACTIVE"


@pytest.mark.parametrize("first", ["reader", "signal"])
def test_ctrl_c_that_ends_the_reader_too_is_130(scripted: Talk, first: str) -> None:
    reader = Reader(scripted, "say", "-wf", ENDLESS, errors=True)
    goal = scripted.watcher.wait_until(lambda each: each.get("event") == "word")["id"]
    reader.client.send_signal(signal.SIGSTOP)
    reader.client.send_signal(signal.SIGINT)
    if first == "reader":
        os.close(reader.descriptor)
        reader.client.send_signal(signal.SIGCONT)
    else:
        scripted.freeze()  # nothing ends before the client has seen the signal, and asked
        reader.client.send_signal(signal.SIGCONT)
        time.sleep(0.1)
        os.close(reader.descriptor)
        scripted.thaw()
    with reader.client:
        assert reader.client.wait(10) == 130
    assert scripted.watcher.wait_for_terminal(goal) == "PREEMPTED"


def test_a_reader_that_had_enough_cancels_the_goal(scripted: Talk) -> None:
    done = bash(scripted, f"talk say -w {ENDLESS} | head -n 1; echo ${{PIPESTATUS[0]}}")
    goal, code = done.stdout.split()
    assert (code, done.stderr.count("Talk preempted")) == (str(CLOSED), 1)
    assert scripted.goal(goal)["state"] == "PREEMPTED"


@pytest.mark.parametrize("words", [["say", "-w"], ["say", "-wf"]])
def test_the_reader_of_who_attached_cancels_nothing(scripted: Talk, words: list[str]) -> None:
    text = "never-ends length=60 " + "word " * 600  # one in a tenth of a second
    scripted.run("say", "--id", "mine", text)
    scripted.watcher.wait_for_word("mine")
    reader = Reader(scripted, *words, "--id", "mine", text)
    assert os.read(reader.descriptor, 4) == b"mine"
    assert reader.leave() == CLOSED
    assert scripted.goal("mine")["state"] == "ACTIVE"


@pytest.mark.parametrize("words", [["wait"], ["wait", "-f"], ["--json", "wait"]])
def test_the_reader_of_a_wait_ends_it_and_cancels_nothing(scripted: Talk, words: list[str]) -> None:
    goal = scripted.run("say", ENDLESS).id
    reader = Reader(scripted, *words, goal)
    assert reader.leave() == CLOSED
    assert scripted.goal(goal)["state"] in {"PENDING", "ACTIVE"}


def test_sighup_cancels_what_say_owns_and_nohup_keeps_it_away(scripted: Talk) -> None:
    for words, code, state in ((["say", "-w"], 129, "PREEMPTED"), (["wait"], 129, "ACTIVE")):
        goal = scripted.run("say", ENDLESS).id if words == ["wait"] else None
        client = scripted.start(*words, goal or ENDLESS)
        goal = goal or scripted.watcher.wait_until(lambda each: each.get("event") == "word")["id"]
        _wait_until_caught(client.pid, signal.SIGHUP)
        client.send_signal(signal.SIGHUP)
        assert scripted.finish(client).code == code
        assert scripted.goal(goal)["state"] == state
        scripted.run("cancel")
    needs("nohup")
    kept = subprocess.Popen(
        ["nohup", *TALK.split(), "say", "-w", "--id", "kept", ENDLESS],
        env=scripted.env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert kept.stdout
    with kept.stdout:
        assert kept.stdout.readline() == b"kept\n"
        kept.send_signal(signal.SIGHUP)
        scripted.run("cancel", "kept")
        assert kept.wait(10) == 7


def _wait_until_caught(pid: int, number: int) -> None:
    """Wait until a process catches a signal, of which nothing tells."""
    while True:
        with open(f"/proc/{pid}/status", encoding="utf-8") as status:
            caught = next(int(each.split()[1], 16) for each in status if each.startswith("SigCgt:"))
        if caught >> (number - 1) & 1:
            return
        time.sleep(0.002)


def test_closed_standard_error_changes_no_exit_code(scripted: Talk) -> None:
    done = bash(scripted, "talk status 4k7f-99 2>&-; echo $?; talk say -w fail=audio_lost 2>&-; echo $?")
    assert [each for each in done.stdout.splitlines() if "-" not in each] == ["8", "4"]
