"""The project's documents with their sections, tables and examples."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]

Row = tuple[str, ...]


class Document:
    """A Markdown document. Its path is relative to the project."""

    def __init__(self, path: str) -> None:
        self.name = path
        self.path = ROOT / path
        self.text = self.path.read_text(encoding="utf-8")

    def section(self, title: str) -> str:
        """Return the text under a heading, including its subsections."""
        match = re.search(rf"^(##+) {re.escape(title)}\n(.*?)(?=^## |^\1 |\Z)", self.text, re.MULTILINE | re.DOTALL)
        assert match, f"{self.name} has no section {title!r}"
        return match[2]

    def examples(self, language: str, title: str | None = None) -> list[str]:
        """Return the code blocks in a language, of one section or of all."""
        text = self.text if title is None else self.section(title)
        return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)

    @property
    def prose(self) -> str:
        """The text without code blocks."""
        fenced = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
        return re.sub(r"^    .*$", "", fenced.sub("", self.text), flags=re.MULTILINE)

    @property
    def anchors(self) -> set[str]:
        """The anchors that GitHub makes from the headings."""
        headings = re.findall(r"^#+ (.+)$", self.prose, re.MULTILINE)
        return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


README = Document("README.md")
COMMAND_LINE = Document("talkcli/cli/README.md")
WIRE = Document("talkcli/protocol/README.md")
TALKING = Document("talkcli/client/README.md")
ASYNCIO = Document("talkcli/aio/README.md")
DOCTOR = Document("talkcli/doctor/README.md")
SERVICES = Document("talkcli/daemon/README.md")
FLEET = Document("talkcli/fleet/README.md")
INTERNALS = Document("talkcli/README.md")
BENCHMARK = Document("tests/tools/bench/README.md")
CONTRIBUTING = Document(".github/CONTRIBUTING.md")
DOCUMENTS = (
    *(README, COMMAND_LINE, TALKING, ASYNCIO, DOCTOR, SERVICES, WIRE, FLEET, INTERNALS, BENCHMARK, CONTRIBUTING),
    *(Document(path) for path in ("tests/faults/README.md", "tests/fleet/README.md", "tests/fresh/README.md")),
)


def tables(text: str) -> list[list[Row]]:
    """Return the tables of a text as rows of cells. The first row has the headings."""
    result = []
    for table in re.findall(r"^(?:\|.*\|\n)+", text, re.MULTILINE):
        lines = [re.split(r"(?<!\\)\|", row[1:-1]) for row in table.splitlines()]
        rows = [tuple(cell.strip().replace("\\|", "|") for cell in line) for line in lines]
        assert {len(row) for row in rows} == {len(rows[0])}, f"cells are missing: {table}"
        result.append([rows[0], *rows[2:]])
    return result


def code_spans(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def first_column(table: list[Row]) -> list[str]:
    """Return the first code span of each row, if its first cell has one."""
    return [code_spans(row[0])[0] for row in table[1:] if code_spans(row[0])]
