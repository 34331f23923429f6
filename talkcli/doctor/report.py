"""The doctor's findings and conclusion, and functions to format them.

This module has no side effects.
"""

from __future__ import annotations

import textwrap

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State
from talkcli.terminal.text import COLUMN_GAP, Screen, pad, printable

if TYPE_CHECKING:
    from collections.abc import Sequence

#: The states of a finding. A warning means that speech may be inaudible. A failure means that speech is certainly
#: inaudible.
OK, WARNING, FAILURE = "ok", "warning", "failed"
#: Number of names that are shown if a list is shortened.
_SHOWN_NAMES_COUNT = 4
#: Widths of the columns for the state and the name of a check.
_STATE_WIDTH_CHARS, _CHECK_WIDTH_CHARS = 7, 12
_MESSAGE_INDENT = " " * (_STATE_WIDTH_CHARS + _CHECK_WIDTH_CHARS + 2 * len(COLUMN_GAP))
_ARROW = "-> "
_FINAL_STEP_INDENT = "  "
#: For each state of a finding, the goal state with the same colour.
_FINDING_COLOURS = {OK: State.SUCCEEDED, WARNING: State.PREEMPTED, FAILURE: State.ABORTED}


@frozen
class Finding:
    """The result of one check."""

    #: name of the check
    check: str
    #: OK, WARNING or FAILURE
    state: str
    #: human-readable description, with text from other programs escaped
    message: str
    #: what the user should do next, or None if nothing is wrong
    next: str | None = None
    #: the times that the check measured, such as `onset_ms`; None if it measures nothing
    measured: dict[str, int | None] | None = None


@frozen
class Question:
    """The two answers to the doctor's question: `yes` if all checks passed, `no` if one failed."""

    #: the human-readable answers
    yes: str
    no: str


SENTENCE_QUESTION = Question(
    "a sentence is heard, unless the loudspeaker itself is off", "a sentence would not be heard"
)
ROBOT_QUESTION = Question("the robot answers", "the robot can't be reached")
#: The question for a robot that checks its own access to the broker.
BRIDGE_QUESTION = Question("the broker accepts this robot's messages", "the broker would not accept these messages")


def ok(check: str, message: str, measured: dict[str, int | None] | None = None) -> Finding:
    """Return a finding for a check that passed."""
    return Finding(check, OK, printable(message), measured=measured)


def warning(check: str, message: str, step: str) -> Finding:
    """Return a finding for a fault that may prevent sound. `step` is the advice for the user."""
    return Finding(check, WARNING, printable(message), printable(step))


def failure(check: str, message: str, step: str) -> Finding:
    """Return a finding for a fault that certainly prevents sound. `step` is the advice for the user."""
    return Finding(check, FAILURE, printable(message), printable(step))


def join_names(names: Sequence[str]) -> str:
    """Join names with commas, and shorten long lists."""
    hidden = len(names) - _SHOWN_NAMES_COUNT
    return ", ".join(names) if hidden <= 1 else f"{', '.join(names[:_SHOWN_NAMES_COUNT])} and {hidden} more"


def next_steps(findings: Sequence[Finding]) -> list[str]:
    """Return the advice for the first failure, or an empty list if no check failed.

    If no check failed, the answer to the question is yes, because every examination ends with a failure or with the
    check that proves the answer. If the advice is to start a server, the advice for the next failure follows, because
    a new server alone would not be heard.
    """
    failures = [each for each in findings if each.state == FAILURE]
    steps = [each.next or "" for each in failures]
    starts_server = bool(steps) and failures[0].check == "socket" and "talk serve" in steps[0]
    return steps[: 2 if starts_server else 1]


def format_finding(finding: Finding, screen: Screen) -> list[str]:
    """Format a finding as lines of text.

    In a pipe, a finding is a single line. On a terminal, the advice has lines of its own.
    """
    state = screen.coloured(pad(finding.state, _STATE_WIDTH_CHARS), _FINDING_COLOURS[finding.state])
    head = COLUMN_GAP.join((state, pad(finding.check, _CHECK_WIDTH_CHARS), ""))
    room = screen.columns_left(len(_MESSAGE_INDENT))
    if room is None:
        return [head + finding.message + ("" if finding.next is None else f" {_ARROW}{finding.next}")]
    first, *rest = _wrap(finding.message, room) or [""]
    for number, step in enumerate(_wrap(finding.next or "", room - len(_ARROW))):
        rest.append((" " * len(_ARROW) if number else _ARROW) + screen.coloured(step, None))
    return [head + first, *(_MESSAGE_INDENT + each for each in rest)]


def format_conclusion(findings: Sequence[Finding], screen: Screen, question: Question = SENTENCE_QUESTION) -> str:
    """Format the answer to the question, and the advice if a check failed."""
    steps = next_steps(findings)
    if not steps:
        warned = sum(each.state == WARNING for each in findings)
        return question.yes + ("" if not warned else "; 1 warning" if warned == 1 else f"; {warned} warnings")
    room = screen.columns_left(len(_FINAL_STEP_INDENT))
    wrapped = ["\n".join(_FINAL_STEP_INDENT + each for each in _wrap(step, room)) for step in steps]
    return f"{question.no}; do this next:\n" + "\nand then:\n".join(wrapped)


def _wrap(text: str, room: int | None) -> list[str]:
    """Split a text into lines of at most `room` characters.

    If `room` is None, return a single line.
    """
    if room is None:
        return [text]
    # Don't break words at hyphens, because users copy paths and commands.
    return textwrap.wrap(text, room, break_on_hyphens=False)
