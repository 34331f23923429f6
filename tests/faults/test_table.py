"""The tables of faults name tests that exist."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
#: A file, a function, or both: `test_a.py::test_b`; `::test_c` belongs to the file named before it.
_NAMED = re.compile(r"`((?:tests/)?[\w/]*\.py)?(?:::(\w+))?`")
_HEAD = re.compile(r"\| (---|fault|it covers|line|text) \|")


@functools.cache
def functions(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {each.name for each in ast.walk(tree) if isinstance(each, ast.FunctionDef)}


@pytest.mark.parametrize("folder", ["tests/faults", "tests/fleet"])
def test_every_row_names_tests_that_exist(folder: str) -> None:
    lines = (ROOT / folder / "README.md").read_text(encoding="utf-8").splitlines()
    for row in (each for each in lines if each.startswith("| ") and not _HEAD.match(each)):
        path = None
        for file, function in _NAMED.findall(row.split("|")[2]):
            if file:
                path = ROOT / ("" if file.startswith("tests/") else folder) / file
                assert path.is_file(), f"{path} does not exist: {row}"
            if path and function:
                assert function in functions(path), f"{path.name} has no {function}: {row}"
                assert function.startswith("test_"), f"{function} is no test"
        assert path, f"no test: {row}"
