"""What a client makes of its arguments before they go over the wire: whole ids, parts of long lists, checked options.

Pure: it sends nothing. What it refuses was never sent.
"""

from __future__ import annotations

from talkcli.errors import UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.option import MAX_ID, MAX_IDS
from talkcli.goals.options import Say, bad_key, bad_option
from talkcli.goals.states import State
from talkcli.protocol.lines import MAX_LINE
from talkcli.protocol.requests import request_line

if TYPE_CHECKING:
    from collections.abc import Iterable

    from talkcli.goals.options import Set

#: Bytes of a request's line that are left for what isn't its list of ids: another id, a key, the names of the fields.
_REST_OF_LINE = 4096
#: Bytes of JSON that one character may take: a quote with its backslash, two halves of a surrogate pair, escaped.
_LONGEST_ASCII, _LONGEST_CHARACTER = 2, 12
#: The number of a request has no more digits than this.
_LONGEST_NUMBER = 10**15


def full_id(goal_id: str, boot: str) -> str:
    """Return the whole id for a number alone, which means a goal of the server of this boot id.

    UsageError for an empty id, UnknownGoal for one that no goal can have.
    """
    if not goal_id:
        raise UsageError("an id is empty: is the variable set that it comes from?")
    if goal_id.isascii() and goal_id.isdecimal():
        goal_id = f"{boot}-{goal_id}"
    if len(goal_id) > MAX_ID:
        raise UnknownGoal(f"no goal {goal_id[:MAX_ID]!a}… is known: an id has at most {MAX_ID} characters")
    return goal_id


def batches(ids: Iterable[str]) -> list[tuple[str, ...]]:
    """Return the ids in their order, each once, in parts that each fit into a request's line."""
    parts: list[list[str]] = []
    room = 0
    for each in dict.fromkeys(ids):
        plain = each.isascii() and each.isprintable()
        size = (_LONGEST_ASCII if plain else _LONGEST_CHARACTER) * len(each) + len('"", ')
        if not parts or size > room or len(parts[-1]) == MAX_IDS:
            parts.append([])
            room = MAX_LINE - _REST_OF_LINE
        room -= size
        parts[-1].append(each)
    return [tuple(each) for each in parts]


def check_key(key: str | None) -> None:
    """Raise UsageError for a key that no goal can have."""
    words = None if key is None else bad_key(key)
    if words:
        raise UsageError(words)


def check(request: Say | Set) -> None:
    """Raise UsageError for options of the wrong kind, or out of their range: as the server would, without asking it."""
    for option in request.options:
        try:
            fault = option.fault(getattr(request, option.name))
        except (TypeError, ValueError) as error:  # something in `data`
            fault = f"is no JSON: {error}"
        if fault:
            raise UsageError(f"{option.name!r} {fault}")
    words = bad_option(request)
    if words:
        raise UsageError(words)


def too_long(request: Say) -> Goal | None:
    """Return the goal that the server would have made of a text that doesn't fit into a request, None if it fits."""
    try:
        line = request_line(request, _LONGEST_NUMBER)
    except ValueError as error:  # NaN in `data`
        raise UsageError(f"'data' is no JSON: {error}") from None
    if len(line) <= MAX_LINE:
        return None
    message = f"Talk rejected: the text has {len(request.text):,} characters, more than a request can hold"
    return Goal("", State.REJECTED, request.text, reason="text_too_long", message=message)
