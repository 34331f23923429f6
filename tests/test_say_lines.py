"""`say --lines`: each line of standard input is a goal. Few are pending, and none is spoken late or twice."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from select import POLLOUT, poll
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK, environment
from tests.support.forking import Forked
from tests.support.surroundings import short_directory
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

ENDLESS = "never-ends words=1\n"


class Typing:
    """A client whose standard input stays open."""

    def __init__(self, talk: Talk, *arguments: str) -> None:
        self.client = talk.start(*arguments, stdin=subprocess.PIPE)
        assert self.client.stdin
        assert self.client.stdout
        assert self.client.stderr
        self._input, self._output, self.errors = self.client.stdin, self.client.stdout, self.client.stderr

    def type(self, text: str) -> None:
        self._input.write(text)
        self._input.flush()

    def line(self) -> str:
        """Return the next line that the client prints."""
        return self._output.readline().rstrip("\n")

    def end(self, number: signal.Signals | None = None) -> tuple[int, list[str], str]:
        """Send the client a signal, or close its input. Return its exit code, remaining output and messages."""
        if number is None:
            self._input.close()
        else:
            self.client.send_signal(number)
        out, err = self._output.read().splitlines(), self.errors.read()
        code = self.client.wait(20)
        self._input.close()
        assert "Traceback" not in err, err
        return code, out, err


def test_each_line_is_a_goal_and_its_id_is_printed(scripted: Talk) -> None:
    lines = "length=0 one\n\n   \n\u3000\nlength=0 two\r\nlength=0 -x 日本\nlength=0 last"
    done = scripted.run("say", "--lines", stdin=lines)
    assert (done.code, done.err) == (0, "")
    ids = done.out.split()
    assert len(ids) == 4
    scripted.watcher.wait_for_terminal(ids[-1])
    texts = ["length=0 one", "length=0 two", "length=0 -x 日本", "length=0 last"]
    assert [scripted.goal(goal_id)["text"] for goal_id in ids] == texts
    assert scripted.watcher.texts("ACTIVE") == texts
    for options in ([], ["-f"], ["-w", "--json"]):
        done = scripted.run("say", "--lines", *options, stdin="\n\r\n")
        assert (done.code, done.out, done.err) == (0, "", ""), "empty input is a success"


def test_endless_input_is_spoken_line_by_line(scripted: Talk) -> None:
    typing = Typing(scripted, "say", "--lines")
    for text in ("length=0 one", "length=0 two"):
        typing.type(f"{text}\n")
        assert scripted.goal(typing.line())["text"] == text
    typing.type("half a li")
    typing.type("ne\n")
    assert scripted.goal(typing.line())["text"] == "half a line"
    typing.type("length=0 without a newline")
    code, out, err = typing.end()
    assert (code, err) == (0, "")
    assert scripted.goal(out[0])["text"] == "length=0 without a newline"


def test_options_apply_to_each_line_with_the_remaining_ttl(scripted: Talk) -> None:
    options = ("--as", "reader", "--priority", "3", "--ttl", "9", "--ahead", "1")
    text = "length=0.5 one\n\0\nlength=0 two\nlength=0 three\n"
    done = scripted.run("--json", "say", "--lines", *options, stdin=text)
    goals = [json.loads(line) for line in done.out.splitlines()]
    assert [goal["state"] for goal in goals] == ["PENDING", "REJECTED", "PENDING", "PENDING"]  # the first state
    goals.pop(1)
    assert [(goal["priority"], goal["client"]["name"]) for goal in goals] == [(3, "reader")] * 3
    first, second, third = [goal["ttl"] for goal in goals]
    assert 9 >= first >= second > third
    assert third <= 8.5
    ended = scripted.run("--json", "say", "--lines", "-w", "--key", "k", stdin="length=0\nfail=audio_lost\n")
    goals = [json.loads(line) for line in ended.out.splitlines()]
    assert {goal["key"] for goal in goals} == {"k"}
    assert (goals[-1]["state"], ended.code) == ("ABORTED", 4)


def test_a_refused_line_is_reported_by_number_and_the_rest_is_spoken(scripted: Talk) -> None:
    widest = "\N{GRINNING FACE}" * 10_000  # the longest text in bytes, without its line end
    lines = ["length=0 one", "", "nul \0", "length=0 two", "x" * 10_001, "y" * 300_000, "length=0 three"]
    text = "\n".join([*lines, f"{widest}\r", f"{widest}a\r\n"])
    done = scripted.run("say", "--lines", stdin=text)
    assert (done.code, len(done.out.split())) == (5, 4)
    notes = done.err.splitlines()
    assert [line.split(":")[1] for line in notes] == [" line 3", " line 5", " line 6", " line 9"]
    for note, excerpt in zip(notes, ("NUL", "10,001 characters", "300,000 bytes", "40,002 bytes"), strict=True):
        assert excerpt in note
    quiet = scripted.run("-q", "say", "--lines", stdin=text)
    assert (quiet.code, quiet.out, quiet.err) == (5, "", "")


def test_a_line_with_invalid_utf8_is_reported_and_spoken(scripted: Talk) -> None:
    data = b"length=0 one\n\nlength=0 t\xffw\xfeo\n\xff\nlength=0 three\xc3"
    done, quiet = (
        subprocess.run([*TALK, *arguments], env=scripted.env, input=data, capture_output=True, timeout=60, check=False)
        for arguments in (["say", "--lines", "--wait"], ["-q", "say", "--lines"])
    )
    assert (done.returncode, len(done.stdout.split())) == (0, 4)
    assert done.stderr.decode().splitlines() == [
        "talk: line 3, column 11: the byte 0xff is not valid UTF-8 and is skipped (1 more like it)",
        "talk: line 4, column 1: the byte 0xff is not valid UTF-8 and is skipped",
        "talk: line 5, column 15: the byte 0xc3 is not valid UTF-8 and is skipped",
    ]
    texts = ["length=0 one", "length=0 t\ufffdw\ufffdo", "\ufffd", "length=0 three\ufffd"]
    assert scripted.watcher.texts("ACTIVE")[:4] == texts
    assert quiet.stderr == b""


def test_wait_reports_failures_and_exits_with_the_first_one(scripted: Talk) -> None:
    text = "length=0 fine\nfail=audio_lost message=no_cable\n\0\nlength=0 too\n"
    done = scripted.run("say", "--lines", "--wait", stdin=text)
    assert done.code == 4
    ids = done.out.split()
    assert f"talk: {ids[1]}: speech failed: no cable; find out why with: talk doctor" in done.err.splitlines()
    refused_first = scripted.run("say", "--lines", "--wait", stdin="\0\nfail=audio_lost\n")
    assert refused_first.code == 5
    throttled = scripted.run("say", "--lines", "-w", "--key", "k", "--throttle", "60", stdin="length=0 a\nlength=0 b\n")
    assert (throttled.code, len(throttled.out.split()), "line 2: " in throttled.err) == (0, 1, True)


def test_feedback_shows_the_events_of_all_lines(scripted: Talk) -> None:
    done = scripted.run("say", "--lines", "-f", stdin="length=0.1 a\nlength=0.1 b\n")
    assert done.code == 0
    shown = [line.split(" ", 1) for line in done.out.splitlines()]
    assert [event for _, event in shown] == [
        "PENDING", "ACTIVE", "word 1 0-10 0.000 length=0.1", "word 2 11-12 0.050 a", "SUCCEEDED",
        "PENDING", "ACTIVE", "word 1 0-10 0.000 length=0.1", "word 2 11-12 0.050 b", "SUCCEEDED",
    ]  # fmt: skip
    as_objects = scripted.run("--json", "say", "--lines", "-f", stdin="length=0\n\0\n")
    events = [json.loads(line) for line in as_objects.out.splitlines()]
    assert [event["goal"]["state"] for event in events if event["event"] == "result"].count("REJECTED") == 1
    assert {"word", "state", "result"} == {event["event"] for event in events}


@pytest.mark.parametrize(("options", "ahead"), [([], 10), (["--ahead", "2", "--wait"], 2)])
def test_few_lines_are_pending_so_that_others_have_room(scripted: Talk, options: list[str], ahead: int) -> None:
    typing = Typing(scripted, "say", "--lines", *options)
    lines = [ENDLESS.rstrip(), *(f"length=0 {number}" for number in range(20))]
    typing.type("\n".join(lines))
    ids = [typing.line() for _ in range(ahead + 1)]
    scripted.watcher.wait_for_word(ids[0])
    other = scripted.run("say", "length=0 other").id
    scripted.run("cancel", ids[0])
    scripted.watcher.wait_for_terminal(other)
    typing.end()
    scripted.watcher.wait_until(lambda _: len(scripted.watcher.texts("SUCCEEDED")) == len(lines))
    assert scripted.watcher.texts("PENDING") == [*lines[: ahead + 1], "length=0 other", *lines[ahead + 1 :]]


def test_a_line_replaces_a_pending_line_with_its_key_despite_the_limit(scripted: Talk) -> None:
    typing = Typing(scripted, "say", "--lines", "--key", "k", "--ahead", "1")
    typing.type(ENDLESS + "length=0 old\nlength=0 older\nlength=0 new\n")
    ids = [typing.line() for _ in range(4)]
    assert [scripted.goal(goal_id)["state"] for goal_id in ids] == ["ACTIVE", "RECALLED", "RECALLED", "PENDING"]
    assert typing.end()[0] == 0


@pytest.mark.parametrize("ttl", ["0.3", "0"])
def test_lines_whose_ttl_expires_are_dropped(make_talk: MakeTalk, ttl: str) -> None:
    talk = make_talk("--max-queue", "1", scripted=True)
    others = [talk.run("say", text).id for text in (ENDLESS, "never-ends")]
    talk.watcher.wait_for_word(others[0])
    started_at = time.monotonic()
    typing = Typing(talk, "say", "--lines", "--json", "--wait", "--ttl", ttl)
    typing.type("length=0 one\nlength=0 two\nlength=0 three\n")
    if ttl == "0":
        time.sleep(0.4)  # no event to wait for
    else:
        notes: list[str] = []
        while len(notes) < 2:  # other notes report the result of the sent line
            notes += [line for line in [typing.errors.readline()] if "was not sent" in line or not line]
        assert time.monotonic() - started_at >= 0.3
        assert notes == [f"talk: line {number} was not sent: its ttl of 0.3 s is over\n" for number in (2, 3)]
    talk.run("cancel", *others)
    exit_code, out, err = typing.end()
    assert (exit_code, "was not sent" in err) == (0 if ttl == "0" else 6, False)
    texts = [f"length=0 {word}" for word in ("one", "two", "three")]
    assert talk.watcher.texts("ACTIVE")[1:] == (texts if ttl == "0" else [])
    # The ttl includes the time that the first line waited for room.
    ends = [("SUCCEEDED", None) if ttl == "0" else ("RECALLED", "expired")] * 3
    goals = [json.loads(line) for line in out]
    assert sorted((goal["text"], goal["state"], goal["reason"]) for goal in goals) == sorted(
        (text, *end) for text, end in zip(texts, ends, strict=True)
    )


def test_only_as_much_input_is_read_as_can_be_kept(scripted: Talk) -> None:
    most, options = 1_000_000, ["--ttl", "60"]
    client = Forked(["say", "--lines", *options], scripted.env, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    assert client.stdin
    pipe = client.stdin.fileno()
    os.write(pipe, ENDLESS.encode())
    os.set_blocking(pipe, False)
    room, written = poll(), 0
    room.register(pipe, POLLOUT)
    with client:
        while room.poll(10_000 if written < most else 500):
            written += os.write(pipe, b"length=0 line\n" * 1_000)
            assert written < most + 400_000  # the pipe and the read buffer hold more
        assert written >= most
        client.kill()
        client.wait(10)


def test_several_hundred_lines_are_spoken_per_second(make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True, watched=False)
    lines = [f"length=0 {number}" for number in range(300)]
    with limits():
        done = talk.run("say", "--lines", "--wait", stdin="\n".join(lines))
        assert_within(done.seconds, 1.5, f"{len(lines)} lines")  # takes half a second on an idle machine
    assert (done.code, len(done.out.split())) == (0, len(lines))


def test_an_endless_line_is_read_with_bounded_memory(scripted: Talk) -> None:
    limited = ["sh", "-c", 'ulimit -v 400000 && exec "$@"', "sh", *TALK, "say", "--lines"]
    client = subprocess.Popen(
        limited, env=scripted.env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert client.stdin
    for _ in range(450):
        client.stdin.write(b"x" * 1_000_000)
    out, err = client.communicate(b"\nlength=0 next\n", timeout=60)
    assert client.returncode == 5, err
    assert b"line 1: not spoken: the line has 450,000,000 bytes" in err
    assert len(out.split()) == 1


def test_a_signal_cancels_only_the_clients_own_goals(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "4", scripted=True)
    other = talk.run("say", "--priority", "-1", "length=0 other").id
    talk.watcher.wait_for_terminal(other)
    typing = Typing(talk, "say", "--lines", "--wait")
    typing.type(ENDLESS + "second\nthird\n")
    ids = [typing.line() for _ in range(3)]
    other = talk.run("say", "length=0 other").id
    talk.watcher.wait_for_word(ids[0])
    started_at = time.monotonic()
    code, out, err = typing.end(signal.SIGINT)
    assert time.monotonic() - started_at < 3
    assert (code, out) == (130, [])
    assert f"talk: {ids[0]}: Talk preempted: the goal was cancelled\n" in err
    assert "removed 2 waiting lines from the queue" in err
    assert [talk.watcher.wait_for_terminal(goal_id) for goal_id in ids] == ["PREEMPTED", "RECALLED", "RECALLED"]
    assert talk.watcher.wait_for_terminal(other) == "SUCCEEDED"
    assert talk.watcher.states(ids[2]) == ["PENDING", "RECALLED"]
    typing = Typing(talk, "say", "--lines")  # without --wait, its goals continue
    typing.type(f"{ENDLESS}\nsecond\n")
    ids = [typing.line() for _ in range(2)]
    assert typing.end(signal.SIGHUP) == (129, [], "")
    assert talk.goal(ids[1])["state"] == "PENDING"


@pytest.mark.parametrize("options", [["--json", "--wait"], ["-f"]])
def test_a_line_that_waits_for_room_is_not_spoken_after_a_signal(make_talk: MakeTalk, options: list[str]) -> None:
    talk = make_talk("--max-queue", "1", scripted=True)
    typing = Typing(talk, "say", "--lines", *options)
    typing.type(ENDLESS + "second\nthird\nfourth\n")
    talk.watcher.wait_until(lambda event: bool(event.get("goal")) and event["goal"]["text"] == "second")
    # The client may not have its reply yet, and the third line causes no event.
    code, out, err = typing.end(signal.SIGINT)
    assert code == 130
    assert re.search("line [23] may not have been accepted, and the lines after it were not sent", err)
    assert talk.watcher.texts("ACTIVE") == [ENDLESS.rstrip()]
    assert talk.watcher.texts("PENDING")[:2] == [ENDLESS.rstrip(), "second"]
    if "--json" in options:
        last = [json.loads(line) for line in out][-2:]
        states = [result["goal"]["state"] if "event" in result else result["state"] for result in last]
        assert sorted(states) == ["PREEMPTED", "RECALLED"]
    assert talk.run("--json", "status").out.count('"PENDING"') == 0


def test_the_timeout_applies_to_all_lines_together(scripted: Talk) -> None:
    typing = Typing(scripted, "say", "--lines", "-w", "-t", "0.5")
    typing.type(ENDLESS + "second\n")
    ids = [typing.line(), typing.line()]
    code, _, err = typing.end()
    assert code == 124
    assert "Talk preempted" in err
    assert err.splitlines()[-1] == "talk: timed out after 0.5 s"
    assert [scripted.watcher.wait_for_terminal(goal_id) for goal_id in ids] == ["PREEMPTED", "RECALLED"]
    started_at = time.monotonic()
    silent = Typing(scripted, "say", "--lines", "-w", "-t", "0.2")
    assert silent.client.wait(10) == 124  # without any input or goals
    assert time.monotonic() - started_at >= 0.2
    assert scripted.run("say", "--lines", "-w", "-t", "1e300", stdin="length=0\n").code == 0


@pytest.mark.parametrize("options", [[], ["-f"]])
def test_the_client_exits_if_the_server_goes_away(scripted: Talk, options: list[str]) -> None:
    typing = Typing(scripted, "say", "--lines", *options)
    typing.type(ENDLESS)
    first = typing.line().split()[0]
    scripted.watcher.wait_for_word(first)
    scripted.kill()
    assert typing.client.wait(10) == (12 if options else 3)
    _, out, err = typing.end()
    assert "lost the connection to the server" in err
    assert ("may still be spoken" in err) == bool(options)
    assert [line for line in out if "LOST" in line] == ([f"{first} LOST"] if options == ["-f"] else [])


def test_a_lost_idle_server_is_reported_with_the_next_line(scripted: Talk) -> None:
    typing = Typing(scripted, "say", "--lines")
    typing.type("\0\n")
    assert "line 1" in typing.errors.readline()
    scripted.kill()
    typing.type("into the void\n")
    code, _, err = typing.end()
    assert code == 5  # for the first line that failed
    assert "line 2 may not have been accepted" in err


def test_a_missing_server_is_reported_before_input_is_read() -> None:
    with short_directory() as home:
        client = subprocess.Popen(
            [*TALK, "say", "--lines"],
            env=environment(home, TALK_SOCKET=f"{home}/s"),
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert client.wait(10) == 3
        _, err = client.communicate()
        assert b"talk serve" in err


def piped(talk: Talk, *arguments: str, read: bool = True) -> tuple[Forked, int]:
    """Start `say --lines` with a pipe as its output. Return it with the reading end, which is closed unless `read`."""
    reader, writer = os.pipe()
    if not read:
        os.close(reader)
    command = ["say", "--lines", *arguments]
    client = Forked(command, talk.env, stdin=subprocess.PIPE, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    return client, reader


@pytest.mark.parametrize(("options", "read"), [([], False), (["-f"], False), ([], True)])
def test_lines_are_spoken_if_the_reader_of_their_ids_has_gone(scripted: Talk, options: list[str], read: bool) -> None:
    client, reader = piped(scripted, *options, read=read)
    assert client.stdin
    client.stdin.write("length=0 a\n")
    client.stdin.flush()
    if read:
        with open(reader, encoding="utf-8") as lines:
            assert lines.readline()
    assert client.communicate("\0\nlength=0 b\n", 10)[1].startswith("talk: line 2: ")
    assert client.returncode == 5
    scripted.watcher.wait_until(lambda _: scripted.watcher.texts("SUCCEEDED") == ["length=0 a", "length=0 b"])


@pytest.mark.parametrize(("options", "ended"), [(["--wait"], True), (["--wait", "--json"], False), (["-f"], False)])
def test_goals_are_cancelled_if_the_reader_goes_away(scripted: Talk, options: list[str], ended: bool) -> None:
    client, reader = piped(scripted, *options)
    with client:
        assert client.stdin
        client.stdin.write(f"{ENDLESS}second\n")
        client.stdin.flush()
        second = scripted.watcher.wait_until(lambda event: (event.get("goal") or {}).get("text") == "second")
        first = scripted.watcher.goals()[0]
        scripted.watcher.wait_for_word(first)
        if ended:
            client.stdin.close()
        os.close(reader)
        assert client.wait(10) == 141
    assert scripted.watcher.wait_for_terminal(first) == "PREEMPTED"
    assert scripted.watcher.wait_for_terminal(second["id"]) == "RECALLED"


def test_an_unreadable_standard_input_is_reported(scripted: Talk) -> None:
    for arguments in (["--lines"], ["-"]):
        with open(os.devnull, "wb") as write_only:
            command = [*TALK, "say", *arguments]
            done = subprocess.run(
                command, env=scripted.env, stdin=write_only, capture_output=True, timeout=20, check=False
            )
        assert (done.returncode, done.stdout) == (2, b"")
        assert b"can't read standard input: Bad file descriptor" in done.stderr
