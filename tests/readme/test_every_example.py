"""Each example in the documents has a test. A new example fails here until it has one."""

from __future__ import annotations

import ast
import importlib
import subprocess
from pathlib import Path

from tests.readme.blocks import BLOCKS, RUN
from tests.support.documents import ROOT

#: Examples that are run by tests in other folders.
ELSEWHERE = {
    "Use it from Python": "tests/wire/test_examples.py::test_the_first_example_of_the_library_prints_the_words",
    "Use it from Python: In a robot's loop": "tests/wire/test_examples.py::test_the_loop_of_a_robot_speaks",
    "The wire": "tests/wire/test_examples.py::test_a_goal_can_be_sent_with_socat",
    "Two clients": "tests/wire/test_examples.py::test_the_shell_client_reports_each_result",
    "Two clients #2": "tests/wire/test_examples.py::test_the_plain_python_client_prints_the_words",
    "Completion": "tests/test_completion.py::test_shells_complete_and_quote_ids_keys_and_options_and_show_texts",
    "Speed": "tests/test_bench.py::test_every_row_of_a_group_measures_something",
}
for _path in Path(__file__).parent.glob("test_*.py"):
    if _path != Path(__file__):
        importlib.import_module(f"tests.readme.{_path.stem}")


def test_every_example_has_a_test() -> None:
    assert sorted([*RUN, *ELSEWHERE]) == sorted(BLOCKS)
    for test in ELSEWHERE.values():
        path, _, name = test.partition("::")
        nodes = ast.walk(ast.parse((ROOT / path).read_text("utf-8")))
        assert name in [node.name for node in nodes if isinstance(node, ast.FunctionDef)], test


def test_examples_can_be_parsed() -> None:
    for name, (language, code) in BLOCKS.items():
        if language == "python":
            compile(code, name, "exec")
        elif language == "sh":
            done = subprocess.run(["sh", "-n"], input=code, capture_output=True, text=True, timeout=20, check=False)
            assert (done.returncode, done.stderr) == (0, ""), name


def test_examples_put_two_dashes_before_a_text_from_a_variable() -> None:
    """Without them, a text that starts with a dash would be read as an option."""
    for name, (_, code) in BLOCKS.items():
        for line in code.splitlines():
            rest = line.replace("talk -q say", "talk say").partition("talk say")[2]
            assert '"$' not in rest or " -- " in rest, f"{name}: {line}"
