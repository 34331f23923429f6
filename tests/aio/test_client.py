"""The asyncio client with a scripted server: goals, cancelled tasks, lost connections and time limits."""

from __future__ import annotations

import asyncio
import socket
import statistics
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import Snapshot, State
from talkcli.aio import Client
from talkcli.errors import ServerUnavailable, UsageError
from talkcli.protocol.events import Result, StateChanged
from tests.support.connection import PATIENCE
from tests.support.loop import in_loop
from tests.support.timing import assert_within, limits
from tests.test_client_reconnecting import disconnect, restart

if TYPE_CHECKING:
    from collections.abc import Coroutine
    from typing import Any

    from talkcli.aio import GoalHandle
    from talkcli.protocol.events import Event
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

pytestmark = pytest.mark.timeout(60)


async def interrupted(coroutine: Coroutine[Any, Any, object]) -> None:
    """Run a coroutine in a task until it waits, and cancel the task."""
    task = asyncio.create_task(coroutine)
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


def socket_of(talk: Client) -> socket.socket:
    connected = talk._connection._socket  # type: ignore[attr-defined]
    assert connected
    return connected  # type: ignore[no-any-return]


async def until_active(goal: GoalHandle) -> None:
    while goal.state is not State.ACTIVE:
        await goal.events(PATIENCE).__anext__()


# Goals


@in_loop
async def test_words_and_states_arrive_as_they_happen(scripted: Talk) -> None:
    async with Client(scripted.socket, name="patrol") as talk:
        goal = await talk.say("length=0.1 one two", feedback=True)
        assert [word.word async for word in goal.feedback(PATIENCE)] == ["length=0.1", "one", "two"]
        assert (await goal.wait()).client.name == "patrol"  # type: ignore[union-attr]
        goal = await talk.say("length=0")
        events = [event async for event in goal.events(PATIENCE)]
        assert [type(event) for event in events] == [*[StateChanged] * 3, Result]
        assert goal.poll() is None
        (followed,) = await talk.follow([goal.id])
        assert followed.poll() == Result(goal.goal)
        assert [each.id for each in await talk.log(1)] == [goal.id]
        assert (await talk.status()).active is await talk.pause() is await talk.resume() is None


@in_loop
async def test_a_goal_is_followed_although_no_task_waits(scripted: Talk) -> None:
    async with Client(scripted.socket) as talk:
        goal = await talk.say("length=0", block=False)
        scripted.watcher.wait_for(goal.id, "SUCCEEDED")
        while goal.state is not State.SUCCEEDED:  # noqa: ASYNC110 - only the client's own callbacks change the state
            await asyncio.sleep(0.001)
        assert [type(goal.poll()) for _ in range(5)] == [*[StateChanged] * 3, Result, type(None)]


@in_loop
async def test_a_timeout_does_not_affect_the_goal(scripted: Talk) -> None:
    async with Client(scripted.socket) as talk:
        goal = await talk.say("never-ends")
        with pytest.raises(TimeoutError, match=f"goal {goal.id} has not ended after 0.1 s"):
            await goal.wait(0.1)
        await until_active(goal)
        with pytest.raises(TimeoutError):
            _ = [event async for event in goal.events(0)]
        goal.request_cancel()
        assert (await goal.wait(PATIENCE)).state is State.PREEMPTED


# Connections


@in_loop
async def test_a_pause_ends_with_its_task(scripted: Talk) -> None:
    async def pause_for_ever() -> None:
        async with talk.paused(20):
            paused.set()
            await asyncio.sleep(PATIENCE)

    async with Client(scripted.socket) as talk:
        paused = asyncio.Event()
        task = asyncio.create_task(pause_for_ever())
        await paused.wait()
        assert (await talk.status()).server["paused"]
        task.cancel()
        while (await talk.status()).server["paused"]:  # noqa: ASYNC110 - the server hears of the end a little later
            await asyncio.sleep(0.001)


@in_loop
async def test_a_client_connects_when_it_is_told_to(scripted: Talk) -> None:
    talk = Client(scripted.socket)
    with pytest.raises(UsageError, match="not connected"):
        await talk.status()
    assert await talk.connect() is talk
    async with talk:
        assert talk.server_pid == scripted.pid
        descriptor = socket_of(talk).fileno()
        waiting = asyncio.create_task((await talk.say("never-ends")).wait())
        await asyncio.sleep(0)
    assert not asyncio.get_running_loop().remove_reader(descriptor), "the loop watches a closed descriptor"
    assert (await waiting).state is State.LOST
    with pytest.raises(ServerUnavailable, match="closed"):
        await talk.status()
    async with talk:
        assert len((await talk.cancel()).canceled) == 1


@in_loop
async def test_a_client_reconnects_and_follows_its_goals_again(scripted: Talk) -> None:
    async with Client(scripted.socket, timeout=10) as talk:
        events = talk.events(reconnect=True)
        goal = await talk.say("never-ends")
        await until_active(goal)
        for lose in (disconnect, restart):
            assert isinstance(await events.__anext__(), Snapshot)
            lose(talk if lose is disconnect else scripted)  # type: ignore[arg-type]
            event: Event | None = None
            while not isinstance(event, Snapshot):
                event = await events.__anext__()
            assert goal.state is (State.ACTIVE if lose is disconnect else State.LOST)
            events = talk.events(reconnect=True)
        assert (await (await talk.say("length=0")).wait(PATIENCE)).state is State.SUCCEEDED
    scripted.unfinished = True


@in_loop
async def test_goals_of_a_hanging_server_are_lost(scripted: Talk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("talkcli.client.core.SILENCE_LIMIT_S", 0.3)
    async with Client(scripted.socket, timeout=0.3) as talk:
        goal = await talk.say("never-ends")
        scripted.freeze()
        assert (await goal.wait(PATIENCE)).state is State.LOST
        with pytest.raises(ServerUnavailable):
            await talk.status()
        scripted.thaw()
        with pytest.raises(ServerUnavailable):
            await Client("/nowhere").connect()


@in_loop
async def test_a_bug_ends_the_connection_and_the_waiting_tasks(scripted: Talk, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context.get("exception")))
    async with Client(scripted.socket) as talk:
        goal = await talk.say("length=0.2")
        bug = ZeroDivisionError("oops")
        monkeypatch.setattr(talk._connection.listeners, "publish", lambda _: exec("raise bug", {"bug": bug}))
        assert (await goal.wait(PATIENCE)).state is State.LOST
        assert "oops" in (goal.goal.message or "")
    assert reported == [bug]


# Cancelled tasks


@in_loop
async def test_a_cancelled_task_cancels_nothing_on_the_robot(scripted: Talk) -> None:
    async with Client(scripted.socket) as talk:
        goal = await talk.say("never-ends")
        await until_active(goal)
        await interrupted(goal.wait())
        while goal.poll():  # read all events
            pass
        await interrupted(goal.events().__anext__())  # type: ignore[arg-type]
        await interrupted(talk.say("never-ends", id="interrupted"))
        assert [each.id for each in (await talk.status()).pending] == ["interrupted"]
        assert goal.state is State.ACTIVE
        assert len((await talk.cancel()).canceled) == 2


@in_loop
async def test_no_event_is_lost_if_a_task_is_cancelled_when_it_arrives(scripted: Talk) -> None:
    async with Client(scripted.socket) as talk:
        await talk.pause()
        goal = await talk.say("length=0")
        assert goal.poll()
        task: asyncio.Task[Event] = asyncio.create_task(goal.events().__anext__())  # type: ignore[arg-type]
        await asyncio.sleep(0)
        resuming = asyncio.create_task(talk.resume())
        while not goal._has_event():  # noqa: ASYNC110 - the task must be cancelled before it runs again
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.gather(task, resuming, return_exceptions=True)
        events = [event async for event in goal.events(PATIENCE)]
        assert [type(event) for event in events] == [StateChanged, StateChanged, Result]


@in_loop
async def test_a_stream_is_completed_although_its_write_was_interrupted(scripted: Talk) -> None:
    async with Client(scripted.socket) as talk:
        async with talk.stream() as speech:
            await interrupted(speech.write("length=0 "))
            assert speech.goal is None
            assert await speech.write("one")
        goal = await speech.wait(PATIENCE)
        assert goal
        assert (goal.state, goal.text) == (State.SUCCEEDED, "length=0 one")
        assert not await speech.write("more")


@in_loop
async def test_an_interrupted_saying_or_stream_ends_its_goal(scripted: Talk) -> None:
    async with Client(scripted.socket) as talk:
        await talk.pause()
        await interrupted(talk.saying("never-ends", id="said").__aenter__())

        async def write() -> None:
            async with talk.stream(id="streamed") as speech:
                await speech.write("never-ends ")

        await interrupted(write())
        for goal_id in ("said", "streamed"):
            (goal,) = await talk.follow([goal_id])
            assert (await goal.wait(PATIENCE)).state is State.RECALLED
        await talk.resume()


@in_loop
async def test_an_unsent_request_of_a_cancelled_task_is_withdrawn(scripted: Talk) -> None:
    """Other tasks use the same connection, so it must survive, even if a part of a request was sent."""
    text = "length=0 " + "x" * 9_900
    async with Client(scripted.socket, timeout=10) as talk:
        await talk.pause()
        connected = socket_of(talk)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)  # less than a request
        scripted.freeze()
        tasks = [asyncio.create_task(talk.say(text, id=f"goal-{number}")) for number in range(3)]
        await asyncio.sleep(0)
        exchanges = list(talk._connection.exchanges.values())
        assert not any(each.sent for each in exchanges)
        assert talk._connection._first_sent_bytes > 0, "a part of the first request was sent"
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        scripted.thaw()
        assert [each.id for each in (await talk.status()).pending] == ["goal-0"]
        assert socket_of(talk) is connected
        await talk.cancel()


# Time limits


@in_loop
async def test_a_cancel_is_answered_at_once_while_200_goals_are_awaited(make_talk: MakeTalk) -> None:
    scripted = make_talk("--max-queue", "300", scripted=True)
    before = threading.active_count()
    async with Client(scripted.socket) as talk:
        goals = [await talk.say("never-ends") for _ in range(200)]
        waiting = [asyncio.create_task(goal.wait()) for goal in goals]
        with limits():
            times = []
            for goal in goals[100:130]:
                started_at = time.monotonic()
                assert (await goal.cancel()).state is State.RECALLED
                times.append(time.monotonic() - started_at)
            assert_within(statistics.median(times), 0.05, "cancelling one of 200 awaited goals")
        assert threading.active_count() == before
        await talk.cancel()
        assert {goal.state for goal in await asyncio.gather(*waiting)} == {State.RECALLED, State.PREEMPTED}
