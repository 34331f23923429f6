"""The client library: the results and errors of its calls, forked children, and a full server."""

from __future__ import annotations

import os
import threading
import time
import warnings
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
    client.pause()  # the goal must still be pending below
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
        for _ in range(100):  # the server may have hung up before the client says hello
            with pytest.raises(AccessDenied, match="not you"), Client(f"{home}/s"):
                pass


def test_closed_client_says_so(client: Client) -> None:
    handle = client.say("length=0.2")
    client.close()
    client.close()  # a second time is no error
    with pytest.raises(ServerUnavailable):
        client.status()
    assert handle.wait(1).state is State.LOST


@pytest.mark.parametrize("reads", [False, True], ids=["alone", "while a thread reads"])
def test_a_forked_child_closes_its_copy_and_leaves_its_parents_connection(client: Client, reads: bool) -> None:
    goal = client.say("never-ends words=1", feedback=True)
    next(goal.feedback(5))
    waiting = threading.Thread(target=goal.wait)
    if reads:
        waiting.start()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads beside a fork
        child = os.fork()
    if child == 0:
        try:
            client.close()
            client.close()
            os._exit(0)
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
    active = client.status().active
    assert (active and active.id, goal.cancel().state) == (goal.id, State.PREEMPTED)
    if reads:
        waiting.join(5)


def test_full_server_turns_goals_away_but_answers_status_and_cancel(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-clients", "1", scripted=True, watched=False)
    with talk.connect() as only:
        goal_id = only.request("say", text="never-ends", wait=True)["goal"]["id"]
        began = time.monotonic()
        assert talk.run("status", goal_id).code == 0
        assert talk.run("cancel").id == goal_id
        with Client.over(SocketConnection(talk.socket, urgent=True)) as urgent:
            assert [each.id for each in urgent.status().recent] == [goal_id]
        with pytest.raises(Busy, match="--max-clients"):
            SocketConnection(talk.socket, patience=0.5)
        assert 0.5 <= time.monotonic() - began < 2.5
        late = talk.start("say", "--wait", "length=0")
    assert talk.finish(late).code == 0  # it came in when there was room
