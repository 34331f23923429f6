"""What was found: one finding a check, and what all of them mean together. Pure."""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import JsonObject

#: The states of a finding. A warning may be why a sentence is not heard; with a failure it is certain.
DONE, WARNING, FAILED = "done", "warning", "failed"

#: The check that sends a sentence all the way.
SENTENCE = "sentence"
#: Checks of what lies behind the engine, the nearest cause of a sentence's end first.
_BEHIND = ("player", "device", "sound server", "group", "cards", "session")


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


def done(check: str, message: str) -> Finding:
    """Return a finding that all is well."""
    return Finding(check, DONE, printable(message))


def warning(check: str, message: str, step: str) -> Finding:
    """Return a finding of what may be why nothing is heard."""
    return Finding(check, WARNING, printable(message), printable(step))


def failed(check: str, message: str, step: str) -> Finding:
    """Return a finding of what lets nothing be heard."""
    return Finding(check, FAILED, printable(message), printable(step))


def heard(findings: Sequence[Finding]) -> bool:
    """Tell whether a sentence would be heard: one was played, and nothing failed."""
    return any(each.check == SENTENCE for each in findings) and all(each.state != FAILED for each in findings)


def behind(findings: Sequence[Finding], *, custom: bool = False) -> str | None:
    """Return the next step for what lies behind the engine, where something there is not as it should be.

    `custom`: whether the player is a command of the user's own, of which nobody here knows what it needs.
    """
    steps = {each.check: each.next for each in findings}
    return next((steps[check] for check in _BEHIND[: 1 if custom else None] if steps.get(check) is not None), None)


def next_step(findings: Sequence[Finding]) -> str | None:
    """Return the one thing to do: for the first that failed."""
    return next((each.next for each in findings if each.state == FAILED), None)
