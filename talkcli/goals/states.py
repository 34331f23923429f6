"""The states of a goal, with the names and numbers of actionlib, and the table of allowed transitions.

A transition that is not in the table is an error and changes nothing. To allow another one, change the table and the
tests that list it.
"""

from __future__ import annotations

from enum import IntEnum

from talkcli.errors import TalkError


class State(IntEnum):
    """State of a goal. Its value is actionlib's number; `str` and f-strings give its name."""

    PENDING = 0  # in the queue
    ACTIVE = 1  # handed to the engine
    PREEMPTED = 2  # stopped while it was spoken, by a cancel or by another goal
    SUCCEEDED = 3  # all of it was played
    ABORTED = 4  # engine or audio failed, or nothing in the text can be spoken
    REJECTED = 5  # never queued
    PREEMPTING = 6  # told to stop, not yet silent
    RECALLING = 7  # being taken out of the queue; a goal never stays in this state
    RECALLED = 8  # taken out of the queue before it was spoken
    LOST = 9  # set by a client: the connection to the server ended after the goal was accepted

    @property
    def terminal(self) -> bool:
        """Whether a goal in this state has ended."""
        return not TRANSITIONS[self]

    def __str__(self) -> str:
        return self.name

    def __format__(self, spec: str) -> str:
        # Without this, IntEnum formats the number from Python 3.11 on.
        return format(int(self) if spec.endswith("d") else self.name, spec)


#: the terminal states, each with the exit code of a command whose goal ended in it
EXIT_CODES: dict[State, int] = {
    State.SUCCEEDED: 0,
    State.ABORTED: 4,
    State.REJECTED: 5,
    State.RECALLED: 6,
    State.PREEMPTED: 7,
    State.LOST: 12,
}

#: The states that may follow each state. A goal begins PENDING or REJECTED. PREEMPTING may end ABORTED only with the
#: reason `not_silent`, which the scheduler ensures. A client may conclude LOST from any state that is not terminal.
TRANSITIONS: dict[State, frozenset[State]] = {
    State.PENDING: frozenset({State.ACTIVE, State.RECALLING, State.LOST}),
    State.RECALLING: frozenset({State.RECALLED, State.LOST}),
    State.ACTIVE: frozenset({State.PREEMPTING, State.SUCCEEDED, State.ABORTED, State.LOST}),
    State.PREEMPTING: frozenset({State.PREEMPTED, State.SUCCEEDED, State.ABORTED, State.LOST}),
    **dict.fromkeys(EXIT_CODES, frozenset()),
}


class IllegalTransition(TalkError):
    """A change of state that the table does not allow. It is a bug of the caller and has changed nothing."""

    code = "illegal_transition"


def check_transition(state: State, target: State) -> State:
    """Return `target` if it may follow `state`. Otherwise raise IllegalTransition."""
    if target not in TRANSITIONS[state]:
        raise IllegalTransition(f"a goal that is {state.name} can't become {target.name}")
    return target
