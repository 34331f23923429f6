"""The scheduler's own record of a goal. Outside the scheduler it is read, never written.

Slots and no dictionary: a queue of ten thousand goals has to stay small.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

from talkcli.frozen import replace
from talkcli.goals.goal import By, Goal
from talkcli.goals.options import SHOWN
from talkcli.goals.states import State, follow

if TYPE_CHECKING:
    from talkcli.goals.goal import Output, Sender
    from talkcli.goals.options import Say
    from talkcli.goals.reasons import Reason


@dataclass(slots=True, eq=False)
class Record:
    """One goal, from its acceptance to its end."""

    id: str
    #: order of acceptance
    number: int
    #: what its sender asked for, with the server's own time to live where it brought none
    say: Say
    sender: Sender
    queued_at: float
    preempt: bool = False
    #: the monotonic time by which it must have begun
    expires_at: float | None = None
    #: its text; None once that is dropped
    text: str | None = field(init=False)
    #: stands for the text once that is dropped
    text_hash: int = 0
    #: bytes that the text takes; none once that is dropped
    text_bytes: int = field(init=False)
    state: State = State.PENDING
    #: its place among the pending goals of its priority; the queue's business alone
    turn: int = 0
    reason: Reason | None = None
    by: By | None = None
    message: str | None = None
    #: offset after the last word that was heard
    spoken_end: int = 0
    #: held in the middle of being spoken
    paused: bool = False
    #: how often that was asked for
    holds: int = 0
    #: monotonic time at which its turn had come, whether its voice was there or not
    turn_at: float = inf
    #: monotonic time at which it was handed to the engine
    began: float = 0.0
    started_at: float | None = None
    ended_at: float | None = None
    duration: float | None = None
    #: id of the voice by which it is heard
    voice: str | None = None
    output: Output | None = None
    #: monotonic time of the first stop
    stop_since: float | None = None

    def __post_init__(self) -> None:
        self.text = self.say.text
        self.text_bytes = len(self.text.encode(errors="surrogatepass"))

    @property
    def priority(self) -> int:
        """Higher goes first."""
        return self.say.priority

    @property
    def key(self) -> str | None:
        """What a later goal replaces it by; None for nothing."""
        return self.say.key

    def become(self, state: State) -> None:
        """Change the state as the table allows, or raise IllegalTransition and change nothing."""
        self.state = follow(self.state, state)

    def drop_text(self) -> None:
        """Forget the text, to make room; the result stays."""
        self.text_hash = hash(self.text)
        self.text, self.text_bytes, self.say = None, 0, replace(self.say, text="")

    def has_text(self, text: str) -> bool:
        """Whether this was the goal's text, also where it is not kept any more."""
        return hash(text) == self.text_hash if self.text is None else text == self.text

    def snapshot(self, state: State | None = None) -> Goal:
        """Return the goal as it is now; with PENDING, as it was when it was accepted."""
        state = self.state if state is None else state
        accepted = state is State.PENDING
        spoken = None if accepted or self.started_at is None or self.text is None else self.text[: self.spoken_end]
        return Goal(
            id=self.id,
            state=state,
            text=self.text,
            reason=None if accepted else self.reason,
            by=None if accepted else self.by,
            message=None if accepted else self.message,
            spoken=spoken,
            client=self.sender,
            paused=self.paused and state is self.state,
            queued_at=self.queued_at,
            started_at=None if accepted else self.started_at,
            ended_at=None if accepted else self.ended_at,
            duration=None if accepted else self.duration,
            voice=None if accepted else self.voice,
            output=None if accepted else self.output,
            **{name: getattr(self.say, name) for name in SHOWN},
        )
