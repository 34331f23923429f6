"""The scheduler's own record of a goal. Outside the scheduler it is read, never written.

Slots and no dictionary: a queue of a hundred thousand goals has to stay small.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.messages import By, Goal
from talkcli.states import State, follow

if TYPE_CHECKING:
    from talkcli.messages import JsonObject, Sender


class Record:
    """One goal, from its acceptance to its end."""

    __slots__ = (
        "by",
        "data",
        "duration",
        "ended_at",
        "format",
        "id",
        "message",
        "number",
        "place",
        "preempt",
        "queued_at",
        "reason",
        "sender",
        "spoken_end",
        "started_at",
        "state",
        "stop_since",
        "text",
        "text_bytes",
    )

    def __init__(self, goal_id: str, number: int, text: str, sender: Sender, queued_at: float) -> None:
        self.id = goal_id
        #: order of acceptance
        self.number = number
        self.text: str | None = text
        #: what the text takes in the history
        self.text_bytes = len(text.encode(errors="surrogatepass"))
        self.sender = sender
        self.queued_at = queued_at
        self.state = State.PENDING
        self.preempt = False
        #: where it stands in the queue: lower goes first
        self.place = 0
        self.format = "text"
        self.data: JsonObject | None = None
        self.reason: str | None = None
        self.by: By | None = None
        self.message: str | None = None
        #: offset after the last word that was heard
        self.spoken_end = 0
        self.started_at: float | None = None
        self.ended_at: float | None = None
        self.duration: float | None = None
        #: monotonic time of the first stop
        self.stop_since: float | None = None

    def become(self, state: State) -> None:
        """Change the state as the table allows, or raise IllegalTransition and change nothing."""
        self.state = follow(self.state, state)

    def drop_text(self) -> None:
        """Forget the text, to make room; the result stays."""
        self.text = None

    def snapshot(self, state: State | None = None) -> Goal:
        """Return the goal as it is now; with PENDING, as it was when it was accepted."""
        state = self.state if state is None else state
        started_at = None if state is State.PENDING else self.started_at
        spoken = None
        if started_at is not None and self.text is not None:
            spoken = self.text[: self.spoken_end]
        return Goal(
            id=self.id,
            state=state,
            text=self.text,
            reason=self.reason,
            by=self.by,
            message=self.message,
            format=self.format,
            spoken=spoken,
            data=self.data,
            client=self.sender,
            queued_at=self.queued_at,
            started_at=started_at,
            ended_at=self.ended_at,
            duration=self.duration,
        )
