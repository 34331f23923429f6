"""What somebody sees who looks at all robots of a fleet, see `lookout`. Pure."""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from talkcli.fleet.presence import Presence
    from talkcli.fleet.status import Standing
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import PausedChanged, StateChanged


@frozen
class Begun:
    """How all robots stand in the beginning; by name."""

    standings: tuple[Standing, ...]


@frozen
class Changed:
    """A robot has come or gone, or its server has; None where the broker knows, or knew, nothing of it."""

    name: str
    before: Presence | None
    now: Presence | None


@frozen
class Happened:
    """What a robot tells of a goal, or of a pause: as an event, and as it came."""

    name: str
    event: StateChanged | PausedChanged
    message: JsonObject


@frozen
class Missed:
    """What nobody could hear of, as the broker was away, or the robot's way there: how the robot stands now.

    `events`: what of it is new, of the goal that ended last and the one that is spoken.
    """

    standing: Standing
    events: tuple[StateChanged, ...]


@frozen
class Away:
    """The broker is away, and is tried again."""

    why: str
    #: seconds after which it counts as lost
    limit: float


@frozen
class Back:
    """The broker is there again, after so many seconds."""

    after: float


Sighting = Begun | Changed | Happened | Missed | Away | Back
