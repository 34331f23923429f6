"""The options of `say`. Contradictions are refused before anything is sent."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shlex
import signal
import struct
import subprocess
import termios
import time
import wave
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK, alone, environment, run
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


def busy(talk: Talk) -> str:
    """Start a goal that doesn't end, and return its id when its first word is heard."""
    goal_id = talk.run("say", "never-ends words=1").id
    talk.watcher.wait_for_word(goal_id)
    return goal_id


def test_markdown_is_spoken_without_its_marks(make_talk: MakeTalk, tmp_path: Path) -> None:
    talk, text = make_talk("--player", "null", "--rate", "450"), "**Battery** [low](http://a.b/c)"
    plain = talk.goal(talk.run("say", "--wait", "Battery low").id)
    done = talk.run("say", "--feedback", "--markdown", text)
    goal = talk.goal(done.out.split()[0])
    assert (done.code, goal["format"], goal["text"]) == (0, "markdown", text)
    assert goal["duration"] == pytest.approx(plain["duration"], abs=0.01)
    assert [line.split()[3::2] for line in done.out.splitlines() if " word " in line] == [
        ["2-9", "Battery"],
        ["13-16", "low"],
    ]
    line = talk.run("say", "--lines", "--wait", "--markdown", stdin=text)
    assert talk.goal(line.id)["duration"] == pytest.approx(plain["duration"], abs=0.01)
    for name, words in (("plain", ["Battery low"]), ("markdown", ["--markdown", text])):
        assert alone("say", "-o", f"{tmp_path}/{name}", *words).code == 0
    assert (tmp_path / "plain").read_bytes() == (tmp_path / "markdown").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "hints"),
    [
        (["--lines", "-"], ["--lines", "TEXT"]),
        (["--lines", "--id", "mine"], ["--lines", "--id"]),
        (["--lines", "--timeout", "3"], ["--timeout", "--wait"]),
        (["--ahead", "3", "hello"], ["--ahead", "--lines"]),
        (["-o", "x.wav"], ["TEXT"]),
        (["-o", "x.wav", "-w", "--key", "k", "hello"], ["--output", "--wait, --key"]),
        (["-o", "x.wav", "--lines"], ["--output", "--lines"]),
        (["-o", "x.wav", "--id", "mine", "--as", "me", "hello"], ["--id, --as"]),
        (["--key", "k\udcff\udcfe", "hello"], ["--key", "0xff"]),
        (["--as", "日\udcff", "hello"], ["--as", "0xff"]),
        (["--as=", "-o", "x.wav", "hello"], ["--as", "variable"]),
    ],
)
def test_contradictions_and_values_out_of_range_are_usage_errors(arguments: list[str], hints: list[str]) -> None:
    """`tests/golden/errors.txt` has many more cases."""
    done = alone("say", *arguments)
    assert (done.code, done.out) == (2, ""), done
    assert [hint for hint in hints if hint not in done.err] == [], done.err


def test_preempt_queue_flush_and_priority_reach_the_server(make_talk: MakeTalk) -> None:
    talk = make_talk("--preempt", scripted=True)
    first = busy(talk)
    queued = [talk.run("say", "--queue", "--priority", priority, "length=0").id for priority in ("-1", "0", "5")]
    assert [talk.watcher.states(goal_id) for goal_id in queued] == [["PENDING"]] * 3
    assert talk.run("say", "--wait", "--preempt", "--priority", "9", "length=0").code == 0
    assert talk.watcher.wait_for_terminal(first) == "PREEMPTED"
    assert {talk.watcher.wait_for_terminal(goal_id) for goal_id in queued} == {"SUCCEEDED"}
    started = [event["id"] for event in talk.watcher.events() if event.get("state") == "ACTIVE"]
    assert started[2:] == queued[::-1]
    first = busy(talk)
    pending, important = (talk.run("say", "--queue", "--priority", priority, "length=0").id for priority in ("0", "1"))
    assert talk.run("say", "--wait", "--flush", "length=0 now").code == 0
    ends = [talk.watcher.wait_for_terminal(goal_id) for goal_id in (first, pending, important)]
    assert ends == ["PREEMPTED", "RECALLED", "SUCCEEDED"]


def test_a_throttled_goal_exits_with_0_and_prints_no_id(scripted: Talk) -> None:
    throttled = ["say", "--key", "battery", "--throttle", "60"]
    assert scripted.run(*throttled, "--wait", "length=0").code == 0
    for options in ([], ["-f"]):
        done = scripted.run(*throttled, *options, "length=0")
        assert (done.code, done.out) == (0, ""), done
        assert "less than 60 s ago" in done.err
        assert done.err.count("\n") == 1
    quiet = scripted.run(*throttled, "-q", "length=0")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")
    goal = json.loads(scripted.run("--json", *throttled, "length=0").out)
    assert (goal["state"], goal["reason"]) == ("REJECTED", "throttled")


def test_the_settings_of_a_goal_come_from_options_not_from_variables(make_talk: MakeTalk) -> None:
    env = {"TALK_RATE": "111", "TALK_VOLUME": "0.1", "TALK_VOICE": "nobody"}
    talk = make_talk(scripted=True)
    done = run([*TALK, "say", "--wait", "length=0"], {**talk.env, **env})
    assert done.code == 0, done.err
    given = ("--rate", "250", "--volume", "0.5", "--pitch", "20", "--voice", "en")
    assert talk.run("say", "--wait", *given, "length=0").code == 0
    unknown = talk.run("say", "--voice", "nobody-speaks-it", "length=0")
    assert (unknown.code, unknown.out) == (5, "")
    assert "nobody-speaks-it" in unknown.err


def test_ctrl_c_while_the_text_is_read_prints_a_newline(scripted: Talk) -> None:
    with subprocess.Popen(
        [*TALK, "say", "-"], env=scripted.env, stdin=subprocess.PIPE, stderr=subprocess.PIPE
    ) as client:
        assert client.stdin
        client.stdin.write(b"battery")
        client.stdin.flush()
        while struct.unpack("i", fcntl.ioctl(client.stdin, termios.FIONREAD, bytes(4)))[0]:
            time.sleep(0.005)  # no event reports that another process has read
        client.send_signal(signal.SIGINT)
        assert client.stderr
        assert client.stderr.read() == b"\n"
    assert client.returncode == 130


def test_say_reports_that_speech_is_paused(scripted: Talk) -> None:
    active = busy(scripted)
    assert scripted.run("pause").code == 0
    note = r"talk: speech is paused by \S+ since \S+; to continue, run: talk resume\n"
    assert re.fullmatch(note, scripted.run("say", "length=0").err)
    assert scripted.run("say", "-q", "length=0").err == ""
    waiting = scripted.start("say", "-w", "length=0")
    assert waiting.stdout
    assert waiting.stdout.readline()  # the id is printed before the goal is spoken
    assert scripted.run("resume").code == 0
    scripted.run("cancel", active)
    ended = scripted.finish(waiting)
    assert ended.code == 0
    assert re.fullmatch(note, ended.err)
    assert scripted.run("say", "length=0").err == ""


def test_a_goal_with_a_chosen_id_is_spoken_once(scripted: Talk) -> None:
    text = "fail=audio_lost message=no_cable"
    assert scripted.run("say", "--id", "dock-17a", text).out == "dock-17a\n"
    scripted.watcher.wait_for_terminal("dock-17a")
    for options, out in (([], "dock-17a\n"), (["--wait", "-f"], "dock-17a ABORTED\n")):
        done = scripted.run("say", "--id", "dock-17a", *options, text)  # the result is already known
        assert (done.code, done.out) == (4, out)
        assert done.err == "talk: dock-17a: speech failed: no cable; find out why with: talk doctor\n"
    goal = json.loads(scripted.run("--json", "say", "--id", "dock-17a", text).out)
    assert (goal["id"], goal["state"]) == ("dock-17a", "ABORTED")
    assert scripted.watcher.states("dock-17a") == ["PENDING", "ACTIVE", "ABORTED"]
    conflict = scripted.run("say", "--id", "dock-17a", "another text")
    assert (conflict.code, conflict.out) == (5, "")


def test_an_attached_client_cancels_nothing(scripted: Talk) -> None:
    text = "never-ends length=60 " + "word " * 600  # ten words per second
    scripted.run("say", "--id", "mine", text)
    scripted.watcher.wait_for_word("mine")
    late = scripted.run("say", "--wait", "-t", "0.3", "--id", "mine", text)
    assert late.code == 124
    assert late.err == "talk: timed out after 0.3 s: mine was sent earlier and continues\n"
    attached = scripted.start("say", "--wait", "-f", "--id", "mine", text)
    assert attached.stdout
    assert attached.stdout.readline().startswith("mine word ")
    attached.send_signal(signal.SIGTERM)
    assert attached.wait(10) == 143
    assert scripted.goal("mine")["state"] == "ACTIVE"
    waiting = scripted.start("say", "--wait", "--id", "mine", text)
    assert waiting.stdout
    assert waiting.stdout.readline() == "mine\n"
    scripted.run("cancel", "mine")
    assert scripted.finish(waiting).code == 7


def test_output_writes_a_file_without_a_server(tmp_path: Path) -> None:
    file = tmp_path / "said.wav"
    done = alone("say", "-o", str(file), "--", "battery", "low")
    assert (done.code, done.out, done.err) == (0, "", "")
    with wave.open(str(file)) as audio:
        seconds = audio.getnframes() / audio.getframerate()
    report = json.loads(alone("--json", "say", "-o", str(file), "battery low").out)
    assert report["output"] == str(file)
    assert report["text"] == "battery low"
    with short_directory() as home:
        script = f'"$@" --json say -o {shlex.quote(str(file))} one >&-'
        done = run(["bash", "-c", script, "bash", *TALK], environment(home, TALK_SOCKET=f"{home}/s"))
        assert (done.code, done.err) == (0, "")
    assert report["seconds"] == pytest.approx(seconds, abs=0.05)


def test_output_omits_and_reports_invalid_utf8_bytes(tmp_path: Path) -> None:
    hidden = ".mp3"  # a hidden file without an extension
    for name, text in (("said.wav", "battery \udcfflow"), (hidden, "battery  low")):
        done = alone("say", "-o", str(tmp_path / name), "--", text, TALK_NAME="patrol")
        assert (done.code, done.out) == (0, "")
        assert ("line 1, column 9: the byte 0xff is not valid UTF-8 and is skipped\n" in done.err) == ("said" in name)
    assert (tmp_path / "said.wav").read_bytes() == (tmp_path / hidden).read_bytes()


def _seconds_of(tmp_path: Path, *arguments: str, **env: str) -> float:
    done = alone("--json", "say", "-o", str(tmp_path / "x.wav"), *arguments, "one two three four five six", **env)
    assert done.code == 0, done.err
    return float(json.loads(done.out)["seconds"])


def test_output_can_be_standard_output(tmp_path: Path) -> None:
    with short_directory() as home:
        env = environment(home, TALK_SOCKET=f"{home}/s")
        script = 'printf "battery low" | "$@" say -o - - | cat > said.wav'
        done = run(["bash", "-c", f"set -o pipefail; {script}", "bash", *TALK], env, cwd=tmp_path)
        assert (done.code, done.out, done.err) == (0, "", "")
        gone = run(["bash", "-c", '"$@" say -o - one two three | true; echo ${PIPESTATUS[0]}', "bash", *TALK], env)
        assert (gone.out, gone.err) == ("141\n", "")
        full = run(["bash", "-c", '"$@" say -o - one > /dev/full', "bash", *TALK], env)
        assert (full.code, full.err) == (1, "talk: standard output cannot be written: No space left on device\n")
    piped = (tmp_path / "said.wav").read_bytes()
    assert alone("say", "-o", str(tmp_path / "file.wav"), "battery low").code == 0
    assert piped[44:] == (tmp_path / "file.wav").read_bytes()[44:]
    both = alone("--json", "say", "-o", "-", "x")
    assert (both.code, both.out) == (2, "")
    assert "standard output" in both.err


def test_output_prefers_options_to_environment_variables(tmp_path: Path) -> None:
    usual = _seconds_of(tmp_path, "--rate", "200", TALK_RATE="100")
    assert _seconds_of(tmp_path, TALK_RATE="") == pytest.approx(usual, abs=0.1)
    assert _seconds_of(tmp_path, TALK_RATE="100") > 1.5 * usual
    for variable, value in (("TALK_RATE", "5"), ("TALK_VOLUME", "nan")):
        done = alone("say", "-o", str(tmp_path / "never.wav"), "hello", **{variable: value})
        assert done.code == 2
        assert variable in done.err
    unknown = alone("say", "-o", str(tmp_path / "never.wav"), "hello", TALK_VOICE="nobody-speaks-it")
    assert unknown.code == 5
    assert "nobody-speaks-it" in unknown.err
    assert os.listdir(tmp_path) == ["x.wav"]


def test_a_failed_output_reports_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    for arguments, code in (
        (["-o", f"{tmp_path}/no/x.wav", "hello"], 1),
        (["-o", str(tmp_path), "hello"], 2),
        (["-o", f"{tmp_path}/x.wav", ""], 5),
        (["-o", f"{tmp_path}/x.wav", "-t", "0.001", "hello"], 124),
    ):
        done = alone("say", *arguments)
        assert (done.code, done.out) == (code, ""), done
        assert done.err
    assert os.listdir(tmp_path) == []


def test_an_interrupted_output_leaves_no_file(tmp_path: Path) -> None:
    with short_directory() as home:
        client = subprocess.Popen(
            [*TALK, "say", "-o", str(tmp_path / "x.wav"), "--rate", "80", "--", "one two three. " * 600],
            env=environment(home),
        )
        while not os.listdir(tmp_path):  # a hidden file appears when the engine starts
            assert client.poll() is None
            time.sleep(0.005)
        client.send_signal(signal.SIGINT)
        assert client.wait(10) == 130
    assert os.listdir(tmp_path) == []
