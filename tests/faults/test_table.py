"""The tables of faults name only existing tests, and the table of this folder names all of its modules."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
#: A file, a function, or both: `test_a.py::test_b`. `::test_c` is in the file named before it.
_NAMED = re.compile(r"`((?:tests/)?[\w/]*\.py)?(?:::(\w+))?`")
_HEAD = re.compile(r"\| (---|fault|it covers|line|text) \|")


@functools.cache
def functions(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


@pytest.mark.parametrize("folder", ["tests/faults", "tests/fleet"])
def test_every_row_names_tests_that_exist(folder: str) -> None:
    for row in _rows(folder):
        path = None
        for file, function in _NAMED.findall(row.split("|")[2]):
            if file:
                path = ROOT / ("" if file.startswith("tests/") else folder) / file
                assert path.is_file(), f"{path} does not exist: {row}"
            if path and function:
                assert function in functions(path), f"{path.name} has no {function}: {row}"
                assert function.startswith("test_"), f"{function} is not a test"
        assert path, f"no test: {row}"


def test_every_module_of_faults_is_named_in_a_row() -> None:
    rows = "\n".join(_rows("tests/faults"))
    modules = {path.name for path in Path(__file__).parent.glob("test_*.py")}
    # Neither systemd units nor this table are faults.
    assert {module for module in modules if f"`{module}" not in rows} == {"test_service_units.py", "test_table.py"}


def _rows(folder: str) -> list[str]:
    lines = (ROOT / folder / "README.md").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.startswith("| ") and not _HEAD.match(line)]
