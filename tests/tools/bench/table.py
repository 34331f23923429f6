"""The benchmark's rows with their goals, and the table that shows them."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Sequence

Figure = Literal["median", "p99", "least", "ratio", "above"]
HEADINGS = ("from → to", "n", "median", "99th", "peer", "peer's median", "ratio", "goal", "met")


@dataclass(frozen=True, slots=True)
class Limit:
    """The highest allowed value of a row's figure, or the lowest with `at_least`."""

    figure: Figure
    bound: float
    at_least: bool = False

    def holds(self, value: float) -> bool:
        return value >= self.bound if self.at_least else value <= self.bound

    def text(self, unit: str) -> str:
        """Return the limit as the table shows it."""
        suffixes = {
            "median": unit,
            "p99": f"{unit} 99th",
            "least": f"{unit} each",
            "above": f"{unit} above",
            "ratio": "×",
        }
        return f"{'≥' if self.at_least else '≤'} {number(self.bound)} {suffixes[self.figure]}"


@dataclass(frozen=True, slots=True)
class Row:
    """The measured values of a subject and of its peer."""

    name: str
    unit: str
    values: Sequence[float] = ()
    peer: str = ""
    peer_values: Sequence[float] = ()
    limits: Sequence[Limit] = ()
    failure: str | None = None

    @property
    def figures(self) -> dict[Figure, float]:
        """The figures of the values. A peer is needed for the ratio and the difference."""
        median = statistics.median(self.values)
        figures: dict[Figure, float] = {"median": median, "p99": percentile(self.values, 99), "least": min(self.values)}
        if self.peer_values:
            peer_median = statistics.median(self.peer_values)
            figures |= {"ratio": median / peer_median, "above": median - peer_median}
        return figures

    @property
    def goal(self) -> str:
        return ", ".join(limit.text(self.unit) for limit in self.limits)

    @property
    def met(self) -> str:
        """Whether all limits hold: "yes", "no", or "" without limits or without a peer for them."""
        figures = self.figures
        if not self.limits or any(limit.figure not in figures for limit in self.limits):
            return ""
        return "yes" if all(limit.holds(figures[limit.figure]) for limit in self.limits) else "no"

    def cells(self) -> list[str]:
        """Return the text under each heading."""
        if self.failure is not None:
            return [self.name, "0", f"FAILED: {self.failure}", "", "", "", "", self.goal, "no"]
        figures = self.figures
        peer = ["", "", ""]
        if self.peer_values:
            peer = [
                self.peer,
                f"{number(statistics.median(self.peer_values))} {self.unit}",
                f"{figures['ratio']:.2f}",
            ]
        own = [f"{len(self.values):,}", f"{number(figures['median'])} {self.unit}".strip(), number(figures["p99"])]
        return [self.name, *own, *peer, self.goal, self.met]


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the smallest value that `percent` percent of the values don't exceed."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(len(ordered) * percent / 100) - 1)]


def number(value: float) -> str:
    """Return a number with three significant digits."""
    if value == 0:
        return "0"
    size = abs(value)
    if size >= 100:
        return f"{value:,.0f}"
    text = f"{value:.{1 if size >= 10 else 2 if size >= 1 else 3}f}"
    return text.rstrip("0").rstrip(".") if value == int(value) else text


def as_table(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table. Its columns are aligned, except for failed rows."""
    lines = [list(HEADINGS), ["---"] * len(HEADINGS), *(row.cells() for row in rows)]
    aligned = [line for line in lines if not line[2].startswith("FAILED")]
    widths = [max(len(line[column]) for line in aligned) for column in range(len(HEADINGS))]
    return "\n".join(
        f"| {' | '.join(f'{cell:<{width}}' for cell, width in zip(line, widths, strict=True))} |" for line in lines
    )
