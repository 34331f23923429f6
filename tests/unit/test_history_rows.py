"""Goals as rows of the history, and the filters of `log`, which SQLite and Python must apply in the same way."""

from __future__ import annotations

import sqlite3

from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals.goal import By, Goal, Output, Sender
from talkcli.goals.options import END_STATES, Log
from talkcli.goals.states import EXIT_CODES, State
from talkcli.history.rows import (
    COLUMNS,
    SCHEMA,
    filter_values,
    given_filters,
    matches,
    row_to_json,
    sql_condition,
    to_row,
    without_text,
)

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
words = st.sampled_from(["", "a", "A", "é", "ab", '"%_'])
senders = st.builds(Sender, st.none() | st.integers(0, 9), st.none(), st.none() | texts, st.none() | texts, words)
states = st.sampled_from([State[name] for name in END_STATES])
goals = st.builds(
    Goal,
    id=st.sampled_from(["4k7f-1", "4k7f-2", "dock"]),
    state=states,
    text=texts | words,
    reason=st.none() | texts,
    by=st.none() | st.builds(By, st.none(), senders),
    message=st.none() | texts,
    spoken_end=st.none() | st.integers(0, 9),
    heard=st.none() | st.floats(0, 9),
    priority=st.integers(-9, 9),
    key=st.none() | words,
    data=st.none() | st.dictionaries(texts, texts | st.none(), max_size=2),
    client=st.none() | senders,
    queued_at=st.floats(0, 2e9),
    ended_at=st.sampled_from([1.0, 2.0, 3.0]),
    voice=st.none() | texts,
    output=st.none() | st.builds(Output, texts, texts, st.floats(0, 1), st.booleans()),
)
logs = st.builds(
    Log,
    since=st.none() | st.sampled_from([1.0, 2, 3.5]),
    until=st.none() | st.sampled_from([1.0, 2, 3.5]),
    state=st.none() | st.sampled_from(END_STATES),
    name=st.none() | words,
    key=st.none() | words,
    grep=st.none() | words,
)


@given(goals, st.integers(0, 12))
def test_a_goal_is_the_same_after_it_was_stored(goal: Goal, spoken: int) -> None:
    shown = {**goal.to_json(), "spoken": (goal.text or "")[:spoken]}
    stored = row_to_json(to_row(Goal.from_json(shown)))
    assert list(stored) == list(shown)
    assert stored == shown


def test_half_of_a_surrogate_pair_is_stored_as_a_question_mark() -> None:
    stored = row_to_json(to_row(Goal("4k7f-1", State.REJECTED, "\ud83e", data={"a": "\ud83e"}, key="\ud83e")))
    assert (stored["text"], stored["key"], stored["data"]) == ("?", "?", {"a": "\ud83e"})


@given(st.lists(goals, max_size=8), logs)
def test_sqlite_and_python_select_the_same_goals(ended: list[Goal], log: Log) -> None:
    filters = given_filters(log)
    condition, values = sql_condition(filters)
    database = sqlite3.connect(":memory:")
    database.executescript(SCHEMA)
    places = ", ".join("?" * len(COLUMNS))
    database.executemany(f"INSERT INTO goals ({', '.join(COLUMNS)}) VALUES ({places})", map(to_row, ended))
    found = database.execute(f"SELECT number FROM goals WHERE {condition} ORDER BY number", values).fetchall()
    database.close()
    assert [number - 1 for (number,) in found] == [
        index for index, goal in enumerate(ended) if matches(filters, filter_values(goal))
    ]


def test_a_goal_without_text_contains_no_field_that_may_quote_it() -> None:
    client = Sender(7, 0, "talk", "sh -c talk say secret", "patrol")
    goal = Goal("4k7f-1", State.ABORTED, "a secret", message="can't say 'secret'", spoken="a secret", client=client)
    goal = Goal.from_json(
        {**goal.to_json(), "by": {"client": client.to_json()}, "key": "door", "said": "secret", "ended_at": 1.0}
    )
    kept = without_text(goal)
    assert "secret" not in str(to_row(kept))
    assert (kept.key, kept.client, kept.by) == ("door", Sender(7, 0, "talk", None, "patrol"), By(client=kept.client))


def test_end_states_are_the_states_in_which_a_server_ends_goals() -> None:
    assert set(END_STATES) == {state.name for state in EXIT_CODES} - {"LOST"}
