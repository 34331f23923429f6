"""The layout of the package, read from its source: who may import whom, which modules are pure, who may print.

Imports point one way, and heavy modules are imported only where they are needed.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

import talkcli
from talkcli.cli.commands import COMMANDS
from talkcli.engine.players import PLAYERS
from talkcli.engine.voices import SYNTHESIZERS
from tests.support.surroundings import needs

PACKAGE = Path(talkcli.__file__).parent

#: The layers: each may import itself and those before it.
LAYERS = ["ground", "goals", "protocol", "terminal", "daemon", "engine", "client", "server", "fleet", "doctor", "cli"]
#: The modules of the ground, which import only each other.
GROUND = {"errors", "frozen", "install", "paths", "peers", "polling", "processes"}
#: The package itself and its command, which only pass on the work of others.
FACE = {"", "__main__"}
#: What is pure besides all of `goals`, `protocol` and `terminal`.
PURE = [
    *("errors", "frozen", "client.core", "engine.child.words", "engine.child.synthesizers.guard"),
    *("engine.child.synthesizers.phonemes", "engine.child.synthesizers.vits"),
    *("fleet.payloads", "fleet.topics", "fleet.bridge.policy"),
    *("fleet.desk.request", "fleet.desk.table"),
]
IMPURE = {
    *("asyncio", "threading", "_thread", "socket", "_socket", "select", "selectors", "signal", "time", "datetime"),
    *("random", "secrets", "click", "pyttsx3", "platformdirs", "os", "io", "pathlib", "subprocess", "multiprocessing"),
}
#: What the modules of `goals` may import besides each other: these and nothing else.
FOR_GOALS = {
    *("__future__", "bisect", "collections", "dataclasses", "enum", "hashlib", "itertools", "json", "math", "operator"),
    *("typing", "unicodedata", "talkcli.errors", "talkcli.frozen"),
}
#: The files and folders at the top of the project whose names do not begin with a dot.
TOP = {"pyproject.toml", "talkcli", "tests", "completions", "README.md", "CHANGELOG.md", "LICENSE"}
#: Who may name these: a module, or the first part of its name.
ONLY = {
    "pyttsx3": {"engine"},
    "espeakng_loader": {"engine"},
    "numpy": {"engine"},
    "onnxruntime": {"engine.child.synthesizers.inference"},  # which turns its telemetry off first
    "click": {"cli"},
    "asyncio": {"daemon", "server", "fleet"},
    "paho": {"fleet"},
    "platformdirs": {"paths"},
}


class Import(NamedTuple):
    """An import of a module: in which function, or only for the type checker."""

    name: str
    function: str | None
    typing: bool
    line: int


def module_name(path: Path) -> str:
    """Return a file's name within the package: `paths`, `engine.parent.supervisor`, and "" for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def sources() -> dict[str, ast.Module]:
    return {module_name(path): ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def part(module: str) -> str:
    """Return the layer of a module, or a file of the ground by its own name; `python -m talkcli` is the cli's."""
    first = module.partition(".")[0]
    return "cli" if first == "__main__" else first


def layer(module: str) -> int:
    """Return the place of a module's layer among the `LAYERS`."""
    return LAYERS.index("ground" if module in GROUND else part(module))


def pure() -> list[str]:
    """Return the modules that have no I/O, no clock and no thread."""
    return PURE + [each for each in sources() if part(each) in {"goals", "protocol", "terminal"}]


def named(module: str, node: ast.AST) -> list[str]:
    """Return the full names of the modules that this node names."""
    if isinstance(node, ast.Import):
        return [each.name for each in node.names]
    if isinstance(node, ast.ImportFrom):
        base = node.module or ""
        assert not node.level, f"talkcli.{module}:{node.lineno} imports relatively"
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
    """Return the modules of the package that a module imports, by their names within it."""
    return [
        (each.name.removeprefix("talkcli").removeprefix("."), each)
        for each in imports(module)
        if each.name.partition(".")[0] == "talkcli"
    ]


def test_every_module_belongs_to_a_layer() -> None:
    assert {part(each) for each in sources()} - {*FACE, "cli"} == GROUND | set(LAYERS) - {"ground", "cli"}
    assert set(PURE) <= sources().keys()
    assert {"asyncio", "json"} & set().union(*map(outside, sources()))


def test_the_picture_for_developers_shows_the_layers() -> None:
    """What stands above in the picture for developers is above, and each package is there."""
    _, _, below = (PACKAGE / "README.md").read_text(encoding="utf-8").partition("## The layers\n")
    assert re.findall(r"^    (\w+) ", below.partition("\n## ")[0], re.MULTILINE) == LAYERS[::-1]


def test_no_module_imports_a_layer_above_it_not_even_for_types() -> None:
    for module in sources().keys() - FACE:
        above = {name for name, _ in inside(module) if name not in FACE and layer(name) > layer(module)}
        assert not above, f"talkcli.{module} is of a layer below {above}"


def test_the_top_of_the_project_is_as_listed() -> None:
    needs("git")
    listed = subprocess.run(["git", "ls-files"], cwd=PACKAGE.parent, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("this is no checkout")
    top = {each.strip('"').partition("/")[0] for each in listed.stdout.splitlines()}
    assert {each for each in top if not each.startswith(".")} == TOP


def test_every_module_is_used() -> None:
    """By the command, by the engine process, or by a module that is itself run."""
    used: set[str] = set()
    runs = {each for command in COMMANDS.values() for each in (command.function, command.fleet_function) if each}
    new = {"__main__", "engine.child.main", "", "cli.ask", *(f"cli.{each.partition(':')[0]}" for each in runs)}
    new |= {f"engine.child.players.{each.class_path.partition(':')[0]}" for each in PLAYERS.values() if each.class_path}
    new |= {f"engine.child.synthesizers.{each.partition(':')[0]}" for each in SYNTHESIZERS.values()}
    while new:
        used |= new
        new = {name for module in new for name, _ in inside(module)} - used
    heads = {module_name(each) for each in PACKAGE.rglob("__init__.py")}
    assert sources().keys() - used <= heads


def test_imports_have_no_cycle_not_even_for_types() -> None:
    graph = {module: {name for name, _ in inside(module)} - {"", module} for module in sources() if module}
    assert {*TopologicalSorter(graph).static_order()} == graph.keys()  # else CycleError


@pytest.mark.parametrize("module", pure())
def test_a_module_that_decides_is_pure(module: str) -> None:
    shows_times = part(module) == "terminal"
    assert not outside(module) & (IMPURE - {"time"} if shows_times else IMPURE)
    assert not {each for each, _ in inside(module) if each not in {"", *pure()}}  # `talkcli` itself has the version
    if part(module) == "goals":
        names = {name if name.startswith("talkcli") else name.partition(".")[0] for name, *_ in imports(module)}
        assert {each for each in names if not each.startswith("talkcli.goals")} <= FOR_GOALS


def test_a_module_that_shows_times_knows_the_time_zone_and_asks_no_clock() -> None:
    """With its last argument left out, each of these would."""
    arguments = {"localtime": 1, "strftime": 2}
    for module in [each for each in sources() if part(each) == "terminal" and "time" in outside(each)]:
        nodes = [*ast.walk(sources()[module])]
        calls = [each for each in nodes if isinstance(each, ast.Call) and ast.unparse(each.func).startswith("time.")]
        for each in calls:
            name = ast.unparse(each.func).removeprefix("time.")
            assert arguments.get(name) == len(each.args), f"talkcli.{module}:{each.lineno} asks a clock"
        # The module `time` is used in no other way, and under no other name.
        assert not any(isinstance(each, ast.ImportFrom) and each.module == "time" for each in nodes)
        assert len(calls) == sum(isinstance(each, ast.Name) and each.id == "time" for each in nodes) > 0


@pytest.mark.parametrize("library", ONLY)
def test_a_library_is_named_by_its_own_part_alone(library: str) -> None:
    naming = {module for module in sources() if library in outside(module)} - ONLY[library]
    assert {part(each) for each in naming} <= ONLY[library]


def test_only_a_server_asks_platformdirs_for_its_path() -> None:
    found = [each for module in sources() for each in imports(module) if each.name.startswith("platformdirs")]
    assert {each.function for each in found} == {"server_socket"}
    for module, tree in sources().items():
        if part(module) not in {"server", "paths"}:
            assert "server_socket" not in {getattr(each, "attr", "") for each in ast.walk(tree)}, module


#: The modules of commands and doctor that are for fleets alone: no other module pays for their imports.
OF_THE_FLEET = {"cli.fleet", "cli.several", "doctor.broker"}


def test_server_doctor_and_fleet_are_imported_only_if_they_are_asked_for() -> None:
    for module in sources():
        for name, each in inside(module):
            where = f"talkcli.{module}:{each.line} imports {name}"
            if part(name) == "server" and part(module) != "server" and not each.typing:
                assert module == "cli.services", where
            if part(name) == "doctor" and part(module) != "doctor":
                assert module == "cli.ask", where
                assert each.function or each.typing, f"{where}, and the other commands would pay for it"
            if part(module) == "fleet":
                assert part(name) not in {"server", "engine"}, where
            elif part(name) == "fleet" or name in OF_THE_FLEET:
                assert part(module) in {"", "cli", "doctor"}, where
                assert each.function or each.typing or module in OF_THE_FLEET, where


def test_only_the_engine_imports_its_process() -> None:
    """The server, doctor and the commands use the tables in `engine` itself, and its `parent`."""
    for module in sources():
        if part(module) != "engine":
            assert not {name for name, _ in inside(module) if name.startswith("engine.child")}, module


def test_the_two_sides_of_the_engine_import_nothing_of_each_other() -> None:
    """They share the modules of `engine` itself, above all the protocol, and those import neither side."""
    for module in [each for each in sources() if each.startswith("engine.")]:
        side = module.split(".")[1]
        other = {"parent": "engine.child", "child": "engine.parent"}.get(side, ("engine.child", "engine.parent"))
        assert not {name for name, _ in inside(module) if name.startswith(other)}, module


#: Other modules that may end the process on the spot, as the server does on its second signal.
ENDING = {"server.run": {"os._exit"}, "engine.child.main": {"os._exit"}}
#: Other modules that may write to standard error: the log, and the engine process, whose server reads it.
COMPLAINING = {"daemon.log", "engine.child.main", "engine.child.runner"}


def test_only_the_cli_prints_and_exits() -> None:
    for module, tree in sources().items():
        if part(module) == "cli":
            continue
        words = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute | ast.Name)}
        ending = words & {"print", "exit", "quit", "SystemExit", "sys.exit", "os._exit", "sys.stdout"}
        assert ending <= ENDING.get(module, set()), f"talkcli.{module} has {ending}"
        assert "sys.stderr" not in words or module in COMPLAINING, f"talkcli.{module} writes to standard error"


HEAVY = [
    *("asyncio", "pyttsx3", "click", "platformdirs", "espeakng_loader"),
    *("paho", "talkcli.daemon", "talkcli.fleet", "talkcli.server", "talkcli.goals.scheduler"),
]
#: What every start of a client would pay for: each takes as long to import as a server takes to answer, or longer.
COSTLY = ["dataclasses", "inspect", "typing", "contextlib", "random", "socket", "logging", "subprocess", "tempfile"]


@pytest.mark.parametrize(
    ("statement", "without"),
    [
        ("import talkcli", [*HEAVY, *COSTLY, "talkcli.client.client"]),
        ("import talkcli.client.client", [*HEAVY, *COSTLY]),
        ("from talkcli import Client", [*HEAVY, *COSTLY]),
        ("import talkcli.cli, talkcli.cli.plain", [*HEAVY, *COSTLY, "json", "re", "enum", "signal"]),
        ("import talkcli.protocol.lines", [*HEAVY, *COSTLY, "_json", "json", "re", "enum", "signal"]),
        ("import talkcli.cli.ask, talkcli.cli.say, talkcli.cli.wait", [*HEAVY, *COSTLY]),
        ("import talkcli.terminal.goals, talkcli.terminal.transcript, talkcli.cli.show, talkcli.cli.command", HEAVY),
    ],
)
def test_a_client_loads_nothing_heavy(statement: str, without: list[str]) -> None:
    code = f"import sys\nbefore = {{*sys.modules}}\n{statement}\nprint(*({{*{without!r}}} & {{*sys.modules}} - before))"
    done = subprocess.run(  # as a program of its own: this one has loaded everything already
        [sys.executable, "-c", code], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, [], "")


#: The doctor's modules that judge; all but the last gather facts, too.
JUDGING = ["voice", "sound", "server", "sentence", "broker", "report"]
#: Modules that the doctor's judgements may call besides each other; a clock's format is all that they read.
FOR_JUDGING = {
    *("talkcli.engine.players", "talkcli.fleet.payloads", "talkcli.goals.goal", "talkcli.goals.options"),
    *("talkcli.goals.states", "talkcli.goals.reasons", "talkcli.terminal.goals", "talkcli.terminal.text"),
    "talkcli.frozen",
}


@cache
def sources_of_names(module: str) -> dict[str, str]:
    """Return the names that a module imports at its top, with the module that each is from."""
    found: dict[str, str] = {}
    for node in sources()[module].body:
        if isinstance(node, ast.Import):
            found |= {each.asname or each.name: each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {each.asname or each.name: node.module or "" for each in node.names}
    return found


def not_its_own(function: ast.FunctionDef) -> set[str]:
    """Return the names in a function that are neither its arguments nor its variables."""
    names = [node for node in ast.walk(function) if isinstance(node, ast.Name)]
    own = {node.arg for node in ast.walk(function) if isinstance(node, ast.arg)}
    own |= {node.id for node in names if isinstance(node.ctx, ast.Store)}
    return {node.id for node in names} - own


def test_the_doctor_judges_without_looking() -> None:
    """The same modules gather facts, so this follows each judgement through all that it calls."""
    functions = {
        (module, node.name): node
        for module, tree in sources().items()
        if part(module) == "doctor"
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
    }
    new = {each for each in functions if each[1].startswith("judge") or each[0] == "doctor.report"}
    assert {module for module, _ in new} == {f"doctor.{each}" for each in JUDGING}
    judging: set[tuple[str, str]] = set()
    while new:
        judging |= new
        called = set()
        for module, name in new:
            function = functions[module, name]
            assert not any(isinstance(node, ast.Import | ast.ImportFrom) for node in ast.walk(function)), name
            for each in not_its_own(function):
                source = sources_of_names(module).get(each, f"talkcli.{module}")
                owner = (source.removeprefix("talkcli."), each)
                if owner in functions:
                    called.add(owner)
                elif source != f"talkcli.{module}" and part(owner[0]) != "doctor" and not each.lstrip("_").isupper():
                    pure = source in FOR_JUDGING or source.partition(".")[0] not in (IMPURE | {"talkcli"}) - {"time"}
                    assert pure or each == "__version__", f"talkcli.{module}: {name} has {each} of {source}"
        new = called - judging


def test_contributing_names_every_file_that_an_option_goes_through() -> None:
    """The option --ttl is its example."""
    text = (PACKAGE.parent / ".github" / "CONTRIBUTING.md").read_text("utf-8")
    steps = text.partition("**An option of `say`**")[2].partition("\n\nThe protocol, its checks")[0]
    named = {module_name(PACKAGE / each) for each in re.findall(r"talkcli/([\w/]+\.py)", steps)}
    having = {module for module in sources() if re.search(r"\bttl\b", ast.unparse(sources()[module]))}
    # On a broker it is a message's expiry, too; no other option is known there.
    having -= {module for module in having if part(module) == "fleet"}
    assert named - having == {"engine.protocol"}  # it takes no expiry
    # Examples and help of commands, the sentence of the doctor, requests that wait for the queue, and reasons in words.
    assert having - named == {
        "cli.commands",
        "doctor.sentence",
        "cli.stdin",
        "client.core",
        "goals.reasons",
        "server.requests",
    }
    assert len(having) <= 11
