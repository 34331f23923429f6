"""The client library against a server that follows a script: events that the program doesn't take, or get twice."""

from __future__ import annotations

import pytest

from talkcli import Client
from talkcli.client.following import MAX_FEEDBACK, MAX_STATES
from talkcli.errors import Lost, UnknownGoal
from talkcli.goals.states import State
from talkcli.protocol.events import Event, Result, Snapshot, StateChanged
from talkcli.protocol.lines import MAX_LINE
from tests.support.scripted_peer import OVERVIEW, Peer, goal, result, serving


def test_words_are_not_kept_for_a_goal_that_was_sent_without_feedback() -> None:
    def play(peer: Peer) -> None:
        peer.accept()
        peer.send(peer.state("ACTIVE"), peer.word(), {"event": "paused", "paused": True, "id": "g", "by": None})
        peer.send(result())

    with serving(play) as path, Client(path) as client:
        handle = client.say("a")
        assert [type(each) for each in handle.events(5)] == [StateChanged, Result]
        assert handle.speech_paused


def test_watch_that_is_not_read_is_bounded_and_ends() -> None:
    def play(peer: Peer) -> None:
        peer.reply("watch", **OVERVIEW)
        for _ in range(MAX_STATES + 500):
            peer.send(peer.state("ACTIVE"), peer.word())
        peer.reply("status", **OVERVIEW)

    with serving(play) as path, Client(path) as client:
        watch = client.events()
        client.status()  # which reads all that
        seen: list[Event] = []
        with pytest.raises(Lost, match="take them faster"):
            seen.extend(watch)
        states = [each for each in seen if isinstance(each, StateChanged)]
        assert isinstance(seen[0], Snapshot)
        assert len(states) == MAX_STATES - 1  # and the snapshot
        assert [each.n for each in states] == list(range(1, 2 * len(states), 2))  # no gap but that of the words
        assert 0 < len(seen) - len(states) <= MAX_FEEDBACK + 1


def test_watch_ends_with_its_iterator() -> None:
    def play(peer: Peer) -> None:
        for _ in range(2):
            peer.reply("watch", **OVERVIEW)
            peer.send(peer.state("ACTIVE"))
        peer.reply("status", **OVERVIEW)

    with serving(play) as path, Client(path) as client:
        for _ in client.events():
            break
        client.events()  # not even begun
        client.status()
        watches = client._connection.followed._watches
        assert watches is not None
        assert len(watches) == 0


def test_event_that_comes_twice_is_one() -> None:
    """A connection that waits for a goal and watches all goals gets each state twice."""

    def play(peer: Peer) -> None:
        peer.reply("watch", **OVERVIEW)
        peer.accept()
        for state in ("PENDING", "ACTIVE", "SUCCEEDED"):
            event = peer.state(state)
            whole = {} if state == "ACTIVE" else {"goal": goal(state)}
            peer.send(event, {**event, **whole})
        peer.send(result())
        peer.hang_up()

    with serving(play) as path, Client(path) as client:
        watch = client.events()
        handle = client.say("a", feedback=True)
        own = [each for each in handle.events(5) if isinstance(each, StateChanged)]
        states = [State.PENDING, State.ACTIVE, State.SUCCEEDED]
        assert [each.state for each in own] == states
        seen: list[Event] = []
        with pytest.raises(Lost):
            seen.extend(watch)
        told = [each for each in seen if isinstance(each, StateChanged)]
        assert [each.state for each in told] == states
        assert [each.goal is not None for each in told] == [True, False, True]
        assert len(seen) == 4  # a result is for those who wait


def test_thousands_of_ids_go_in_lines_that_are_not_too_long() -> None:
    ids = [f"4k7f-{each}" for each in range(9_000)] + ["é" * 64, "🤖" * 64]
    asked: list[str] = []

    def play(peer: Peer) -> None:
        for kind in ("wait", "cancel"):
            asked.clear()
            while len(asked) < len(ids):
                request = peer.receive(kind)
                asked.extend(request["ids"])
                assert (request.get("key"), request.get("feedback", False)) in ((None, kind == "wait"), ("k", False))
                if kind == "wait":
                    items = [{"seq": request["seq"], "goal": goal(goal_id=each)} for each in request["ids"]]
                    peer.send(*items, {"seq": request["seq"], "ok": True})
                else:
                    error = {"code": "unknown_goal", "message": f"no {request['ids'][-1]!a}"}
                    ended = {"seq": request["seq"], "ended": goal(goal_id=request["ids"][0])}
                    peer.send(ended, {"seq": request["seq"], "ok": False, "error": error})
            assert asked == ids
        assert MAX_LINE // 2 < peer.longest <= MAX_LINE

    with serving(play) as path, Client(path) as client:
        handles = client.follow([*ids, ids[0]], feedback=True)
        assert [each.id for each in handles] == [*ids, ids[0]]
        with pytest.raises(UnknownGoal) as unknown:
            client.cancel(ids, key="k")
        assert len(unknown.value.items) > 2
        assert unknown.value.message.count("no '") == len(unknown.value.items)
