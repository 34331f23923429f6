"""The states of a goal, and the allowed transitions between them.

Names and numbers are those of ROS's actionlib. A transition that is not allowed raises an error and changes nothing. To
allow another transition, add it to the table and to the tests that repeat the table.
"""

from __future__ import annotations

from enum import IntEnum

from talkcli.errors import TalkError


class State(IntEnum):
    """The state of a goal, numbered as in actionlib. `str()` and f-strings return the name."""

    PENDING = 0  # waiting in the queue
    ACTIVE = 1  # sent to the engine to be spoken
    PREEMPTED = 2  # stopped after it became ACTIVE
    SUCCEEDED = 3  # played to the end
    ABORTED = 4  # the engine or the audio failed, or nothing in the text could be spoken
    REJECTED = 5  # refused before it entered the queue
    PREEMPTING = 6  # being stopped, but not yet silent
    RECALLING = 7  # being removed from the queue, just before it becomes RECALLED
    RECALLED = 8  # removed from the queue before it was spoken
    LOST = 9  # set by a client that lost its connection to the server

    @property
    def terminal(self) -> bool:
        """Whether a goal in this state has ended."""
        return not TRANSITIONS[self]

    def __str__(self) -> str:
        return self.name

    def __format__(self, spec: str) -> str:
        # Since Python 3.11, IntEnum members are formatted as numbers by default.
        return format(int(self) if spec.endswith("d") else self.name, spec)


#: Exit codes of a command that waits for a goal, by the goal's final state.
EXIT_CODES: dict[State, int] = {
    State.SUCCEEDED: 0,
    State.ABORTED: 4,
    State.REJECTED: 5,
    State.RECALLED: 6,
    State.PREEMPTED: 7,
    State.LOST: 12,
}

#: Allowed next states for each state. New goals are PENDING or REJECTED. PREEMPTING becomes ABORTED only with the
#: reasons `not_silent`, `text_stalled` and `broken_off`. A client may change any state that isn't terminal to LOST.
TRANSITIONS: dict[State, frozenset[State]] = {
    State.PENDING: frozenset({State.ACTIVE, State.RECALLING, State.LOST}),
    State.RECALLING: frozenset({State.RECALLED, State.LOST}),
    State.ACTIVE: frozenset({State.PREEMPTING, State.SUCCEEDED, State.ABORTED, State.LOST}),
    State.PREEMPTING: frozenset({State.PREEMPTED, State.SUCCEEDED, State.ABORTED, State.LOST}),
    **dict.fromkeys(EXIT_CODES, frozenset()),
}


class IllegalTransition(TalkError):
    """Raised for a state change that isn't allowed, which is a bug in the caller."""

    code = "illegal_transition"
