"""Closed or full standard output: the exit code reports it, without a traceback, and goals are spoken once."""

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
FULL = "talk: can't write to standard output: No space left on device\n"


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


def run_to(talk: Talk, output: int | str, *arguments: str, stdin: str | None = None) -> tuple[int, str]:
    """Run `talk` with this file as its output, and return its exit code and its standard error."""
    descriptor = os.open(output, os.O_WRONLY) if isinstance(output, str) else output
    source = subprocess.DEVNULL if stdin is None else subprocess.PIPE
    client = Forked(arguments, talk.env, stdin=source, stdout=descriptor, stderr=subprocess.PIPE)
    os.close(descriptor)
    err = client.communicate(stdin, timeout=20)[1]
    assert "Traceback" not in err
    return client.wait(), err


def unread(talk: Talk, *command: str) -> tuple[int, str]:
    """Run `talk` with a closed pipe as its output, and return its exit code and its standard error."""
    reader, writer = os.pipe()
    os.close(reader)
    return run_to(talk, writer, *command)


# Commands that print


def test_a_command_whose_reader_has_gone_exits_with_141(scripted: Talk) -> None:
    scripted.run("say", "--wait", "length=0")
    for arguments in (["status"], ["--json", "status"], ["voices"], ["--json", "voices"], ["log"], ["set"], ["--help"]):
        assert unread(scripted, *arguments) == (CLOSED, ""), arguments
    done = bash(scripted, "talk status | head -n 1; echo ${PIPESTATUS[0]}")
    first, code = done.stdout.splitlines()
    assert (first.startswith("server   pid "), done.stderr) == (True, "")
    assert code in {"0", str(CLOSED)}  # talk may have written everything before the reader left


@pytest.mark.parametrize("closed", [">&-", "1</dev/null"])
def test_a_command_with_a_closed_output_exits_with_141(scripted: Talk, closed: str) -> None:
    done = bash(scripted, f"(talk status; echo $? >&2) {closed}")
    assert (done.stdout, done.stderr) == ("", f"{CLOSED}\n")


@pytest.mark.parametrize("command", ["status", "--json status", "say -w length=0", "voices"])
def test_a_full_disk_is_reported_with_a_readable_message(scripted: Talk, command: str) -> None:
    assert run_to(scripted, "/dev/full", *command.split()) == (1, FULL)


def test_an_io_error_is_not_mistaken_for_a_closed_reader(scripted: Talk) -> None:
    with open("/proc/self/mem", "r+b") as broken:  # nothing can be written to address 0
        result = run_to(scripted, os.dup(broken.fileno()), "status")
    assert result == (1, "talk: can't write to standard output: Input/output error\n")


def test_a_closed_standard_error_changes_no_exit_code(scripted: Talk) -> None:
    done = bash(scripted, "talk status 4k7f-99 2>&-; echo $?; talk say -w fail=audio_lost 2>&-; echo $?")
    assert [line for line in done.stdout.splitlines() if "-" not in line] == ["8", "4"]


# Output that can't be written from the start


def test_a_goal_is_spoken_even_if_its_id_cannot_be_printed(scripted: Talk) -> None:
    bash(scripted, "talk say length=0 >&-")
    run_to(scripted, "/dev/full", "say", "length=0")
    unread(scripted, "say", "length=0")
    assert [scripted.watcher.wait_for_terminal(goal) for goal in scripted.watcher.goals()] == ["SUCCEEDED"] * 3


@pytest.mark.parametrize("arguments", ["say", "say -w", "--json say -wf"])
def test_say_waits_even_if_its_output_was_closed_from_the_start(scripted: Talk, arguments: str) -> None:
    for closed in [">&-", "1</dev/null"] if arguments in {"say -w", "--json say -wf"} else []:
        done = bash(scripted, f"(talk {arguments} length=0.2; echo $? >&2) {closed}")
        assert (done.stdout, done.stderr) == ("", "0\n")
    assert unread(scripted, *arguments.split(), "length=0.2") == (0, "")
    for goal in scripted.watcher.goals():
        if arguments == "say":
            scripted.watcher.wait_for_terminal(goal)
        assert scripted.goal(goal)["state"] == "SUCCEEDED"  # it ended before the command did
    code, err = unread(scripted, *arguments.split(), "fail=audio_lost")
    assert (code, "speech failed" in err) == ((0, False) if arguments == "say" else (4, True))


def test_wait_waits_even_if_its_output_was_closed_from_the_start(scripted: Talk) -> None:
    goal = scripted.run("say", "fail=audio_lost length=0.2").id
    assert bash(scripted, f"talk wait {goal} >&-; echo $?").stdout == "4\n"
    goal = scripted.run("say", "fail=audio_lost length=0.2").id
    assert unread(scripted, "--json", "wait", "-f", goal)[0] == 4
    assert scripted.goal(goal)["state"] == "ABORTED"


@pytest.mark.parametrize("arguments", ["say -w", "--json say -wf", "wait", "wait -f"])
def test_a_client_waits_for_its_goal_even_if_the_disk_is_full(scripted: Talk, arguments: str) -> None:
    for text, state, code in (("length=0.2", "SUCCEEDED", 1), ("fail=audio_lost length=0.2", "ABORTED", 4)):
        given = scripted.run("say", text).id if "wait" in arguments else text
        ended, err = run_to(scripted, "/dev/full", *arguments.split(), given)
        goal = scripted.watcher.goals()[-1]
        assert scripted.goal(goal)["state"] == state  # the command waited for it
        notes = [] if arguments == "wait" else [FULL]
        notes += (
            [f"talk: {goal}: speech failed: scripted audio_lost; find out why with: talk doctor\n"]
            if state == "ABORTED"
            else []
        )
        assert sorted(err.splitlines(True)) == sorted(notes)
        assert ended == (0 if arguments == "wait" and code == 1 else code)  # `wait` prints nothing


@pytest.mark.parametrize("options", ["", "--json", "-w", "--json -f"])
def test_lines_are_spoken_even_if_the_disk_is_full(scripted: Talk, options: str) -> None:
    for first, code in (("length=0 a", 1), ("fail=audio_lost", 4) if options[-2:] in {"-w", "-f"} else ("nul \0", 5)):
        lines = f"{first}\nlength=0 b\n"
        ended, err = run_to(scripted, "/dev/full", "say", "--lines", *options.split(), stdin=lines)
        goal = scripted.watcher.goals()[-1]
        assert scripted.watcher.wait_for_terminal(goal) == "SUCCEEDED"
        assert scripted.goal(goal)["text"] == "length=0 b"
        assert (ended, err.count("can't write to standard output")) == (code, 1)


# Readers that go away later


class Reader:
    """The reader of a client's output."""

    def __init__(self, talk: Talk, *arguments: str, errors: bool = False, terminal: bool = False) -> None:
        """`errors`: also read standard error; `terminal`: use a terminal that doesn't control the client."""
        self.descriptor, client_end = os.openpty() if terminal else os.pipe()
        stderr = client_end if errors else subprocess.PIPE
        self.client = Forked(arguments, talk.env, stdout=client_end, stderr=stderr, start_new_session=True)
        os.close(client_end)
        _wait_until_caught(self.client, signal.SIGHUP)  # now the client has checked its output once

    def leave(self) -> int:
        """Close the output, and return the client's exit code."""
        os.close(self.descriptor)
        with self.client:
            return self.client.wait(10)


ENDLESS = "never-ends words=1"
#: A goal that takes 0.2 s to stop.
SLOW = f"{ENDLESS} slow-stop=0.2"


@pytest.mark.parametrize(
    ("arguments", "kind"),
    [
        (["say", "-w"], {}),
        (["say", "-wf"], {"terminal": True}),
        (["--json", "say", "-w"], {"errors": True}),
        (["-q", "say", "-w"], {"terminal": True, "errors": True}),
    ],
)
def test_a_goal_is_cancelled_if_its_reader_leaves(scripted: Talk, arguments: list[str], kind: dict[str, bool]) -> None:
    reader = Reader(scripted, *arguments, ENDLESS, **kind)
    goal = scripted.watcher.wait_until(lambda event: event.get("event") == "word")["id"]
    assert reader.leave() == CLOSED
    assert scripted.goal(goal)["state"] == "PREEMPTED"  # the client waited for it
    assert scripted.goal(goal)["by"]["client"]["pid"] == reader.client.pid


@pytest.mark.parametrize("first", ["reader", "signal"])
@pytest.mark.parametrize(
    ("arguments", "kind"),
    [("say -wf", {}), ("--json say -w", {"terminal": True, "errors": True})],
)
def test_a_signal_decides_the_exit_code_even_if_the_reader_has_gone(
    scripted: Talk, arguments: str, kind: dict[str, bool], first: str
) -> None:
    number = signal.SIGINT if first == "reader" else signal.SIGHUP
    reader = Reader(scripted, *arguments.split(), SLOW, **kind)
    goal = scripted.watcher.wait_until(lambda event: event.get("event") == "word")["id"]
    if first == "reader":
        reader.client.send_signal(signal.SIGSTOP)
        reader.client.send_signal(number)
        os.close(reader.descriptor)
        reader.client.send_signal(signal.SIGCONT)
    else:
        reader.client.send_signal(number)
        scripted.watcher.wait_for(goal, "PREEMPTING")  # the client has requested this
        os.close(reader.descriptor)
    err = reader.client.communicate(timeout=10)[1]
    assert reader.client.returncode == 128 + number
    assert scripted.watcher.wait_for_terminal(goal) == "PREEMPTED"
    assert err.count("Talk preempted") == (not kind.get("errors"))


@pytest.mark.parametrize(
    ("arguments", "first"),
    [("say -w", signal.SIGINT), ("say -w --lines", signal.SIGHUP)],
)
def test_a_second_signal_does_not_change_the_exit_code(scripted: Talk, arguments: str, first: signal.Signals) -> None:
    lines = "--lines" in arguments
    client = scripted.start(*arguments.split(), *([] if lines else [SLOW]), stdin=subprocess.PIPE)
    if lines:
        assert client.stdin
        client.stdin.write(f"{SLOW}\n")
        client.stdin.flush()
    goal = scripted.watcher.wait_until(lambda event: event.get("event") == "word")["id"]
    client.send_signal(first)
    scripted.watcher.wait_for(goal, "PREEMPTING")
    client.send_signal(signal.SIGHUP)
    done = scripted.finish(client)
    assert (done.code, done.err.count("Talk preempted")) == (128 + first, 1)


@pytest.mark.parametrize("shared", [True, False], ids=["with its input", "output only"])
def test_nothing_is_spoken_if_the_reader_goes_away_while_text_is_read(scripted: Talk, shared: bool) -> None:
    reader_end, client_end = socket.socketpair()  # like sshd's for a command
    reader, output = (-1, client_end.fileno()) if shared else os.pipe()
    arguments = ["say", "-w", "-"]
    client = Forked(arguments, scripted.env, stdin=client_end.fileno(), stdout=output, stderr=subprocess.PIPE)
    client_end.close()
    reader_end.send(b"half of a sen")
    while fcntl.ioctl(reader_end, termios.TIOCOUTQ, b"    ") != b"\0\0\0\0":  # no event reports that it was read
        time.sleep(0.002)
    if shared:
        reader_end.close()
    else:
        os.close(output)
        os.close(reader)
    with reader_end:
        err = client.communicate(timeout=10)[1]
    assert (client.returncode, err) == (CLOSED, "")
    assert scripted.watcher.goals() == []


def test_a_text_is_spoken_if_its_sender_closes_only_the_input(scripted: Talk) -> None:
    reader_end, client_end = socket.socketpair()
    with reader_end:
        client = Forked(["say", "-w", "-"], scripted.env, stdin=client_end.fileno(), stdout=client_end.fileno())
        client_end.close()
        reader_end.send(b"length=0 whole")
        reader_end.shutdown(socket.SHUT_WR)
        assert client.wait(10) == 0
        assert scripted.goal(reader_end.recv(100).decode().strip())["state"] == "SUCCEEDED"


@pytest.mark.parametrize("arguments", [["say", "-w"], ["say", "-wf"]])
def test_a_closed_reader_of_an_attached_client_cancels_nothing(scripted: Talk, arguments: list[str]) -> None:
    text = "never-ends length=60 " + "word " * 600  # ten words per second
    scripted.run("say", "--id", "mine", text)
    scripted.watcher.wait_for_word("mine")
    reader = Reader(scripted, *arguments, "--id", "mine", text)
    assert os.read(reader.descriptor, 4) == b"mine"
    assert reader.leave() == CLOSED
    assert scripted.goal("mine")["state"] == "ACTIVE"


@pytest.mark.parametrize(
    ("arguments", "terminal"),
    [(["wait"], True), (["wait", "-f"], False), (["wait", "-f"], True)],
)
def test_a_closed_reader_ends_wait_and_cancels_nothing(scripted: Talk, arguments: list[str], terminal: bool) -> None:
    goal = scripted.run("say", ENDLESS).id
    reader = Reader(scripted, *arguments, goal, terminal=terminal)
    if terminal and arguments == ["wait", "-f"]:
        assert os.read(reader.descriptor, 1)
    assert reader.leave() == CLOSED
    assert scripted.goal(goal)["state"] in {"PENDING", "ACTIVE"}


def test_sighup_cancels_the_goal_of_say_unless_nohup_blocks_it(scripted: Talk) -> None:
    for arguments, code, state in ((["say", "-w"], 129, "PREEMPTED"), (["wait"], 129, "ACTIVE")):
        goal = scripted.run("say", ENDLESS).id if arguments == ["wait"] else None
        client = scripted.start(*arguments, goal or ENDLESS)
        goal = goal or scripted.watcher.wait_until(lambda event: event.get("event") == "word")["id"]
        _wait_until_caught(client, signal.SIGHUP)
        client.send_signal(signal.SIGHUP)
        assert scripted.finish(client).code == code
        assert scripted.goal(goal)["state"] == state
        scripted.run("cancel")
    needs("nohup")
    command = ["nohup", *TALK.split(), "say", "-w", "--id", "kept", ENDLESS]
    null = subprocess.DEVNULL
    kept = subprocess.Popen(command, env=scripted.env, stdin=null, stdout=subprocess.PIPE, stderr=null)
    assert kept.stdout
    with kept.stdout:
        assert kept.stdout.readline() == b"kept\n"
        kept.send_signal(signal.SIGHUP)
        scripted.run("cancel", "kept")
        assert kept.wait(10) == 7


def _wait_until_caught(client: Process, number: int) -> None:
    """Wait until a process catches a signal. No event reports this."""
    while True:
        assert client.poll() is None, "the client has ended"
        with open(f"/proc/{client.pid}/status", encoding="utf-8") as status:
            caught = next(int(line.split()[1], 16) for line in status if line.startswith("SigCgt:"))
        if caught >> (number - 1) & 1:
            return
        time.sleep(0.002)
