"""The options, results and errors of the client library, with a scripted server."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import warnings
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import Client, PausedChanged, StateChanged
from talkcli.client.calls import batches
from talkcli.client.connection import SocketConnection
from talkcli.errors import (
    AccessDenied,
    BadOption,
    Busy,
    Lost,
    RequestRefused,
    ServerUnavailable,
    UnknownGoal,
    UsageError,
)
from talkcli.goals.options import OPTIONS
from talkcli.goals.states import State
from talkcli.polling import run_blocking
from talkcli.protocol.lines import MAX_LINE_BYTES, encode
from tests.conformance.rawsocket import GREETING, FakeServer
from tests.support.patched_serve import patched_serve
from tests.support.processes import Talk
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk


@pytest.fixture
def client(scripted: Talk) -> Iterator[Client]:
    with Client(scripted.socket, name="patrol") as result:
        yield result


def test_wait_returns_the_ended_goal(scripted: Talk, client: Client) -> None:
    client.pause()  # the goal must still be pending when it is checked
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
    assert (aborted.state, aborted.reason, aborted.message) == (State.ABORTED, "audio_lost", "speech failed: no cable")
    assert aborted.client == goal.client


def test_a_goal_continues_after_a_wait_has_timed_out(scripted: Talk, client: Client) -> None:
    handle = client.say("never-ends")
    started_at = time.monotonic()
    with pytest.raises(TimeoutError, match=handle.id):
        handle.wait(0.2)
    assert 0.2 <= time.monotonic() - started_at < 1
    assert scripted.goal(handle.id)["state"] == "ACTIVE"
    assert handle.cancel().state is State.PREEMPTED
    assert handle.wait(0).reason == "canceled"
    assert handle.cancel() is handle.goal  # a second time: the goal has ended


def test_cancel_stops_only_the_selected_goals(client: Client, scripted: Talk) -> None:
    handles = [client.say(f"never-ends {number}") for number in range(5)]
    scripted.watcher.wait_for_word(handles[0].id)
    assert client.cancel([]).canceled == ()  # an empty list doesn't mean all goals
    assert [goal.id for goal in client.cancel([handles[4].id]).canceled] == [handles[4].id]
    done = client.cancel(before=handles[1].id.rpartition("-")[2])
    assert [goal.state for goal in done.canceled] == [State.RECALLED, State.PREEMPTED]
    assert [goal.id for goal in client.cancel([handles[0].id]).ended] == [handles[0].id]
    with pytest.raises(UnknownGoal, match="none-1") as unknown:
        client.cancel(["none-1", handles[3].id])
    assert len(unknown.value.items) == 1
    handles[2].request_cancel()
    assert all(handle.wait(5).reason == "canceled" for handle in handles)
    assert client.cancel() == client.cancel(current=True)
    assert client.cancel().canceled == ()


def test_status_goal_voices_and_follow_show_the_servers_state(client: Client, scripted: Talk) -> None:
    ended = client.say("length=0").wait(5)
    active, pending = client.say("never-ends", follow=False), client.say("never-ends too", follow=False)
    scripted.watcher.wait_for_word(active.id)
    status = client.status()
    assert status.active
    assert status.active.id == active.id
    assert [goal.id for goal in status.pending] == [pending.id]
    assert status.recent == (ended,)
    assert status.server["pid"] == scripted.pid
    voice = {"id": "en", "language": "en", "name": "scripted", "quality": None, "speakers": None}
    assert client.voices() == [voice]
    with pytest.raises(UnknownGoal):
        client.goal("none-1")
    with pytest.raises(UnknownGoal):
        client.follow(["none-1"])
    followed = client.follow([ended.id, active.id.rpartition("-")[2], ended.id])
    assert [handle.id for handle in followed] == [ended.id, active.id, ended.id]
    assert followed[0].wait(1) == ended
    assert {handle.id for handle in client.follow()} == {active.id, pending.id}
    assert client.follow([]) == []
    client.cancel()
    assert followed[1].wait(1).state is State.PREEMPTED


def test_sounds_are_listed_and_played(client: Client, scripted: Talk) -> None:
    assert client.sounds() == ["chirp", "error", "warning"]
    goal = client.play("chirp", key="bell", volume=0.5, data={"a": 1}).wait(5)
    assert (goal.state, goal.format, goal.text, goal.key) == (State.SUCCEEDED, "sound", "chirp", "bell")
    assert goal.spoken is None
    refused = client.play("horn", block=False).wait(5)
    assert (refused.state, refused.reason) == (State.REJECTED, "unknown_sound")
    assert scripted.run("play", "--list").out.split() == client.sounds()


def test_a_client_name_that_is_too_long_is_an_error(scripted: Talk) -> None:
    with pytest.raises(UsageError, match="64"), Client(scripted.socket, name="n" * 65):
        pass


def test_a_say_without_an_answer_is_an_error() -> None:
    with (
        short_directory() as home,
        FakeServer(f"{home}/s", [GREETING], closes=True),
        Client(f"{home}/s") as client,
        pytest.raises((Lost, ServerUnavailable)),
    ):
        client.say("hello")
    with short_directory() as home, pytest.raises(ServerUnavailable, match="talk serve"):
        Client(f"{home}/s")


def test_a_refusal_is_read_even_if_the_server_hangs_up_at_once() -> None:
    refusal = b'{"talk": 1, "error": "permission_denied", "message": "not you"}\n'
    with short_directory() as home, FakeServer(f"{home}/s", [refusal], closes=True, listens=False):
        for _ in range(100):  # the server may have hung up before the client says hello
            with pytest.raises(AccessDenied, match="not you"), Client(f"{home}/s"):
                pass


def test_calls_of_a_closed_client_fail_and_its_goals_are_lost(client: Client) -> None:
    handle = client.say("length=0.2")
    client.close()
    client.close()  # a second time is not an error
    with pytest.raises(ServerUnavailable):
        client.status()
    assert handle.wait(1).state is State.LOST


@pytest.mark.parametrize("reads", [False, True], ids=["no other thread", "while a thread reads"])
def test_closing_a_client_in_a_forked_child_keeps_the_parents_connection(client: Client, reads: bool) -> None:
    goal = client.say("never-ends words=1", feedback=True)
    next(goal.feedback(5))
    waiting = threading.Thread(target=goal.wait)
    if reads:
        waiting.start()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about a fork with several threads
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


def test_a_full_server_answers_urgent_clients_and_refuses_others(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-clients", "1", scripted=True, watched=False)
    with talk.connect() as only:
        goal_id = only.request("say", text="never-ends", wait=True)["goal"]["id"]
        started_at = time.monotonic()
        assert talk.run("status", goal_id).code == 0
        assert talk.run("cancel").id == goal_id
        with Client.over(run_blocking(SocketConnection.open(talk.socket, urgent=True))) as urgent:
            assert [goal.id for goal in urgent.status().recent] == [goal_id]
        with pytest.raises(Busy, match="--max-clients"):
            run_blocking(SocketConnection.open(talk.socket, patience_s=0.5))
        assert 0.5 <= time.monotonic() - started_at < 2.5
        late = talk.start("say", "--wait", "length=0")
    assert talk.finish(late).code == 0  # it was admitted when a place became free


SETTINGS = {"rate": 200, "volume": 1.0, "voice": None, "pitch": 50, "preempt": False, "ttl": None}


@pytest.fixture(scope="module")
def untouched() -> Iterator[Client]:
    """A client of a server that tests must not change. It has spoken nothing, and has its initial settings."""
    with contextlib.closing(Talk(scripted=True)) as talk, Client(talk.socket) as result:
        yield result
        talk.stop()


ROWS = [option for option in OPTIONS if option.name not in {"wait", "more", "stall", "dry_run"}]


def test_an_invalid_value_is_refused_and_nothing_is_sent(untouched: Client) -> None:
    """`tests/unit/test_options.py` tests all limits."""
    for row in ROWS:
        with pytest.raises(UsageError, match=f"'{row.name}' must be"):
            untouched.say(**{"text": "hello", row.name: object()})  # type: ignore[arg-type]
        if row.setting:
            with pytest.raises(UsageError, match=f"'{row.name}' must be"):
                untouched.set(**{"rate": 100, row.name: []})  # type: ignore[arg-type]
    wrong: list[dict[str, Any]] = [{"rate": 79}, {"ttl": math.nan}, {"id": "17"}, {"data": {"a": math.nan}}]
    for options in wrong:
        with pytest.raises(UsageError):
            untouched.say("hello", **options)
    with pytest.raises(UsageError):
        untouched.set(volume=2, preempt=True)
    assert (untouched.log(), untouched.settings()) == ([], SETTINGS)


def test_the_options_of_a_goal_reach_the_server(client: Client) -> None:
    client.say("never-ends")
    hello = client.say("hello", priority=-3, ttl=60, key="k", id="mine", data={"a": [1]}, voice="en", throttle=0.1)
    goal = client.goal("mine")
    assert (goal.priority, goal.ttl, goal.key, goal.id, goal.data) == (-3, 60.0, "k", "mine", {"a": [1]})
    assert hello.goal == goal
    client.say("length=0", flush=True)
    assert (hello.wait(5).state, hello.goal.reason) == (State.RECALLED, "preempted")


def test_the_same_id_and_text_attach_to_the_existing_goal(client: Client, scripted: Talk) -> None:
    scripted.request("pause")  # the second handle must be attached before the first word
    first = client.say("length=0.2 one", id="door.1", feedback=True)
    with Client(scripted.socket) as other:
        second = other.say("length=0.2 one", id="door.1", feedback=True)
        assert (first.attached, second.attached) == (False, True)
        other.resume()
        assert [word.word for word in second.feedback(5)] == ["length=0.2", "one"]
        assert second.wait(5) == first.wait(5)
        third = other.say("length=0.2 one", id="door.1")
        assert (third.attached, third.goal) == (True, first.goal)
        assert third.wait(0) is third.goal
        assert [event.to_json()["event"] for event in third.events()] == ["result"]
    assert len(scripted.watcher.words("door.1")) == 2  # it was spoken once


def test_a_patient_goal_is_not_spoken_after_its_sender_hangs_up(make_talk: MakeTalk, tmp_path: Path) -> None:
    """The server notices a hang-up the next time it reports that it is alive."""
    talk = make_talk("--max-queue", "1", program=patched_serve(tmp_path, subscribers__CLIENT_ALIVE_INTERVAL_S=0.1))
    with Client(talk.socket) as client:
        active = client.say("never-ends")
        talk.watcher.wait_for(active.id, "ACTIVE")
        pending = client.say("length=0")
        with talk.connect() as wire:
            wire.send({"seq": 1, "request": "say", "text": "length=0 never heard", "patient": True})
            wire.request("hello")  # its reply shows that the goal has been received
        while client.status().server["clients"] != 2:  # the watcher and this client
            time.sleep(0.05)  # no event reports that a client has gone
        active.cancel()
        assert pending.wait(5).state is State.SUCCEEDED
        assert client.say("length=0").wait(5).state is State.SUCCEEDED
        assert "never heard" not in str(client.log())


def test_cancel_accepts_a_key_and_no_invalid_selection(client: Client) -> None:
    active, other = client.say("never-ends", key="k"), client.say("never-ends")
    assert {goal.id for goal in client.cancel([other.id], key="k").canceled} == {active.id, other.id}
    goal = client.say("never-ends")
    wrong: list[dict[str, Any]] = [{"key": ""}, {"key": "k" * 65}, {"ids": [""]}, {"before": ""}]
    for selection in wrong:
        with pytest.raises(UsageError, match="key" if "key" in selection else "id is empty"):
            client.cancel(**selection)
    assert not goal.state.terminal
    goal.cancel()


def test_long_lists_of_ids_are_split_into_lines_of_legal_length() -> None:
    assert batches([]) == []
    assert batches(["a", "b", "a"]) == [("a", "b")]
    for prefix in ("a" * 64, '"' * 64, "\x01" * 64, "🤖" * 64, "\ud800" * 64, "7"):
        ids = [f"{prefix}{number}" for number in range(2_000)]
        parts = batches(ids)
        assert [goal_id for part in parts for goal_id in part] == ids
        longest = max(len(encode({"request": "cancel", "ids": list(part), "key": "\ud800" * 64})) for part in parts)
        assert longest < MAX_LINE_BYTES - 1_000


def test_the_log_lists_ended_goals_oldest_first(client: Client) -> None:
    assert client.log() == []
    goals = [client.say(f"length=0 {number}").wait(5) for number in range(3)]
    rejected = client.say("").goal
    assert client.log() == [*goals, rejected]
    assert client.log(2) == [goals[2], rejected]
    for count in (0, -1, 2_201):
        with pytest.raises(UsageError, match="1 to 2,200"):
            client.log(count)


def test_set_changes_settings_and_returns_them(client: Client) -> None:
    assert client.settings() == SETTINGS
    changed = client.set(rate=150, volume=0.5, voice="en", pitch=60, preempt=True, ttl=30)
    assert changed == {"rate": 150, "volume": 0.5, "voice": "en", "pitch": 60, "preempt": True, "ttl": 30}
    assert client.settings() == changed
    assert client.set(voice="default", ttl=0, preempt=False) == {
        **changed,
        "voice": None,
        "ttl": None,
        "preempt": False,
    }
    assert client.set(rate=200, volume=1.0, pitch=50) == SETTINGS


def test_an_unknown_voice_cannot_be_set(untouched: Client) -> None:
    with pytest.raises(BadOption, match="klingon") as refused:
        untouched.set(rate=300, voice="klingon")
    assert (refused.value.code, refused.value.exit_code) == ("unknown_voice", 2)
    assert isinstance(refused.value, RequestRefused)
    assert untouched.settings() == SETTINGS


def test_speech_is_paused_while_a_block_runs(client: Client) -> None:
    handle = client.say("never-ends")
    for seconds, error in ((600, None), (20, None), (20, KeyError)):
        with contextlib.suppress(KeyError), client.paused(*([] if seconds == 600 else [seconds])) as goal:
            server = client.status().server
            assert (goal and goal.id, server["paused"]) == (handle.id, True)
            assert server["paused_until"] - server["paused_at"] == seconds  # type: ignore[operator]
            if error:
                raise error
        while client.status().server["paused"]:  # the server learns of the end of a connection a little later
            time.sleep(0.001)
    with pytest.raises(UsageError, match=r"0\.1 to 86400"), client.paused(0):
        pass
    assert client.status().server["paused"] is False
    handle.cancel()


def test_saying_cancels_its_goal_when_the_block_ends(client: Client) -> None:
    with client.saying("never-ends step back", key="path") as goal:
        assert next(goal.events()).id == goal.id  # type: ignore[union-attr]
        assert goal.goal.key == "path"
    assert (goal.state, goal.goal.reason) == (State.PREEMPTED, "canceled")
    with contextlib.suppress(ZeroDivisionError), client.saying("never-ends step back", id="mine", follow=False) as goal:
        assert goal.id == "mine"
        raise ZeroDivisionError
    assert goal.state in {State.PREEMPTED, State.RECALLED}


def test_saying_does_not_cancel_a_goal_that_has_ended(client: Client) -> None:
    with client.saying("length=0") as goal:
        assert goal.wait(10).state is State.SUCCEEDED
    assert goal.state is State.SUCCEEDED
    with pytest.raises(UsageError, match="'rate' must be an integer"), client.saying("hello", rate="fast"):  # type: ignore[arg-type]
        pass


def test_pause_stops_speech_and_resume_continues_it(client: Client, scripted: Talk) -> None:
    assert client.resume() is None  # speech was not paused
    assert client.pause() is None  # nothing was being spoken
    assert client.status().server["paused"] is True
    assert client.resume() is None
    handle = client.say("length=0.3 one two", feedback=True)
    scripted.watcher.wait_for_word(handle.id)
    paused = client.pause()
    assert paused
    assert (paused.id, paused.state, paused.paused) == (handle.id, State.ACTIVE, True)
    assert client.pause() == paused  # a second pause is not an error
    assert (handle.speech_paused, handle.goal.paused) == (True, True)
    waiting = client.say("length=0", preempt=False)
    assert (waiting.speech_paused, waiting.state) == (True, State.PENDING)
    with pytest.raises(TimeoutError):
        handle.wait(0.4)
    resumed = client.resume()
    assert resumed
    assert (resumed.id, resumed.paused) == (handle.id, False)
    events = list(handle.events(5))
    assert [event.paused for event in events if isinstance(event, PausedChanged)] == [True, False]
    assert [event.state for event in events if isinstance(event, StateChanged)][-1] is State.SUCCEEDED
    assert not handle.speech_paused
    assert waiting.wait(5).state is State.SUCCEEDED
