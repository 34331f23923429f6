"""Calls of the library that don't block, and lost connections: goals sent later or never, and server restarts."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, Result, Snapshot, State
from talkcli.client.core import MAX_UNSENT_BYTES
from talkcli.errors import Lost, ServerUnavailable, TalkError, UnknownGoal, UsageError
from tests.support.connection import PATIENCE
from tests.support.documents import README
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli import GoalHandle
    from talkcli.protocol.events import Event
    from tests.support.processes import Talk

#: A call that takes no longer than this doesn't block.
NONBLOCKING_S = 0.05


@pytest.fixture
def client(scripted: Talk) -> Iterator[Client]:
    with Client(scripted.socket) as result:
        yield result


def poll_until(handle: GoalHandle, done: Callable[[GoalHandle], bool], limit: float = PATIENCE) -> list[Event]:
    """Poll a goal until a condition is true, and return its events."""
    events: list[Event] = []
    end = time.monotonic() + limit
    while True:
        started_at = time.monotonic()
        event = handle.poll()
        assert_within(time.monotonic() - started_at, NONBLOCKING_S, "a poll")
        if event:
            events.append(event)
        elif done(handle):
            return events
        else:
            assert time.monotonic() < end, (handle.goal, events)
            time.sleep(0.01)


def ended(handle: GoalHandle) -> bool:
    return handle.state.terminal


def accepted(handle: GoalHandle) -> bool:
    return handle.goal.queued_at is not None


def cancel_often(handle: GoalHandle) -> None:
    for _ in range(1_000):
        handle.request_cancel()


def disconnect(client: Client) -> None:
    """Break the connection. The server keeps running."""
    connection = client._connection
    connection._socket.shutdown(socket.SHUT_RDWR)  # type: ignore[attr-defined]


def restart(talk: Talk) -> None:
    talk.kill()
    talk.start_server()


# Nonblocking calls


def test_a_nonblocking_say_returns_an_id_at_once(client: Client) -> None:
    handle = client.say("length=0.1 one", feedback=True, block=False)
    assert (handle.state, handle.goal.text) == (State.PENDING, "length=0.1 one")
    assert handle.id.startswith("talk:")
    own = client.say("length=0", id="mine", block=False)
    assert own.id == "mine"
    events = poll_until(handle, ended)
    assert [type(event).__name__ for event in events] == [
        *("StateChanged", "StateChanged", "WordHeard", "WordHeard", "StateChanged", "Result"),
    ]
    assert handle.state is State.SUCCEEDED
    assert own.wait(PATIENCE).state is State.SUCCEEDED
    assert client.goal(handle.id).text == "length=0.1 one"


def test_a_goal_from_a_nonblocking_say_can_be_cancelled_at_once(client: Client, scripted: Talk) -> None:
    handle = client.say("never-ends", block=False)
    handle.request_cancel()
    poll_until(handle, ended)
    assert handle.state in {State.RECALLED, State.PREEMPTED}
    assert client.say("never-ends", block=False).cancel().state in {State.RECALLED, State.PREEMPTED}
    assert scripted.watcher.terminal_counts()[handle.id] == 1


def test_a_nonblocking_say_may_be_rejected_or_not_followed(client: Client) -> None:
    handle = client.say("", block=False)
    assert poll_until(handle, ended)[-1] == Result(handle.goal)
    assert (handle.state, handle.goal.reason) == (State.REJECTED, "invalid_text")
    with pytest.raises(UsageError, match="the rate must be"):
        client.say("a", rate=1000, block=False)
    unheard = client.say("length=0", follow=False, block=False)
    with pytest.raises(UsageError, match="follow=False"):
        unheard.poll()
    assert client.goal(unheard.id).text == "length=0"
    client.close()
    with pytest.raises(ServerUnavailable, match="closed"):
        client.say("a", block=False)


def test_calls_do_not_wait_for_a_frozen_server_and_send_the_rest_later(scripted: Talk) -> None:
    """The goals exceed the socket's buffer. Later calls send the rest, unless it is too late."""
    text = "length=0 " + "a" * 8_000
    with limits(), Client(scripted.socket, timeout=60) as client:
        client.pause()
        scripted.freeze()
        handles: list[GoalHandle] = []
        while len(handles) < 500 and not (handles and handles[-1].state.terminal):
            started_at = time.monotonic()
            handles.append(client.say(text, priority=len(handles), block=False))
            assert_within(time.monotonic() - started_at, NONBLOCKING_S, "a nonblocking say")
        assert (handles[-1].state, handles[-1].goal.reason) == (State.REJECTED, "not_sent")
        assert f"{MAX_UNSENT_BYTES >> 10} KiB" in (handles[-1].goal.message or "")
        assert len(handles) > MAX_UNSENT_BYTES / len(text)
        handles.pop()
        with pytest.raises(ServerUnavailable, match="KiB"):
            cancel_often(handles[0])
        scripted.thaw()
        for handle in handles:
            poll_until(handle, lambda handle: accepted(handle) or ended(handle))
        client.cancel()
        assert {handle.wait(PATIENCE).state for handle in handles} == {State.RECALLED}


def test_a_partly_sent_goal_is_rejected_and_the_client_reconnects(scripted: Talk) -> None:
    with Client(scripted.socket, timeout=0.5) as client:
        followed = client.say("never-ends")
        scripted.watcher.wait_for(followed.id, "ACTIVE")
        scripted.freeze()
        handles = [client.say("length=0 " + "a" * 9_900, block=False) for _ in range(40)]
        for handle in handles:
            poll_until(handle, ended)
        states = [handle.state for handle in handles]
        assert states == sorted(states, key=State.LOST.__ne__)
        assert {handle.goal.reason for handle in handles} == {"lost", "not_sent"}
        scripted.thaw()
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            try:
                client.cancel()
                break
            except TalkError:
                time.sleep(0.05)
        assert followed.wait(PATIENCE).state in {State.PREEMPTED, State.LOST}


# Lost connections


def test_a_restart_loses_all_goals_and_the_client_uses_the_new_server(client: Client, scripted: Talk) -> None:
    active, pending = client.say("never-ends"), client.say("never-ends", block=False)
    poll_until(pending, accepted)
    number = active.id.partition("-")[2]
    watch = client.events()
    next(watch)
    restart(scripted)
    with pytest.raises(Lost, match="no more events"):
        list(watch)
    late = client.say("length=0", block=False)
    for handle in (active, pending):
        assert poll_until(handle, ended)[-1] == Result(handle.goal)
        assert (handle.state, handle.goal.reason) == (State.LOST, "lost")
    poll_until(late, ended)
    assert late.state is State.SUCCEEDED
    assert client.say("length=0").wait(PATIENCE).state is State.SUCCEEDED
    with pytest.raises(UnknownGoal):
        client.goal(number)
    assert client.server_pid == scripted.pid


def test_watching_threads_survive_a_server_outage(client: Client, scripted: Talk) -> None:
    """One of the threads tries to connect. The others wait for it without a limit."""
    watches = [client.events(reconnect=True) for _ in range(3)]
    for watch in watches:
        next(watch)
    scripted.kill()
    with ThreadPoolExecutor(len(watches)) as pool:
        futures = [pool.submit(next, watch) for watch in watches]
        time.sleep(0.3)
        scripted.start_server()
        assert {type(future.result(PATIENCE)) for future in futures} == {Snapshot}


def test_calls_fail_at_once_while_no_server_runs(client: Client, scripted: Talk) -> None:
    scripted.kill()
    with limits():
        for act in (client.status, client.cancel, lambda: client.say("a"), client.log):
            started_at = time.monotonic()
            with pytest.raises(ServerUnavailable, match=r"no server|nothing was sent"):
                act()
            assert_within(time.monotonic() - started_at, NONBLOCKING_S, "a call without a server")
    time.sleep(1)  # after 1 s, the pause between two attempts has its maximum length
    scripted.start_server()
    handle = client.say("length=0", block=False)
    started_at = time.monotonic()
    poll_until(handle, ended)
    with limits():
        assert_within(time.monotonic() - started_at, 0.8, "the end of a goal after the server's return")
    assert handle.state is State.SUCCEEDED


def test_cancel_reconnects_without_a_delay(client: Client, scripted: Talk) -> None:
    scripted.kill()
    for _ in range(20):
        with pytest.raises(ServerUnavailable):
            client.cancel()
    scripted.start_server()
    assert client.cancel().canceled == ()


@pytest.mark.parametrize("timeout", [0, -1, float("nan")])
def test_the_timeout_must_be_positive(timeout: float) -> None:
    with pytest.raises(UsageError, match="timeout"):
        Client(timeout=timeout)


# A robot's loop

#: A robot that is blocked during its whole ride, except briefly after it has spoken. It records how late its loop is,
#: and prints this after SIGTERM.
ROBOT = """
import json
import signal
import time

class Robot:
    def __init__(self):
        self.free_until = 0.0
        self.due = time.monotonic()
        self.driving = True
        self.lateness = []
        signal.signal(signal.SIGTERM, self.park)

    def park(self, *_):
        self.driving = False

    def drives(self):
        self.due += 0.02
        time.sleep(max(0.0, self.due - time.monotonic()))
        self.lateness.append(time.monotonic() - self.due)
        return self.driving

    @property
    def blocked(self):
        return time.monotonic() >= self.free_until

    def wait_for_people(self):
        self.free_until = time.monotonic() + 0.1

    def move_lips(self, word):
        pass

    def flash_lights(self):
        pass

robot = Robot()
{loop}
print(json.dumps(robot.lateness))
"""


def test_the_readmes_loop_is_never_late_and_speaks_after_outages(scripted: Talk) -> None:
    """The server is stopped and killed once. The same loop without `talk` runs at the same time."""
    (example,) = [code for code in README.examples("python", "Use it from Python") if "robot.drives" in code]
    assert example.count("Client(name") == 1
    example = example.replace("Client(name", "Client(timeout=0.5, name")
    programs = [ROBOT.format(loop=example), ROBOT.format(loop="while robot.drives():\n    pass")]
    with limits(), contextlib.ExitStack() as stack:
        loops = []
        for program in programs:
            loop = subprocess.Popen([sys.executable, "-c", program], env=scripted.env, stdout=subprocess.PIPE)
            loops.append(stack.enter_context(loop))
            stack.callback(loop.kill)  # needed only if the test fails
        scripted.watcher.wait_for(None, "SUCCEEDED")
        scripted.freeze()
        time.sleep(0.8)
        scripted.thaw()
        back = time.monotonic()
        seen = len(scripted.watcher.events())
        while not any(event.get("state") == "ACTIVE" for event in scripted.watcher.events()[seen:]):
            time.sleep(0.01)
            assert time.monotonic() - back < PATIENCE
        assert_within(time.monotonic() - back, 1.0, "speaking again after the stop")
        restart(scripted)
        back = time.monotonic()
        scripted.watcher.wait_for(None, "ACTIVE")
        assert_within(time.monotonic() - back, 1.0, "speaking again after the restart")
        for loop in loops:
            loop.terminate()
        with_talk, without = (max(json.loads(loop.communicate(timeout=30)[0])) for loop in loops)
        assert [loop.returncode for loop in loops] == [0, 0]
        assert_within(with_talk, without + 0.02, "the latest iteration of a loop with talk")
    scripted.unfinished = True
