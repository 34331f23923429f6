"""The client library with a scripted peer: time limits, lost connections, interrupts and limited line lengths."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, GoalHandle
from talkcli.client.connection import SocketConnection
from talkcli.errors import Lost, ServerUnavailable, UnknownGoal
from talkcli.goals.states import State
from talkcli.polling import Interrupted, run_blocking
from talkcli.protocol.events import Event, Result, StateChanged, WordHeard
from talkcli.protocol.lines import MAX_LINE_BYTES
from tests.support.connection import PATIENCE
from tests.support.scripted_peer import OVERVIEW, Peer, goal, result, serving

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def ignore_say(peer: Peer) -> None:
    peer.receive("say")


def test_a_patient_say_waits_while_the_server_is_alive() -> None:
    def play(peer: Peer) -> None:
        seq = peer.receive("say")["seq"]
        for _ in range(3):
            time.sleep(0.1)
            peer.send({"event": "alive"})
        peer.send({"seq": seq, "ok": True, "goal": goal("PENDING"), "paused": True})
        peer.reply("status", **OVERVIEW)
        peer.send(result())

    with serving(play) as path, Client.over(run_blocking(SocketConnection.open(path, patience_s=0.2))) as client:
        handle = client.say("a", patient=True)
        assert (handle.state, handle.speech_paused, handle.attached) == (State.PENDING, True, False)
        client.status()
        assert handle.wait(5).state is State.SUCCEEDED


def test_a_silent_server_is_considered_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("talkcli.client.core.SILENCE_LIMIT_S", 0.3)
    with serving(ignore_say) as path, Client.over(run_blocking(SocketConnection.open(path, patience_s=5))) as client:
        started_at = time.monotonic()
        with pytest.raises(Lost, match=r"nothing for 0\.3 s"):
            client.say("a", patient=True)
        assert 0.3 <= time.monotonic() - started_at < 1
        with pytest.raises(ServerUnavailable, match="nothing was sent"):
            client.status()


def test_feedback_times_out_even_while_words_arrive() -> None:
    def play(peer: Peer) -> None:
        peer.accept()
        with contextlib.suppress(OSError):
            while True:
                peer.send(peer.word())

    with serving(play) as path, Client(path) as client:
        handle = client.say("a", feedback=True)
        started_at = time.monotonic()
        words: list[WordHeard] = []
        with pytest.raises(TimeoutError, match=r"g has not ended after 0\.3 s"):
            words.extend(handle.feedback(0.3))
        assert words
        assert 0.3 <= time.monotonic() - started_at < 3  # only words that had been read by then are returned


@pytest.mark.parametrize("timeout", [0, 0.1])
def test_events_received_by_the_deadline_are_returned(timeout: float) -> None:
    def play(peer: Peer) -> None:
        peer.accept()
        peer.send(peer.state("PENDING"), peer.state("ACTIVE"))
        sent.set()

    sent = threading.Event()
    with serving(play) as path, Client(path) as client:
        handle = client.say("a")
        assert sent.wait(PATIENCE)
        seen: list[Event] = []
        with pytest.raises(TimeoutError):
            seen.extend(handle.events(timeout))
        assert [event.state for event in seen if isinstance(event, StateChanged)] == [State.PENDING, State.ACTIVE]
        with pytest.raises(TimeoutError):
            next(handle.events(timeout))  # each event is returned once


def test_a_result_received_before_the_server_disconnects_counts() -> None:
    gone = threading.Event()

    def play(peer: Peer) -> None:
        peer.accept()
        peer.send(peer.state("ACTIVE"), peer.state("PREEMPTED"), result("PREEMPTED"))
        peer.hang_up()
        gone.set()

    with serving(play) as path, Client(path, timeout=0.3) as client:
        handle = client.say("a")
        assert gone.wait(PATIENCE)
        with pytest.raises(ServerUnavailable):
            client.status()
        with pytest.raises(ServerUnavailable):
            client.say("b")
        assert handle.wait(5).state is State.PREEMPTED


@pytest.fixture
def interrupt() -> Iterator[tuple[int, int]]:
    """A pipe that interrupts the client: its reading end and its writing end."""
    pipe = os.pipe()
    yield pipe
    for descriptor in pipe:
        os.close(descriptor)


@pytest.mark.parametrize(
    "wait", [lambda handle: [*handle.events(5)], lambda handle: [*handle.feedback(5)], GoalHandle.wait]
)
def test_an_interrupt_ends_a_wait_and_loses_no_event(
    interrupt: tuple[int, int], wait: Callable[[GoalHandle], object]
) -> None:
    def play(peer: Peer) -> None:
        peer.accept()
        peer.send(peer.state("ACTIVE"))
        os.write(interrupt[1], b"x")
        peer.reply("status", **OVERVIEW)
        peer.send(peer.word(), result())

    with (
        serving(play) as path,
        Client.over(run_blocking(SocketConnection.open(path, interrupt={interrupt[0]: select.POLLIN}))) as client,
    ):
        handle = client.say("a", feedback=True)
        with pytest.raises(Interrupted):
            wait(handle)
        os.read(interrupt[0], 1)
        client.status()
        assert [type(event) for event in handle.events(5)][-2:] == [WordHeard, Result]


@pytest.mark.parametrize(
    ("kind", "call"),
    [
        ("watch", lambda client: [*client.events()]),
        ("say", lambda client: client.say("a", patient=True)),
        ("pause", Client.pause),
    ],
)
def test_an_interrupt_ends_a_long_call(interrupt: tuple[int, int], kind: str, call: Callable[[Client], object]) -> None:
    def play(peer: Peer) -> None:
        request = peer.receive(kind)
        if kind == "watch":
            peer.send({"seq": request["seq"], "ok": True, **OVERVIEW})
        os.write(interrupt[1], b"x")

    with serving(play) as path:
        client = Client.over(run_blocking(SocketConnection.open(path, interrupt={interrupt[0]: select.POLLIN})))
        with client, pytest.raises(Interrupted):
            call(client)


def test_a_watch_ends_when_its_iterator_is_dropped() -> None:
    def play(peer: Peer) -> None:
        for _ in range(2):
            peer.reply("watch", **OVERVIEW)
            peer.send(peer.state("ACTIVE"))
        peer.reply("status", **OVERVIEW)

    with serving(play) as path, Client(path) as client:
        for _ in client.events():
            break
        client.events()  # never iterated
        client.status()
        watches = client._connection.listeners.watches
        assert watches is not None
        assert len(watches) == 0


def test_thousands_of_ids_are_sent_in_lines_of_legal_length() -> None:
    ids = [f"4k7f-{number}" for number in range(9_000)] + ["é" * 64, "🤖" * 64]
    requested: list[str] = []

    def play(peer: Peer) -> None:
        for kind in ("wait", "cancel"):
            requested.clear()
            while len(requested) < len(ids):
                request = peer.receive(kind)
                requested.extend(request["ids"])
                assert (request.get("key"), request.get("feedback", False)) in ((None, kind == "wait"), ("k", False))
                if kind == "wait":
                    items = [{"seq": request["seq"], "goal": goal(goal_id=goal_id)} for goal_id in request["ids"]]
                    peer.send(*items, {"seq": request["seq"], "ok": True})
                else:
                    error = {"code": "unknown_goal", "message": f"no {request['ids'][-1]!a}"}
                    ended = {"seq": request["seq"], "ended": goal(goal_id=request["ids"][0])}
                    peer.send(ended, {"seq": request["seq"], "ok": False, "error": error})
            assert requested == ids
        assert MAX_LINE_BYTES // 2 < peer.longest <= MAX_LINE_BYTES

    with serving(play) as path, Client(path) as client:
        handles = client.follow([*ids, ids[0]], feedback=True)
        assert [handle.id for handle in handles] == [*ids, ids[0]]
        with pytest.raises(UnknownGoal) as unknown:
            client.cancel(ids, key="k")
        assert len(unknown.value.items) > 2
        assert unknown.value.message.count("no '") == len(unknown.value.items)
