"""The README, taken apart: its sections, its tables and its examples."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")

Row = tuple[str, ...]


def section(title: str) -> str:
    """Return what stands under a heading, what is under its own headings included."""
    found = re.search(rf"^(##+) {re.escape(title)}\n(.*?)(?=^## |^\1 |\Z)", TEXT, re.MULTILINE | re.DOTALL)
    assert found, f"the README has no section {title!r}"
    return found[2]


def tables(text: str) -> list[list[Row]]:
    """Return the tables of a text as rows of cells, headings first, the line under these left out."""
    found = []
    for table in re.findall(r"^(?:\|.*\|\n)+", text, re.MULTILINE):
        lines = [re.split(r"(?<!\\)\|", row[1:-1]) for row in table.splitlines()]
        rows = [tuple(cell.strip().replace("\\|", "|") for cell in line) for line in lines]
        assert {len(row) for row in rows} == {len(rows[0])}, f"cells are missing: {table}"
        found.append([rows[0], *rows[2:]])
    return found


def words(cell: str) -> list[str]:
    """Return what stands in a cell as code."""
    return re.findall(r"`([^`]+)`", cell)


def first_column(table: list[Row]) -> list[str]:
    """Return the one name that stands as code at the beginning of each row."""
    return [words(row[0])[0] for row in table[1:] if words(row[0])]


def examples(language: str, text: str = TEXT) -> list[str]:
    """Return the blocks of code in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
