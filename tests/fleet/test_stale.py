"""Delayed goals are refused: after a connection has stalled, or a robot was suspended."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from typing import TYPE_CHECKING

import pytest

from tests.fleet.remote_client import RemoteClient
from tests.fleet.robot import LONG, Robot
from tests.support.bridge import Desk
from tests.support.proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.fleet.conftest import MakeRobot
    from tests.support.broker import Broker

#: Seconds after the newest echo for which messages are accepted.
STALE = 6.0
#: Seconds of a stall that makes messages too old, and of one that doesn't.
TOO_LONG, SHORT = STALE + 1.0, STALE / 2


@pytest.fixture
def proxied(broker: Broker, make_robot: MakeRobot) -> Iterator[tuple[Robot, Proxy]]:
    """A robot behind a proxy, online."""
    with Proxy(broker.port) as proxy:
        yield make_robot("anna", port=proxy.port), proxy


def stall(proxied: tuple[Robot, Proxy], fault: str) -> Callable[[], None]:
    """Suspend the robot, or stall one direction of its connection. Return the function that ends the fault."""
    robot, proxy = proxied
    if fault == "suspended":
        robot.bridge.stop_process()
        return robot.bridge.resume_process
    proxy.hold("to_client" if fault == "to_client" else "to_broker")
    return proxy.release


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["suspended", "to_client"])
def test_a_goal_delayed_for_7_s_is_refused_and_the_next_is_spoken(proxied: tuple[Robot, Proxy], fault: str) -> None:
    robot, _ = proxied
    with RemoteClient(robot.broker, "olga") as olga, robot.listen("echo") as listener:
        started_at = time.monotonic()
        resume = stall(proxied, fault)
        seq = olga.post("say", text="late")
        for kind in ("say", "request"):
            olga.send('{"request": "say", "text": "late, too"}', kind=kind, response=None)
        time.sleep(started_at + TOO_LONG - time.monotonic())
        resume()
        resumed_at = time.monotonic()
        answer = olga.reply(seq)
        assert answer["error"]["code"] == "stale", answer
        # A new echo arrived with the refusal or up to a second before it, so later messages aren't stale.
        listener.await_message(lambda message: message.topic.endswith("/echo") and message.arrived > resumed_at - 1)
        assert robot.desk("say", "--wait", "control").code == 0
    assert robot.spoken == ["control"]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["suspended", "to_client", "to_broker"])
def test_a_goal_delayed_for_3_s_is_spoken(proxied: tuple[Robot, Proxy], fault: str) -> None:
    robot, _ = proxied
    with Desk(robot.broker) as desk:
        resume = stall(proxied, fault)
        client = desk.start("--robot", "anna", "say", "--wait", "in time")
        time.sleep(SHORT)
        resume()
        done = desk.finish(client)
    assert done.code == 0, done
    assert robot.spoken == ["in time"]


@pytest.mark.slow
def test_a_goal_that_may_be_old_is_refused_if_no_echo_returns(proxied: tuple[Robot, Proxy]) -> None:
    robot, proxy = proxied
    with RemoteClient(robot.broker, "olga") as olga:
        proxy.hold("to_broker")
        early = olga.post("say", text="in time")
        robot.talk.watcher.wait_for(None, "SUCCEEDED")
        time.sleep(TOO_LONG)
        late = olga.post("say", text="late")
        assert olga.lines == []
        proxy.release()
        assert olga.reply(early)["ok"]
        assert olga.reply(late)["error"]["code"] == "stale"
    assert robot.spoken == ["in time"]


def test_a_sentence_is_accepted_with_a_token_of_this_run_of_the_bridge_only(robot: Robot) -> None:
    with RemoteClient(robot.broker, "olga") as olga, robot.listen("request/+") as listener:
        olga.ask("hello")
        (token,) = [value for message in olga.listener.messages for name, value in message.user if name == "talk-token"]
        assert token.startswith(robot.bridge.await_online()["session"])
        for seq, value in ((10, token), (11, f"another {token.split()[1]}")):
            olga.send({"seq": seq, "request": "say", "text": f"from {seq}"}, user=[("talk-token", value)])
        assert olga.reply(10)["ok"]
        assert olga.reply(11)["error"]["code"] == "stale"
        assert robot.desk("say", "--wait", "from a desk").code == 0
        sent = listener.await_message(lambda message: b"from a desk" in message.payload)
        assert [name for name, _ in sent.user] == ["talk-token"]
    assert robot.spoken == ["from 10", "from a desk"]


@pytest.mark.slow
@pytest.mark.parametrize(("stalled", "seconds"), [*(("desk", each) for each in (8, 13, 20, 40)), ("broker", 12)])
def test_nothing_is_spoken_late_if_a_desks_connection_or_the_broker_stalls(
    robot: Robot, stalled: str, seconds: float
) -> None:
    """One desk has requested a token when the stall begins, and the other one has just sent its sentence."""
    with contextlib.ExitStack() as stack:
        proxies = [stack.enter_context(Proxy(robot.broker.port)) for _ in range(2)]
        desks = [stack.enter_context(Desk(robot.broker, port=proxy.port)) for proxy in proxies]
        clients = []
        for request, proxy, desk in zip((b'"hello"', b'"say"'), proxies, desks, strict=True):
            is_held = proxy.hold_from("to_broker", request)
            clients.append(desk.start("--robot", "anna", "say", "--wait", "--", "spoken late"))
            assert is_held.wait(10)
        if stalled == "broker":
            os.kill(robot.broker.pid, signal.SIGSTOP)
            stack.callback(os.kill, robot.broker.pid, signal.SIGCONT)
            for proxy in proxies:
                proxy.release()
        time.sleep(seconds)
        os.kill(robot.broker.pid, signal.SIGCONT)
        for proxy in proxies:
            proxy.release()
        ends = [desk.finish(client, timeout=60) for desk, client in zip(desks, clients, strict=True)]
        robot.bridge.await_online()
        assert robot.desk("say", "--wait", "--connect-timeout", "20", "control").code == 0
    assert all(each.code in (3, 12) for each in ends), ends
    assert robot.spoken == ["control"]


def test_the_expiry_of_a_message_also_limits_the_wait_in_the_queue(robot: Robot) -> None:
    robot.talk.run("say", "--", LONG)
    robot.talk.watcher.wait_for(None, "ACTIVE")
    with RemoteClient(robot.broker, "olga") as olga:
        olga.send({"seq": 1, "request": "say", "id": "short", "text": "a", "ttl": 100}, expiry=1)
        olga.send({"seq": 2, "request": "say", "id": "shorter", "text": "b", "ttl": 0.2}, expiry=100)
        olga.send("c", expiry=1, kind="say", response=None)
        goals = [olga.reply(seq)["goal"] for seq in (1, 2)]
        assert [goal["ttl"] for goal in goals] == [pytest.approx(1, abs=0.2), 0.2]
        for goal in goals:
            assert robot.talk.watcher.wait_for_terminal(goal["id"]) == "RECALLED"
            assert robot.talk.goal(goal["id"])["reason"] == "expired"
        robot.talk.watcher.wait_until(lambda _: len(robot.talk.watcher.texts("RECALLED")) == 3)
    first, *others = robot.talk.watcher.texts("RECALLED")
    assert (first, {*others}) == ("b", {"a", "c"})  # two sessions have no common order
    assert robot.spoken == [LONG]


@pytest.mark.slow
def test_a_delayed_goal_expires_within_its_ttl_plus_6_s(proxied: tuple[Robot, Proxy]) -> None:
    robot, proxy = proxied
    robot.talk.run("say", "--", LONG)
    robot.talk.watcher.wait_for(None, "ACTIVE")
    with RemoteClient(robot.broker, "olga") as olga, contextlib.ExitStack() as stack:
        stack.callback(proxy.release)
        sent_at = time.monotonic()
        proxy.hold("to_client")
        seq = olga.post("say", text="late", ttl=1, id="late")
        time.sleep(SHORT)
        proxy.release()
        assert olga.reply(seq)["ok"]
        expired = robot.talk.watcher.wait_for("late", "RECALLED")
        assert robot.talk.watcher.arrived(expired) - sent_at < 1 + STALE
