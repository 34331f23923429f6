"""The client library's requests, each with all that it can be asked, against a server with the scripted engine."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import Client, PausedChanged, State, StateChanged
from talkcli.client.client import batches
from talkcli.errors import BadOption, RequestRefused, UnknownGoal, UsageError
from talkcli.protocol.lines import MAX_LINE, encode
from talkcli.server import subscribers
from tests.support.processes import Talk

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk

#: Serves with the scripted engine, and says every so many seconds that it is alive.
ALIVE = """
import sys
sys.path.insert(0, {root!r})
from talkcli.server import subscribers
from tests.support import scripted_serve
subscribers.ALIVE_EVERY = {every}
scripted_serve.main()
"""
SETTINGS = {"rate": 200, "volume": 1.0, "voice": None, "pitch": 50, "preempt": False, "ttl": None}


@pytest.fixture
def client(scripted: Talk) -> Iterator[Client]:
    with Client(scripted.socket, name="patrol") as result:
        yield result


@pytest.fixture(scope="module")
def untouched() -> Iterator[Client]:
    """A client of a server for all tests that must leave it as it was: it has spoken nothing, with its own settings."""
    with contextlib.closing(Talk(scripted=True)) as talk, Client(talk.socket) as result:
        yield result
        talk.stop()


# say


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


def test_goal_that_is_late_is_recalled(client: Client) -> None:
    client.say("never-ends")
    assert client.say("late", ttl=0.1).wait(5).reason == "expired"
    client.cancel()


def test_throttled_goal_is_rejected(client: Client) -> None:
    first = client.say("length=0 obstacle", throttle=60)
    second = client.say("length=0 obstacle", throttle=60)
    assert (second.state, second.goal.reason) == (State.REJECTED, "throttled")
    assert second.id != first.id
    assert first.wait(5).state is State.SUCCEEDED


def test_same_id_again_attaches(client: Client, scripted: Talk) -> None:
    scripted.request("pause")  # so that no word is told before the second is attached
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


@pytest.mark.parametrize(
    "options",
    [
        {"rate": 79},
        {"rate": 451},
        {"rate": 200.5},
        {"rate": "fast"},
        {"rate": True},
        {"volume": -0.1},
        {"volume": 1.01},
        {"volume": math.nan},
        {"pitch": -1},
        {"pitch": 101},
        {"voice": ""},
        {"ttl": -1},
        {"ttl": math.inf},
        {"ttl": math.nan},
        {"throttle": -0.001},
        {"throttle": math.inf},
        {"key": ""},
        {"key": "k" * 65},
        {"id": ""},
        {"id": "17"},
        {"id": "4k7f-1"},
        {"id": "-x"},
        {"id": "a b"},
        {"id": "é"},
        {"id": "i" * 65},
        {"priority": 1_000_001},
        {"priority": 1.5},
        {"preempt": False, "flush": True},
        {"preempt": 1},
        {"data": {"a": "x" * 1024}},
        {"data": {"a": "日" * 300}},
        {"data": [1]},
        {"data": {"a": object()}},
        {"data": {"a": math.nan}},
    ],
)
def test_option_out_of_its_range_is_an_error_and_nothing_is_sent(untouched: Client, options: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        untouched.say("hello", **options)
    assert untouched.log() == []


@pytest.mark.parametrize(
    "options",
    [
        {"rate": 80, "volume": 0, "pitch": 0, "ttl": 0, "throttle": 0, "key": "k", "id": "-".rjust(64, "a")},
        {"rate": 450, "volume": 1.0, "pitch": 100, "ttl": 1e9, "throttle": 0.5, "key": "k" * 64, "id": "a"},
        {"priority": -1_000_000, "data": {"a": "x" * 1000}, "preempt": True, "flush": True, "voice": "default"},
    ],
)
def test_ends_of_the_ranges_are_within(client: Client, options: dict[str, Any]) -> None:
    assert client.say("length=0", **options).wait(5).state is State.SUCCEEDED


def test_text_of_the_wrong_kind_is_an_error(untouched: Client) -> None:
    with pytest.raises(UsageError, match="'text' must be a string"):
        untouched.say(b"hello")  # type: ignore[arg-type]


def test_voice_that_the_engine_has_not_is_rejected(client: Client) -> None:
    handle = client.say("hello", voice="klingon")
    assert (handle.state, handle.goal.reason) == (State.REJECTED, "unknown_voice")


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


@pytest.mark.parametrize("every", [0.5, pytest.param(subscribers.ALIVE_EVERY, marks=pytest.mark.slow)])
def test_patient_goal_whose_sender_hangs_up_is_not_spoken(make_talk: MakeTalk, tmp_path: Path, every: float) -> None:
    """The server sees that somebody who waits has hung up when it says that it is alive."""
    program = tmp_path / "serve.py"
    program.write_text(ALIVE.format(root=str(Path(__file__).parents[1]), every=every), encoding="utf-8")
    talk = make_talk("--max-queue", "1", program=str(program))
    with Client(talk.socket) as client:
        active = client.say("never-ends")
        talk.watcher.wait_for(active.id, "ACTIVE")
        pending = client.say("length=0")
        with talk.connect() as wire:
            wire.send({"seq": 1, "request": "say", "text": "length=0 never heard", "patient": True})
            wire.request("hello")  # it was taken
        while client.status().server["clients"] != 2:  # the watcher, and this one
            time.sleep(0.05)  # nobody is told that a client has gone
        active.cancel()
        assert pending.wait(5).state is State.SUCCEEDED
        assert client.say("length=0").wait(5).state is State.SUCCEEDED
        assert "never heard" not in str(client.log())


# cancel, log, settings


def test_cancel_by_key(client: Client) -> None:
    active, other = client.say("never-ends", key="k"), client.say("never-ends", key="j")
    pending = client.say("pending", key="k")
    assert {each.id for each in client.cancel(key="k").canceled} == {active.id, pending.id}
    assert client.cancel(key="k").canceled == ()
    assert {each.id for each in client.cancel([other.id], key="k").canceled} == {other.id}
    for key in ("", "k" * 65):
        with pytest.raises(UsageError, match="key"):
            client.cancel(key=key)


@pytest.mark.parametrize("selection", [{"ids": [""]}, {"before": ""}])
def test_empty_id_is_an_error_and_selects_nothing(client: Client, selection: dict[str, Any]) -> None:
    goal = client.say("never-ends")
    with pytest.raises(UsageError, match="an id is empty"):
        client.cancel(**selection)
    assert not goal.state.terminal
    goal.cancel()


def test_more_ids_than_a_request_holds(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "5000", scripted=True, watched=False)
    ids = [f"{number:04}.".ljust(64, "x") for number in range(1_000)]
    assert len(batches(ids)) == 3
    with Client(talk.socket) as client:
        active = client.say("never-ends")
        for each in ids:
            client.say("hello", id=each, follow=False)
        handles = client.follow(ids)
        assert [each.id for each in handles] == ids
        with pytest.raises(UnknownGoal, match="none-1") as unknown:
            client.cancel(["none-1", *ids])
        assert len(unknown.value.items) == len(ids)
        assert {each.wait(5).state for each in handles} == {State.RECALLED}
        assert len(client.cancel(ids).ended) > 0
        assert active.cancel().state is State.PREEMPTED


def test_parts_of_a_list_of_ids_fit_into_a_line() -> None:
    assert batches([]) == []
    assert batches(["a", "b", "a"]) == [("a", "b")]
    for each in ("a" * 64, '"' * 64, "\x01" * 64, "🤖" * 64, "\ud800" * 64, "7"):
        ids = [f"{each}{number}" for number in range(5_000)]
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


@pytest.mark.parametrize("options", [{"rate": 79}, {"volume": 2}, {"pitch": 101}, {"ttl": -1}, {"voice": ""}])
def test_setting_out_of_its_range_is_an_error_and_changes_nothing(untouched: Client, options: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        untouched.set(preempt=True, **options)
    assert untouched.settings() == SETTINGS


def test_voice_that_the_engine_has_not_cannot_be_set(untouched: Client) -> None:
    with pytest.raises(BadOption, match="klingon") as refused:
        untouched.set(rate=300, voice="klingon")
    assert (refused.value.code, refused.value.exit_code) == ("unknown_voice", 2)
    assert isinstance(refused.value, RequestRefused)
    assert untouched.settings() == SETTINGS


# pause and resume


def test_speech_is_held_and_goes_on(client: Client, scripted: Talk) -> None:
    handle = client.say("length=0.3 one two", feedback=True)
    scripted.watcher.wait_for_word(handle.id)
    held = client.pause()
    assert held
    assert (held.id, held.state, held.paused) == (handle.id, State.ACTIVE, True)
    assert client.pause() == held  # twice is no error
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


def test_nothing_is_spoken_while_speech_is_paused(make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True, watched=False)
    with Client(talk.socket) as client:
        assert client.resume() is None  # it goes already
        assert client.pause() is None  # nothing was being spoken
        handle = client.say("length=0 one", preempt=True, feedback=True)
        assert handle.speech_paused
        assert client.status().server["paused"] is True
        with pytest.raises(TimeoutError):
            list(handle.feedback(0.2))
        assert handle.state is State.PENDING
        assert client.resume() is None  # it was not begun, so that it was not held
        assert [each.word for each in handle.feedback(5)] == ["length=0", "one"]
