"""The reference: every option as click has it, every variable that the code reads; and commands named in passing."""

from __future__ import annotations

import ast
import re
import shlex

import click
import pytest

from talkcli.cli.click_app import talk
from talkcli.cli.commands import COMMANDS
from tests.readme import reference
from tests.support.documents import COMMAND_LINE, DOCUMENTS, README, ROOT, tables, words

#: Variables that `talk` makes itself, for processes of its own.
INTERNAL = {"TALK_LIVENESS_FD"}
_ENVIRONMENT = {"environ", "environment"}
_NAME = re.compile(r"_?[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*")
#: Commands that stand in sentences and tables, on one line.
_BEFORE = r"talk (?:--socket \S+ |--robot \S+ |--json |-q )*"
IN_PASSING = sorted(
    {
        each
        for document in DOCUMENTS
        for each, name in re.findall(rf"`((?:sudo |ssh robot )?{_BEFORE}([a-z]+)[^`\n]*)`", document.text)
        if name in COMMANDS
    }
)


@pytest.mark.parametrize("name", reference.MADE)
def test_what_is_made_is_current(name: str) -> None:
    """If not: `python -m tests.readme.reference`."""
    document, _ = reference.MADE[name]
    assert reference.current(name) == document.text


def test_options_of_a_command_are_all_there() -> None:
    for option in ("`-w, --wait`", "`--preempt / --queue`", "`--print-unit UNIT`", "`--socket PATH`", "`--silent`"):
        assert option in reference.options()


def _is_environment(node: ast.expr) -> bool:
    name = node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
    return name in _ENVIRONMENT


def _names(node: ast.expr, constants: dict[str, str], loops: dict[str, set[str]]) -> set[str]:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return {node.value}
    if isinstance(node, ast.Name):
        return loops.get(node.id) or {constants[node.id]} if node.id in constants or node.id in loops else set()
    return set()


def variables() -> set[str]:
    """Return the variables that the sources read, in each form in which they do so."""
    found: set[str] = set()
    for path in (ROOT / "talkcli").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = list(ast.walk(tree))
        constants = {
            node.targets[0].id: node.value.value
            for node in nodes
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
            if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        }
        loops = {
            node.target.id: {str(each.value) for each in node.iter.elts if isinstance(each, ast.Constant)}
            for node in nodes
            if isinstance(node, ast.comprehension) and isinstance(node.target, ast.Name)
            if isinstance(node.iter, ast.Tuple | ast.List)
        }
        for node in nodes:
            if isinstance(node, ast.Call):
                found |= {
                    str(each.value.value)
                    for each in node.keywords
                    if each.arg == "env" and isinstance(each.value, ast.Constant)
                }
                if (
                    isinstance(node.func, ast.Attribute)
                    and node.func.attr == "get"
                    and _is_environment(node.func.value)
                ):
                    found |= _names(node.args[0], constants, loops)
            elif isinstance(node, ast.Subscript) and _is_environment(node.value):
                found |= _names(node.slice, constants, loops)
            elif isinstance(node, ast.Compare) and _is_environment(node.comparators[0]):
                found |= _names(node.left, constants, loops)
    return {each for each in found if _NAME.fullmatch(each)} - INTERNAL


def test_variables_of_the_sources_are_found() -> None:
    """One of each form, so that a search that finds nothing is seen."""
    assert variables() >= {
        "TALK_SOCKET",
        "TALK_RATE",
        "TALK_DEBUG",
        "TMPDIR",
        "COMP_WORDS",
        "_TALK_COMPLETE",
        "NO_COLOR",
    }


def test_variables_are_in_the_table() -> None:
    documented = [each for row in tables(COMMAND_LINE.section("Variables"))[0][1:] for each in words(row[0])]
    assert sorted(documented) == sorted(variables())


@pytest.mark.parametrize("line", IN_PASSING)
def test_commands_in_passing_can_be_read(line: str) -> None:
    """Placeholders are words; a command without its text or its goals is a name, and has no option."""
    name, *arguments = shlex.split(re.sub(f"^.*?{_BEFORE}", "", line.partition(" < ")[0]))
    command = talk.get_command(click.Context(talk), name)
    assert command
    if name == "say" and all(each.startswith("--") or each in {"-o", "-f", "-wf"} for each in arguments):
        arguments = ["text"] if arguments in (["-o"], ["-wf"], ["-f"]) else [*arguments, "text"]
    command.make_context(name, arguments, parent=click.Context(talk))


def test_what_doctor_says_of_containers_is_in_the_readme() -> None:
    """It names the README, and the two ways to hand sound in."""
    sources = [each.read_text(encoding="utf-8") for each in (ROOT / "talkcli" / "doctor").glob("*.py")]
    steps = [step for each in sources for step in re.findall(r'"(start the container [^"]*README)"', each)]
    assert len(steps) == 2
    for words_of_both in ("--device /dev/snd", "PULSE_SERVER"):
        assert any(words_of_both in each for each in steps)
        assert words_of_both in README.section("In a container")
