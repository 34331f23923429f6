"""Standard output that is closed, or full: the exit code says so, no traceback does, and nothing is spoken twice."""

from __future__ import annotations

import fcntl
import os
import shlex
import signal
import socket
import subprocess
import sys
import termios
import time
from typing import TYPE_CHECKING

import pytest

from tests.support.forking import Forked
from tests.support.surroundings import needs

if TYPE_CHECKING:
    from tests.support.processes import Process, Talk

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


@pytest.mark.parametrize("closed", [">&-", "1</dev/null"])
def test_output_that_was_closed_from_the_beginning(scripted: Talk, closed: str) -> None:
    done = bash(scripted, f"(talk status; echo $? >&2) {closed}")
    assert (done.stdout, done.stderr) == ("", f"{CLOSED}\n")


@pytest.mark.parametrize("command", ["status", "--json status", "say -w length=0", "voices"])
def test_full_disk_is_told_in_plain_words(scripted: Talk, command: str) -> None:
    done = bash(scripted, f"talk {command} >/dev/full; echo $?")
    assert (done.stdout, done.stderr) == ("1\n", "talk: standard output can't be written: No space left on device\n")


def test_a_broken_disk_is_no_reader_that_went_away(scripted: Talk) -> None:
    with open("/proc/self/mem", "r+b") as broken:  # at 0 there is nothing that could be written
        client = Forked(["status"], scripted.env, stdout=broken.fileno(), stderr=subprocess.PIPE)
        err = client.communicate(timeout=20)[1]
    assert (client.returncode, err) == (1, "talk: standard output can't be written: Input/output error\n")


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
    for closed in (">&-", "1</dev/null"):
        done = bash(scripted, f"(talk {words} length=0.2; echo $? >&2) {closed}")
        assert (done.stdout, done.stderr) == ("", "0\n")
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


@pytest.mark.parametrize(
    "words",
    ["say -w", "say -wf", "--json say -w", "--json say -wf", "wait", "wait -f", "--json wait", "--json wait -f"],
)
def test_a_goal_is_waited_for_though_there_is_no_room_for_what_is_shown(scripted: Talk, words: str) -> None:
    told = "talk: standard output can't be written: No space left on device"
    for text, state, code in (("length=0.2", "SUCCEEDED", 1), ("fail=audio_lost length=0.2", "ABORTED", 4)):
        what = scripted.run("say", text).id if "wait" in words else text
        done = bash(scripted, f"talk {words} {what} >/dev/full; echo $?")
        goal = scripted.watcher.goals()[-1]
        assert scripted.goal(goal)["state"] == state  # so it was waited for
        notes = [] if words == "wait" else [told]
        notes += [f"talk: {goal}: Talk aborted: scripted audio_lost; see 'talk doctor'"] if state == "ABORTED" else []
        assert sorted(done.stderr.splitlines()) == sorted(notes)
        assert done.stdout == f"{0 if words == 'wait' and code == 1 else code}\n"  # which shows nothing


@pytest.mark.parametrize("words", ["", "--json", "-w", "--json -w", "-f", "--json -f"])
def test_lines_are_spoken_though_there_is_no_room_for_what_is_shown(scripted: Talk, words: str) -> None:
    for first, code in (("length=0 a", 1), ("fail=audio_lost" if words not in {"", "--json"} else "nul \\0", None)):
        done = bash(scripted, f"printf '{first}\\nlength=0 b\\n' | talk say --lines {words} >/dev/full; echo $?")
        goal = scripted.watcher.goals()[-1]
        assert scripted.watcher.wait_for_terminal(goal) == "SUCCEEDED"
        assert scripted.goal(goal)["text"] == "length=0 b"
        assert done.stderr.count("standard output can't be written") == 1
        assert int(done.stdout) == (code or (5 if "nul" in first else 4))


class Reader:
    """Reads what a client writes, until it goes away."""

    def __init__(self, talk: Talk, *words: str, errors: bool = False, terminal: bool = False) -> None:
        """`errors`: it has standard error, too; `terminal`: it is one, and not the client's own."""
        self.descriptor, theirs = os.openpty() if terminal else os.pipe()
        self.client = Forked(
            words, talk.env, stdout=theirs, stderr=theirs if errors else subprocess.PIPE, start_new_session=True
        )
        os.close(theirs)
        _wait_until_caught(self.client, signal.SIGHUP)  # which comes after its first look at its output

    def leave(self) -> int:
        """Go away, and return the client's exit code."""
        os.close(self.descriptor)
        with self.client:
            return self.client.wait(10)


ENDLESS = "never-ends words=1"
#: It takes a moment until it is silent.
SLOW = f"{ENDLESS} slow-stop=0.2"


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


@pytest.mark.parametrize("way", [{}, {"errors": True}, {"terminal": True}])
@pytest.mark.parametrize("words", ["say -wf", "--json say -wf", "--json say -w"])
@pytest.mark.parametrize(("first", "number"), [("reader", signal.SIGINT), ("signal", signal.SIGHUP)])
def test_a_signal_that_ends_the_reader_too_is_what_counts(
    scripted: Talk, words: str, way: dict[str, bool], first: str, number: signal.Signals
) -> None:
    reader = Reader(scripted, *words.split(), SLOW, **way)
    goal = scripted.watcher.wait_until(lambda each: each.get("event") == "word")["id"]
    if first == "reader":
        reader.client.send_signal(signal.SIGSTOP)
        reader.client.send_signal(number)
        os.close(reader.descriptor)
        reader.client.send_signal(signal.SIGCONT)
    else:
        reader.client.send_signal(number)
        scripted.watcher.wait_for(goal, "PREEMPTING")  # which is what the client had to ask for
        os.close(reader.descriptor)
    err = reader.client.communicate(timeout=10)[1]
    assert reader.client.returncode == 128 + number
    assert scripted.watcher.wait_for_terminal(goal) == "PREEMPTED"
    assert err.count("Talk preempted") == (not way.get("errors"))


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("words", ["say -w", "say -wf", "say -w --lines"])
def test_a_terminal_that_is_closed_sends_sighup_more_than_once(
    scripted: Talk, words: str, first: signal.Signals
) -> None:
    lines = "--lines" in words
    client = scripted.start(*words.split(), *([] if lines else [SLOW]), stdin=subprocess.PIPE)
    if lines:
        assert client.stdin
        client.stdin.write(f"{SLOW}\n")
        client.stdin.flush()
    goal = scripted.watcher.wait_until(lambda each: each.get("event") == "word")["id"]
    client.send_signal(first)
    scripted.watcher.wait_for(goal, "PREEMPTING")
    client.send_signal(signal.SIGHUP)
    done = scripted.finish(client)
    assert (done.code, done.err.count("Talk preempted")) == (128 + first, 1)


@pytest.mark.parametrize("shared", [True, False], ids=["with its input", "alone"])
def test_a_reader_that_goes_away_while_the_text_is_read_has_nothing_spoken(scripted: Talk, shared: bool) -> None:
    ours, theirs = socket.socketpair()  # what sshd gives a command
    reader, output = (-1, theirs.fileno()) if shared else os.pipe()
    words = ["say", "-w", "-"]
    client = Forked(words, scripted.env, stdin=theirs.fileno(), stdout=output, stderr=subprocess.PIPE)
    theirs.close()
    ours.send(b"half of a sen")
    while fcntl.ioctl(ours, termios.TIOCOUTQ, b"    ") != b"\0\0\0\0":  # until it was read, of which nothing tells
        time.sleep(0.002)
    if shared:
        ours.close()
    else:
        os.close(output)
        os.close(reader)
    with ours:
        err = client.communicate(timeout=10)[1]
    assert (client.returncode, err) == (CLOSED, "")
    assert scripted.watcher.goals() == []


def test_a_text_whose_sender_only_has_no_more_is_spoken(scripted: Talk) -> None:
    ours, theirs = socket.socketpair()
    with ours:
        client = Forked(["say", "-w", "-"], scripted.env, stdin=theirs.fileno(), stdout=theirs.fileno())
        theirs.close()
        ours.send(b"length=0 whole")
        ours.shutdown(socket.SHUT_WR)
        assert client.wait(10) == 0
        assert scripted.goal(ours.recv(100).decode().strip())["state"] == "SUCCEEDED"


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


@pytest.mark.parametrize("way", [{}, {"terminal": True}])
@pytest.mark.parametrize("words", [["wait"], ["wait", "-f"], ["--json", "wait"]])
def test_the_reader_of_a_wait_ends_it_and_cancels_nothing(
    scripted: Talk, words: list[str], way: dict[str, bool]
) -> None:
    goal = scripted.run("say", ENDLESS).id
    reader = Reader(scripted, *words, goal, **way)
    if way and words == ["wait", "-f"]:
        assert os.read(reader.descriptor, 1)
    assert reader.leave() == CLOSED
    assert scripted.goal(goal)["state"] in {"PENDING", "ACTIVE"}


def test_sighup_cancels_what_say_owns_and_nohup_keeps_it_away(scripted: Talk) -> None:
    for words, code, state in ((["say", "-w"], 129, "PREEMPTED"), (["wait"], 129, "ACTIVE")):
        goal = scripted.run("say", ENDLESS).id if words == ["wait"] else None
        client = scripted.start(*words, goal or ENDLESS)
        goal = goal or scripted.watcher.wait_until(lambda each: each.get("event") == "word")["id"]
        _wait_until_caught(client, signal.SIGHUP)
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


def _wait_until_caught(client: Process, number: int) -> None:
    """Wait until a process catches a signal, of which nothing tells."""
    while True:
        assert client.poll() is None, "it has ended"
        with open(f"/proc/{client.pid}/status", encoding="utf-8") as status:
            caught = next(int(each.split()[1], 16) for each in status if each.startswith("SigCgt:"))
        if caught >> (number - 1) & 1:
            return
        time.sleep(0.002)


def test_closed_standard_error_changes_no_exit_code(scripted: Talk) -> None:
    done = bash(scripted, "talk status 4k7f-99 2>&-; echo $?; talk say -w fail=audio_lost 2>&-; echo $?")
    assert [each for each in done.stdout.splitlines() if "-" not in each] == ["8", "4"]
