"""What the slow model of the scheduler keeps of a goal, what it is asked and what it answers.

Rules for this file: as for `slow_model`; it imports nothing of `talkcli`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

#: The table of states, as a watcher sees it: what may follow what. RECALLING is transient and never published.
TABLE: dict[str, set[str]] = {
    "PENDING": {"ACTIVE", "RECALLED"},
    "ACTIVE": {"PREEMPTING", "SUCCEEDED", "ABORTED"},
    "PREEMPTING": {"PREEMPTED", "SUCCEEDED", "ABORTED"},
}
#: What a goal that just arrived may be.
FIRST = {"PENDING", "REJECTED"}
ENDS = {"PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "RECALLED"}


@dataclass
class Wish:
    """What a client asks to be spoken, and how."""

    text: str
    preempt: bool | None = None
    flush: bool = False
    priority: int = 0
    ttl: float | None = None
    key: str | None = None
    throttle: float | None = None
    id: str | None = None
    voice: str | None = None
    voice_only: bool = False


@dataclass
class SlowGoal:
    """One goal. `by` is "goal ID", "client NAME", or None where the server or nobody ended it."""

    id: str
    text: str
    preempt: bool
    priority: int = 0
    key: str | None = None
    ttl: float | None = None
    voice: str | None = None
    voice_only: bool = False
    state: str = "PENDING"
    reason: str | None = None
    by: str | None = None
    paused: bool = False
    spoken: int = 0
    duration: float | None = None
    #: on the monotonic clock: when it was accepted, when it began, when it was told to stop first
    accepted_at: float = 0.0
    began_at: float | None = None
    stopped_at: float | None = None
    #: when it was first seen to be its turn, where it waited then
    turn_at: float | None = None
    #: on the clock on the wall
    times: dict[str, float] = field(default_factory=dict)


@dataclass
class Selection:
    """What a cancel names; nothing named is everything, but a list of no ids names none."""

    ids: list[str] | None = None
    current: bool = False
    before: str | None = None
    key: str | None = None


@dataclass
class Outcome:
    """What a cancel answers, by id. Whether `before` is noted where that goal has ended is left open."""

    recalled: list[str] = field(default_factory=list)
    stopping: str | None = None
    ended: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
