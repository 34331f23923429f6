"""The class `Fleet`: listing robots, a client of one robot, requests to several robots, and errors."""

from __future__ import annotations

import gc
import os
from typing import TYPE_CHECKING

import pytest

from talkcli import Fleet, State
from talkcli.errors import AccessDenied, ServerUnavailable, UnknownGoal, UsageError
from tests.fleet import publish
from tests.fleet.conftest import fleet_of
from tests.fleet.many import request
from tests.fleet.robot import LONG
from tests.support.broker import Broker
from tests.support.mqtt import Listener
from tests.support.ports import Port

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from typing import Any

    from talkcli import Outcome
    from tests.fleet.many import RealRobots

#: Two robots, and the selections that match both.
PAIR, SELECTIONS = ["wh-1", "wh-2"], ("wh-*", "@warehouse")


def results(outcomes: Iterable[Outcome]) -> dict[str, tuple[str, int]]:
    """Assert that each robot has one outcome, and return its state and exit code."""
    every = list(outcomes)
    assert all(outcome.last for outcome in every)
    assert len({outcome.robot for outcome in every}) == len(every)
    return {outcome.robot: (outcome.state, outcome.exit_code) for outcome in every}


def alike(state: str, code: int = 0, names: Iterable[str] = PAIR) -> dict[str, tuple[str, int]]:
    return dict.fromkeys(names, (state, code))


def count_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def reply_of(outcome: Outcome) -> Any:
    return outcome.said


def test_all_known_robots_are_listed_by_name(fleet: Fleet, pair: RealRobots) -> None:
    with Listener(pair.broker) as publisher:
        publish.presence(publisher, "anna", online=False, groups=["night"])
        anna, *others = fleet.robots()
        publisher.publish("talk/robot/anna/presence", b"", retain=True)
    assert (anna.name, anna.online, anna.groups, anna.server) == ("anna", False, ("all", "night"), None)
    assert [(robot.name, robot.online, robot.groups) for robot in others] == [
        (name, True, ("all", "warehouse")) for name in PAIR
    ]
    assert "say" in others[0].allow
    assert others[0].server is not None
    assert others[0].server["pid"] == pair["wh-1"].talk.pid


def test_one_robot_is_a_client(fleet: Fleet, pair: RealRobots) -> None:
    with fleet.robot("wh-1") as client:
        goal = client.say("the door opens", feedback=True)
        assert [word.word for word in goal.feedback(5)] == ["the", "door", "opens"]
        assert goal.wait(5).state is State.SUCCEEDED
        assert client.status().server["pid"] == pair["wh-1"].talk.pid


@pytest.mark.parametrize(("to", "names"), [("wh-*", PAIR), ("@warehouse", PAIR), ("wh-2", ["wh-2"])])
def test_a_goal_has_the_same_id_on_all_robots(fleet: Fleet, to: str, names: list[str]) -> None:
    outcomes = list(fleet.say(to, "hello", key="door", priority=3))
    assert results(outcomes) == alike("SUCCEEDED", names=names)
    goals = [outcome.goal for outcome in outcomes if outcome.goal]
    assert len({goal.id for goal in goals}) == 1
    for goal in goals:
        assert (goal.text, goal.key, goal.priority) == ("hello", "door", 3)
        assert goal.ttl
        assert 5 < goal.ttl <= 10


def test_cancel_cancels_a_goal_on_all_robots(fleet: Fleet, pair: RealRobots) -> None:
    assert pair["wh-1"].talk.request("say", id="before-it", text=LONG)["ok"]
    outcomes = fleet.say("wh-*", LONG, id="canceled-later")
    with pytest.raises(TimeoutError, match=r"0 of 2 robots have finished after 0\.1 s"):
        list(outcomes.results(0.1))
    pair["wh-2"].talk.watcher.wait_for("canceled-later", "ACTIVE")
    pair["wh-1"].talk.watcher.wait_for("canceled-later", "PENDING")
    outcomes.cancel()
    assert results(outcomes.results(5)) == {"wh-1": ("RECALLED", 6), "wh-2": ("PREEMPTED", 7)}
    assert pair["wh-1"].talk.goal("before-it")["state"] == "ACTIVE"


def test_the_goal_of_a_closed_request_is_still_spoken(fleet: Fleet, pair: RealRobots) -> None:
    outcomes = fleet.say("wh-*", "length=0.3 go on", id="left")
    pair.each(lambda robot: robot.talk.watcher.wait_for("left", "ACTIVE"))
    outcomes.close()
    assert pair.each(lambda robot: robot.talk.watcher.wait_for_terminal("left")) == ["SUCCEEDED"] * 2


def test_a_fleet_has_the_requests_of_a_client(fleet: Fleet, pair: RealRobots) -> None:
    to, goal = "@warehouse", "paused"
    request(pair, "say", id=goal, text=LONG, key="door")
    paused = list(fleet.pause(to, 60))
    assert results(paused) == alike("PAUSED")
    assert [outcome.goal and outcome.goal.id for outcome in paused] == [goal] * 2
    status = list(fleet.status(to))
    assert results(status) == alike("PAUSED")
    assert [reply_of(outcome)["status"]["active"]["id"] for outcome in status] == [goal] * 2
    assert results(fleet.resume(to)) == alike("RESUMED")
    settings = list(fleet.set(to, rate=222))
    assert results(settings) == alike("SET")
    assert [reply_of(outcome)["settings"]["rate"] for outcome in settings] == [222] * 2
    assert results(fleet.cancel(to, key="window")) == alike("IDLE")
    assert results(fleet.cancel(to, key="door")) == alike("PREEMPTED")
    assert results(fleet.wait(to, [goal])) == alike("PREEMPTED", 7)
    assert results(fleet.wait(to)) == results(fleet.cancel(to)) == alike("IDLE")


@pytest.mark.usefixtures("fleet")
def test_a_goal_has_the_name_of_its_sender(pair: RealRobots) -> None:
    for to in (*SELECTIONS, "wh-1"):
        for outcome in Fleet(pair.broker.url, name="shift-plan").say(to, "length=0"):
            assert outcome.goal
            assert outcome.goal.client
            assert str(outcome.goal.client.name).endswith(" shift-plan")


def test_requests_leave_no_descriptors_open(fleet: Fleet) -> None:
    assert results(fleet.status("wh-*"))  # imports may open descriptors that stay open
    gc.collect()
    before = count_descriptors()
    for to in SELECTIONS:
        assert results(fleet.say(to, "length=0")) == alike("SUCCEEDED")
        fleet.status(to).close()
        with fleet.status(to) as outcomes:
            assert next(iter(outcomes)).exit_code == 0
            assert count_descriptors() > before
        with pytest.raises(UsageError):
            fleet.say(to, "hello", rate=9)
        with pytest.raises(ServerUnavailable):
            list(fleet.status("nobody*"))
    assert count_descriptors() == before


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("to", SELECTIONS)
def test_an_abandoned_request_leaves_no_descriptors_open(fleet: Fleet, to: str) -> None:
    list(fleet.status(to))
    gc.collect()
    before = count_descriptors()
    for _ in range(5):
        for _ in fleet.status(to):
            break
    gc.collect()
    assert count_descriptors() == before


def test_a_refused_request_leaves_no_descriptors_open(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = "topic readwrite #\nuser olga\ntopic read talk/robot/+/presence\ntopic readwrite talk/reply/olga/+/+\n"
    with Broker(acl=rules) as broker:
        with Listener(broker) as publisher:
            publish.presence(publisher, "wh-1", groups=["warehouse"])
        fleet = fleet_of(broker, monkeypatch, user="olga")
        before = 0
        for _ in range(3):
            assert results(fleet.say("wh-*", "hello")) == {"wh-1": ("REFUSED", 10)}
            with pytest.raises(AccessDenied, match="does not allow 'olga'"):
                list(fleet.say("@warehouse", "hello"))
            before = before or count_descriptors()
        assert count_descriptors() == before


def test_a_failure_on_a_robot_is_an_outcome_with_its_error(fleet: Fleet) -> None:
    for outcome in fleet.wait("@all", ["nobodys"]):
        assert (outcome.state, outcome.exit_code, outcome.goal) == ("UNKNOWN", 8, None)
        assert isinstance(outcome.error, UnknownGoal)
        assert outcome.to_json()["error"] == {"code": "unknown_goal", "message": str(outcome.error)}
    rejected = list(fleet.say("@all", "x" * 70_000))
    assert results(rejected) == alike("REJECTED", 5)
    assert [outcome.goal and outcome.goal.reason for outcome in rejected] == ["text_too_long"] * 2


@pytest.mark.parametrize(
    ("ask", "error"),
    [
        (lambda fleet: fleet.say("@all", "hello", rate=9), "the rate must be 80 to 450 words per minute, got 9"),
        (lambda fleet: fleet.say("@all", b"hello"), "'text' must be a string"),
        (lambda fleet: fleet.set("@all", rate="fast"), "'rate' must be an integer"),
        (lambda fleet: fleet.wait("@all", ["12"]), "a goal's number is only valid on one server"),
        (lambda fleet: fleet.cancel("@all", [""]), "the goal's id is empty"),
        (lambda fleet: fleet.cancel("@all", key=""), "the key must have 1 to 64 characters"),
        (lambda fleet: fleet.say("", "hello"), "invalid robot name ''"),
        (lambda fleet: fleet.say("a/b", "hello"), "invalid robot name 'a/b'"),
        (lambda fleet: fleet.say("@", "hello"), "invalid group name ''"),
        (lambda fleet: fleet.robot("wh-*"), "invalid robot name 'wh-*'"),
    ],
)
def test_an_invalid_request_raises_before_it_is_sent(fleet: Fleet, ask: Callable[[Fleet], Any], error: str) -> None:
    with pytest.raises(UsageError) as caught:
        ask(fleet)
    assert error in str(caught.value)


@pytest.mark.parametrize(
    ("to", "expected"),
    [("nobody", "no robot matches 'nobody'"), ("@night", "no robot is in the group 'night'")],
)
def test_a_selection_without_robots_raises_an_error(fleet: Fleet, to: str, expected: str) -> None:
    with pytest.raises(ServerUnavailable, match=expected):
        list(fleet.say(to, "hello"))
    with pytest.raises(ServerUnavailable, match="no robot 'nobody'"):
        fleet.robot("nobody")


@pytest.mark.usefixtures("fleet")
def test_a_missing_broker_raises_an_error() -> None:
    with Port() as port:
        nowhere = Fleet(f"mqtt://127.0.0.1:{port.number}")
        for ask in (nowhere.robots, lambda: nowhere.robot("wh-1"), lambda: nowhere.say("@all", "hello")):
            with pytest.raises(ServerUnavailable, match="can't connect to the broker at"):
                ask()
    with pytest.raises(UsageError, match="TALK_BROKER is not set"):
        Fleet()
    with pytest.raises(UsageError):
        Fleet("http://127.0.0.1")
