"""The tables of faults name tests that exist."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
#: The folders with such a table, in their README.
FOLDERS = (HERE, ROOT / "tests" / "fleet")
#: A file, a function, or both: `test_a.py::test_b`; `::test_c` belongs to the file named before it.
_NAMED = re.compile(r"`((?:tests/)?[\w/]*\.py)?(?:::(\w+))?`")


@functools.cache
def functions(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {each.name for each in ast.walk(tree) if isinstance(each, ast.FunctionDef)}


def rows(folder: Path) -> list[str]:
    lines = (folder / "README.md").read_text(encoding="utf-8").splitlines()
    return [
        each for each in lines if each.startswith("| ") and not re.match(r"\| (---|fault|it covers|line|text) \|", each)
    ]


def named(folder: Path, row: str) -> list[tuple[Path, str | None]]:
    found: list[tuple[Path, str | None]] = []
    path = None
    for file, function in _NAMED.findall(row.split("|")[2]):
        if file:
            path = ROOT / file if file.startswith("tests/") else folder / file
        if path and (file or function):
            found.append((path, function or None))
    return found


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_every_row_names_tests_that_exist(folder: Path) -> None:
    for row in rows(folder):
        tests = named(folder, row)
        assert tests, f"no test: {row}"
        for path, function in tests:
            assert path.is_file(), f"{path} does not exist: {row}"
            assert function is None or function in functions(path), f"{path.name} has no {function}: {row}"
            assert function is None or function.startswith("test_"), f"{function} is no test"
