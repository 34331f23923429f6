"""The scheduler's mutable record of a goal.

Only the `goals` package changes records. Other packages may read them.
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

#: Fields that a goal gets after it was accepted.
_LATER = ("reason", "by", "message", "started_at", "ended_at", "duration", "voice", "output")
require_fields(Goal, (*SHOWN_OPTIONS, *_LATER))


@dataclass(slots=True, eq=False)
class Record:
    """One goal from its submission to its end. It has slots because ten thousand goals may wait."""

    id: str
    #: position in the order of submission
    number: int
    #: the request; if the sender gave no time to live, the request contains that of the server
    say: Say
    sender: Sender
    queued_at: float
    preempt: bool = False
    #: time at which it expires unless it has started (monotonic)
    expires_at: float | None = None
    #: the text, or None after it was dropped to free memory
    text: str | None = field(init=False)
    #: a hash of the text, set when the text is dropped
    text_hash: int = 0
    #: size of the text, or 0 after it was dropped
    text_bytes: int = field(init=False)
    state: State = State.PENDING
    #: position among the pending goals of its priority, used only by the queue
    position: int = 0
    reason: Reason | None = None
    by: By | None = None
    message: str | None = None
    #: offset of the end of the last word that was heard
    spoken_end: int = 0
    #: whether it was paused in mid-sentence
    paused: bool = False
    #: number of times it was paused
    pause_count: int = 0
    #: time at which it became the next goal (monotonic), or inf before that
    next_since: float = inf
    #: time at which it was given to the engine (monotonic)
    began_at: float = 0.0
    started_at: float | None = None
    ended_at: float | None = None
    duration: float | None = None
    #: id of the voice that is used
    voice: str | None = None
    output: Output | None = None
    #: time of the first order to stop it (monotonic)
    stop_requested_at: float | None = None

    def __post_init__(self) -> None:
        self.text = self.say.text
        self.text_bytes = len(self.text.encode(errors="surrogatepass"))

    @property
    def priority(self) -> int:
        """The goal's priority. Higher priorities are spoken first."""
        return self.say.priority

    @property
    def key(self) -> str | None:
        """The goal's key, or None. A later goal with the same key replaces this one."""
        return self.say.key

    def change_state(self, state: State) -> None:
        """Change the state. Raises IllegalTransition if the transition is not allowed."""
        self.state = check_transition(self.state, state)

    def drop_text(self) -> None:
        """Drop the text to free memory, and keep everything else."""
        self.text_hash = hash(self.text)
        self.text, self.text_bytes, self.say = None, 0, replace(self.say, text="")

    def has_text(self, text: str) -> bool:
        """Return whether the goal has this text. After the text was dropped, compare hashes."""
        return hash(text) == self.text_hash if self.text is None else text == self.text

    def snapshot(self, state: State | None = None) -> Goal:
        """Return the goal as it is now. With PENDING, return the goal as it was when it was accepted."""
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
