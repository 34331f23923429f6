"""The package's layout: who may import whom, what is pure, who may print; read from the source, with ast.

Imports point one way, and what is heavy is imported only where it is needed.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import talkcli
from talkcli.cli.commands import COMMANDS
from tests.support.surroundings import needs

PACKAGE = Path(talkcli.__file__).parent

#: Each of these may import those after it, never one before it.
CHAIN = ["cli", "client", "wire", "requests", "messages", "states", "errors"]
PURE = [
    "states",
    "scheduler",
    "admission",
    "effects",
    "pending",
    "recent",
    "selection",
    "record",
    "history",
    "text",
    "messages",
    "events",
    "replies",
    "backlog",
    "outgoing",
    "requests",
    "wire",
    "errors",
    "unreachable",
    "values",
    "engine.changeover",
    "engine.guard",
    "engine.murmur",
    "engine.restarts",
]
IMPURE = {
    *("asyncio", "threading", "_thread", "socket", "_socket", "select", "selectors", "signal", "time", "datetime"),
    *("random", "secrets", "click", "pyttsx3", "platformdirs", "os", "io", "pathlib", "subprocess", "multiprocessing"),
}
#: What the package is made of, at its top: each a module, or a folder of them.
PARTS = {
    *("engine", "engine.thread", "engine.process", "engine.espeak", "engine.players", "scheduler"),
    *("server", "paths", "client", "output", "cli"),
}
#: What stands at the top of the project; beside it only files and folders whose names begin with a dot.
TOP = {"pyproject.toml", "talkcli", "tests", "completions", "README.md", "LICENSE"}
#: The longest that a module may be: what can be kept in mind as one thing.
LONGEST = 500
#: Who may name these, by the first part of a module's name.
ONLY = {
    "pyttsx3": {"engine"},
    "espeakng_loader": {"engine"},
    "click": {"cli"},
    "asyncio": {"server"},
    "platformdirs": {"paths"},
}


@dataclass(frozen=True)
class Import:
    """One module that one import names, and where: the innermost function, or only for the type checker."""

    name: str
    function: str | None
    typing: bool
    line: int


def module_name(path: Path) -> str:
    """Return a file's name within the package: `wire`, `engine.thread`, and "" for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def sources() -> dict[str, ast.Module]:
    return {module_name(path): ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def part(module: str) -> str:
    """Return which part of the package a module is of; `python -m talkcli` is the cli's, `server_x` the server's."""
    first = module.partition(".")[0]
    if first.startswith("server"):
        return "server"
    return "cli" if first == "__main__" else first


def absolute(module: str, node: ast.ImportFrom) -> str:
    """Return the full name of what an import is from."""
    if not node.level:
        return node.module or ""
    is_package = (PACKAGE / module.replace(".", "/") / "__init__.py").exists()
    parents = ["talkcli", *module.split(".")] if module else ["talkcli"]
    base = parents[: len(parents) - node.level + is_package]
    return ".".join([*base, node.module] if node.module else base)


def named(module: str, node: ast.AST) -> list[str]:
    """Return the full names of the modules that this node names."""
    if isinstance(node, ast.Import):
        return [each.name for each in node.names]
    if isinstance(node, ast.ImportFrom):
        base = absolute(module, node)
        inner = [f"{base}.{each.name}" for each in node.names]
        modules = [each for each in inner if each.removeprefix("talkcli.") in sources()]
        return modules if len(modules) == len(inner) else [base, *modules]
    if isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", None)
        if called in {"import_module", "__import__", "find_spec", "run_module"}:
            return [str(node.args[0].value)]
    return []


@cache
def imports(module: str) -> list[Import]:
    found: list[Import] = []

    def walk(node: ast.AST, function: str | None, *, typing: bool) -> None:
        found.extend(Import(name, function, typing, getattr(node, "lineno", 0)) for name in named(module, node))
        inner = node.name if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else function
        typing = typing or (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"))
        for child in ast.iter_child_nodes(node):
            walk(child, inner, typing=typing)

    walk(sources()[module], None, typing=False)
    return found


def outside(module: str) -> set[str]:
    return {each.name.partition(".")[0] for each in imports(module)} - {"talkcli"}


def inside(module: str) -> list[tuple[str, Import]]:
    """Return the modules of the package that this one imports, with their names within it."""
    return [
        (each.name.removeprefix("talkcli").removeprefix("."), each)
        for each in imports(module)
        if each.name.partition(".")[0] == "talkcli"
    ]


def test_the_modules_that_these_rules_are_about_are_there() -> None:
    assert set(PURE) | set(CHAIN) | PARTS <= sources().keys()
    assert {"asyncio", "json"} & set().union(*map(outside, sources()))


def test_the_top_of_the_project_holds_what_it_should() -> None:
    needs("git")
    known = subprocess.run(
        ["git", "ls-files", "-z"], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=60, check=False
    )
    if known.returncode:
        pytest.skip("this is no checkout")
    top = {each.partition("/")[0] for each in known.stdout.split("\0") if each}
    assert top >= TOP
    assert not {each for each in top - TOP if not each.startswith(".")}


def test_every_module_says_what_it_is_and_is_no_longer_than_one_can_keep_in_mind() -> None:
    for module, tree in sources().items():
        assert ast.get_docstring(tree), f"talkcli.{module} has no docstring"
        lines = [each.end_lineno or 0 for each in tree.body]
        assert max(lines) <= LONGEST, f"talkcli.{module} has {max(lines)} lines"


def test_every_module_is_used() -> None:
    """By the command, by the engine process, or by a module that is itself run."""
    used: set[str] = set()
    new = {"__main__", "engine.process", "cli.tabulate", *(f"cli.{each}" for each in COMMANDS)}
    while new:
        used |= new
        new = {name for module in new for name, _ in inside(module)} - used
    parents = {module.rpartition(".")[0] for module in sources()}
    assert sources().keys() - used <= parents


@pytest.mark.parametrize("name", CHAIN)
def test_imports_point_one_way(name: str) -> None:
    before = set(CHAIN[: CHAIN.index(name)]) | {"server", "engine"}
    if name == "cli":
        before = set()
    for module in sources():
        if part(module) == name:
            wrong = {each for each, _ in inside(module) if part(each) in before}
            assert not wrong, f"talkcli.{module} imports {wrong}"


def test_no_module_imports_itself_by_a_detour_not_even_for_its_types() -> None:
    graph = {module: {name for name, _ in inside(module)} - {"", module} for module in sources() if module}
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(f"imports go round: {error.args[1]}")


@pytest.mark.parametrize("module", PURE)
def test_what_decides_is_pure(module: str) -> None:
    assert not outside(module) & IMPURE
    assert not {each for each, _ in inside(module) if part(each) not in PURE}


@pytest.mark.parametrize("library", ONLY)
def test_only_its_own_part_names_a_library(library: str) -> None:
    naming = {module for module in sources() if library in outside(module)}
    assert {part(each) for each in naming} <= ONLY[library]


def test_platformdirs_is_imported_only_when_a_server_asks_for_its_path() -> None:
    found = [each for module in sources() for each in imports(module) if each.name.startswith("platformdirs")]
    assert {each.function for each in found} == {"server_socket"}
    for module, tree in sources().items():
        if part(module) not in {"server", "paths"}:
            names = {each.attr if isinstance(each, ast.Attribute) else "" for each in ast.walk(tree)}
            assert "server_socket" not in names, f"talkcli.{module} asks for the server's path"


def test_the_server_is_imported_by_the_serve_command_alone() -> None:
    for module in sources():
        if part(module) == "server":
            continue
        for name, each in inside(module):
            if part(name) == "server" and not each.typing:
                assert module == "cli.serve", f"talkcli.{module}:{each.line} imports the server"


#: Who else may end the process on the spot: the server, on its second signal, in the handler.
ENDING = {"server.run": {"os._exit"}}
#: Who else may write to standard error: the server's log, and the engine process, whose server reads it.
COMPLAINING = {"server.log", "engine.process", "engine.session"}


def test_only_the_cli_prints_and_exits() -> None:
    for module, tree in sources().items():
        if part(module) == "cli":
            continue
        words = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute | ast.Name)}
        ending = words & {"print", "exit", "quit", "SystemExit", "sys.exit", "os._exit", "sys.stdout"}
        assert ending <= ENDING.get(module, set()), f"talkcli.{module} has {ending}"
        assert "sys.stderr" not in words or module in COMPLAINING, f"talkcli.{module} writes to standard error"


HEAVY = ["asyncio", "pyttsx3", "click", "platformdirs", "espeakng_loader", "talkcli.server", "talkcli.scheduler"]
#: What every start of a client would pay for: each takes as long to import as a server takes to answer, or longer.
COSTLY = ["dataclasses", "inspect", "typing", "contextlib", "random", "socket", "logging", "subprocess", "tempfile"]


@pytest.mark.parametrize(
    ("statement", "without"),
    [
        ("import talkcli", [*HEAVY, *COSTLY, "talkcli.client"]),
        ("import talkcli.client", [*HEAVY, *COSTLY]),
        ("from talkcli import Client", [*HEAVY, *COSTLY]),
        ("import talkcli.cli, talkcli.cli.early", [*HEAVY, *COSTLY, "json", "re", "enum", "signal"]),
        ("import talkcli.cli.asking, talkcli.cli.saying, talkcli.cli.waiting", [*HEAVY, *COSTLY]),
        ("import talkcli.output, talkcli.transcript, talkcli.cli.show, talkcli.cli.nearest", HEAVY),
    ],
)
def test_a_client_loads_nothing_heavy(statement: str, without: list[str]) -> None:
    code = f"import sys\nbefore = {{*sys.modules}}\n{statement}\nprint(*({{*{without!r}}} & {{*sys.modules}} - before))"
    done = subprocess.run(  # as a program of its own: this one has loaded everything already
        [sys.executable, "-c", code], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, [], "")


#: The doctor's modules that judge facts; they read a clock's format at most, and gather nothing.
JUDGING = ["findings", "session", "voice", "sound", "level", "places", "sentence", "serving", "report"]
#: What those may import of the package besides each other.
FOR_JUDGING = {"", "columns", "messages", "printable", "states", "unreachable", "values"}


def test_the_doctor_judges_without_looking() -> None:
    judging = {f"doctor.{each}" for each in JUDGING}
    assert judging <= sources().keys()
    for module in judging:
        assert not outside(module) & (IMPURE - {"time"}), module
        assert {name for name, each in inside(module) if not each.typing} <= judging | FOR_JUDGING, module


def test_the_doctor_is_imported_by_its_command_alone_and_the_engine_where_it_needs_one() -> None:
    for module in sources():
        for name, each in inside(module):
            if part(module) == "doctor" and not each.typing:
                assert part(name) not in {"cli", "server", "output"}, f"talkcli.{module} imports {name}"
                assert part(name) != "engine" or each.function, f"talkcli.{module}:{each.line}"
            if part(name) == "doctor" and part(module) != "doctor":
                assert module == "cli.doctor", f"talkcli.{module} imports {name}"
                assert each.function, "the other commands don't pay for it"


def test_contributing_names_every_file_that_an_option_goes_through() -> None:
    """By the option that it takes as its example: --ttl."""
    text = (PACKAGE.parent / ".github" / "CONTRIBUTING.md").read_text("utf-8")
    steps = text.partition("**An option of `say`**")[2].partition("What is forgotten")[0]
    named = {module_name(PACKAGE / each) for each in re.findall(r"talkcli/([\w/]+\.py)", steps)}
    having = {module for module in sources() if re.search(r"\bttl\b", ast.unparse(sources()[module]))}
    assert named <= having
    assert having - named <= {"doctor.reach"}  # which says a sentence, as any client does
