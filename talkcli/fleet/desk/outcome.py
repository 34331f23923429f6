"""What became of a request at one robot of several: a goal, or how the robot stands, or why it did not do it. Pure."""

from __future__ import annotations

from talkcli.errors import AccessDenied, Lost, ServerUnavailable, TalkError, UnknownGoal
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State

if TYPE_CHECKING:
    from talkcli.goals.goal import Goal, JsonObject

#: How a robot stands that has no goal to show, or that did not do what it was asked.
IDLE, PAUSED, RESUMED, SET = "IDLE", "PAUSED", "RESUMED", "SET"
OFFLINE, NO_SERVER, UNREACHABLE, UNKNOWN, REFUSED = "OFFLINE", "NO_SERVER", "UNREACHABLE", "UNKNOWN", "REFUSED"


@frozen
class Outcome:
    """What became of a request at a robot: one for each goal that it is about, else one."""

    robot: str
    #: the name of the goal's state; without a goal what the robot does, or why it does not
    state: str
    #: 0 where it is as was asked, else what `talk` ends with for it
    exit_code: int = 0
    goal: Goal | None = None
    #: why nothing came of it
    error: TalkError | None = None
    #: the server's reply besides its goal: `status`, `settings` or `paused`
    said: JsonObject | None = None
    #: whether it is the last of this robot's
    last: bool = True

    def to_json(self) -> JsonObject:
        """Return it as an object, for programs."""
        found: JsonObject = {"robot": self.robot, "state": self.state, "exit_code": self.exit_code}
        if self.error is not None:
            return {**found, "error": {"code": self.error.code, "message": self.error.message}}
        return {**found, **({} if self.goal is None else {"goal": self.goal.to_json()}), **(self.said or {})}


def failed(robot: str, error: TalkError, state: str | None = None) -> Outcome:
    """Return what became of a request that came to nothing; `state`: what the robot is, where that is why."""
    kinds = {UnknownGoal: UNKNOWN, Lost: State.LOST.name, AccessDenied: REFUSED, ServerUnavailable: UNREACHABLE}
    named = next((name for kind, name in kinds.items() if isinstance(error, kind)), REFUSED)
    return Outcome(robot, state or named, error.exit_code, error=error)
