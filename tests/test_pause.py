"""The messages, output and exit codes of `talk pause` and `talk resume`. Other tests compare the sound."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK
from tests.support.patched_serve import patched_serve
from tests.support.screen import Terminal

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


@pytest.fixture
def active(scripted: Talk) -> str:
    """The id of a goal that is being spoken."""
    goal_id = scripted.run("say", "--", "never-ends \x1b[31m\u202e").id
    scripted.watcher.wait_until(lambda event: event["id"] == goal_id and event.get("number") == 2)
    return goal_id


def test_pause_and_resume_report_the_affected_goal(scripted: Talk, active: str) -> None:
    done = scripted.run("pause")
    assert (done.code, done.out) == (0, "")
    assert done.err.startswith(f'talk: goal {active} is paused after "never-ends')
    assert done.err.endswith('"; to continue, run: talk resume\n')
    assert ("\x1b" in done.err, r"\x1b[31m\u202e" in done.err) == (False, True)
    assert scripted.goal(active)["paused"] is True
    again = scripted.run("pause")
    assert (again.code, f"goal {active} is paused" in again.err) == (0, True)
    resumed = scripted.run("resume")
    assert (resumed.code, resumed.out, resumed.err) == (0, "", f"talk: speech continues with goal {active}\n")
    assert scripted.goal(active)["paused"] is False
    again = scripted.run("resume")
    assert (again.code, again.out, again.err) == (0, "", f"talk: speech continues with goal {active}\n")
    reply = json.loads(scripted.run("pause", "--json").out)
    assert (reply["paused"], reply["goal"]["id"], reply["goal"]["paused"]) == (True, active, True)
    reply = json.loads(scripted.run("resume", "--json").out)
    assert (reply["paused"], reply["goal"]["id"], reply["goal"]["paused"]) == (False, active, False)
    for command in ("pause", "resume"):
        quiet = scripted.run(command, "-q")
        assert (quiet.code, quiet.out, quiet.err) == (0, "", "")
    scripted.run("cancel")


def test_status_shows_the_paused_goal(scripted: Talk, active: str) -> None:
    scripted.run("pause")
    status = scripted.run("status").out
    assert re.search(r"paused   speech is paused by \S+ since \S+; to continue, run: talk resume\n", status)
    assert f"now      {active.partition('-')[2]}  ACTIVE" in status
    assert ", paused, for " in status
    assert "state    ACTIVE, paused\n" in scripted.run("status", active).out
    assert json.loads(scripted.run("--json", "status").out)["server"]["paused"] is True
    scripted.run("resume")
    assert "speech is paused" not in scripted.run("status").out
    scripted.run("cancel")


def say_until_heard(talk: Talk, text: str) -> str:
    goal_id = talk.run("say", text).id
    talk.watcher.wait_for_word(goal_id)  # the engine may still be starting when the goal is ACTIVE
    return goal_id


def test_a_resume_answers_a_pause_that_is_not_silent_yet(scripted: Talk) -> None:
    goal = say_until_heard(scripted, "never-ends slow-pause=1")
    with scripted.connect() as wire:
        wire.send_raw(b'{"seq": 1, "request": "pause"}\n{"seq": 2, "request": "resume"}\n')
        first, second = wire.receive(), wire.receive()
        assert [(reply["seq"], reply["ok"], reply["paused"]) for reply in (first, second)] == [
            (1, True, False),
            (2, True, False),
        ]
        assert first["goal"]["id"] == second["goal"]["id"] == goal
    scripted.run("cancel")


def test_each_unconfirmed_pause_fails_after_its_own_time_limit(make_talk: MakeTalk, tmp_path: Path) -> None:
    limit = 0.5
    talk = make_talk(program=patched_serve(tmp_path, requests__PAUSE_ANSWER_S=limit))
    say_until_heard(talk, "never-ends ignore-pause")
    with talk.connect() as wire:
        wire.send({"seq": 1, "request": "pause"})
        with pytest.raises(TimeoutError):
            wire.receive(limit / 4)
        asked_at = time.monotonic()
        wire.send({"seq": 2, "request": "pause"})
        for seq in (1, 2):
            reply = wire.receive()
            assert (reply["seq"], reply["error"]["code"]) == (seq, "not_silent")
        assert time.monotonic() - asked_at >= 0.95 * limit
    talk.run("resume")
    talk.run("cancel")


def paused_for(talk: Talk) -> float | None:
    """Return the length of the current pause; None if speech is not paused."""
    server = talk.request("status")["server"]
    return float(server["paused_until"] - server["paused_at"]) if server["paused"] else None


def test_a_pause_ends_after_the_time_of_for(scripted: Talk) -> None:
    done = scripted.run("pause", "--for", "20m")
    assert (done.code, paused_for(scripted)) == (0, 1200)
    assert re.fullmatch(r"talk: speech is paused until \d\d:\d\d:\d\d; to continue, run: talk resume\n", done.err)
    assert re.search(r"^paused   .* since \S+, until \S+;", scripted.run("status").out, re.MULTILINE)
    assert scripted.run("resume").code == 0
    assert scripted.run("pause", "--for", "100ms").code == 0
    scripted.watcher.wait_until(lambda event: event["event"] == "paused" and event["n"] > 2 and not event["paused"])


def test_a_command_runs_during_a_pause_and_its_exit_code_is_returned(scripted: Talk, tmp_path: Path) -> None:
    status = f"{shlex.join(TALK)} --json status"
    for options, seconds in (([], 600), (["--for", "20m"], 1200)):
        done = scripted.run("pause", *options, "--while", "--", "sh", "-c", f"{status}; exit 5")
        server = json.loads(done.out)["server"]
        assert (done.code, server["paused_until"] - server["paused_at"], done.err) == (5, seconds, "")
    for command, code, message in (
        (["sh", "-c", "kill -9 $$"], 137, ""),
        (["no\x1bne"], 127, r"talk: can't run 'no\x1bne': No such file or directory" + "\n"),
        ([str(tmp_path)], 126, f"talk: can't run '{tmp_path}': Permission denied\n"),
    ):
        done = scripted.run("pause", "--while", "--", *command)
        assert (done.code, done.out, done.err) == (code, "", message)
    assert scripted.run("resume").code == 0
    assert paused_for(scripted) is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_passed_on_to_the_command(scripted: Talk, number: int) -> None:
    program = "trap 'echo caught; exit 9' INT TERM HUP; echo ready; for _ in $(seq 500); do sleep 0.01; done"
    client = scripted.start("pause", "--while", "--", "sh", "-c", program)
    assert client.stdout
    assert client.stdout.readline() == "ready\n"
    client.send_signal(number)
    done = scripted.finish(client)
    assert (done.code, done.out) == (9, "caught\n")


def test_ctrl_c_is_left_to_the_terminal_which_also_sends_it_to_the_command(scripted: Talk) -> None:
    program = (
        "import os, signal, time\n"
        "os.setsid()\n"  # so the terminal does not send it
        "caught = []\n"
        "signal.signal(signal.SIGINT, lambda *_: caught.append(1))\n"
        "print('ready', flush=True)\n"
        "input()\n"
        "time.sleep(0.1)\n"
        "print('caught', len(caught))\n"
        "exit(4)\n"
    )
    terminal = Terminal([*TALK, "pause", "--while", "--", sys.executable, "-c", program], scripted.env)
    try:
        terminal.wait_until(lambda screen: "ready" in screen.lines)
        terminal.type(b"\x03")
        terminal.wait_until(lambda screen: screen.last == "^C")
        terminal.type(b"\n")
        assert terminal.finish() == 4
        assert "caught 0" in terminal.screen.lines
    finally:
        terminal.close()


def test_a_killed_pause_command_ends_its_pause(scripted: Talk) -> None:
    client = scripted.start("pause", "--while", "cat", stdin=subprocess.PIPE)
    assert client.stdin
    assert client.stdout
    client.stdin.write("ready\n")
    client.stdin.flush()
    assert client.stdout.readline() == "ready\n"
    client.kill()
    scripted.watcher.wait_until(lambda event: event["event"] == "paused" and not event["paused"])
    client.communicate()  # this also ends the program


def test_pause_and_resume_succeed_if_nothing_is_being_spoken(make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True, watched=False)
    done = talk.run("pause")
    assert (done.code, done.out, "talk: speech is paused; " in done.err) == (0, "", True)
    assert json.loads(talk.run("--json", "pause").out) == {"paused": True, "goal": None}
    waiting = talk.run("say", "length=0").id
    assert talk.goal(waiting)["state"] == "PENDING"
    done = talk.run("resume")
    assert (done.code, done.out, done.err.startswith("talk: speech continues")) == (0, "", True)
    assert talk.run("wait", waiting).code == 0
    assert json.loads(talk.run("--json", "resume").out) == {"paused": False, "goal": None}
