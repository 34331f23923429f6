"""Goals as rows of the history's table, and the filters of a `log` request.

The values that a filter may need have columns of their own. The column `other` contains the rest of the goal as JSON,
without the fields that have their default values. Therefore, fields can be added to goals without changing the table.
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING

from talkcli.frozen import replace
from talkcli.goals.goal import By, Goal
from talkcli.goals.states import State
from talkcli.protocol.lines import decode, encode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

    from talkcli.goals.goal import JsonObject, Sender
    from talkcli.goals.options import Log

    #: The values of COLUMNS for one goal.
    Row = tuple[Any, ...]

SCHEMA = """
CREATE TABLE IF NOT EXISTS goals (
    number INTEGER PRIMARY KEY, id TEXT NOT NULL, ended_at REAL NOT NULL, state TEXT NOT NULL,
    name TEXT, key TEXT, text TEXT, other TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS goals_by_id ON goals (id);
CREATE INDEX IF NOT EXISTS goals_by_end ON goals (ended_at);
"""
#: The columns of the table, except for the number that shows the order in which goals ended.
COLUMNS = ("id", "ended_at", "state", "name", "key", "text", "other")
#: The fields of a goal that have columns of their own, and the goal's field `spoken`.
_SEPARATE_FIELDS = {"id", "ended_at", "state", "key", "text", "spoken"}
#: The fields of a goal that may quote its text, besides the sender.
_TEXT_FIELDS = ("text", "said", "spoken", "message")
_DEFAULTS = Goal("", State.PENDING).to_json()
#: For the id and for each filter of a `log` request: its SQL condition, its column, and a function that compares the
#: value in the column with the filter's value.
_FILTERS: dict[str, tuple[str, str, Callable[[Any, Any], bool]]] = {
    "id": ("id = ?", "id", operator.eq),
    "since": ("ended_at >= ?", "ended_at", operator.ge),
    "until": ("ended_at < ?", "ended_at", operator.lt),
    "state": ("state = ?", "state", operator.eq),
    "name": ("name = ?", "name", operator.eq),
    "key": ("key = ?", "key", operator.eq),
    "grep": ("instr(text, ?)", "text", operator.contains),
}


def given_filters(log: Log) -> JsonObject:
    """Return the filters of a `log` request that are not None."""
    return {name: value for name in _FILTERS if (value := getattr(log, name, None)) is not None}


def filter_values(goal: Goal) -> JsonObject:
    """Return the values of a goal that filters compare, by column name."""
    name = goal.client.name if goal.client else None
    values = {"id": goal.id, "state": goal.state.name, "name": name, "key": goal.key}
    return {**values, "ended_at": goal.ended_at or 0.0, "text": goal.text or ""}


def matches(filters: Mapping[str, object], values: Mapping[str, object]) -> bool:
    """Return whether a goal with these `filter_values` passes all filters."""
    return all(_FILTERS[name][2](values[_FILTERS[name][1]], wanted) for name, wanted in filters.items())


def sql_condition(filters: Mapping[str, object]) -> tuple[str, list[object]]:
    """Return the filters as an SQL expression, and the values of its placeholders."""
    return " AND ".join(_FILTERS[name][0] for name in filters) or "1", [*map(_storable, filters.values())]


def to_row(goal: Goal) -> Row:
    """Return the row for an ended goal."""
    shown = goal.to_json()
    other = {name: each for name, each in shown.items() if name not in _SEPARATE_FIELDS and each != _DEFAULTS[name]}
    if goal.spoken is not None and goal.text is not None:
        other["spoken"] = len(goal.spoken)  # the spoken part is the beginning of the text
    columns = {**filter_values(goal), "text": goal.text, "other": encode(other).decode()}
    return tuple(_storable(columns[name]) for name in COLUMNS)


def row_chars(row: Row) -> int:
    """Return the approximate number of characters in a row."""
    return len(row[COLUMNS.index("text")] or "") + len(row[COLUMNS.index("other")])


def row_to_json(row: Row) -> JsonObject:
    """Return the goal in a row as the JSON object that clients receive."""
    columns = dict(zip(COLUMNS, row, strict=True))
    other, text = decode(columns.pop("other").encode()), columns["text"]
    del columns["name"]
    if text is not None and isinstance(length := other.get("spoken"), int):
        other["spoken"] = text[:length]
    return {**_DEFAULTS, **columns, **other}


def without_text(goal: Goal) -> Goal:
    """Return a copy of a goal without its text and without any fields that may quote the text."""
    by, hidden = goal.by and By(goal.by.goal, _without_command_line(goal.by.client)), dict.fromkeys(_TEXT_FIELDS)
    return replace(goal, client=_without_command_line(goal.client), by=by, **hidden)


def _without_command_line(sender: Sender | None) -> Sender | None:
    """Return a copy of a sender without its parent's command line, which may contain the text."""
    return sender and replace(sender, parent=None)


def _storable(value: object) -> object:
    """Convert a value to one that SQLite can store. In a text, unpaired surrogates become question marks."""
    return value.encode(errors="replace").decode() if isinstance(value, str) else value
