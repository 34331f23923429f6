"""What the scheduler says shall be done, and what it answers: plain objects, to be carried out by the server.

Rules for this file: no decision, no I/O. Effects are to be carried out in the order in which they come: those for the
engine in theirs, and the news for clients, `Changed`, in theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from talkcli.frozen import frozen

if TYPE_CHECKING:
    from talkcli.goals.record import Record
    from talkcli.goals.states import State


@frozen
class Now:
    """One moment on both clocks, in seconds: monotonic, for limits, and since 1970 UTC, to be shown.

    The monotonic one counts the time in which the machine was suspended: what was true before is not news after it.
    """

    monotonic: float
    wall: float


@frozen
class Changed:
    """A goal is in a new state; to be published."""

    record: Record
    state: State


@frozen
class Start:
    """The engine shall speak this goal."""

    record: Record


@frozen
class Stop:
    """The engine shall stop this goal; the answer is `ended`."""

    record: Record


@frozen
class GiveUp:
    """The engine didn't become silent in time: it must be replaced before it may be given another goal."""

    record: Record


@frozen
class Hold:
    """The engine shall be silent and go on with this goal at `Resume`."""

    record: Record


@frozen
class Resume:
    """The engine shall go on with the goal that it holds."""

    record: Record


Effect = Changed | Start | Stop | GiveUp | Hold | Resume


@frozen
class Submitted:
    """What became of a goal that was sent: its record, or that of the first goal of its id, to which it is attached."""

    record: Record
    effects: list[Effect]
    attached: bool = False


@dataclass(slots=True)
class Cancelled:
    """What a cancel did: goals that ended at once, the one being stopped, those that had ended, ids nobody knows."""

    recalled: list[Record] = field(default_factory=list)
    stopping: Record | None = None
    ended: list[Record] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)
