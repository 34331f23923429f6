"""Rows of the benchmark, whether their goals are met, and how they are shown: as text, Markdown or JSON.

Pure. A row that could not be measured has a reason in the place of figures: it never shows a number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from tests.bench.arithmetic import median, percentile, ratio

if TYPE_CHECKING:
    from collections.abc import Sequence

Figure = Literal["median", "p99", "least", "ratio", "above"]
HEADINGS = ("from → to", "n", "median", "99th", "peer", "its median", "ratio", "goal", "met")
#: What stands behind a goal's unit.
_BEHIND = {"median": "", "p99": " 99th", "least": " each", "above": " above"}


@dataclass(frozen=True, slots=True)
class Limit:
    """What one figure of a row may be at most, or has to be at least."""

    figure: Figure
    bound: float
    at_least: bool = False

    def holds(self, value: float) -> bool:
        """Whether a figure is within the limit."""
        return value >= self.bound if self.at_least else value <= self.bound


@dataclass(frozen=True, slots=True)
class Row:
    """What was measured from one event to another, beside a peer or not."""

    group: str
    name: str
    unit: str
    values: tuple[float, ...] = ()
    #: what it is compared with
    peer: str | None = None
    peer_values: tuple[float, ...] = ()
    limits: tuple[Limit, ...] = ()
    #: why there is no figure
    failure: str | None = None

    @property
    def figures(self) -> dict[Figure, float]:
        """The figures there are; without a peer no ratio, and nothing by which it is above one."""
        if self.failure is not None or not self.values:
            return {}
        found: dict[Figure, float] = {
            "median": median(self.values),
            "p99": percentile(self.values, 99),
            "least": min(self.values),
        }
        if self.peer_values:
            found["ratio"] = ratio(found["median"], median(self.peer_values))
            found["above"] = found["median"] - median(self.peer_values)
        return found

    @property
    def met(self) -> bool | None:
        """Whether all goals are met; None where there is none, or a figure for one is missing."""
        figures = self.figures
        if not self.limits or any(each.figure not in figures for each in self.limits):
            return None
        return all(each.holds(figures[each.figure]) for each in self.limits)

    @property
    def goal(self) -> str:
        """The goals in words."""
        return ", ".join(
            f"{'≥' if each.at_least else '≤'} {number(each.bound)}{_after(each.figure, self.unit)}"
            for each in self.limits
        )

    def cells(self) -> list[str]:
        """Return what stands under each heading."""
        figures = self.figures
        if self.failure is not None or not figures:
            return [self.name, "0", f"FAILED: {self.failure or 'nothing was measured'}", *[""] * 4, self.goal, "no"]
        theirs = _with_unit(median(self.peer_values), self.unit) if self.peer_values else ""
        return [
            self.name,
            str(len(self.values)),
            _with_unit(figures["median"], self.unit),
            number(figures["p99"]),
            (self.peer or "") if self.peer_values else "",
            theirs,
            f"{figures['ratio']:.2f}" if "ratio" in figures else "",
            self.goal,
            {True: "yes", False: "no", None: ""}[self.met],
        ]

    def to_json(self) -> dict[str, object]:
        """Return the row with every value that was measured."""
        figures = self.figures
        return {
            "group": self.group,
            "name": self.name,
            "unit": self.unit,
            "n": len(self.values),
            "median": figures.get("median"),
            "p99": figures.get("p99"),
            "peer": self.peer,
            "peer_median": median(self.peer_values) if self.peer_values else None,
            "ratio": _finite(figures.get("ratio")),
            "goal": self.goal,
            "met": self.met,
            "failure": self.failure,
            "values": list(self.values),
            "peer_values": list(self.peer_values),
        }


def number(value: float) -> str:
    """Return a number with three digits that matter."""
    if value == 0:
        return "0"
    size = abs(value)
    if size >= 100:
        return f"{value:,.0f}"
    places = 1 if size >= 10 else 2 if size >= 1 else 3
    text = f"{value:.{places}f}"
    return text.rstrip("0").rstrip(".") if value == int(value) else text


def as_text(rows: Sequence[Row]) -> str:
    """Return the table for a terminal: columns of equal width, the failures' reasons not counted."""
    lines = [list(HEADINGS), *(each.cells() for each in rows)]
    plain = [line for line in lines if not line[2].startswith("FAILED")]
    widths = [max(len(line[column]) for line in plain) for column in range(len(HEADINGS))]
    widths[0] = max(len(line[0]) for line in lines)
    return "\n".join(
        "  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def as_markdown(rows: Sequence[Row]) -> str:
    """Return the table for a README."""
    lines = [list(HEADINGS), ["---"] * len(HEADINGS), *(each.cells() for each in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _after(figure: Figure, unit: str) -> str:
    return " ×" if figure == "ratio" else f" {unit}{_BEHIND[figure]}"


def _with_unit(value: float, unit: str) -> str:
    return f"{number(value)} {unit}"


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
