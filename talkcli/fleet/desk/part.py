"""A request to several robots at one of them: how far it is there, and what becomes of it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from talkcli.client.connection import Exchange
from talkcli.client.goal import GoalHandle
from talkcli.errors import EXIT_OK, ServerUnavailable, TalkError, UnknownGoal
from talkcli.fleet.desk.outcome import IDLE, NO_SERVER, PAUSED, RESUMED, SET, Outcome, failed
from talkcli.goals.goal import Goal
from talkcli.goals.options import Cancel, Say, Set
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, ServerStatus, goal_in, goals
from talkcli.protocol.requests import Pause, Resume, Status, Wait

if TYPE_CHECKING:
    from talkcli.fleet.desk.robot import RobotConnection
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request


class Part:
    """The request at one robot."""

    def __init__(self, robot: RobotConnection, name: str, request: Request) -> None:
        self.robot = robot
        self._name, self._request = name, request
        self._exchange: Exchange | None = None
        #: the goals that are waited for, since when, and those of them that were told of
        self._handles: list[GoalHandle] = []
        self._since = time.monotonic()
        self._told = 0

    @property
    def was_asked(self) -> bool:
        """Whether the robot was asked, or may have been."""
        return self._exchange is not None

    def ask(self) -> list[Outcome]:
        """Ask it alone, and return what is known at once."""
        try:
            self.robot.check()
            self._exchange = self.robot.begin(self._request, self._accepted)
        except TalkError as error:
            return [failed(self._name, error)]
        return []

    def expect(self, number: int, latest: float | None) -> None:
        """Await its answer: it was asked as one of a group, by this number."""
        self._exchange = Exchange(number, self._request, self._accepted)
        self._exchange.latest = latest
        self.robot.expect(self._exchange)

    def withdraw(self, *, told: bool) -> None:
        """Have the goal be cancelled, now or when the robot is back; `told`: whether the robot was told already."""
        assert isinstance(self._request, Say)
        self.robot.withdraw(str(self._request.id), told=told)

    def look(self, *, judge: bool) -> list[Outcome]:
        """Return what has become of it since, as far as it is new; `judge`: as of `Round.look`."""
        exchange, robot = self._exchange, self.robot
        assert exchange is not None
        robot.sign()
        now = time.monotonic()
        if not self._handles:
            request = self._request
            slow = isinstance(request, Pause) or (isinstance(request, Say) and request.patient)
            late = judge and now > (robot.silent_by(self._since)[0] if slow else robot.answer_by(exchange))
            if not (exchange.over or robot.ended is not None or late):
                return []
            robot.forget(exchange)
            try:
                found = self._replied(exchange)
                if found:
                    return found
            except TalkError as error:
                refused = (exchange.reply or {}).get("error")
                serverless = isinstance(refused, dict) and refused.get("code") == ServerUnavailable.code
                return [failed(self._name, error, NO_SERVER if serverless else None)]
        quiet, why = robot.silent_by(self._since)
        if judge and now > quiet:
            robot.ended = robot.ended or why
        return self._ended()

    def _accepted(self, reply: JsonObject, items: list[JsonObject]) -> None:
        """Follow the goals that are to be waited for."""
        request = self._request
        if isinstance(request, Say):
            found = [Goal.from_json(reply.get("goal"))]  # without one it is no answer: it may be spoken all the same
            if not request.wait:
                return
        elif isinstance(request, Wait):
            found = list(goals(items, "goal"))
        else:
            return
        self._since = time.monotonic()
        self._handles = [GoalHandle(self.robot, each) for each in found]
        for each in self._handles:
            each._listen(feedback=False)

    def _ended(self) -> list[Outcome]:
        """Return those of its goals that have ended, in their order."""
        found = []
        while self._told < len(self._handles):
            handle = self._handles[self._told]
            if not (handle.state.terminal or handle._lose()):
                break
            self._told += 1
            whatever = isinstance(self._request, Wait) and self._request.ids is None and handle.state is not State.LOST
            code = EXIT_OK if whatever else handle.goal.exit_code or EXIT_OK
            last = self._told == len(self._handles)
            found.append(Outcome(self._name, handle.state.name, code, handle.goal, last=last))
        return found

    def _replied(self, exchange: Exchange) -> list[Outcome]:
        """Return what an answer says, nothing where goals are waited for; errors as of `answer`."""
        try:
            reply, items = self.robot.answer(exchange)
        except UnknownGoal as error:
            return [*self._canceled(Canceled.from_items(error.items), last=False), failed(self._name, error)]
        return [] if self._handles else self._answered(reply, items)

    def _answered(self, reply: JsonObject, items: list[JsonObject]) -> list[Outcome]:
        """Return what a reply says of a robot that has nothing more to tell."""
        name, request = self._name, self._request
        asked_for = isinstance(request, Status) and request.id is not None
        goal = Goal.from_json(reply.get("goal")) if asked_for else goal_in(reply)
        if isinstance(request, Cancel):
            return self._canceled(Canceled.from_items(items)) or [Outcome(name, IDLE)]
        if isinstance(request, Pause | Resume):
            paused = isinstance(request, Pause)
            return [Outcome(name, PAUSED if paused else RESUMED, goal=goal, said={"paused": paused})]
        if isinstance(request, Set):
            return [Outcome(name, SET, said={"settings": reply.get("settings")})]
        if goal is not None:
            return [Outcome(name, goal.state.name, (isinstance(request, Say) and goal.exit_code) or EXIT_OK, goal)]
        if isinstance(request, Status):
            status = ServerStatus.from_reply(reply, items)
            state = status.active.state.name if status.active else IDLE
            state = PAUSED if status.server.get("paused") is True else state
            return [Outcome(name, state, goal=status.active, said={"status": status.to_json()})]
        return [Outcome(name, IDLE)]

    def _canceled(self, done: Canceled, *, last: bool = True) -> list[Outcome]:
        every = (*done.canceled, *done.ended)
        return [Outcome(self._name, each.state.name, EXIT_OK, each, last=last and each is every[-1]) for each in every]
