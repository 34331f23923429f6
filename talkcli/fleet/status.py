"""What a robot's status says of its goals: what is spoken, what waits, what ended last; and how it so stands. Pure.

As of its presence: what is not of the form that it should be is taken as not said.
"""

from __future__ import annotations

from talkcli.errors import BadRequest
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.goal import Goal, known
from talkcli.goals.states import State
from talkcli.protocol.events import StateChanged
from talkcli.protocol.lines import decode

if TYPE_CHECKING:
    from talkcli.fleet.presence import Presence
    from talkcli.goals.goal import JsonObject


@frozen
class LastGoal:
    """The goal that ended last."""

    id: str
    state: State
    reason: str | None = None
    #: None where it is not told
    text: str | None = None
    #: when it ended, in seconds since 1970 UTC by the robot's clock
    at: float | None = None


@frozen
class Status:
    """What a robot says of its goals."""

    #: the id of the goal that is spoken, and its text; None where none is, or it is not told
    active: str | None = None
    text: str | None = None
    #: how many goals wait
    pending: int = 0
    paused: bool = False
    last: LastGoal | None = None

    @classmethod
    def read(cls, payload: bytes) -> Status | None:
        """Return what the broker keeps of it; None where somebody has cleared it."""
        try:
            said = decode(payload.strip())
        except BadRequest:
            return None
        pending = said.get("pending")
        return cls(
            _text(said.get("active")),
            _text(said.get("text")),
            max(0, pending) if isinstance(pending, int) else 0,
            said.get("paused") is True,
            _last(said.get("last")),
        )

    def events(self) -> list[StateChanged]:
        """Return the events by which it came to stand so: how the last goal ended, and that the next is spoken."""
        last, found = self.last, []
        if last:
            ended = Goal(last.id, last.state, last.text, last.reason, ended_at=last.at)
            found.append(StateChanged(last.id, last.state, last.at, goal=ended))
        if self.active is not None:
            spoken = Goal(self.active, State.ACTIVE, self.text)
            found.append(StateChanged(self.active, State.ACTIVE, goal=spoken))
        return found

    def to_json(self) -> JsonObject:
        """Return it as an object, for programs."""
        last = self.last
        return {**fields(self), "last": None if last is None else {**fields(last), "state": last.state.name}}


@frozen
class Standing:
    """A robot as it stands: whether it is there, and what it told of its goals last."""

    presence: Presence
    #: None where it has told nothing; that of one that is gone is what it told before
    status: Status | None

    def to_json(self) -> JsonObject:
        """Return it as an object, for programs."""
        status = None if self.status is None else self.status.to_json()
        return {"robot": self.presence.name, "presence": self.presence.to_json(), "status": status}


def _last(said: object) -> LastGoal | None:
    if not isinstance(said, dict):
        return None
    found = known(LastGoal, said)
    return LastGoal(**found) if "id" in found and "state" in found else None


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None
