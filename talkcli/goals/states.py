"""The states of a goal, with actionlib's names and numbers, and the table of allowed transitions.

A transition that is not in the table raises an error and changes nothing. To allow another transition, change the table
and the tests that repeat it.
"""

from __future__ import annotations

from enum import IntEnum

from talkcli.errors import TalkError


class State(IntEnum):
    """The state of a goal. The value is actionlib's number. `str` and f-strings give the name."""

    PENDING = 0  # in the queue
    ACTIVE = 1  # given to the engine
    PREEMPTED = 2  # stopped after it had become ACTIVE
    SUCCEEDED = 3  # completely played
    ABORTED = 4  # the engine or the audio failed, or the text contains nothing that can be spoken
    REJECTED = 5  # refused, so never in the queue
    PREEMPTING = 6  # being stopped, but not silent yet
    RECALLING = 7  # being removed from the queue; becomes RECALLED in the same step
    RECALLED = 8  # removed from the queue before it was spoken
    LOST = 9  # set by a client if its connection to the server ends after the goal was accepted

    @property
    def terminal(self) -> bool:
        """Whether a goal in this state has ended."""
        return not TRANSITIONS[self]

    def __str__(self) -> str:
        return self.name

    def __format__(self, spec: str) -> str:
        # In Python 3.11 and later, IntEnum would format the number.
        return format(int(self) if spec.endswith("d") else self.name, spec)


#: The terminal states, each with the exit code of a command that waits for the goal.
EXIT_CODES: dict[State, int] = {
    State.SUCCEEDED: 0,
    State.ABORTED: 4,
    State.REJECTED: 5,
    State.RECALLED: 6,
    State.PREEMPTED: 7,
    State.LOST: 12,
}

#: The states that may follow each state. A new goal is PENDING or REJECTED. The scheduler changes PREEMPTING to ABORTED
#: only with the reason `not_silent`. A client may change any non-terminal state to LOST.
TRANSITIONS: dict[State, frozenset[State]] = {
    State.PENDING: frozenset({State.ACTIVE, State.RECALLING, State.LOST}),
    State.RECALLING: frozenset({State.RECALLED, State.LOST}),
    State.ACTIVE: frozenset({State.PREEMPTING, State.SUCCEEDED, State.ABORTED, State.LOST}),
    State.PREEMPTING: frozenset({State.PREEMPTED, State.SUCCEEDED, State.ABORTED, State.LOST}),
    **dict.fromkeys(EXIT_CODES, frozenset()),
}


class IllegalTransition(TalkError):
    """A transition that the table does not allow. It indicates a bug in the caller. No state was changed."""

    code = "illegal_transition"


def check_transition(state: State, target: State) -> State:
    """Return `target`. Raises IllegalTransition if `target` may not follow `state`."""
    if target not in TRANSITIONS[state]:
        raise IllegalTransition(f"a goal that is {state.name} can't become {target.name}")
    return target
