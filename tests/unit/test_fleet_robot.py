"""A desk's connection to a robot, without a broker: what is sent again after an absence."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from talkcli.client.core import TrackedGoal
from talkcli.fleet import topics
from talkcli.fleet.broker import Broker
from talkcli.fleet.payloads import Message
from talkcli.goals.goal import Goal
from talkcli.goals.options import Append, Say
from talkcli.goals.states import State
from talkcli.protocol.events import Result
from talkcli.protocol.features import FEATURES
from talkcli.protocol.lines import encode
from talkcli.protocol.requests import Wait
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

    def send(self, request: Request, number: int, *_: object) -> bool:
        self.sent.append((number, request))
        return True

    def wake(self) -> None:
        pass


def come_online(robot: RobotConnection, session: str = "5e55") -> None:
    server = {"boot": "7r2z", "pid": 4711, "features": list(FEATURES)}
    presence = {"talk": 1, "online": True, "session": session, "server": server}
    robot.on_message(Message(topics.robot("anna", topics.PRESENCE), encode(presence)))


def answer(robot: RobotConnection, desk: Desk, **fields: Any) -> None:
    """Answer the last request."""
    robot.on_message(Message("talk/reply/bob/s1/anna", encode({"seq": desk.sent[-1][0], "ok": True, **fields})))


def begin_text(robot: RobotConnection, desk: Desk, goal_id: str) -> TrackedGoal:
    """Send a growing text, and follow its goal."""
    robot.begin(Say("Hel", more=True, id=goal_id, wait=True))
    reply: JsonObject = {"goal": Goal(goal_id, State.PENDING, more=True).to_json()}
    answer(robot, desk, **reply)
    tracked = TrackedGoal(Goal("", State.PENDING))
    tracked._accept(reply)
    tracked._listen_to(robot.listeners, feedback=False, now=0.0)
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
