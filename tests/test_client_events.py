"""Events of the client library: in JSON, from handles, from watches, and in many threads."""

from __future__ import annotations

import json
import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, GoalHandle, PausedChanged, Result, Snapshot, State, StateChanged, WordHeard
from talkcli.errors import Lost, UnknownGoal
from talkcli.goals.goal import By, Goal, Sender
from talkcli.goals.states import TRANSITIONS
from talkcli.protocol import events
from talkcli.protocol.events import ServerStatus
from tests.support.connection import PATIENCE
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


GOAL = Goal("4k7f-7", State.ACTIVE, "moving back", client=Sender(7, 0, "talk", "sh", "patrol"), queued_at=1.5)
EVENTS: list[Event] = [
    StateChanged("4k7f-7", State.ACTIVE, 2.5, 42),
    StateChanged("4k7f-7", State.SUCCEEDED, 2.5, 42, GOAL),
    WordHeard("4k7f-7", "back", 7, 11, 2, 0.25, 2.5, 43),
    PausedChanged(True, "4k7f-7", By(client=Sender(7, 0)), 2.5, 44),
    PausedChanged(False, None, None, 2.5, 45),
    Result(GOAL),
    Snapshot(ServerStatus({"pid": 1}, GOAL, (GOAL,), (GOAL, GOAL))),
    Snapshot(ServerStatus({}, None, (), ())),
]


@pytest.fixture
def client(scripted: Talk) -> Iterator[Client]:
    with Client(scripted.socket) as result:
        yield result


@pytest.mark.parametrize("event", EVENTS)
def test_an_event_survives_conversion_to_json_and_back(event: Event) -> None:
    message = json.loads(json.dumps(event.to_json()))
    assert next(iter(message)) == "event"
    assert events.from_json(message) == event
    assert events.from_json({**message, "new": 1}) == event


@pytest.mark.parametrize(
    "message",
    [
        {"event": "state", "id": "g", "state": "BORED"},
        {"event": "state", "id": 7, "state": "ACTIVE"},
        {"event": "state", "id": "g", "state": "ACTIVE", "goal": {}},
        {"event": "state", "id": "g", "state": "ACTIVE", "n": True},
        {"event": "word", "id": "g", "word": "a", "start": 0, "end": 1, "number": 1},
        {"event": "paused", "paused": 1},
        {"event": "result"},
        {"event": "snapshot", "active": {}},
        {"event": "snapshot", "pending": [1]},
    ],
)
def test_a_malformed_event_is_an_error(message: JsonObject) -> None:
    with pytest.raises(ValueError, match=r"goal|event"):
        events.from_json(message)


def test_an_unknown_kind_of_event_is_parsed_as_none() -> None:
    for kind in ("alive", None, ["state"]):
        assert events.from_json({"event": kind}) is None
    assert events.from_json({"ok": True}) is None


def summary(events: list[Event]) -> list[object]:
    """Return the states, words and, for other events, types."""
    return [
        event.state if isinstance(event, StateChanged) else event.word if isinstance(event, WordHeard) else type(event)
        for event in events
    ]


def test_the_events_of_a_goal_end_with_its_result(client: Client) -> None:
    handle = client.say("length=0.2 one", feedback=True)
    events = list(handle.events(5))
    assert summary(events) == [State.PENDING, State.ACTIVE, "length=0.2", "one", State.SUCCEEDED, Result]
    assert events[-1] == Result(handle.goal)
    assert [event.id for event in events if not isinstance(event, Result | Snapshot)] == [handle.id] * 5
    word = events[3]
    assert isinstance(word, WordHeard)
    assert (word.number, handle.goal.text and handle.goal.text[word.start : word.end]) == (2, "one")
    assert list(handle.events()) == [Result(handle.goal)]
    assert list(handle.feedback()) == []
    assert handle.wait(0) is handle.goal


def test_feedback_can_be_requested_after_a_goal_was_sent(client: Client, scripted: Talk) -> None:
    for follow in (True, False):
        first = client.say("never-ends", follow=follow)
        handle = client.say("length=0.1 one", follow=follow)
        scripted.watcher.wait_for(handle.id, "PENDING")
        words = handle.feedback(5)
        first.cancel()
        assert [word.word for word in words] == ["length=0.1", "one"]
        assert handle.state is State.SUCCEEDED
    assert summary(list(client.say("length=0").events(5))) == [State.PENDING, State.ACTIVE, State.SUCCEEDED, Result]


def test_a_rejected_goal_has_a_result_and_no_words(client: Client) -> None:
    for handle in (client.say(""), client.say("a" * 100_000, feedback=True)):
        assert [handle.poll(), handle.poll()] == [Result(handle.goal), None]
        assert list(handle.events(1)) == [Result(handle.goal)]
        assert list(handle.feedback(1)) == []
        assert handle.cancel() is handle.goal
        handle.request_cancel()  # must do nothing
    assert client.log()[-1].state is State.REJECTED


def test_an_interrupted_feedback_loop_can_be_continued(client: Client) -> None:
    handle = client.say("length=0.3 one two three", feedback=True)
    seen: list[str] = []
    for word in handle.feedback(5):
        seen.append(word.word)
        if word.word == "one":
            break
    assert client.goal(handle.id).state is State.ACTIVE  # the connection still works
    assert client.say("length=0", follow=False).state is State.PENDING
    seen.extend(word.word for word in handle.feedback(5))
    assert seen == ["length=0.3", "one", "two", "three"]
    assert handle.wait(5).state is State.SUCCEEDED


def test_two_handles_of_a_goal_get_the_same_events(client: Client, scripted: Talk) -> None:
    client.say("never-ends", key="first")
    handle = client.say("length=0.1 one", feedback=True)
    (other,) = client.follow([handle.id], feedback=True)
    (plain,) = client.follow([handle.id])
    scripted.watcher.wait_for(handle.id, "PENDING")
    client.cancel(key="first")
    mine, others = list(handle.events(5)), list(other.events(5))
    assert mine[1:] == others  # `other` was created after PENDING
    assert summary(list(plain.events(5))) == [State.ACTIVE, State.SUCCEEDED, Result]


def test_feedback_of_an_unknown_goal_is_an_error(client: Client) -> None:
    with pytest.raises(UnknownGoal):
        GoalHandle(client._connection, Goal("none-1", State.ACTIVE)).feedback(1)


def polled(handle: GoalHandle) -> list[Event]:
    """Poll a handle until it returns a result, and return all its events."""
    events: list[Event] = []
    end = time.monotonic() + PATIENCE
    while not (events and isinstance(events[-1], Result)):
        assert time.monotonic() < end, events
        event = handle.poll()
        if event is None:
            time.sleep(0.002)  # like a robot's loop, which does other work
        else:
            events.append(event)
    return events


def test_poll_returns_each_event_once_then_the_result_then_none(client: Client) -> None:
    handle = client.say("length=0.2 one", feedback=True)
    events = polled(handle)
    assert summary(events) == [State.PENDING, State.ACTIVE, "length=0.2", "one", State.SUCCEEDED, Result]
    assert events[-1] == Result(handle.goal)
    assert [handle.poll(), handle.poll()] == [None, None]
    assert list(handle.events()) == [Result(handle.goal)]
    heard = client.say("length=0")
    assert summary(list(heard.events(5)))[-1] is Result
    assert heard.poll() is None  # its result has been returned


def test_poll_never_waits(client: Client, scripted: Talk) -> None:
    handle = client.say("never-ends words=1", feedback=True)
    scripted.watcher.wait_for_word(handle.id)
    waiting = threading.Thread(target=handle.wait)
    with limits():
        started_at = time.monotonic()
        polls = [handle.poll() for _ in range(100)]
        assert_within(time.monotonic() - started_at, 0.1, "100 polls of an active goal")
        waiting.start()  # now this thread reads from the socket
        started_at = time.monotonic()
        polls += [handle.poll() for _ in range(100)]
        assert_within(time.monotonic() - started_at, 0.1, "100 polls while another thread waits")
    client.cancel([handle.id])
    seen = [event for event in polls if event] + polled(handle)  # some events may arrive after the watcher got them
    assert summary(seen) == [State.PENDING, State.ACTIVE, "never-ends", State.PREEMPTING, State.PREEMPTED, Result]
    waiting.join(5)


def test_poll_returns_the_result_of_a_goal_of_a_frozen_server(scripted: Talk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("talkcli.client.core.SILENCE_LIMIT_S", 0.2)
    started_at = time.monotonic()
    with Client(scripted.socket, timeout=0.3) as client:
        handle = client.say("never-ends words=1")
        scripted.freeze()
        assert summary(polled(handle))[-1] is Result
        assert (handle.state, handle.goal.reason, handle.poll()) == (State.LOST, "lost", None)
        assert time.monotonic() - started_at >= 0.5
        assert "nothing for 0.2 s" in (handle.goal.message or "")
        scripted.thaw()
        scripted.run("cancel")


def until_all_ended(watch: Iterator[Event], count: int) -> list[Event]:
    """Return the events of a watch until this number of goals has ended."""
    events: list[Event] = []
    for event in watch:
        events.append(event)
        count -= isinstance(event, StateChanged) and event.state.terminal
        if not count:
            break
    return events


def test_a_watch_starts_with_a_snapshot_and_then_misses_no_event(client: Client, scripted: Talk) -> None:
    ended = client.say("length=0").wait(5)
    active, pending = client.say("never-ends words=1"), client.say("length=0")
    scripted.watcher.wait_for_word(active.id)
    watch = client.events()
    snapshot = next(watch)
    assert isinstance(snapshot, Snapshot)
    status = snapshot.status
    assert status.active
    assert (status.active.id, [goal.id for goal in status.pending]) == (active.id, [pending.id])
    assert status.recent == (ended,)
    with Client(scripted.socket, name="another") as other:
        other.pause()
        other.resume()
        other.say("length=0 hello", follow=False)
        other.cancel([active.id])
    events = until_all_ended(watch, 3)
    goals = [event.goal for event in events if isinstance(event, StateChanged) and event.goal]
    assert [goal.state for goal in goals] == [State.PENDING, State.PREEMPTED, State.SUCCEEDED, State.SUCCEEDED]
    assert goals[0].client
    assert goals[0].client.name == "another"
    assert [event.word for event in events if isinstance(event, WordHeard)].count("hello") == 1
    assert [event.paused for event in events if isinstance(event, PausedChanged)] == [True, False]
    numbers = [event.n or 0 for event in events if not isinstance(event, Result | Snapshot)]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))  # no event is missing or repeated
    handle = client.say("length=0 one", feedback=True)
    assert summary(until_all_ended(watch, 1)) == summary(list(handle.events(5)))[:-1]


def run_all(functions: list[Callable[[], None]]) -> None:
    """Run each function in its own thread, and raise the first error."""
    with ThreadPoolExecutor(len(functions)) as pool:
        for future in [pool.submit(function) for function in functions]:
            future.result(60)


def check_events(events: list[Event], handle: GoalHandle) -> None:
    """Assert that these are all events of one goal, without repetitions and in order."""
    *before, last = events
    assert last == Result(handle.goal)
    assert not any(isinstance(event, Result | Snapshot) for event in before)
    states = [event.state for event in before if isinstance(event, StateChanged)]
    assert states[0] is State.PENDING
    for one, next_one in pairwise(states):
        recalled = (one, next_one) == (State.PENDING, State.RECALLED)  # there is no RECALLING event
        assert next_one in TRANSITIONS[one] or recalled, states
    assert states[-1] is handle.state
    words = [event for event in before if isinstance(event, WordHeard)]
    assert [word.number for word in words] == list(range(1, len(words) + 1))
    assert {event.id for event in before if isinstance(event, StateChanged | WordHeard)} == {handle.id}


def test_eight_threads_can_say_follow_wait_and_cancel_at_once(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "1000", scripted=True)
    turns, count = 6, 8
    handles: list[GoalHandle] = []

    with Client(talk.socket) as client:

        def use(number: int) -> None:
            choose = random.Random(number)
            for turn in range(turns):
                text = f"length=0.0{choose.randrange(5)} {number} {turn}"
                handle = client.say(text, feedback=True, preempt=choose.random() < 0.2, key=f"{number}")
                handles.append(handle)
                how = choose.randrange(4)
                if how == 0:
                    check_events(list(handle.events(30)), handle)
                elif how == 1:
                    for word in handle.feedback(30):
                        assert text[word.start : word.end] == word.word
                        if word.number == 2:
                            handle.cancel()
                elif how == 2:
                    handle.request_cancel()
                    check_events(list(handle.events(30)), handle)
                else:
                    assert client.goal(handle.id).text == text
                goal = handle.wait(30)
                assert goal.text == text
                assert client.goal(goal.id) == goal

        run_all([lambda number=number: use(number) for number in range(count)])  # type: ignore[misc]
        assert len({handle.id for handle in handles}) == turns * count
        ended = {State.SUCCEEDED, State.PREEMPTED, State.RECALLED}
        assert {handle.state for handle in handles} <= ended
        assert State.SUCCEEDED in {handle.state for handle in handles}
    counts = talk.watcher.terminal_counts()
    assert {counts[handle.id] for handle in handles} == {1}


def test_threads_share_the_events_of_one_goal(scripted: Talk) -> None:
    """One of the threads gets each event. All threads get the result."""
    with Client(scripted.socket) as client:
        words = " ".join(map(str, range(200)))
        handle = client.say(f"length=0.2 {words}", feedback=True)
        taken: list[list[Event]] = [[] for _ in range(4)]
        run_all([lambda part=part: part.extend(handle.events(30)) for part in taken])  # type: ignore[misc]
        assert [part[-1] for part in taken] == [Result(handle.goal)] * 4
        events = [event for part in taken for event in part[:-1] if isinstance(event, StateChanged | WordHeard)]
        events.sort(key=lambda event: event.n or 0)
        check_events([*events, Result(handle.goal)], handle)
        assert len([event for event in events if isinstance(event, WordHeard)]) == 201


@pytest.mark.parametrize("how", ["killed", "closed"])
def test_all_waiting_threads_return_if_the_connection_ends(scripted: Talk, how: str) -> None:
    with Client(scripted.socket, timeout=0.5) as client:
        handles = [client.say("never-ends words=1", feedback=True) for _ in range(6)]
        scripted.watcher.wait_for_word(handles[0].id)
        scripted.unfinished = True
        lost: list[bool] = []
        watching = threading.Event()

        def watch() -> None:
            events = client.events()
            next(events)
            watching.set()
            with pytest.raises(Lost):
                list(events)
            lost.append(True)

        def end() -> None:
            assert watching.wait(5)
            if how == "killed":
                scripted.kill()
            else:
                client.close()

        def hear(handle: GoalHandle) -> None:
            *_, last = handle.events(30)
            lost.append(last == Result(handle.goal) and handle.state is State.LOST)

        def wait(handle: GoalHandle) -> None:
            lost.append(handle.wait(30).state is State.LOST)

        uses = [lambda handle=handle: (hear if int(handle.id[-1]) % 2 else wait)(handle) for handle in handles]
        run_all([watch, end, *uses])
        assert lost == [True] * 7
