"""The scheduler's mutable record of a goal.

Only the `goals` package changes records. Other packages may read them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from talkcli.frozen import replace
from talkcli.goals.goal import By, Goal, Output, Sender
from talkcli.goals.options import SHOWN_OPTIONS, Say, Set, require_fields
from talkcli.goals.states import TRANSITIONS, IllegalTransition, State

if TYPE_CHECKING:
    from talkcli.goals.reasons import Reason, Refusal

#: Fields of a goal that are set after the goal was accepted.
_FIELDS_SET_LATER = ("reason", "by", "message", "started_at", "ended_at", "duration", "voice", "output")
require_fields(Goal, (*SHOWN_OPTIONS, *_FIELDS_SET_LATER))


@dataclass(slots=True, eq=False)
class Record:
    """Everything that the scheduler knows about a goal.

    The class has slots to save memory, because ten thousand goals may be in the queue.
    """

    id: str
    #: number of the goal in the order of submission
    number: int
    #: the client's request, with the default time to live filled in
    say: Say
    sender: Sender
    queued_at: float
    preempt: bool = False
    #: monotonic time at which the goal expires if it hasn't started, or inf
    expires_at: float = inf
    #: length of the text when the goal was sent; a growing text becomes longer
    first_chars: int = 0
    #: hash of the original text, if the text was dropped to save memory
    text_hash: int | None = None
    state: State = State.PENDING
    #: position in the queue among the goals of the same priority
    position: int = 0
    reason: Reason | None = None
    by: By | None = None
    message: str | None = None
    #: replacements for terms in the text, or None before the goal has started
    pronunciations: dict[str, str] | None = None
    #: offset of the end of the last word that has started, or 0 if nothing was heard
    begun_end: int = 0
    #: offset of the end of the last word that was heard completely
    spoken_end: int = 0
    #: how many seconds of the audio are known to have been heard
    heard: float = 0.0
    #: whether the text may still grow
    more: bool = False
    #: whether the text broke off. Such a goal can't succeed.
    broken: bool = False
    #: whether the goal is silent because the next part of its text is missing
    waits: bool = False
    #: number of characters that were heard, or that had arrived when the goal ran out of text
    passed_chars: int = 0
    #: monotonic time by which more text must arrive, or inf
    stalls_at: float = inf
    #: whether the goal is paused or interrupted
    paused: bool = False
    #: id of the goal that interrupts this one, or None
    interrupted_by: str | None = None
    #: where the goal continues after the last interruption: an offset in the text, or a number of samples of a sound
    rest: int = 0
    #: number of words that have started
    word_count: int = 0
    #: number of gaps in the audio before the last interruption, and their total length in seconds
    gaps: int = 0
    gap_seconds: float = 0.0
    #: the server's settings at the time when the goal became ACTIVE, or None before that
    settings: Set | None = None
    #: how often the goal has been paused
    pause_count: int = 0
    #: monotonic time at which the goal reached the front of the queue, or inf before that
    next_since: float = inf
    #: monotonic time at which the goal became ACTIVE
    began_at: float = 0.0
    started_at: float | None = None
    ended_at: float | None = None
    duration: float | None = None
    #: id of the voice that speaks the goal
    voice: str | None = None
    output: Output | None = None
    #: monotonic time at which the engine was told to stop the goal
    stop_requested_at: float | None = None

    @property
    def text_bytes(self) -> int:
        """The size of the text in bytes, or 0 after the text was dropped."""
        return len(self.say.text.encode(errors="surrogatepass"))

    @property
    def was_heard(self) -> bool:
        """Whether at least one word of the text, or a part of the sound, was heard."""
        return self.begun_end > 0 or (self.say.is_sound and self.heard > 0)

    def change_state(self, state: State) -> None:
        """Change the state of the goal. Raise IllegalTransition if the change isn't allowed."""
        if state not in TRANSITIONS[self.state]:
            raise IllegalTransition(f"a goal can't change from {self.state.name} to {state.name}")
        self.state = state

    def reject(self, refusal: Refusal, now: float) -> None:
        """Set the state to REJECTED, with the reason and the message."""
        self.reason, words = refusal
        self.state, self.message, self.ended_at = State.REJECTED, f"not spoken: {words}", now

    def drop_text(self) -> None:
        """Replace the text with a hash to save memory."""
        self.text_hash, self.say = hash(self.say.text[: self.first_chars]), replace(self.say, text="")

    def was_sent_as(self, say: Say) -> bool:
        """Return whether the goal was sent with the text or the sound of this request."""
        text_hash = self.text_hash or hash(self.say.text[: self.first_chars])
        return (say.is_sound, hash(say.text)) == (self.say.is_sound, text_hash)

    def snapshot(self, state: State | None = None) -> Goal:
        """Return an immutable copy of the goal, in its current state or in the given one.

        Args:
            state: the state to show instead of the current one. With PENDING, the copy shows the goal as it was
                accepted.
        """
        state = self.state if state is None else state
        text = self.say.text if self.text_hash is None else None
        shown = {name: getattr(self.say, name) for name in SHOWN_OPTIONS}
        if state is not State.PENDING:
            shown |= {name: getattr(self, name) for name in _FIELDS_SET_LATER}
            if self.started_at is not None:
                shown["heard"] = self.heard
                if not self.say.is_sound:
                    shown["spoken_end"] = self.spoken_end
                    shown["spoken"] = None if text is None else text[: self.begun_end]
        return Goal(
            id=self.id,
            state=state,
            text=text,
            client=self.sender,
            paused=self.paused and state is self.state,
            interrupted_by=self.interrupted_by if state is self.state else None,
            more=self.more,
            waits=self.waits,
            queued_at=self.queued_at,
            **shown,
        )
