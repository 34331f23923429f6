"""One client used by many threads: replies and events find their threads, and every goal has one result."""

from __future__ import annotations

import random
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, Result, Snapshot, State, StateChanged, WordHeard
from talkcli.errors import Lost
from talkcli.goals.states import TRANSITIONS

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli import GoalHandle
    from talkcli.protocol.events import Event
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


def run_all(uses: list[Callable[[], None]]) -> None:
    """Run each in a thread of its own, and raise the errors."""
    with ThreadPoolExecutor(len(uses)) as pool:
        for each in [pool.submit(use) for use in uses]:
            each.result(60)


def check_events(events: list[Event], handle: GoalHandle) -> None:
    """Assert that these are all the events of one goal, each once and in order."""
    *before, last = events
    assert last == Result(handle.goal)
    assert not any(isinstance(each, Result | Snapshot) for each in before)
    states = [each.state for each in before if isinstance(each, StateChanged)]
    assert states[0] is State.PENDING
    for one, next_one in pairwise(states):
        recalled = (one, next_one) == (State.PENDING, State.RECALLED)  # RECALLING is never told
        assert next_one in TRANSITIONS[one] or recalled, states
    assert states[-1] is handle.state
    words = [each for each in before if isinstance(each, WordHeard)]
    assert [each.number for each in words] == list(range(1, len(words) + 1))
    assert {each.id for each in before if isinstance(each, StateChanged | WordHeard)} == {handle.id}


def test_eight_threads_say_hear_wait_and_cancel(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-queue", "1000", scripted=True)
    turns, count = 12, 8
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
        assert len({each.id for each in handles}) == turns * count
        ended = {State.SUCCEEDED, State.PREEMPTED, State.RECALLED}
        assert {each.state for each in handles} <= ended
        assert State.SUCCEEDED in {each.state for each in handles}
    counts = talk.watcher.terminal_counts()
    assert {counts[each.id] for each in handles} == {1}


def test_threads_share_the_events_of_one_goal(scripted: Talk) -> None:
    """Each event goes to one of the threads. The result goes to all."""
    with Client(scripted.socket) as client:
        words = " ".join(map(str, range(200)))
        handle = client.say(f"length=0.5 {words}", feedback=True)
        taken: list[list[Event]] = [[] for _ in range(4)]
        run_all([lambda found=found: found.extend(handle.events(30)) for found in taken])  # type: ignore[misc]
        assert [each[-1] for each in taken] == [Result(handle.goal)] * 4
        events = [each for found in taken for each in found[:-1] if isinstance(each, StateChanged | WordHeard)]
        events.sort(key=lambda each: each.n or 0)
        check_events([*events, Result(handle.goal)], handle)
        assert len([each for each in events if isinstance(each, WordHeard)]) == 201


@pytest.mark.parametrize("how", ["killed", "closed"])
def test_end_of_the_connection_ends_every_thread(scripted: Talk, how: str) -> None:
    with Client(scripted.socket) as client:
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

        uses = [lambda each=each: (hear if int(each.id[-1]) % 2 else wait)(each) for each in handles]
        run_all([watch, end, *uses])
        assert lost == [True] * 7
