"""The options, output, exit codes and errors of all commands."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import Client, __version__, cli
from talkcli.cli.commands import COMMANDS
from tests.conformance.bareserve import TALK, alone, run
from tests.conformance.rawsocket import GREETING, FakeServer
from tests.support.screen import Terminal
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from tests.support.processes import Talk

GOAL = {
    "id", "state", "status", "reason", "by", "message", "text", "format", "said", "spoken", "spoken_end",
    "heard", "priority", "key", "ttl", "data", "client", "paused", "interrupted_by", "more", "waits",
    "queued_at", "started_at", "ended_at", "duration", "voice", "output",
}  # fmt: skip
#: ESC, a bidi override, a line break, a bell, a NEL: none of these may reach a terminal.
HOSTILE = "a\x1b[31mred\u202egnp.exe\nfake line\x07\x85\u2028end"
RAW = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def error_of(err: str) -> dict[str, Any]:
    """Return the error from a standard error that contains one line of JSON."""
    lines = err.splitlines()
    assert len(lines) == 1, err
    error: dict[str, Any] = json.loads(lines[0])["error"]
    assert error.keys() == {"code", "exit", "message"}
    return error


# Usage errors. `tests/golden/errors.txt` has many more.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["STATUS"], "unknown command 'STATUS'; did you mean 'status'?"),
        (["stop"], "unknown command 'stop'; did you mean 'cancel'?"),
        (["start"], "unknown command 'start'; did you mean 'serve'?"),
        (["help"], "unknown command 'help'; try 'talk --help'"),
        (["help", "say"], "unknown command 'help'; try 'talk say --help'"),
        (["good", "morning"], "unknown command 'good'; to speak this text, type: talk say \"good morning\""),
        (
            ["sudo", "$(reboot)", 'a"b'],
            "unknown command 'sudo'; to speak this text, type: talk say 'sudo $(reboot) a\"b'",
        ),
        (
            ["say", "--loud", "x"],
            "unknown option '--loud'. To speak a text that starts with '-', type: talk say -- TEXT",
        ),
        (["cancel", "--key", "k\udcff"], "--key: the byte 0xff is not valid UTF-8"),
        (["serve", "--voice", "\udcfek"], "--voice: the byte 0xfe is not valid UTF-8"),
        (["set", "--voice"], "option '--voice' requires an argument"),
        (["serve", "--socket-mode", "0400"], "--socket-mode: must be a mode such as "),
    ],
)
def test_a_usage_error_suggests_the_next_step(arguments: list[str], message: str) -> None:
    done = alone(*arguments)
    assert (done.code, done.out) == (2, "")
    first, *rest = done.err.splitlines()
    assert first.startswith(f"talk: {message}")
    command = f"talk {arguments[0]}" if arguments[0] in COMMANDS else "talk"
    assert rest == ([] if "--help" in first else [f"talk: see '{command} --help'"])


def test_json_after_the_command_applies_to_usage_errors() -> None:
    assert error_of(alone("wait", "-t", "soon", "--json").err)["exit"] == 2
    assert error_of(alone("say", "--loud", "hello", "--json").err)["exit"] == 2


# Output


def test_json_output_has_the_documented_fields(scripted: Talk) -> None:
    accepted = scripted.run("--json", "say", "never-ends")
    goal = json.loads(accepted.out)
    assert goal.keys() == GOAL
    assert accepted.out.count("\n") == 1
    scripted.watcher.wait_for_word(goal["id"])
    pending = json.loads(scripted.run("say", "behind", "it", "--json").out)  # the option may follow the command
    assert (pending["state"], pending["text"], pending["spoken"]) == ("PENDING", "behind it", None)
    status = json.loads(scripted.run("status", "--json").out)
    assert status.keys() == {"server", "active", "interrupted", "pending", "recent"}
    assert (status["active"]["id"], [goal["id"] for goal in status["pending"]]) == (goal["id"], [pending["id"]])
    assert json.loads(scripted.run("status", "--json", goal["id"]).out).keys() == GOAL
    canceled = [json.loads(line) for line in scripted.run("cancel", "--json").out.splitlines()]
    assert {goal["id"]: goal["state"] for goal in canceled} == {goal["id"]: "PREEMPTED", pending["id"]: "RECALLED"}
    assert all(goal.keys() == GOAL for goal in canceled)
    ended = json.loads(scripted.run("--json", "say", "--wait", "length=0").out)
    assert (ended.keys(), ended["state"], ended["status"]) == (GOAL, "SUCCEEDED", 3)
    assert json.loads(scripted.run("--json", "wait", ended["id"]).out) == ended
    rejected = json.loads(scripted.run("--json", "say", "").out)
    assert (rejected.keys(), rejected["state"]) == (GOAL, "REJECTED")
    voice = json.loads(scripted.run("--json", "voices").out)
    assert voice == {"id": "en", "language": "en", "name": "scripted", "quality": None, "speakers": None}
    unknown = scripted.run("--json", "wait", "none-1")
    assert error_of(unknown.err) == {"code": "unknown_goal", "exit": 8, "message": error_of(unknown.err)["message"]}
    assert unknown.out == ""


def test_standard_output_contains_only_data(scripted: Talk) -> None:
    failed = scripted.run("say", "--wait", "fail=audio_lost message=no_cable")
    assert re.fullmatch(r"\w{4}-\d+\n", failed.out)
    assert failed.err == f"talk: {failed.id}: speech failed: no cable; find out why with: talk doctor\n"
    quiet = scripted.run("-q", "say", "--wait", "fail=audio_lost")
    assert (quiet.code, quiet.out, quiet.err) == (4, "", "")
    assert scripted.run("say", "-q", "length=0").out == ""
    assert alone("--json", "status").out == ""
    assert error_of(alone("--json", "status").err)["code"] == "no_server"


def test_options_work_before_and_after_the_command(scripted: Talk) -> None:
    for arguments in (["--socket", scripted.socket, "status"], ["status", "--socket", scripted.socket]):
        done = run([*TALK, *arguments], {**scripted.env, "TALK_SOCKET": "/nowhere"})
        assert done.code == 0, done.err
        assert f"pid {scripted.pid}" in done.out
    assert run([*TALK, "status"], {**scripted.env, "TALK_SOCKET": "/nowhere"}).code == 3


@pytest.fixture
def local(scripted: Talk, tmp_path: Path) -> dict[str, str]:
    """Return the environment of a user whose server listens on the default socket."""
    (tmp_path / "talk").mkdir()
    (tmp_path / "talk" / "talk.sock").symlink_to(scripted.socket)
    return {**scripted.env, "TALK_SOCKET": "", "XDG_RUNTIME_DIR": str(tmp_path)}


def test_empty_variables_count_as_unset(scripted: Talk, local: dict[str, str]) -> None:
    for arguments in (["say", "length=0"], ["say", "--lines"], ["wait"], ["status"], ["voices"]):
        done = run([*TALK, *arguments], {**local, "TALK_NAME": ""})
        assert done.code == 0, done
    assert scripted.goal(scripted.watcher.goals()[0])["client"]["name"] is None
    with pytest.MonkeyPatch.context() as patch:
        for name in ("TALK_SOCKET", "XDG_RUNTIME_DIR"):
            patch.setenv(name, local[name])
        patch.setenv("TALK_NAME", "")
        with Client() as client:
            assert client.server_pid == scripted.pid


def test_an_invalid_utf8_name_prevents_speech_but_not_cancel(scripted: Talk, local: dict[str, str]) -> None:
    env = {**local, "TALK_NAME": "n\udcff"}
    done = run([*TALK, "say", "x"], env)
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("talk: environment variable TALK_NAME: the byte 0xff is not valid UTF-8\n")
    goal = scripted.run("say", "never-ends").id
    assert run([*TALK, "cancel"], env).code == 0
    assert scripted.goal(goal)["by"]["client"]["name"] == "n\ufffd"


def test_arguments_and_output_are_utf8_in_every_locale(scripted: Talk) -> None:
    ascii_only = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0", "TALK_NAME": "é"}
    arguments = ["say", "-w", "--key", "日", "--", "length=0 a\udcff b é"]
    done = run([*TALK, *arguments], {**scripted.env, **ascii_only})
    assert (done.code, done.err) == (
        0,
        "talk: line 1, column 11: the byte 0xff is not valid UTF-8 and is skipped\n",
    )
    goal = scripted.goal(done.out.strip())
    assert (goal["text"], goal["key"], goal["client"]["name"]) == ("length=0 a\ufffd b é", "日", "é")
    few: dict[str, str] = {name: scripted.env[name] for name in ("PYTHONPATH", "TALK_SOCKET") if name in scripted.env}
    for env in ({**scripted.env, "LANG": "C", "LC_ALL": "C"}, few):
        done = run([*TALK, "--json", "say", "--wait", "--", "d'été 日本"], env)
        assert (done.code, json.loads(done.out)["text"]) == (0, "d'été 日本")
        assert "日本" in run([*TALK, "status"], env).out


@pytest.mark.parametrize("command", [["status"], ["watch"], ["say", "--id", "shared", "-w"]])
def test_json_on_a_terminal_is_escaped_without_changing_its_meaning(scripted: Talk, command: list[str]) -> None:
    text = f'length=0 {HOSTILE} \x9b31m \x7f \ue000 \U000e0001 "quoted" \\ Grüße 日本 👩'
    scripted.run("say", "--wait", "--id", "shared", "--as", "\u202epatrol", "--", text)
    arguments = ["--json", *command, *(["--", text] if command[0] == "say" else [])]
    with Terminal([*TALK, *arguments], scripted.env) as shown:
        shown.wait_for("\n")
        if command == ["watch"]:
            shown.type(b"\x03")
        shown.finish()
        line = shown.raw.decode().split("\r\n")[0]
    assert not RAW.search(line), repr(line)
    for part in (r"\u009b31m \u007f \ue000 \udb40\udc01", "Grüße 日本 👩", r"\u202epatrol"):
        assert part in line
    assert json.dumps(text)[1:-1] in json.dumps(json.loads(line))
    if command != ["watch"]:  # a program gets the text unchanged
        assert json.loads(scripted.run(*arguments).out)
        assert "\x9b31m \x7f" in scripted.run(*arguments).out


def test_colours_are_used_only_on_terminals(scripted: Talk) -> None:
    scripted.run("say", "--wait", "length=0")
    for extra in ({}, {"NO_COLOR": "1"}, {"TERM": "dumb"}):
        env = {"TERM": "xterm", **scripted.env, **extra}
        done = run([*TALK, "status"], env)
        assert (done.code, "\x1b" in done.out + done.err) == (0, False)
        terminal, client_end = pty.openpty()
        with os.fdopen(client_end, "wb") as stdout, os.fdopen(terminal, "rb", buffering=0) as reader:
            subprocess.run([*TALK, "status"], env=env, stdin=stdout, stdout=stdout, timeout=20, check=True)
            shown = reader.read(65536)
        assert b"SUCCEEDED" in shown
        assert (b"\x1b[" in shown) == (not extra), shown


# Standard input


def test_standard_input_is_read_only_on_request(scripted: Talk) -> None:
    assert json.loads(scripted.run("--json", "say", "-", stdin="one\ntwo\n").out)["text"] == "one\ntwo"
    assert json.loads(scripted.run("--json", "say", "-", "and", stdin="unread").out)["text"] == "- and"
    for arguments in (["say", "hello"], ["status"], ["cancel"], ["wait"]):
        client = scripted.start(*arguments, stdin=subprocess.PIPE)  # never closed
        assert client.wait(10) == 0


# The installed script, and other processes at the socket


def test_the_installed_script_imports_only_main() -> None:
    """The script that pip generates for an entry point imports `re`. Therefore, the wheel contains its own script."""
    script = Path(cli.__file__).with_name("talk")
    assert os.access(script, os.X_OK)
    lines = script.read_text("utf-8").splitlines()
    assert (lines[0], [line for line in lines if "import" in line.split()]) == (
        "#!python",
        ["from talkcli.cli import main"],
    )
    done = run([sys.executable, str(script), "--version"], {**os.environ, "PYTHONPATH": str(script.parents[2])})
    assert (done.code, done.out) == (0, f"talk {__version__}\n")


@pytest.mark.parametrize(
    ("greeting", "code", "error", "message"),
    [
        (b'{"talk": 2, "version": "9.1"}\n', 9, "protocol_mismatch", "upgrade this command"),
        (b'{"talk": 0, "version": "0.0"}\n', 9, "protocol_mismatch", "restart the server"),
        (b'{"talk": 1, "error": "permission_denied", "message": "not you"}\n', 10, "permission_denied", "not you"),
        (b"220 mail.example.org ESMTP\r\n", 3, "no_server", "not a talk server"),
        (b"", 3, "no_server", "closed the connection"),
        (GREETING, 3, "no_server", "connection to the server was lost"),
    ],
)
def test_an_incompatible_process_is_reported(greeting: bytes, code: int, error: str, message: str) -> None:
    with short_directory() as home, FakeServer(f"{home}/s", [greeting], closes=True):
        env = clean_environment(home, {"TALK_SOCKET": f"{home}/s"})
        started_at = time.monotonic()
        done = run([*TALK, "--json", "status"], env)
        assert time.monotonic() - started_at < 2
    reported = error_of(done.err)
    assert (done.code, reported["code"], reported["exit"]) == (code, error, code)
    assert message in reported["message"]


def test_a_path_that_is_not_a_socket_is_reported_with_the_next_step(tmp_path: Path) -> None:
    directory, file, pipe = (tmp_path / name for name in ("talk", "file", "pipe"))
    directory.mkdir()
    file.touch()
    os.mkfifo(pipe)
    inside = f"{directory}/talk.sock"
    steps = [f"set TALK_SOCKET to {inside}", f"start one with: talk serve --socket {inside}"]
    others = ["set TALK_SOCKET to a socket", "choose a socket, or leave out --socket"]
    for path, message, (by_variable, by_option) in (
        (directory, f"a directory, not a socket; use {inside}", steps),
        (file, "a file", others),
        (pipe, "a file", others),
    ):
        done = alone("status", TALK_SOCKET=str(path))
        assert (done.code, f"{path}: {message}" in done.err) == (3, True)
        assert f"\n{by_variable}\nor unset TALK_SOCKET" in done.err
        done = alone("--socket", str(path), "status")
        assert (done.code, f"{path}: {message}" in done.err) == (3, True)
        assert done.err.endswith(f"\n{by_option}\n")
