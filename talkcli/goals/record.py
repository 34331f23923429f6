"""The scheduler's record of a goal.

Only this package writes to it; other packages may read it. It has slots, because ten thousand goals may wait.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

from talkcli.frozen import replace
from talkcli.goals.goal import By, Goal
from talkcli.goals.options import SHOWN_OPTIONS, require_fields
from talkcli.goals.states import State, check_transition

if TYPE_CHECKING:
    from talkcli.goals.goal import Output, Sender
    from talkcli.goals.options import Say
    from talkcli.goals.reasons import Reason

#: the fields of a goal that are unknown when it is accepted
_LATER = ("reason", "by", "message", "started_at", "ended_at", "duration", "voice", "output")
require_fields(Goal, (*SHOWN_OPTIONS, *_LATER))


@dataclass(slots=True, eq=False)
class Record:
    """One goal, from its acceptance to its end."""

    id: str
    #: its place in the order of acceptance
    number: int
    #: the request; it has the server's time to live if the sender gave none
    say: Say
    sender: Sender
    queued_at: float
    preempt: bool = False
    #: when it expires if it has not begun (monotonic seconds)
    expires_at: float | None = None
    #: None once the text is dropped
    text: str | None = field(init=False)
    #: replaces a text that is dropped
    text_hash: int = 0
    #: memory for the text; 0 once it is dropped
    text_bytes: int = field(init=False)
    state: State = State.PENDING
    #: its place among the pending goals of its priority; only the queue uses it
    position: int = 0
    reason: Reason | None = None
    by: By | None = None
    message: str | None = None
    #: the offset after the last word that was heard
    spoken_end: int = 0
    #: whether it is held while it is spoken
    paused: bool = False
    #: how often it was paused
    pause_count: int = 0
    #: since when it is the next goal (monotonic seconds); inf before that
    next_since: float = inf
    #: when it was handed to the engine (monotonic seconds)
    began_at: float = 0.0
    started_at: float | None = None
    ended_at: float | None = None
    duration: float | None = None
    #: id of the voice that speaks it
    voice: str | None = None
    output: Output | None = None
    #: when it was first told to stop (monotonic seconds)
    stop_requested_at: float | None = None

    def __post_init__(self) -> None:
        self.text = self.say.text
        self.text_bytes = len(self.text.encode(errors="surrogatepass"))

    @property
    def priority(self) -> int:
        """The goal's priority: higher goes first."""
        return self.say.priority

    @property
    def key(self) -> str | None:
        """The label by which a later goal replaces this one, if it has one."""
        return self.say.key

    def change_state(self, state: State) -> None:
        """Change the state, or raise IllegalTransition and change nothing."""
        self.state = check_transition(self.state, state)

    def drop_text(self) -> None:
        """Forget the text to free memory, but not the result."""
        self.text_hash = hash(self.text)
        self.text, self.text_bytes, self.say = None, 0, replace(self.say, text="")

    def has_text(self, text: str) -> bool:
        """Return whether this is the goal's text, even if the text was dropped."""
        return hash(text) == self.text_hash if self.text is None else text == self.text

    def snapshot(self, state: State | None = None) -> Goal:
        """Return the goal as it is now, or with PENDING, as it was when it was accepted."""
        state = self.state if state is None else state
        shown = {name: getattr(self.say, name) for name in SHOWN_OPTIONS}
        if state is not State.PENDING:
            shown |= {name: getattr(self, name) for name in _LATER}
            if self.started_at is not None and self.text is not None:
                shown["spoken"] = self.text[: self.spoken_end]
        return Goal(
            id=self.id,
            state=state,
            text=self.text,
            client=self.sender,
            paused=self.paused and state is self.state,
            queued_at=self.queued_at,
            **shown,
        )
