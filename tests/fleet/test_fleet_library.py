"""The library for a fleet: the robots of a broker, one robot as a client, several at once, and errors."""

from __future__ import annotations

import gc
import os
from typing import TYPE_CHECKING

import pytest

from talkcli import Fleet, State
from talkcli.errors import AccessDenied, ServerUnavailable, UnknownGoal, UsageError
from tests.fleet import told
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

PAIR, BOTH = ["wh-1", "wh-2"], ("wh-*", "@warehouse")


def found(outcomes: Iterable[Outcome]) -> dict[str, tuple[str, int]]:
    """Return the state and the exit code of each robot, which has one outcome."""
    every = list(outcomes)
    assert all(each.last for each in every)
    assert len({each.robot for each in every}) == len(every)
    return {each.robot: (each.state, each.exit_code) for each in every}


def alike(state: str, code: int = 0, names: Iterable[str] = PAIR) -> dict[str, tuple[str, int]]:
    return dict.fromkeys(names, (state, code))


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def said(outcome: Outcome) -> Any:
    return outcome.said


def test_all_robots_that_the_broker_knows_are_listed_by_name(fleet: Fleet, pair: RealRobots) -> None:
    with Listener(pair.broker) as publisher:
        told.presence(publisher, "anna", online=False, groups=["night"])
        anna, *others = fleet.robots()
        publisher.publish("talk/robot/anna/presence", b"", retain=True)
    assert (anna.name, anna.online, anna.groups, anna.server) == ("anna", False, ("all", "night"), None)
    assert [(each.name, each.online, each.groups) for each in others] == [
        (name, True, ("all", "warehouse")) for name in PAIR
    ]
    assert "say" in others[0].allow
    assert others[0].server is not None
    assert others[0].server["pid"] == pair["wh-1"].talk.pid


def test_one_robot_is_a_client(fleet: Fleet, pair: RealRobots) -> None:
    with fleet.robot("wh-1") as client:
        goal = client.say("the door opens", feedback=True)
        assert [each.word for each in goal.feedback(5)] == ["the", "door", "opens"]
        assert goal.wait(5).state is State.SUCCEEDED
        assert client.status().server["pid"] == pair["wh-1"].talk.pid


@pytest.mark.parametrize(("to", "names"), [("wh-*", PAIR), ("@warehouse", PAIR), ("wh-2", ["wh-2"])])
def test_a_sentence_ends_on_each_with_one_id(fleet: Fleet, to: str, names: list[str]) -> None:
    outcomes = list(fleet.say(to, "hello", key="door", priority=3))
    assert found(outcomes) == alike("SUCCEEDED", names=names)
    goals = [each.goal for each in outcomes if each.goal]
    assert len({each.id for each in goals}) == 1
    for goal in goals:
        assert (goal.text, goal.key, goal.priority) == ("hello", "door", 3)
        assert goal.ttl
        assert 5 < goal.ttl <= 10


def test_a_sentence_is_cancelled_everywhere(fleet: Fleet, pair: RealRobots) -> None:
    assert pair["wh-1"].talk.request("say", id="before-it", text=LONG)["ok"]
    outcomes = fleet.say("wh-*", LONG, id="given-up")
    with pytest.raises(TimeoutError, match=r"0 of 2 robots have finished after 0\.1 s"):
        list(outcomes.results(0.1))
    pair["wh-2"].talk.watcher.wait_for("given-up", "ACTIVE")
    pair["wh-1"].talk.watcher.wait_for("given-up", "PENDING")
    outcomes.cancel()
    assert found(outcomes.results(5)) == {"wh-1": ("RECALLED", 6), "wh-2": ("PREEMPTED", 7)}
    assert pair["wh-1"].talk.goal("before-it")["state"] == "ACTIVE"


def test_without_wait_an_outcome_is_that_the_goal_was_accepted(fleet: Fleet, pair: RealRobots) -> None:
    assert found(fleet.say("@all", "hello", wait=False, id="accepted", ttl=0)) == alike("PENDING")
    assert found(fleet.wait("@all", ["accepted"])) == alike("SUCCEEDED")
    assert pair["wh-1"].talk.goal("accepted")["ttl"] is None


def test_a_request_that_is_closed_leaves_its_sentence_to_be_spoken(fleet: Fleet, pair: RealRobots) -> None:
    outcomes = fleet.say("wh-*", "length=0.3 go on", id="left")
    pair.each(lambda each: each.talk.watcher.wait_for("left", "ACTIVE"))
    outcomes.close()
    assert pair.each(lambda each: each.talk.watcher.wait_for_terminal("left")) == ["SUCCEEDED"] * 2


def test_the_other_requests_are_those_of_a_client(fleet: Fleet, pair: RealRobots) -> None:
    to, goal = "@warehouse", "held"
    request(pair, "say", id=goal, text=LONG, key="door")
    paused = list(fleet.pause(to))
    assert found(paused) == alike("PAUSED")
    assert [each.goal and each.goal.id for each in paused] == [goal] * 2
    status = list(fleet.status(to))
    assert found(status) == alike("PAUSED")
    assert [said(each)["status"]["active"]["id"] for each in status] == [goal] * 2
    assert found(fleet.resume(to)) == alike("RESUMED")
    settings = list(fleet.set(to, rate=222))
    assert found(settings) == alike("SET")
    assert [said(each)["settings"]["rate"] for each in settings] == [222] * 2
    assert found(fleet.cancel(to, key="window")) == alike("IDLE")
    assert found(fleet.cancel(to, key="door")) == alike("PREEMPTED")
    assert found(fleet.wait(to, [goal])) == alike("PREEMPTED", 7)
    assert found(fleet.wait(to)) == found(fleet.cancel(to)) == alike("IDLE")


@pytest.mark.usefixtures("fleet")
def test_a_goal_has_the_name_of_its_sender(pair: RealRobots) -> None:
    for to in (*BOTH, "wh-1"):
        for each in Fleet(pair.broker.url, name="shift-plan").say(to, "length=0"):
            assert each.goal
            assert each.goal.client
            assert str(each.goal.client.name).endswith(" shift-plan")


def test_no_request_leaves_anything_open(fleet: Fleet) -> None:
    assert found(fleet.status("wh-*"))  # what is imported once, opens what stays open
    gc.collect()
    before = descriptors()
    for to in BOTH:
        assert found(fleet.say(to, "length=0")) == alike("SUCCEEDED")
        fleet.status(to).close()
        with fleet.status(to) as asked:
            assert next(iter(asked)).exit_code == 0
            assert descriptors() > before
        with pytest.raises(UsageError):
            fleet.say(to, "hello", rate=9)
        with pytest.raises(ServerUnavailable):
            list(fleet.status("nobody*"))
    assert descriptors() == before


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("to", BOTH)
def test_a_request_that_is_dropped_leaves_nothing_open(fleet: Fleet, to: str) -> None:
    list(fleet.status(to))
    gc.collect()
    before = descriptors()
    for _ in range(5):
        for _ in fleet.status(to):
            break
    gc.collect()
    assert descriptors() == before


def test_a_refusal_by_the_broker_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = "topic readwrite #\nuser olga\ntopic read talk/robot/+/presence\ntopic readwrite talk/reply/olga/+/+\n"
    with Broker(acl=rules) as broker:
        with Listener(broker) as publisher:
            told.presence(publisher, "wh-1", groups=["warehouse"])
        fleet = fleet_of(broker, monkeypatch, user="olga")
        before = 0
        for _ in range(3):
            assert found(fleet.say("wh-*", "hello")) == {"wh-1": ("REFUSED", 10)}
            with pytest.raises(AccessDenied, match="does not allow 'olga'"):
                list(fleet.say("@warehouse", "hello"))
            before = before or descriptors()
        assert descriptors() == before


def test_a_failure_at_a_robot_is_an_outcome_with_its_error(fleet: Fleet) -> None:
    for each in fleet.wait("@all", ["nobodys"]):
        assert (each.state, each.exit_code, each.goal) == ("UNKNOWN", 8, None)
        assert isinstance(each.error, UnknownGoal)
        assert each.to_json()["error"] == {"code": "unknown_goal", "message": str(each.error)}
    rejected = list(fleet.say("@all", "x" * 70_000))
    assert found(rejected) == alike("REJECTED", 5)
    assert [each.goal and each.goal.reason for each in rejected] == ["text_too_long"] * 2


@pytest.mark.parametrize(
    ("ask", "words"),
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
def test_a_request_that_can_not_be_is_raised_before_anything_is_sent(
    fleet: Fleet, ask: Callable[[Fleet], Any], words: str
) -> None:
    with pytest.raises(UsageError) as caught:
        ask(fleet)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("to", "words"),
    [("nobody", "no robot matches 'nobody'"), ("@night", "no robot is in the group 'night'")],
)
def test_a_pick_of_no_robot_is_raised(fleet: Fleet, to: str, words: str) -> None:
    with pytest.raises(ServerUnavailable, match=words):
        list(fleet.say(to, "hello"))
    with pytest.raises(ServerUnavailable, match="no robot 'nobody'"):
        fleet.robot("nobody")


@pytest.mark.usefixtures("fleet")
def test_without_a_broker_each_request_is_raised() -> None:
    with Port() as port:
        nowhere = Fleet(f"mqtt://127.0.0.1:{port.number}")
        for ask in (nowhere.robots, lambda: nowhere.robot("wh-1"), lambda: nowhere.say("@all", "hello")):
            with pytest.raises(ServerUnavailable, match="can't connect to the broker at"):
                ask()
    with pytest.raises(UsageError, match="TALK_BROKER is not set"):
        Fleet()
    with pytest.raises(UsageError):
        Fleet("http://127.0.0.1")
