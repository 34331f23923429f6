"""Who sent a goal and what ended it, in words for people: in one full form, and in shorter ones for narrow columns.

Pure. Everything here comes from others, so all of it goes through `printable`.
"""

from __future__ import annotations

import re

from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.states import State
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from talkcli.goals.goal import By, Goal, Sender

#: Characters of a command line that are shown.
MAX_COMMAND = 60

_NOBODY = "nobody known"
#: Programs whose first argument is the script that one looks for.
_INTERPRETER = re.compile(r"(ba|da|z|fi|k)?sh|python[\d.]*|perl|ruby|node|lua|env|sudo|timeout|nice")


def who(sender: Sender | None) -> str:
    """Return who sent something: the script that one looks for, and what it calls itself."""
    if sender is None:
        return _NOBODY
    parts = [_program(sender)]
    if sender.pid is not None:
        parts.append(f"pid {sender.pid}")
    if sender.uid is not None:
        parts.append(f"uid {sender.uid}")
    if sender.name:
        parts.append(f'calls itself "{printable(sender.name)}"')
    return ", ".join(parts)


def who_forms(sender: Sender | None) -> list[str]:
    """Return who sent something, for a column: the longest form first.

    What it calls itself, in quotes, as it is a claim, comes before what it is, and stays where there is room for one.
    """
    if sender is None:
        return [_NOBODY]
    script = _script(sender)
    number = "" if sender.pid is None else f", pid {sender.pid}"
    forms = [f"{_program(sender)}{number}", f"{script}{number}", script]
    if sender.name:
        claim = f'"{printable(sender.name)}"'
        forms = [*(f"{claim} ({each})" for each in forms), claim]
    return list(dict.fromkeys(forms))


def by_whom(by: By) -> str:
    """Return what ended a goal."""
    if by.goal is not None:
        return f"by {printable(by.goal)}"
    return f"by {who(by.client)}" if by.client else "by nobody known"


def why_forms(goal: Goal) -> list[str]:
    """Return why a goal ended and who ended it, for a column: the longest form first."""
    if goal.state is State.SUCCEEDED:
        return ["" if goal.duration is None else f"{goal.duration:.1f} s"]
    reason = printable(goal.reason or goal.state.name.lower())
    by = []
    if goal.by is not None:
        by = [printable(goal.by.goal)] if goal.by.goal is not None else who_forms(goal.by.client)
    forms = [f"{reason} by {each}" for each in by] or [reason]
    words = _words(goal)
    # Who ended it is worth more than the reason, of which the state says something already.
    shortest = f"by {by[-1]}" if by else reason
    if not words:
        return [*forms, shortest]
    forms = [f"{each}: {words}" for each in forms]
    # What an engine or a player said is worth more than the reason alone, even if it is cut.
    return forms if goal.state in {State.ABORTED, State.REJECTED} else [*forms, shortest]


def _words(goal: Goal) -> str:
    """Return what the goal's message says beyond its state, where that is more than reason and `by` say."""
    if goal.state not in {State.ABORTED, State.REJECTED} and goal.by is not None:
        return ""
    head, colon, words = (goal.message or "").partition(": ")
    return printable(words) if colon and head.startswith("Talk ") else ""


def _program(sender: Sender) -> str:
    return printable(sender.parent or sender.command or "a program", MAX_COMMAND)


def _script(sender: Sender) -> str:
    """Return the name of the script, without its directory, its interpreter and its arguments."""
    words = (sender.parent or sender.command or "a program").split(" ")
    name = _base(words[0])
    if len(words) > 1 and _INTERPRETER.fullmatch(name) and not words[1].startswith("-"):
        name = _base(words[1])
    return printable(name, MAX_COMMAND)


def _base(path: str) -> str:
    return path.rstrip("/").rpartition("/")[2] or path
