"""Rows of the benchmark: figures, goals, and how the table shows them; what failed never shows a number."""

from __future__ import annotations

import json

import pytest

from tests.bench.table import HEADINGS, Limit, Row, as_markdown, as_text, number

ONSET = Row("onset", "start → sound", "ms", (30, 20, 25), "spd-say", (20, 20, 10), (Limit("ratio", 1.6),))
FAILED = Row("gap", "(gap)", "", failure="it was not heard", limits=(Limit("median", 5),))


def test_figures_are_of_the_values_and_the_peers() -> None:
    assert ONSET.figures == {"median": 25, "p99": 30, "least": 20, "ratio": 1.25, "above": 5}
    assert ONSET.met is True
    assert ONSET.cells() == ["start → sound", "3", "25 ms", "30", "spd-say", "20 ms", "1.25", "≤ 1.60 ×", "yes"]


@pytest.mark.parametrize(
    ("limits", "met"),
    [
        ((), None),
        ((Limit("ratio", 1.2),), False),
        ((Limit("median", 25), Limit("p99", 30)), True),
        ((Limit("median", 25), Limit("p99", 29)), False),
        ((Limit("median", 25, at_least=True),), True),
        ((Limit("median", 26, at_least=True),), False),
        ((Limit("least", 20, at_least=True), Limit("above", 5)), True),
        ((Limit("least", 21, at_least=True),), False),
        ((Limit("above", 4),), False),
    ],
)
def test_a_goal_is_met_if_all_its_limits_hold(limits: tuple[Limit, ...], met: bool | None) -> None:
    row = Row("onset", "start → sound", "ms", ONSET.values, "spd-say", ONSET.peer_values, limits)
    assert row.met is met


def test_without_its_peer_a_ratio_is_neither_met_nor_missed() -> None:
    row = Row("onset", "start → sound", "ms", (20.0,), "spd-say", (), (Limit("ratio", 1.6),))
    assert row.met is None
    assert row.cells()[4:] == ["", "", "", "≤ 1.60 ×", ""]


def test_goals_are_told_in_their_units() -> None:
    assert Row("a", "a", "ms", limits=(Limit("median", 5), Limit("p99", 20))).goal == "≤ 5 ms, ≤ 20 ms 99th"
    assert Row("a", "a", "ms", limits=(Limit("above", 8),)).goal == "≤ 8 ms above"
    assert Row("a", "a", "ms", limits=(Limit("least", -10, at_least=True),)).goal == "≥ -10 ms each"
    assert Row("a", "a", "/s", limits=(Limit("median", 5_000, at_least=True),)).goal == "≥ 5,000 /s"


@pytest.mark.parametrize("row", [FAILED, Row("gap", "(gap)", "ms", limits=FAILED.limits)])
def test_what_was_not_measured_has_no_figure_and_misses_its_goal(row: Row) -> None:
    assert row.figures == {}
    cells = row.cells()
    assert cells[2].startswith("FAILED: ")
    assert cells[3:7] == [""] * 4
    assert cells[-1] == "no"


def test_the_table_has_columns() -> None:
    lines = as_text([ONSET, FAILED]).splitlines()
    assert len(lines) == 3
    assert [each for each in HEADINGS if each not in lines[0]] == []
    assert lines[1].index("25 ms") == lines[0].index("median") == lines[2].index("FAILED: it was not heard")
    assert lines[1].index("spd-say") == lines[0].index("peer")


def test_the_table_in_markdown() -> None:
    head, line, onset = as_markdown([ONSET]).splitlines()
    assert head == f"| {' | '.join(HEADINGS)} |"
    assert line.count("---") == len(HEADINGS)
    assert onset == "| start → sound | 3 | 25 ms | 30 | spd-say | 20 ms | 1.25 | ≤ 1.60 × | yes |"


def test_json_has_every_value() -> None:
    told = json.loads(json.dumps(ONSET.to_json()))
    assert (told["median"], told["ratio"], told["met"], told["values"]) == (25, 1.25, True, [30, 20, 25])
    failed = FAILED.to_json()
    assert (failed["median"], failed["met"], failed["failure"]) == (None, None, "it was not heard")


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0, "0"),
        (0.0042, "0.004"),
        (0.6, "0.600"),
        (1.254, "1.25"),
        (5, "5"),
        (24.46, "24.5"),
        (123.4, "123"),
        (5_000, "5,000"),
        (-4.271, "-4.27"),
    ],
)
def test_numbers_have_three_digits_that_matter(value: float, shown: str) -> None:
    assert number(value) == shown
