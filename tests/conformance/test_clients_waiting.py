"""Clients exit in time and with the right code if they time out, are interrupted or lose their server."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK, Ended, environment, run
from tests.conformance.checks import states
from tests.conformance.rawsocket import GREETING, FakeServer, Raw
from tests.support.surroundings import short_directory
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.support.connection import Wire
    from tests.support.processes import Process, Talk

#: Seconds for the start and the end of a client.
START = 0.5


def start_speaking(talk: Talk, *options: str) -> tuple[Process, str]:
    """Start a client whose goal never ends, wait for its first word, and return the client and the goal's id."""
    client = talk.start("say", *options, "--", "never-ends words=1")
    goal_id = str(talk.watcher.wait_for(None, "ACTIVE")["id"])
    talk.watcher.wait_for_word(goal_id)
    return client, goal_id


@limits()
def test_row_07_clients_of_a_killed_server_report_their_goals_lost(scripted: Talk) -> None:
    sayer, goal_id = start_speaking(scripted, "--wait")
    behind = scripted.start("--json", "say", "--wait", "behind it")
    pending_id = scripted.watcher.wait_until(lambda event: bool(event["id"] != goal_id))["id"]
    scripted.kill()
    for client in (sayer, behind):
        done = scripted.finish(client)
        assert done.code == 12
        assert_within(done.seconds, 1, "the end of a client whose server was killed")
        assert "may still be spoken" in done.err
    goal = json.loads(done.out)
    assert (goal["id"], goal["state"], goal["status"], goal["reason"]) == (pending_id, "LOST", 9, "lost")
    assert goal["message"].startswith("result unknown: ")


def _until_connected(wire: Wire, clients: int) -> None:
    """Wait until this many clients are connected, including `wire` and the watcher."""
    end = time.monotonic() + 5
    while wire.request("status")["server"]["clients"] != clients:
        assert time.monotonic() < end, "the clients have not connected"


def test_row_08_a_client_times_out_while_the_server_is_frozen(scripted: Talk) -> None:
    with limits():
        started_at = time.monotonic()
        client = scripted.start("say", "--wait", "--timeout", "2", "--", "never-ends words=1")
        goal_id = scripted.watcher.wait_for(None, "ACTIVE")["id"]
        scripted.freeze()
        try:
            done = scripted.finish(client)
            seconds = time.monotonic() - started_at
        finally:
            scripted.thaw()
        assert done.code == 124
        assert seconds >= 2
        assert "did not confirm" in done.err
        assert scripted.watcher.wait_for_terminal(goal_id) == "PREEMPTED"  # the client had sent its cancel
        assert scripted.goal(goal_id)["state"] == "PREEMPTED"
        assert_within(seconds, 2 + 1 + START, "a timeout of 2 s, and 1 s for silence")


def test_row_10_a_timeout_cancels_the_goal(scripted: Talk) -> None:
    with limits():
        started_at = time.time()
        done = scripted.run("--json", "say", "--wait", "--timeout", "2", "length=10 words=1")
        goal = json.loads(done.out)
        assert (done.code, goal["state"], goal["reason"]) == (124, "PREEMPTED", "canceled")
        error = {"code": "timeout", "exit": 124, "message": "timed out after 2 s"}
        assert json.loads(done.err.splitlines()[-1]) == {"error": error}
        assert goal["ended_at"] - started_at >= 2
        assert_within(goal["ended_at"] - started_at, 2 + 0.3, "a timeout of 2 s")
        assert_within(done.seconds, 2 + START, "a client with a timeout of 2 s")


def test_row_10_a_timeout_includes_the_time_in_the_queue(scripted: Talk) -> None:
    scripted.run("say", "never-ends")
    done = scripted.run("--json", "say", "--wait", "--timeout", "0.2", "behind it")
    goal = json.loads(done.out)
    assert (done.code, goal["state"]) == (124, "RECALLED")
    assert scripted.run("wait", "--timeout", "0.2").code == 124
    assert scripted.request("status")["active"]["state"] == "ACTIVE"  # `wait` cancels nothing


@pytest.mark.parametrize("greeting", [GREETING, b""], ids=["after the greeting", "before it"])
@limits()
def test_a_client_times_out_if_the_server_does_not_answer(greeting: bytes) -> None:
    with short_directory() as home, FakeServer(f"{home}/s", [greeting]):
        started_at = time.monotonic()
        done = _talk(home, "say", "--wait", "--timeout", "0.5", "--", "hello")
        seconds = time.monotonic() - started_at
    # Without a greeting, the client sends no request, and reports that there is no server.
    assert done.code == (124 if greeting else 3), done
    assert ("timed out after 0.5 s: the say request was sent" in done.err) == bool(greeting)
    assert_within(seconds, 0.5 + 1 + START, "a timeout of 0.5 s")


def _talk(home: str, *args: str) -> Ended:
    """Run `talk` in a new process, without a fork."""
    return run([*TALK, *args], environment(home, TALK_SOCKET=f"{home}/s"), cwd="/")


def test_row_15_a_goal_is_spoken_even_if_its_client_disconnects_at_once(scripted: Talk) -> None:
    count = 20
    for number in range(count):
        with Raw(scripted.socket) as raw:
            if number % 2:
                raw.receive_lines(1)  # the greeting
            raw.send(b'{"request": "say", "text": "length=0", "wait": true}\n')
    last = scripted.run("say", "--wait", "length=0 the last").id
    scripted.watcher.wait_for_terminal(last)  # after this event, all earlier ones have arrived
    goals = scripted.watcher.goals()
    assert len(goals) == count + 1
    assert {scripted.watcher.wait_for_terminal(goal_id) for goal_id in goals} == {"SUCCEEDED"}
    for line in scripted.log.splitlines():
        assert " SUCCEEDED after " in line or " ready" in line, line  # nothing about disconnected clients


def test_row_31_any_process_can_get_the_result_of_an_ended_goal(scripted: Talk) -> None:
    texts = {"length=0 fine": 0, "fail=audio_lost": 4, "length=0 too": 0, "crash": 4}
    ids = [scripted.run("say", "--", text).id for text in texts]
    for goal_id in ids:
        scripted.watcher.wait_for_terminal(goal_id)
    for goal_id, code in zip(ids, texts.values(), strict=True):
        done = scripted.run("wait", goal_id)
        assert (done.code, done.out) == (code, "")
    number = ids[1].rpartition("-")[2]
    done = scripted.run("--json", "wait", number)
    goal = json.loads(done.out)
    assert (done.code, goal["id"], goal["state"], goal["reason"]) == (4, ids[1], "ABORTED", "audio_lost")
    scripted.request("cancel", ids=["early"])
    scripted.request("say", text="recalled", id="early")
    for goal_ids, code in ((("early", ids[1]), 6), ((ids[1], "early"), 4)):
        assert scripted.run("wait", ids[0], *goal_ids, ids[2]).code == code  # of the first goal that did not succeed


@pytest.mark.parametrize("command", ["say", "wait"])
@limits()
def test_row_33_ctrl_c_cancels_only_the_clients_own_goal(scripted: Talk, command: str) -> None:
    client, goal_id = start_speaking(scripted, "--wait") if command == "say" else start_speaking(scripted)
    with scripted.connect() as wire:
        if command == "wait":
            assert scripted.finish(client).id == goal_id
            _until_connected(wire, 2)
            client = scripted.start("wait", goal_id)
        _until_connected(wire, 3)
    client.send_signal(signal.SIGINT)
    done = scripted.finish(client)
    assert done.code == 130
    assert_within(done.seconds, 1 + START, "the end after a signal")
    if command == "wait":
        assert scripted.goal(goal_id)["state"] == "ACTIVE"
        return
    assert states(scripted, goal_id)[-2:] == ["PREEMPTING", "PREEMPTED"]
    message = f"talk: {goal_id}: Talk preempted: the goal was cancelled\n"
    assert (done.id, done.err) == (goal_id, message)


def test_row_34_sigterm_to_a_background_client_cancels_its_goal(scripted: Talk) -> None:
    script = """"$0" -m talkcli say --wait -- "never-ends words=1" & pid=$!
    read line; kill -TERM $pid; wait $pid; echo "code $?" """
    with subprocess.Popen(
        ["sh", "-c", script, sys.executable],
        env=scripted.env,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as shell:
        goal_id = scripted.watcher.wait_for(None, "ACTIVE")["id"]
        scripted.watcher.wait_for_word(goal_id)
        out, err = shell.communicate("continue\n", timeout=20)
    assert out == f"{goal_id}\ncode 143\n"
    assert "Talk preempted" in err
    assert scripted.goal(goal_id)["state"] == "PREEMPTED"


def _version() -> float:
    """Return the duration of the shortest command, the control for a client without a server."""
    started_at = time.monotonic()
    assert _talk("/", "--version").code == 0
    return time.monotonic() - started_at


@pytest.mark.parametrize("args", [["status"], ["say", "-w", "hello"], ["wait"]])
def test_row_35_a_missing_server_is_reported_at_once(args: Sequence[str]) -> None:
    with short_directory() as home, limits(_version):
        started_at = time.monotonic()
        done = _talk(home, *args)
        seconds = time.monotonic() - started_at
        assert (done.code, done.out) == (3, "")
        assert f"{home}/s: not found" in done.err
        assert "talk serve" in done.err
        assert_within(seconds, 0.3, "the end of a client without a server")


@pytest.mark.slow
def test_row_46_clients_do_not_wait_forever_for_a_frozen_server(scripted: Talk) -> None:
    """All clients wait in parallel for the limit of 16 s without an event."""
    waiter, goal_id = start_speaking(scripted, "--wait")
    scripted.freeze()
    started_at = time.monotonic()
    try:
        second = scripted.start("serve")
        clients = [scripted.start(*args) for args in (["status"], ["cancel"], ["say", "hello"], ["--json", "wait"])]
        ended = [scripted.finish(client) for client in clients]
        assert time.monotonic() - started_at < 6
        for done in ended:
            assert (done.code, done.out) == (3, ""), done
            assert "doesn't respond" in done.err
            assert str(scripted.pid) in done.err
        refused = scripted.finish(second)
        assert refused.code == 11
        assert f"pid {scripted.pid}" in refused.err
        lost = scripted.finish(waiter, timeout=25)
        assert time.monotonic() - started_at < 20
        assert (lost.code, lost.id) == (12, goal_id)
        assert "may still be spoken" in lost.err
    finally:
        scripted.thaw()
    assert scripted.watcher.wait_for_terminal(scripted.request("say", text="length=0", preempt=True)["goal"]["id"])
    assert [goal_id for goal_id in scripted.watcher.goals() if "hello" in str(scripted.goal(goal_id)["text"])] == []
