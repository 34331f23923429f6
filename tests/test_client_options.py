"""The client library's requests with all their options, against a server with the scripted engine."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import Client, PausedChanged, State, StateChanged
from talkcli.client.client import batches
from talkcli.errors import BadOption, RequestRefused, UsageError
from talkcli.goals.options import OPTIONS
from talkcli.protocol.lines import MAX_LINE, encode
from tests.support.patched_serve import patched_serve
from tests.support.processes import Talk

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from talkcli.goals.option import Option
    from tests.conftest import MakeTalk

SETTINGS = {"rate": 200, "volume": 1.0, "voice": None, "pitch": 50, "preempt": False, "ttl": None}


@pytest.fixture
def client(scripted: Talk) -> Iterator[Client]:
    with Client(scripted.socket, name="patrol") as result:
        yield result


@pytest.fixture(scope="module")
def untouched() -> Iterator[Client]:
    """A client of a server that tests must leave as it was: it has spoken nothing, and has its initial settings."""
    with contextlib.closing(Talk(scripted=True)) as talk, Client(talk.socket) as result:
        yield result
        talk.stop()


TAKEN = [each for each in OPTIONS if each.name not in {"wait", "format"}]


@pytest.mark.parametrize("row", TAKEN, ids=lambda each: each.name)
def test_value_of_the_wrong_type_is_an_error_and_nothing_is_sent(untouched: Client, row: Option) -> None:
    with pytest.raises(UsageError, match=f"'{row.name}' must be"):
        untouched.say(**{"text": "hello", row.name: object()})  # type: ignore[arg-type]
    if row.setting:
        with pytest.raises(UsageError, match=f"'{row.name}' must be"):
            untouched.set(**{"rate": 100, row.name: []})  # type: ignore[arg-type]
    assert (untouched.log(), untouched.settings()) == ([], SETTINGS)


@pytest.mark.parametrize("options", [{"rate": 79}, {"ttl": math.nan}, {"id": "17"}, {"data": {"a": math.nan}}])
def test_value_out_of_range_is_an_error_and_nothing_is_sent(untouched: Client, options: dict[str, Any]) -> None:
    """`tests/unit/test_options.py` has all limits."""
    with pytest.raises(UsageError):
        untouched.say("hello", **options)
    with pytest.raises(UsageError):
        untouched.set(volume=2, preempt=True)
    assert (untouched.log(), untouched.settings()) == ([], SETTINGS)


def test_options_of_a_goal_arrive(client: Client) -> None:
    first = client.say("never-ends")
    told = client.say("hello", priority=-3, ttl=60, key="k", id="mine", data={"a": [1]}, voice="en", throttle=0.1)
    goal = client.goal("mine")
    assert (goal.priority, goal.ttl, goal.key, goal.id, goal.data) == (-3, 60.0, "k", "mine", {"a": [1]})
    assert told.goal == goal
    replaced = client.say("hello again", key="k")
    assert (told.wait(5).reason, told.state) == ("replaced", State.RECALLED)
    higher = client.say("urgent", priority=1)
    assert [each.id for each in client.status().pending] == [higher.id, replaced.id]
    last = client.say("length=0 the last", flush=True, rate=80, volume=0.5, pitch=0)
    assert replaced.wait(5).reason == "preempted"
    assert first.wait(5).state is State.PREEMPTED
    ended = [each.wait(5) for each in (higher, last)]
    assert [each.state for each in ended] == [State.SUCCEEDED] * 2
    assert (ended[0].started_at or 0) < (ended[1].started_at or 0)  # of a higher priority: not flushed, and first


def test_same_id_again_attaches(client: Client, scripted: Talk) -> None:
    scripted.request("pause")  # no word may come before the second handle is attached
    first = client.say("length=0.2 one", id="door.1", feedback=True)
    with Client(scripted.socket) as other:
        second = other.say("length=0.2 one", id="door.1", feedback=True)
        assert (first.attached, second.attached) == (False, True)
        other.resume()
        assert [each.word for each in second.feedback(5)] == ["length=0.2", "one"]
        assert second.wait(5) == first.wait(5)
        third = other.say("length=0.2 one", id="door.1")
        assert (third.attached, third.goal) == (True, first.goal)
        assert third.wait(0) is third.goal
        assert [each.to_json()["event"] for each in third.events()] == ["result"]
        conflict = other.say("another text", id="door.1")
    assert (conflict.state, conflict.goal.reason, conflict.attached) == (State.REJECTED, "id_conflict", False)
    assert conflict.id != "door.1"
    assert len(scripted.watcher.words("door.1")) == 2  # it was spoken once


def test_patient_goal_waits_for_room(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "1", scripted=True)
    with Client(talk.socket) as client, Client(talk.socket) as other:
        active, pending = client.say("never-ends"), client.say("never-ends")
        refused = client.say("length=0")
        assert (refused.state, refused.goal.reason) == (State.REJECTED, "queue_full")
        states: list[State] = []
        thread = threading.Thread(target=lambda: states.append(client.say("length=0", patient=True).wait(10).state))
        thread.start()
        assert active.cancel().state is State.PREEMPTED  # the same client goes on beside it
        assert other.cancel([pending.id]).canceled[0].id == pending.id
        thread.join(10)
        assert states == [State.SUCCEEDED]


def test_patient_goal_whose_sender_hangs_up_is_not_spoken(make_talk: MakeTalk, tmp_path: Path) -> None:
    """The server notices that a waiting client has hung up when it shows that it is alive."""
    talk = make_talk("--max-queue", "1", program=patched_serve(tmp_path, subscribers__ALIVE_EVERY=0.5))
    with Client(talk.socket) as client:
        active = client.say("never-ends")
        talk.watcher.wait_for(active.id, "ACTIVE")
        pending = client.say("length=0")
        with talk.connect() as wire:
            wire.send({"seq": 1, "request": "say", "text": "length=0 never heard", "patient": True})
            wire.request("hello")  # by its reply, the goal has been taken
        while client.status().server["clients"] != 2:  # the watcher and this client
            time.sleep(0.05)  # no event tells that a client has gone
        active.cancel()
        assert pending.wait(5).state is State.SUCCEEDED
        assert client.say("length=0").wait(5).state is State.SUCCEEDED
        assert "never heard" not in str(client.log())


def test_cancel_by_key(client: Client) -> None:
    active, other = client.say("never-ends", key="k"), client.say("never-ends", key="j")
    pending = client.say("pending", key="k")
    assert {each.id for each in client.cancel(key="k").canceled} == {active.id, pending.id}
    assert client.cancel(key="k").canceled == ()
    assert {each.id for each in client.cancel([other.id], key="k").canceled} == {other.id}
    goal = client.say("never-ends")
    wrong: list[dict[str, Any]] = [{"key": ""}, {"key": "k" * 65}, {"ids": [""]}, {"before": ""}]
    for selection in wrong:
        with pytest.raises(UsageError, match="key" if "key" in selection else "an id is empty"):
            client.cancel(**selection)
    assert not goal.state.terminal
    goal.cancel()


def test_parts_of_a_list_of_ids_fit_into_a_line() -> None:
    assert batches([]) == []
    assert batches(["a", "b", "a"]) == [("a", "b")]
    for each in ("a" * 64, '"' * 64, "\x01" * 64, "🤖" * 64, "\ud800" * 64, "7"):
        ids = [f"{each}{number}" for number in range(2_000)]
        parts = batches(ids)
        assert [one for part in parts for one in part] == ids
        longest = max(len(encode({"request": "cancel", "ids": list(part), "key": "\ud800" * 64})) for part in parts)
        assert longest < MAX_LINE - 1_000


def test_log_is_what_was_said_oldest_first(client: Client) -> None:
    assert client.log() == []
    goals = [client.say(f"length=0 {number}").wait(5) for number in range(3)]
    rejected = client.say("").goal
    assert client.log() == [*goals, rejected]
    assert client.log(2) == [goals[2], rejected]
    for count in (0, -1, 2_201):
        with pytest.raises(UsageError, match="1 to 2200"):
            client.log(count)


def test_settings_are_changed_and_told(client: Client) -> None:
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


def test_voice_that_the_engine_has_not_cannot_be_set(untouched: Client) -> None:
    with pytest.raises(BadOption, match="klingon") as refused:
        untouched.set(rate=300, voice="klingon")
    assert (refused.value.code, refused.value.exit_code) == ("unknown_voice", 2)
    assert isinstance(refused.value, RequestRefused)
    assert untouched.settings() == SETTINGS


def test_speech_is_held_and_goes_on(client: Client, scripted: Talk) -> None:
    assert client.resume() is None  # speech was not paused
    assert client.pause() is None  # nothing was being spoken
    assert client.status().server["paused"] is True
    assert client.resume() is None
    handle = client.say("length=0.3 one two", feedback=True)
    scripted.watcher.wait_for_word(handle.id)
    held = client.pause()
    assert held
    assert (held.id, held.state, held.paused) == (handle.id, State.ACTIVE, True)
    assert client.pause() == held  # a second pause is no error
    assert (handle.speech_paused, handle.goal.paused) == (True, True)
    waiting = client.say("length=0", preempt=False)
    assert (waiting.speech_paused, waiting.state) == (True, State.PENDING)
    with pytest.raises(TimeoutError):
        handle.wait(0.4)
    gone_on = client.resume()
    assert gone_on
    assert (gone_on.id, gone_on.paused) == (handle.id, False)
    events = list(handle.events(5))
    assert [each.paused for each in events if isinstance(each, PausedChanged)] == [True, False]
    assert [each.state for each in events if isinstance(each, StateChanged)][-1] is State.SUCCEEDED
    assert not handle.speech_paused
    assert waiting.wait(5).state is State.SUCCEEDED
