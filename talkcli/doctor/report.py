"""The findings of the doctor, the conclusion from all of them, and how to show both.

This module is pure. The caller passes the screen.
"""

from __future__ import annotations

import textwrap

from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.states import State
from talkcli.terminal.text import COLUMN_GAP, Screen, pad, printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import JsonObject

#: The states of a finding. After a warning, a sentence may be inaudible. After a failure, it certainly is.
OK, WARNING, FAILURE = "ok", "warning", "failed"
#: The check that speaks a sentence.
SENTENCE_CHECK = "sentence"
#: How many names to show of a list that is shortened.
_SHOWN_NAMES_COUNT = 4
#: Widths of the first two columns, for the longest state and the longest name of a check.
_STATE_WIDTH_CHARS, _CHECK_WIDTH_CHARS = 7, 12
_MESSAGE_INDENT = " " * (_STATE_WIDTH_CHARS + _CHECK_WIDTH_CHARS + 2 * len(COLUMN_GAP))
_ARROW = "-> "
_FINAL_STEP_INDENT = "  "
#: For each state of a finding, the goal state that is shown in the same colour.
_FINDING_COLOURS = {OK: State.SUCCEEDED, WARNING: State.PREEMPTED, FAILURE: State.ABORTED}


@frozen
class Finding:
    """The result of one check."""

    #: name of the check
    check: str
    #: OK, WARNING or FAILURE
    state: str
    #: description for people, with text from other programs already escaped
    message: str
    #: what to do next, or None if nothing is wrong
    next: str | None = None

    def to_json(self) -> JsonObject:
        return fields(self)


@frozen
class Question:
    """The question that an examination answers."""

    #: the check that has to succeed for the answer "yes"
    check: str
    #: the two answers, for people
    yes: str
    no: str


SENTENCE_QUESTION = Question(
    SENTENCE_CHECK, "a sentence is heard, unless the loudspeaker itself is off", "a sentence would not be heard"
)
ROBOT_QUESTION = Question("bridge", "the robot answers", "the robot would not answer")
#: The question if a robot examines its own access to the broker.
BRIDGE_QUESTION = Question(
    "rights", "the broker takes what this robot's bridge says", "this robot's bridge would not be heard"
)


def ok(check: str, message: str) -> Finding:
    """Return a finding for a check that found no fault."""
    return Finding(check, OK, printable(message))


def warning(check: str, message: str, step: str) -> Finding:
    """Return a finding about a fault that may prevent sound, with the next step."""
    return Finding(check, WARNING, printable(message), printable(step))


def failure(check: str, message: str, step: str) -> Finding:
    """Return a finding about a fault that certainly prevents sound, with the next step."""
    return Finding(check, FAILURE, printable(message), printable(step))


def join_names(names: tuple[str, ...]) -> str:
    """Return a list of names for people. A long list is shortened."""
    hidden = len(names) - _SHOWN_NAMES_COUNT
    return ", ".join(names) if hidden <= 1 else f"{', '.join(names[:_SHOWN_NAMES_COUNT])} and {hidden} more"


def has_passed(findings: Sequence[Finding], question: Question = SENTENCE_QUESTION) -> bool:
    """Return whether the answer is yes: the check of the question was made, and no check failed."""
    return any(each.check == question.check for each in findings) and all(each.state != FAILURE for each in findings)


def next_step(findings: Sequence[Finding]) -> str | None:
    """Return the next step of the first failure, or None if nothing failed."""
    return next((each.next for each in findings if each.state == FAILURE), None)


def format_finding(finding: Finding, screen: Screen) -> list[str]:
    """Return the lines that show a finding: a single line in a pipe. On a terminal, the next step has its own lines."""
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
    """Return the answer to the question, followed by the next step if something failed."""
    if has_passed(findings, question):
        warned = sum(each.state == WARNING for each in findings)
        return question.yes + ("" if not warned else "; 1 warning" if warned == 1 else f"; {warned} warnings")
    step = next_step(findings)
    if step is None:
        return question.no
    steps = _wrap(step, screen.columns_left(len(_FINAL_STEP_INDENT)))
    return "\n".join([f"{question.no}; do this next:", *(_FINAL_STEP_INDENT + each for each in steps)])


def _wrap(text: str, room: int | None) -> list[str]:
    """Return the text in lines of this width. If `room` is None, it is one line."""
    if room is None:
        return [text]
    # People copy paths and commands, so a word is only cut if it is longer than a line.
    return textwrap.wrap(text, room, break_on_hyphens=False)
