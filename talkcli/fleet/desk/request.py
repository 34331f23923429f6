"""Classes that select robots for a request and describe its outcome on each robot.

The module is pure.
"""

from __future__ import annotations

import re
from fnmatch import fnmatchcase

from talkcli.errors import EXIT_OK, Lost, ServerUnavailable, TalkError, UnknownGoal
from talkcli.fleet import topics
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import Goal, JsonObject
from talkcli.goals.options import Cancel, Pause, Say, Set
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, ServerStatus, goal_in
from talkcli.protocol.requests import Request, Resume, Status

if TYPE_CHECKING:
    from talkcli.fleet.payloads import Presence

_GROUP_PREFIX, _WILDCARDS = "@", "*?["
#: Matches a pattern in which all characters are valid. No other pattern can match the name of a robot.
_GLOB = re.compile(r"[A-Za-z0-9._*?\[\]!-]+")


def selects_several(text: str) -> bool:
    """Return whether a value of `--robot` is a pattern or a group instead of a single robot's name."""
    return text.startswith(_GROUP_PREFIX) or any(each in text for each in _WILDCARDS)


class Selection:
    """The robots selected by a value of `--robot`.

    Attributes:
        text: the value of `--robot`: a name, a pattern (`*`, `?` and `[abc]`, as in a shell), or `@GROUP`.
        group: the name of the group, or None if the value is not a group. Every robot belongs to the group `all`.
        name: the name of the robot, or None if the value may select several robots.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self.group = text.removeprefix(_GROUP_PREFIX) if text.startswith(_GROUP_PREFIX) else None
        self.name = None if selects_several(text) else text

    @property
    def fault(self) -> str | None:
        """An error message if no robot can ever match, otherwise None."""
        for kind, name in (("group", self.group), ("robot", self.name)):
            if name is not None:
                fault = topics.name_fault(name)
                return fault and f"invalid {kind} name '{name}': it {fault}"
        # An unclosed bracket matches only itself, and robots' names contain no brackets.
        if not _GLOB.fullmatch(self.text) or "[" in re.sub(r"\[!?[^]]+\]", "", self.text):
            return f"the pattern '{self.text}' can't match any robot; it may only contain A-Z a-z 0-9 . _ - * ? and [ ]"
        return None

    def includes(self, presence: Presence) -> bool:
        """Return whether a robot is selected. The robot may be offline."""
        if self.group is not None:
            return self.group == topics.ALL_ROBOTS or self.group in presence.groups
        return fnmatchcase(presence.name, self.text)


class RobotOffline(ServerUnavailable):
    """Raised if a robot is offline."""


class NoServer(ServerUnavailable):
    """Raised if a robot is online, but its server is not running."""


@frozen
class Outcome:
    """How a request ended on one robot: a state, an exit code, and the goal or the error.

    If the request affects several goals, the robot has one outcome for each of them.

    Attributes:
        robot: the name of the robot.
        state: the name of the goal's state. Without a goal, one of IDLE, PAUSED, RESUMED and SET, or the reason for a
            failure: OFFLINE, NO_SERVER, UNREACHABLE, UNKNOWN (no such goal), REFUSED or LOST.
        exit_code: 0 if the robot carried out the request, otherwise the exit code of `talk` for the failure.
        goal: the goal, or None if the outcome isn't about a goal.
        error: the error if the request failed, otherwise None.
        said: the `status`, `settings` or `paused` field of the server's reply, or None if there is no such field.
        last: whether this is the robot's last outcome.
    """

    robot: str
    state: str
    exit_code: int = 0
    goal: Goal | None = None
    error: TalkError | None = None
    said: JsonObject | None = None
    last: bool = True

    def to_json(self) -> JsonObject:
        """Return the outcome as a JSON object."""
        found: JsonObject = {"robot": self.robot, "state": self.state, "exit_code": self.exit_code}
        if self.error is not None:
            return {**found, "error": {"code": self.error.code, "message": self.error.message}}
        return {**found, **({} if self.goal is None else {"goal": self.goal.to_json()}), **(self.said or {})}


def failure_outcome(robot: str, error: TalkError) -> Outcome:
    """Return the outcome of a failed request. Its state depends on the class of the error."""
    states: dict[type[TalkError], str] = {UnknownGoal: "UNKNOWN", Lost: State.LOST.name, RobotOffline: "OFFLINE"}
    states |= {NoServer: "NO_SERVER", ServerUnavailable: "UNREACHABLE"}
    state = next((name for kind, name in states.items() if isinstance(error, kind)), "REFUSED")
    return Outcome(robot, state, error.exit_code, error=error)


def reply_outcomes(robot: str, request: Request, reply: JsonObject, items: list[JsonObject]) -> list[Outcome]:
    """Convert the reply of a robot's server to a list of outcomes.

    Args:
        robot: the name of the robot.
        request: the request. If it waits for goals, they must have ended.
        reply: the reply.
        items: the list items that the server sent before the reply.
    """
    if isinstance(request, Cancel):
        return cancel_outcomes(robot, items) or [Outcome(robot, "IDLE")]
    if isinstance(request, Set):
        return [Outcome(robot, "SET", said={"settings": reply.get("settings")})]
    goal = goal_in(reply)
    if isinstance(request, Pause | Resume):
        paused = isinstance(request, Pause)
        return [Outcome(robot, "PAUSED" if paused else "RESUMED", goal=goal, said={"paused": paused})]
    if isinstance(request, Status) and request.id is None:
        status = ServerStatus.from_reply(reply, items)
        goal = status.active
        state = "PAUSED" if status.server.get("paused") is True else goal.state.name if goal else "IDLE"
        return [Outcome(robot, state, goal=goal, said={"status": status.to_json()})]
    if isinstance(request, Status):
        goal = Goal.from_json(reply.get("goal"))  # This raises Unreadable if there is no goal.
    if goal is None:
        return [Outcome(robot, "IDLE")]
    return [Outcome(robot, goal.state.name, (isinstance(request, Say) and goal.exit_code) or EXIT_OK, goal)]


def cancel_outcomes(robot: str, items: list[JsonObject], *, last: bool = True) -> list[Outcome]:
    """Return the outcomes of a cancel request: one for each goal that was cancelled or had already ended.

    Args:
        robot: the name of the robot.
        items: the list items that the server sent before its reply.
        last: whether these are the robot's last outcomes.
    """
    done = Canceled.from_items(items)
    goals = (*done.canceled, *done.ended)
    return [Outcome(robot, each.state.name, EXIT_OK, each, last=last and each is goals[-1]) for each in goals]
