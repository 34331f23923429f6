"""The library with a transport other than a socket."""

from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, State
from talkcli.client.connection import Connection
from talkcli.client.core import ServerInfo
from talkcli.client.goal import GoalHandle, merged
from talkcli.errors import Lost, ProtocolMismatch, ServerUnavailable, UsageError
from talkcli.goals.goal import Goal
from talkcli.goals.options import Cancel, Log, Say
from talkcli.protocol.events import PausedChanged, Result, StateChanged, from_json
from talkcli.protocol.lines import encode
from talkcli.protocol.requests import Status, Wait, Watch
from tests.support.connection import PATIENCE
from tests.support.scripted_peer import goal, result

if TYPE_CHECKING:
    from talkcli.client.core import Exchange
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request


class Scripted(Connection):
    """A server that accepts every goal, and speaks while a client waits."""

    def __init__(self) -> None:
        super().__init__(PATIENCE)
        self.path, self.server = "nowhere", ServerInfo("fake")
        self.requests: list[Request] = []
        #: Events for the next calls that wait.
        self.coming: list[JsonObject] = []

    def _send(self, exchange: Exchange) -> None:
        if self.ended:
            raise ServerUnavailable(self.ended)
        self.requests.append(exchange.request)
        exchange.sent = True
        if isinstance(exchange.request, Cancel):
            self._answer(exchange, canceled=goal("RECALLED"))
        elif isinstance(exchange.request, Wait | Log):
            self._answer(exchange, goal=goal("ACTIVE"))
        self._answer(exchange, ok=True, server={}, active=None, goal=goal("PENDING"))

    def _answer(self, exchange: Exchange, **fields: object) -> None:
        self.receive(encode({"seq": exchange.number, **fields}), time.monotonic())

    def _step(self, timeout: float, interruptible: bool) -> None:  # noqa: ARG002 - nothing blocks here
        with self.changed:
            if self.coming:
                self.listeners.publish(from_json(self.coming.pop(0)))
            elif timeout > 0:
                self.end("that was all")

    def _hang_up(self) -> None:
        pass

    def _drop(self) -> None:
        pass


@pytest.fixture
def scripted() -> Scripted:
    return Scripted()


def state(name: str, number: int) -> JsonObject:
    return {"event": "state", "id": "g", "state": name, "n": number, "at": 0.0}


def test_a_goal_is_sent_and_followed_to_its_result(scripted: Scripted) -> None:
    with Client.over(scripted) as client:
        handle = client.say("a b c")
        assert (client.path, client.server_pid, handle.state) == ("nowhere", None, State.PENDING)
        scripted.coming = [state("ACTIVE", 1), result()]
        assert [type(event) for event in handle.events()] == [StateChanged, Result]
        assert scripted.requests == [Say("a b c", wait=True)]
    with pytest.raises(ServerUnavailable, match="closed"):
        client.status()


def test_a_number_means_a_goal_of_the_connected_server(scripted: Scripted) -> None:
    client = Client.over(scripted)
    client.goal("12")
    client.cancel(["12", "mine"])
    assert scripted.requests == [Status("fake-12"), Cancel(("fake-12", "mine"))]


def test_only_a_server_with_filters_is_asked_for_its_history(scripted: Scripted) -> None:
    client = Client.over(scripted)
    scripted.server = ServerInfo("fake", features=())  # an older server
    client.log(5)
    with pytest.raises(ProtocolMismatch, match="does not support filters of the log; restart it"):
        client.log(since=1.0)
    scripted.server = ServerInfo("fake", features=("history",))
    client.log(5)
    client.log(since=1.0, history=False)
    assert scripted.requests == [Log(5), Log(5, history=True), Log(since=1.0)]


def test_a_handle_needs_no_client(scripted: Scripted) -> None:
    handle = GoalHandle(scripted, Goal("g", State.PENDING))
    handle.request_cancel()
    assert handle.cancel().state is State.RECALLED
    assert scripted.requests == [Cancel(("g",)), Cancel(("g",))]
    late = GoalHandle(scripted, Goal("g", State.PENDING))
    late.events()
    assert late.state is State.ACTIVE, "the current state at the server"
    scripted.coming = [result()]
    assert late.wait().state is State.SUCCEEDED
    assert scripted.requests[2:] == [Wait(("g",))]


def test_polling_an_ended_goal_receives_events_of_other_goals(scripted: Scripted) -> None:
    ended, other = GoalHandle(scripted, Goal("x", State.SUCCEEDED)), Client.over(scripted).say("a")
    assert [ended.poll(), ended.poll()] == [Result(ended.goal), None]
    scripted.coming = [result()]
    assert (ended.poll(), other.state) == (None, State.SUCCEEDED)


def test_goals_are_followed_as_one_stream(scripted: Scripted) -> None:
    (handle,) = Client.over(scripted).follow(["g"])
    scripted.coming = [state("PREEMPTING", 1), result("PREEMPTED")]
    assert [(source, type(event)) for source, event in merged([handle])] == [(handle, StateChanged), (handle, Result)]


def test_a_merged_stream_contains_each_pause_once(scripted: Scripted) -> None:
    late, early = (GoalHandle(scripted, Goal(goal_id, State.PENDING)) for goal_id in ("late", "early"))
    pauses = [PausedChanged(paused, None, None, 0.0, n) for n, paused in ((3, True), (5, False), (7, True))]
    early._listen_to(scripted.listeners, feedback=True, followed_at=0.0)
    scripted.listeners.publish(pauses[0])
    late._listen_to(scripted.listeners, feedback=True, followed_at=0.0)
    for pause in pauses[1:]:
        scripted.listeners.publish(pause)
    stream = merged([late, early])
    assert [event for _, event in itertools.islice(stream, 3)] == pauses
    scripted.listeners.publish(PausedChanged(False, None, None, 0.0, 9))
    later = [event for _, event in stream]
    assert [event.n for event in later if isinstance(event, PausedChanged)] == [9]


def test_a_pause_cannot_end_with_the_program_over_a_broker(scripted: Scripted) -> None:
    with pytest.raises(UsageError, match="over a broker"), Client.over(scripted).paused():
        pass
    assert scripted.requests == []


def test_a_goal_and_a_watch_are_lost_if_the_connection_ends(scripted: Scripted) -> None:
    client = Client.over(scripted)
    handle, watch = client.say("a"), client.events()
    next(watch)
    assert isinstance(scripted.requests[-1], Watch)
    assert handle.wait().state is State.LOST
    assert "that was all" in (handle.goal.message or "")
    with pytest.raises(Lost, match="at nowhere: that was all"):
        next(watch)


@pytest.mark.parametrize("error", [ZeroDivisionError, ServerUnavailable])
def test_a_saying_that_cannot_cancel_its_goal_raises_the_first_error(
    scripted: Scripted, error: type[Exception]
) -> None:
    def fail() -> None:
        scripted.end("that was all")
        if error is ZeroDivisionError:
            raise error

    with pytest.raises(error), Client.over(scripted).saying("a"):
        fail()


def test_an_interrupted_saying_cancels_its_goal(scripted: Scripted, monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(exchange: Exchange, **_: object) -> None:
        if isinstance(exchange.request, Say):
            raise KeyboardInterrupt

    monkeypatch.setattr(scripted, "_answer", answer)
    with pytest.raises(KeyboardInterrupt), Client.over(scripted).saying("a", id="mine"):
        pass
    assert scripted.requests == [Say("a", id="mine", wait=True), Cancel(("mine",))]
