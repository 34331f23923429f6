"""No example of a document is without a test: an example that is added fails here, by its name, until it has one."""

from __future__ import annotations

import ast
import importlib
import subprocess
from pathlib import Path

import pytest

from tests.readme.blocks import BLOCKS, RUN
from tests.support.documents import ROOT

#: Examples that tests elsewhere run.
ELSEWHERE = {
    "A tour: From Python": "tests/wire/test_examples.py::test_first_example_of_the_library",
    "A tour: From Python #2": "tests/wire/test_examples.py::test_loop_of_a_robot",
    "The wire": "tests/wire/test_examples.py::test_line_of_socat_says_a_sentence",
    "Two clients": "tests/wire/test_examples.py::test_client_in_shell",
    "Two clients #2": "tests/wire/test_examples.py::test_client_in_plain_python",
    "Completion": "tests/test_completion.py::test_start_files_of_the_readme_load_it",
    "Speed": "tests/test_bench.py::*",
}
for _path in Path(__file__).parent.glob("test_*.py"):
    if _path != Path(__file__):
        importlib.import_module(f"tests.readme.{_path.stem}")


def test_every_example_has_a_test() -> None:
    assert sorted([*RUN, *ELSEWHERE]) == sorted(BLOCKS)


@pytest.mark.parametrize("test", ELSEWHERE.values())
def test_tests_elsewhere_are_there(test: str) -> None:
    path, _, name = test.partition("::")
    names = [
        each.name for each in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))) if isinstance(each, ast.FunctionDef)
    ]
    assert any(each.startswith("test_") if name == "*" else each == name for each in names)


@pytest.mark.parametrize("name", [each for each, (language, _) in BLOCKS.items() if language == "sh"])
def test_shell_can_read_it(name: str) -> None:
    done = subprocess.run(["sh", "-n"], input=BLOCKS[name][1], capture_output=True, text=True, timeout=20, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", [each for each, (language, _) in BLOCKS.items() if language == "python"])
def test_python_can_read_it(name: str) -> None:
    compile(BLOCKS[name][1], name, "exec")


def test_a_text_that_is_not_known_is_behind_two_dashes() -> None:
    """A text that comes from a variable may begin with a dash, and would be an option."""
    for name, (_, code) in BLOCKS.items():
        for line in code.splitlines():
            rest = line.replace("talk -q say", "talk say").partition("talk say")[2]
            assert '"$' not in rest or " -- " in rest, f"{name}: {line}"
