"""What was found: one finding a check, what all of them mean together, and how both are shown to people.

Pure: the screen comes from the caller.
"""

from __future__ import annotations

import textwrap

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State
from talkcli.terminal.text import COLUMN_GAP, Screen, pad, printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import JsonObject

#: The states of a finding. A warning may be why a sentence is not heard; with a failure it is certain.
OK, WARNING, FAILED = "ok", "warning", "failed"
#: The check that sends a sentence all the way.
SENTENCE = "sentence"
#: Names that are shown of a long list.
_SHOWN = 4
#: Columns of the state, and of the check's name: of the longest of each.
_STATE, _CHECK = 7, 12
_INDENT = " " * (_STATE + _CHECK + 2 * len(COLUMN_GAP))
_ARROW = "-> "
#: Before the next step, at the end.
_STEP = "  "
#: Which state of a goal has a finding's colour.
_COLOURS = {OK: State.SUCCEEDED, WARNING: State.PREEMPTED, FAILED: State.ABORTED}


@frozen
class Finding:
    """What one check has found."""

    check: str
    state: str
    #: for people; text of others in it is escaped already
    message: str
    #: the one thing to do, in plain words; None where nothing is to be done
    next: str | None = None

    def to_json(self) -> JsonObject:
        return {"check": self.check, "state": self.state, "message": self.message, "next": self.next}


@frozen
class Question:
    """What is to be found out."""

    #: the check without which nothing is proved
    proof: str
    #: the answers, for people
    yes: str
    no: str


#: Of a sentence here; of a robot of a fleet; and of that robot, where it asks itself.
HEARD = Question(SENTENCE, "a sentence is heard, unless the loudspeaker itself is off", "a sentence would not be heard")
ANSWERED = Question("bridge", "the robot answers", "the robot would not answer")
ADMITTED = Question(
    "rights", "the broker takes what this robot's bridge says", "this robot's bridge would not be heard"
)


def ok(check: str, message: str) -> Finding:
    """Return a finding that all is well."""
    return Finding(check, OK, printable(message))


def warning(check: str, message: str, step: str) -> Finding:
    """Return a finding of what may be why nothing is heard."""
    return Finding(check, WARNING, printable(message), printable(step))


def failed(check: str, message: str, step: str) -> Finding:
    """Return a finding of what lets nothing be heard."""
    return Finding(check, FAILED, printable(message), printable(step))


def some(names: tuple[str, ...]) -> str:
    """Return names for people, not all of many."""
    rest = len(names) - _SHOWN
    return ", ".join(names) if rest <= 1 else f"{', '.join(names[:_SHOWN])} and {rest} more"


def heard(findings: Sequence[Finding], question: Question = HEARD) -> bool:
    """Tell whether a sentence would be heard, or whatever the question is: it was proved, and nothing failed."""
    return any(each.check == question.proof for each in findings) and all(each.state != FAILED for each in findings)


def next_step(findings: Sequence[Finding]) -> str | None:
    """Return the one thing to do: for the first that failed."""
    return next((each.next for each in findings if each.state == FAILED), None)


def lines(finding: Finding, screen: Screen) -> list[str]:
    """Return a finding as it is shown: in a pipe one line, on a terminal the next step has lines of its own."""
    state = screen.coloured(pad(finding.state, _STATE), _COLOURS[finding.state])
    head = COLUMN_GAP.join((state, pad(finding.check, _CHECK), ""))
    room = screen.columns_left(len(_INDENT))
    if room is None:
        return [head + finding.message + ("" if finding.next is None else f" {_ARROW}{finding.next}")]
    first, *rest = _wrapped(finding.message, room) or [""]
    steps = _wrapped(finding.next or "", room - len(_ARROW))
    arrows = (_ARROW if number == 0 else " " * len(_ARROW) for number in range(len(steps)))
    rest += [arrow + screen.coloured(each, None) for arrow, each in zip(arrows, steps, strict=True)]
    return [head + first, *(_INDENT + each for each in rest)]


def verdict(findings: Sequence[Finding], screen: Screen, question: Question = HEARD) -> str:
    """Return what it all means, with the one thing to do next on lines of its own."""
    if heard(findings, question):
        warned = sum(each.state == WARNING for each in findings)
        seen = "" if not warned else "; 1 warning" if warned == 1 else f"; {warned} warnings"
        return f"{question.yes}{seen}"
    step = next_step(findings)
    if step is None:
        return question.no
    room = screen.columns_left(len(_STEP))
    return "\n".join([f"{question.no}; do this next:", *(_STEP + each for each in _wrapped(step, room))])


def _wrapped(text: str, room: int | None) -> list[str]:
    """Return the text as lines of so many columns; None for one line."""
    if room is None:
        return [text]
    # Paths and commands are copied: they are cut only where a line has no blank at all.
    return textwrap.wrap(text, room, break_on_hyphens=False)
