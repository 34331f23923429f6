"""A desk's connection to a robot, without a broker: what is sent again after an absence."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from talkcli.client.core import TrackedGoal
from talkcli.errors import Busy, ServerUnavailable
from talkcli.fleet import topics
from talkcli.fleet.broker import Broker
from talkcli.fleet.payloads import Message
from talkcli.goals.goal import Goal
from talkcli.goals.options import Append, Cancel, Say
from talkcli.goals.states import State
from talkcli.protocol.events import Result
from talkcli.protocol.features import FEATURES
from talkcli.protocol.lines import encode
from talkcli.protocol.requests import Hello, Wait
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from talkcli.fleet.desk.robot import RobotConnection
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request


class Desk:
    """A connection to a broker that records the requests."""

    def __init__(self) -> None:
        self.broker, self.user = Broker("localhost", 1883, tls=False), "bob"
        self.sent: list[tuple[int, Request]] = []
        #: the token of each request
        self.tokens: list[str | None] = []

    def send(self, request: Request, number: int, *_: object, token: str | None = None) -> bool:
        self.sent.append((number, request))
        self.tokens.append(token)
        return True

    def wake(self) -> None:
        pass


def come_online(robot: RobotConnection, session: str = "5e55", **fields: object) -> None:
    server = {"boot": "7r2z", "pid": 4711, "features": list(FEATURES)}
    presence = {"talk": 1, "online": True, "session": session, "server": server, **fields}
    robot.on_message(Message(topics.robot("anna", topics.PRESENCE), encode(presence)))


def answer(robot: RobotConnection, desk: Desk, token: str | None = None, **fields: Any) -> None:
    """Answer the last request."""
    line = encode({"seq": desk.sent[-1][0], "ok": True, **fields})
    robot.on_message(Message("talk/reply/bob/s1/anna", line, token=token))


def begin_text(robot: RobotConnection, desk: Desk, goal_id: str) -> TrackedGoal:
    """Send a growing text, and follow its goal."""
    robot.begin(Say("Hel", more=True, id=goal_id, wait=True))
    reply: JsonObject = {"goal": Goal(goal_id, State.PENDING, more=True).to_json()}
    answer(robot, desk, goal=reply["goal"])
    tracked = TrackedGoal(Goal("", State.PENDING))
    tracked._accept(reply)
    tracked._listen_to(robot.listeners, feedback=False, followed_at=0.0)
    return tracked


def test_after_an_absence_unfinished_texts_are_claimed_and_additions_are_sent_again() -> None:
    """Without the empty additions, the texts would break off if nothing were written for a while."""
    needs_packages("paho")
    from talkcli.fleet.desk.robot import RobotConnection

    desk = Desk()
    robot = RobotConnection("anna", desk)  # type: ignore[arg-type]
    come_online(robot)
    texts = {each: begin_text(robot, desk, each) for each in ("open", "added", "ended", "preempted")}
    for request in (Append("added", "lo", 3), Append("ended", "lo", 3, end=True)):
        robot.begin(request)
        answer(robot, desk, length=5, state="ACTIVE")
        texts[request.id]._grow(request)
    stopped = Goal("preempted", State.PREEMPTED)
    robot.on_message(Message("talk/reply/bob/s1/anna", encode(Result(stopped).to_json())))
    unanswered = robot.begin(Append("open", "lo", 3))
    robot.begin(Say("Hel", more=True, id="begun"))
    robot.on_disconnected("the broker is gone")
    waiting = robot.begin(Append("added", " there", 5, end=True))
    desk.sent.clear()
    come_online(robot, "another")
    sent = [request for _, request in desk.sent]
    lookups = [request for request in sent if isinstance(request, Wait)]
    assert {each.ids for each in lookups} == {("open",), ("added",), ("ended",), ("begun",)}
    additions = [request for request in sent if not isinstance(request, Wait)]
    assert set(additions[:3]) == {Append("open"), Append("added"), Append("begun")}
    assert additions[3:] == [unanswered.request, waiting.request]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time of the desk, which the test can change."""
    needs_packages("paho")
    now = [100.0]
    monkeypatch.setattr("talkcli.fleet.desk.robot.boottime", lambda: now[0])
    return now


def connect(*, tokens: bool = True) -> tuple[RobotConnection, Desk]:
    """Return a connection to a robot that is online."""
    needs_packages("paho")
    from talkcli.fleet.desk.robot import RobotConnection

    desk = Desk()
    robot = RobotConnection("anna", desk)  # type: ignore[arg-type]
    come_online(robot, tokens=tokens)
    return robot, desk


def test_a_sentence_is_sent_with_a_token_that_is_at_most_three_seconds_old(clock: list[float]) -> None:
    """Requests after a sentence that waits for its token wait, too."""
    robot, desk = connect()
    requests: list[Request] = [Say("a", id="a", ttl=2), Append("a", "b"), Cancel(("a",)), Say("c", id="c")]
    for each in requests:
        robot.begin(each)
    assert [request for _, request in desk.sent] == [Hello()]
    clock[0] += 1.0
    answer(robot, desk, "first")
    assert [request for _, request in desk.sent[1:]] == [Say("a", id="a", ttl=1.0), *requests[1:]]
    assert desk.tokens == [None, "first", None, None, "first"]
    clock[0] += 2.0
    robot.begin(Say("d", id="d"))
    clock[0] += 0.1
    robot.begin(Say("e", id="e"))
    assert [request for _, request in desk.sent[5:]] == [Say("d", id="d"), Hello()]
    answer(robot, desk, "second")
    assert desk.tokens[5:] == ["first", None, "second"]


def test_a_robot_without_tokens_is_asked_at_once() -> None:
    robot, desk = connect(tokens=False)
    robot.begin(Say("a", id="a"))
    assert (desk.sent[0][1], desk.tokens) == (Say("a", id="a"), [None])


def test_sentences_without_a_token_in_time_are_never_sent(clock: list[float]) -> None:
    """They expire, or are dropped by their caller, or the robot refuses to give a token."""
    robot, desk = connect()
    expired = robot.begin(Say("a", id="a", ttl=2))
    clock[0] += 2.1
    answer(robot, desk, "late")
    assert isinstance(expired.error, ServerUnavailable)
    clock[0] += 10.0
    dropped, refused = robot.begin(Say("b", id="b")), robot.begin(Say("c", id="c"))
    canceling = robot.begin(Cancel(("c",)))
    robot.forget(dropped)
    answer(robot, desk, ok=False, error={"code": "busy", "message": "too many clients"})
    assert isinstance(refused.error, Busy)
    assert [request for _, request in desk.sent] == [Hello(), Hello(), canceling.request]


def test_after_an_absence_a_sentence_is_sent_again_with_a_new_token() -> None:
    robot, desk = connect()
    robot.begin(Say("a", id="a"))
    answer(robot, desk, "first")
    waiting = robot.begin(Say("b", id="b"))
    assert desk.tokens == [None, "first", "first"]
    robot.on_disconnected("the broker is gone")
    desk.sent.clear()
    come_online(robot, "another", tokens=True)
    for _ in range(2):  # the robot knows neither of the goals
        number = desk.sent[0][0]
        error = {"code": "unknown_goal", "message": "no such goal"}
        line = encode({"seq": number, "ok": False, "error": error})
        robot.on_message(Message("talk/reply/bob/s1/anna", line))
        del desk.sent[0]
    assert [request for _, request in desk.sent] == [Hello()]
    answer(robot, desk, "second")
    assert desk.sent[-1] == (waiting.number, Say("b", id="b"))
    assert desk.tokens[-2:] == ["second", "second"]
