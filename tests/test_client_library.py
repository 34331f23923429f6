"""The client library, from Python: what its calls return and raise, its threads, and a server that is full."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import Client
from talkcli.client.connection import SocketConnection
from talkcli.errors import AccessDenied, Busy, Lost, ServerUnavailable, UnknownGoal, UsageError
from talkcli.goals.states import State
from tests.conformance.rawsocket import GREETING, FakeServer
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


@pytest.fixture
def client(scripted: Talk) -> Iterator[Client]:
    with Client(scripted.socket, name="patrol") as result:
        yield result


def test_say_and_wait(scripted: Talk, client: Client) -> None:
    client.pause()  # so that it has not ended before it is looked at
    handle = client.say("length=0.1 battery low", data={"from": "the test"})
    assert handle.state is State.PENDING
    client.resume()
    assert (handle.goal.text, handle.goal.data) == ("length=0.1 battery low", {"from": "the test"})
    assert handle.goal.client
    assert handle.goal.client.name == "patrol"
    goal = handle.wait(5)
    assert goal is handle.goal
    assert (goal.state, goal.message, goal.spoken) == (State.SUCCEEDED, "Talk completed successfully", goal.text)
    assert handle.wait(0) is goal
    assert client.goal(handle.id) == goal
    assert (client.path, client.server_pid) == (scripted.socket, scripted.pid)
    aborted = client.say("fail=audio_lost message=no_cable").wait()
    assert (aborted.state, aborted.reason, aborted.message) == (State.ABORTED, "audio_lost", "Talk aborted: no cable")
    assert aborted.client == goal.client


def test_states_that_a_handle_shows_only_go_forward(scripted: Talk, client: Client) -> None:
    seen: list[State] = []
    handle = client.say("length=0.3")
    while not handle.state.terminal:
        if seen[-1:] != [handle.state]:
            seen.append(handle.state)
        client.status()  # any request reads on
    assert seen in ([State.PENDING, State.ACTIVE], [State.ACTIVE]), seen
    assert scripted.watcher.wait_for_terminal(handle.id) == "SUCCEEDED"


def test_wait_without_patience_sees_what_has_arrived(scripted: Talk, client: Client) -> None:
    handle = client.say("length=0")
    scripted.watcher.wait_for_terminal(handle.id)
    end = time.monotonic() + 5
    while not handle.state.terminal and time.monotonic() < end:
        with contextlib.suppress(TimeoutError):
            handle.wait(0)  # nothing else reads on this connection
    assert handle.state is State.SUCCEEDED


def test_goal_that_was_not_followed_can_be_waited_for(client: Client) -> None:
    assert client.say("length=0.1", follow=False).wait(5).state is State.SUCCEEDED
    late = client.say("length=0", follow=False)
    client.say("length=0").wait(5)
    assert late.wait(5).state is State.SUCCEEDED


def test_wait_gives_up_and_the_goal_goes_on(scripted: Talk, client: Client) -> None:
    handle = client.say("never-ends")
    began = time.monotonic()
    with pytest.raises(TimeoutError, match=handle.id):
        handle.wait(0.2)
    assert 0.2 <= time.monotonic() - began < 1
    assert scripted.goal(handle.id)["state"] == "ACTIVE"
    assert handle.cancel().state is State.PREEMPTED
    assert handle.wait(0).reason == "canceled"
    assert handle.cancel() is handle.goal  # again: it has ended


def test_cancel_selects(client: Client, scripted: Talk) -> None:
    handles = [client.say(f"never-ends {number}") for number in range(5)]
    scripted.watcher.wait_for_word(handles[0].id)
    assert client.cancel([]).canceled == ()  # none is not all
    assert [each.id for each in client.cancel([handles[4].id]).canceled] == [handles[4].id]
    done = client.cancel(before=handles[1].id.rpartition("-")[2])
    assert {each.id: each.state for each in done.canceled} == {
        handles[0].id: State.PREEMPTED,
        handles[1].id: State.RECALLED,
    }
    assert [each.id for each in client.cancel([handles[0].id]).ended] == [handles[0].id]
    with pytest.raises(UnknownGoal, match="none-1") as unknown:
        client.cancel(["none-1", handles[3].id])
    assert len(unknown.value.items) == 1
    handles[2].request_cancel()
    assert [each.wait(5).state for each in handles] == [
        *(State.PREEMPTED, State.RECALLED),
        *(State.PREEMPTED, State.RECALLED, State.RECALLED),
    ]
    assert client.cancel() == client.cancel(current=True)
    assert client.cancel().canceled == ()


def test_status_goal_voices_and_follow(client: Client, scripted: Talk) -> None:
    said = client.say("length=0").wait(5)
    active, pending = client.say("never-ends", follow=False), client.say("never-ends too", follow=False)
    scripted.watcher.wait_for_word(active.id)
    status = client.status()
    assert status.active
    assert status.active.id == active.id
    assert [each.id for each in status.pending] == [pending.id]
    assert status.recent == (said,)
    assert status.server["pid"] == scripted.pid
    voice = {"id": "en", "language": "en", "name": "scripted", "quality": None, "speakers": None}
    assert client.voices() == [voice]
    with pytest.raises(UnknownGoal):
        client.goal("none-1")
    with pytest.raises(UnknownGoal):
        client.follow(["none-1"])
    followed = client.follow([said.id, active.id.rpartition("-")[2], said.id])
    assert [each.id for each in followed] == [said.id, active.id, said.id]
    assert followed[0].wait(1) == said
    assert {each.id for each in client.follow()} == {active.id, pending.id}
    assert client.follow([]) == []
    client.cancel()
    assert followed[1].wait(1).state is State.PREEMPTED


def test_text_that_cannot_be_spoken_is_a_goal_that_is_rejected(client: Client) -> None:
    for text in ("", "\ud800", "a" * 100_000, "a\0b"):
        handle = client.say(text)
        assert (handle.state, handle.wait(1).state) == (State.REJECTED, State.REJECTED)
        assert handle.goal.reason == ("text_too_long" if len(text) > 10 else "invalid_text")
        assert handle.goal.text == text


def test_name_that_no_server_takes_is_an_error(scripted: Talk) -> None:
    with pytest.raises(UsageError, match="64"), Client(scripted.socket, name="n" * 65):
        pass


def test_server_that_goes_away(scripted: Talk, client: Client) -> None:
    handle = client.say("never-ends words=1")
    scripted.watcher.wait_for_word(handle.id)
    scripted.kill()
    goal = handle.wait(5)
    assert (goal.state, goal.reason) == (State.LOST, "lost")
    assert handle.wait(5) is goal  # once lost, it stays so
    with pytest.raises(ServerUnavailable):
        client.status()
    with pytest.raises(ServerUnavailable):
        Client(scripted.socket)


def test_say_that_is_not_answered_may_have_been_heard() -> None:
    with (
        short_directory() as home,
        FakeServer(f"{home}/s", [GREETING], closes=True),
        Client(f"{home}/s") as client,
        pytest.raises((Lost, ServerUnavailable)),
    ):
        client.say("hello")
    with short_directory() as home, pytest.raises(ServerUnavailable, match="talk serve"):
        Client(f"{home}/s")


def test_refusal_is_heard_though_the_server_hangs_up_at_once() -> None:
    says = b'{"talk": 1, "error": "permission_denied", "message": "not you"}\n'
    with short_directory() as home, FakeServer(f"{home}/s", [says], closes=True, listens=False):
        for _ in range(300):  # it may have hung up before the client's own first words
            with pytest.raises(AccessDenied, match="not you"), Client(f"{home}/s"):
                pass


def test_closed_client_says_so(client: Client) -> None:
    handle = client.say("length=0.2")
    client.close()
    client.close()
    with pytest.raises(ServerUnavailable):
        client.status()
    assert handle.wait(1).state is State.LOST


def test_close_ends_the_wait_of_another_thread(client: Client) -> None:
    handle = client.say("never-ends")
    states: list[State] = []
    thread = threading.Thread(target=lambda: states.append(handle.wait(10).state))
    thread.start()
    time.sleep(0.2)  # there is no event that tells that a thread waits
    client.close()
    thread.join(1)
    assert states == [State.LOST], "it still waits"


#: A program that speaks, and has a forked child close its copy of the client, in the way that is its argument.
FORKS = """
import os, sys, threading
from talkcli import Client
with Client(sys.argv[1]) as client:
    goal = client.say("never-ends words=1", feedback=True)
    next(goal.feedback(5))
    waiting = threading.Thread(target=goal.wait)
    if sys.argv[2] == "while a thread reads":
        waiting.start()
    child = os.fork()
    if child == 0:
        client.close()
        client.close()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert client.status().active.id == goal.id
    print(goal.cancel().state.name)
    if waiting.ident:
        waiting.join(5)
"""


@pytest.mark.parametrize("when", ["alone", "while a thread reads"])
def test_a_forked_child_closes_its_copy_and_leaves_its_parents_connection(scripted: Talk, when: str) -> None:
    program = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORKS, scripted.socket, when]
    done = subprocess.run(program, env=scripted.env, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "PREEMPTED\n", "")


def test_threads_share_a_client(client: Client) -> None:
    """Each waits for its own goals and asks its own questions, on one connection; every answer finds its thread."""
    wrong: list[object] = []

    def use(number: int) -> None:
        try:
            for turn in range(25):
                text = f"length=0 words=1 {number} {turn}"
                handle = client.say(text)
                if client.goal(handle.id).text != text:
                    wrong.append((number, turn))
                goal = handle.wait(20)
                if (goal.state, goal.text) != (State.SUCCEEDED, text):
                    wrong.append(goal)
        except Exception as error:  # noqa: BLE001 - told in the test's own thread
            wrong.append(error)

    threads = [threading.Thread(target=use, args=(number,)) for number in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join(60)
    assert not any(each.is_alive() for each in threads)
    assert wrong == []


def test_waiting_thread_does_not_keep_another_from_cancelling(client: Client, scripted: Talk) -> None:
    handle = client.say("never-ends")
    scripted.watcher.wait_for_word(handle.id)
    states: list[State] = []
    thread = threading.Thread(target=lambda: states.append(handle.wait(10).state))
    thread.start()
    assert handle.cancel().state is State.PREEMPTED
    thread.join(5)
    assert states == [State.PREEMPTED]


@pytest.mark.parametrize("commands", [[], pytest.param([["say", "hello"], ["--json", "wait"]], marks=pytest.mark.slow)])
def test_full_server_turns_goals_away_but_answers_status_and_cancel(
    make_talk: MakeTalk, commands: list[list[str]]
) -> None:
    """With commands it takes 5 s, for which these try to get in."""
    talk = make_talk("--max-clients", "1", scripted=True, watched=False)
    with talk.connect() as only:
        goal_id = only.request("say", text="never-ends", wait=True)["goal"]["id"]
        began = time.monotonic()
        turned_away = [talk.start(*each) for each in commands]
        assert talk.run("status", goal_id).code == 0
        assert talk.run("cancel").id == goal_id
        with Client.over(SocketConnection(talk.socket, urgent=True)) as urgent:
            assert [each.id for each in urgent.status().recent] == [goal_id]
        with pytest.raises(Busy, match="--max-clients"):
            SocketConnection(talk.socket, patience=0.5)
        assert 0.5 <= time.monotonic() - began < 2.5
        for each in turned_away:
            done = talk.finish(each)
            assert (done.code, done.out) == (5, "")
            assert "--max-clients" in done.err
        assert not commands or 5 <= time.monotonic() - began < 7
        late = talk.start("say", "--wait", "length=0")
    assert talk.finish(late).code == 0  # it came in when there was room
