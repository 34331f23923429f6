"""Rules that the source must follow: which modules may import which others, are pure, or may print."""

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

PACKAGE = Path(talkcli.__file__).parent

#: The layers. A layer may import itself and the layers before it.
LAYERS = [
    *("ground", "goals", "protocol", "terminal", "daemon", "history", "engine"),
    *("client", "aio", "server", "fleet", "doctor", "cli"),
]
#: The modules of the ground, which import only each other.
GROUND = {"errors", "frozen", "install", "paths", "peers", "polling", "processes"}
#: The packages that users import, and the command. They may import any layer.
FACE = {"", "__main__", "aio"}
#: The pure modules outside `goals`, `protocol` and `terminal`, which are all pure.
PURE = [
    *("errors", "frozen", "client.core", "client.growing"),
    *("engine.child.cutting", "engine.child.words", "engine.markdown"),
    *("engine.child.synthesizers.guard", "engine.child.synthesizers.phonemes", "engine.child.synthesizers.vits"),
    "history.rows",
    *("fleet.payloads", "fleet.topics", "fleet.bridge.policy"),
    *("fleet.desk.request", "fleet.desk.table"),
]
IMPURE = {
    *("asyncio", "threading", "_thread", "socket", "_socket", "select", "selectors", "signal", "time", "datetime"),
    *("random", "secrets", "click", "pyttsx3", "platformdirs", "os", "io", "pathlib", "subprocess", "multiprocessing"),
}
#: The only modules that those of `goals` may import besides each other.
FOR_GOALS = {
    *("__future__", "bisect", "collections", "dataclasses", "enum", "hashlib", "itertools", "json", "math", "operator"),
    *("typing", "unicodedata", "talkcli.errors", "talkcli.frozen"),
}
#: Libraries, and the layers or modules that may import them.
ALLOWED = {
    "pyttsx3": {"engine"},
    "espeakng_loader": {"engine"},
    "numpy": {"engine"},
    "onnxruntime": {"engine.child.synthesizers.inference"},  # this module turns off telemetry first
    "click": {"cli"},
    "asyncio": {"daemon", "server", "fleet", "aio"},
    "paho": {"fleet"},
    "platformdirs": {"paths"},
    "sqlite3": {"history.file"},
}


class Import(NamedTuple):
    """An import of a module. `typing` is true if it is only for the type checker."""

    name: str
    function: str | None
    typing: bool
    line: int


def module_name(path: Path) -> str:
    """Return a file's name within the package, such as `engine.parent.supervisor`, or "" for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def sources() -> dict[str, ast.Module]:
    return {module_name(path): ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def part(module: str) -> str:
    """Return the layer of a module. A module of the ground has its own name, and `__main__` belongs to the cli."""
    first = module.partition(".")[0]
    return "cli" if first == "__main__" else first


def layer(module: str) -> int:
    """Return the index of a module's layer in `LAYERS`."""
    return LAYERS.index("ground" if module in GROUND else part(module))


def pure() -> list[str]:
    """Return the modules that must not use I/O, clocks or threads."""
    return PURE + [module for module in sources() if part(module) in {"goals", "protocol", "terminal"}]


def named(module: str, node: ast.AST) -> list[str]:
    """Return the full names of the modules that a node imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        base = node.module or ""
        assert not node.level, f"talkcli.{module}:{node.lineno} imports relatively"
        inner = [f"{base}.{alias.name}" for alias in node.names]
        modules = [name for name in inner if name.removeprefix("talkcli.") in sources()]
        return modules if len(modules) == len(inner) else [base, *modules]
    if isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", None)
        if called in {"import_module", "__import__", "find_spec", "run_module"}:
            return [str(node.args[0].value)]
    return []


@cache
def imports(module: str) -> list[Import]:
    collected: list[Import] = []

    def walk(node: ast.AST, function: str | None, *, typing: bool) -> None:
        collected.extend(Import(name, function, typing, getattr(node, "lineno", 0)) for name in named(module, node))
        inner = node.name if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else function
        typing = typing or (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"))
        for child in ast.iter_child_nodes(node):
            walk(child, inner, typing=typing)

    walk(sources()[module], None, typing=False)
    return collected


def outside(module: str) -> set[str]:
    return {imported.name.partition(".")[0] for imported in imports(module)} - {"talkcli"}


def inside(module: str) -> list[tuple[str, Import]]:
    """Return a module's imports from the package, with their names within it."""
    return [
        (imported.name.removeprefix("talkcli").removeprefix("."), imported)
        for imported in imports(module)
        if imported.name.partition(".")[0] == "talkcli"
    ]


def test_every_module_belongs_to_a_layer() -> None:
    assert {part(module) for module in sources() if module not in FACE} == GROUND | set(LAYERS) - {"ground"}
    assert set(PURE) <= sources().keys()
    assert {"asyncio", "json"} & set().union(*map(outside, sources()))


def test_the_developers_picture_shows_the_layers_in_order() -> None:
    _, _, below = (PACKAGE / "README.md").read_text(encoding="utf-8").partition("## The layers\n")
    assert re.findall(r"^(\w+) {2,}", below.partition("\n## ")[0], re.MULTILINE) == LAYERS[::-1]


def test_no_module_imports_a_layer_above_it_even_for_types() -> None:
    for module in sources().keys() - FACE:
        above = {name for name, _ in inside(module) if name not in FACE and layer(name) > layer(module)}
        assert not above, f"talkcli.{module} imports {above} from a layer above"


def test_imports_have_no_cycles_even_for_types() -> None:
    graph = {module: {name for name, _ in inside(module)} - {"", module} for module in sources() if module}
    assert {*TopologicalSorter(graph).static_order()} == graph.keys()  # else CycleError


@pytest.mark.parametrize("module", pure())
def test_a_pure_module_imports_only_pure_modules(module: str) -> None:
    shows_times = part(module) == "terminal"
    assert not outside(module) & (IMPURE - {"time"} if shows_times else IMPURE)
    assert not {name for name, _ in inside(module) if name not in {"", *pure()}}  # `talkcli` itself has the version
    if part(module) == "goals":
        names = {name if name.startswith("talkcli") else name.partition(".")[0] for name, *_ in imports(module)}
        assert {name for name in names if not name.startswith("talkcli.goals")} <= FOR_GOALS


def test_a_module_that_formats_times_does_not_read_the_clock() -> None:
    """These functions would read the clock if their last argument were left out."""
    arguments = {"localtime": 1, "strftime": 2}
    for module in [module for module in sources() if part(module) == "terminal" and "time" in outside(module)]:
        nodes = [*ast.walk(sources()[module])]
        calls = [node for node in nodes if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("time.")]
        for call in calls:
            name = ast.unparse(call.func).removeprefix("time.")
            assert arguments.get(name) == len(call.args), f"talkcli.{module}:{call.lineno} reads the clock"
        # The module `time` is used in no other way, and under no other name.
        assert not any(isinstance(node, ast.ImportFrom) and node.module == "time" for node in nodes)
        assert len(calls) == sum(isinstance(node, ast.Name) and node.id == "time" for node in nodes) > 0


@pytest.mark.parametrize("library", ALLOWED)
def test_a_library_is_imported_only_where_it_is_allowed(library: str) -> None:
    naming = {module for module in sources() if library in outside(module)} - ALLOWED[library]
    assert {part(module) for module in naming} <= ALLOWED[library]


def test_only_the_engine_imports_its_child_modules() -> None:
    """Other packages may use the modules directly in `engine`, and `engine.parent`."""
    for module in sources():
        if part(module) != "engine":
            assert not {name for name, _ in inside(module) if name.startswith("engine.child")}, module


def test_the_engines_parent_and_child_do_not_import_each_other() -> None:
    """They share the modules directly in `engine`, which import neither of them."""
    for module in [module for module in sources() if module.startswith("engine.")]:
        side = module.split(".")[1]
        other = {"parent": "engine.child", "child": "engine.parent"}.get(side, ("engine.child", "engine.parent"))
        assert not {name for name, _ in inside(module) if name.startswith(other)}, module


#: Other modules that may exit at once, as the server does on its second signal.
EXITING = {"server.run": {"os._exit"}, "engine.child.main": {"os._exit"}}
#: Other modules that may write to standard error: the log and the engine process, whose errors the server reads.
WRITING_STDERR = {"daemon.log", "engine.child.main", "engine.child.runner"}


def test_only_the_cli_prints_and_exits() -> None:
    for module, tree in sources().items():
        if part(module) == "cli":
            continue
        names = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute | ast.Name)}
        exits = names & {"print", "exit", "quit", "SystemExit", "sys.exit", "os._exit", "sys.stdout"}
        assert exits <= EXITING.get(module, set()), f"talkcli.{module} uses {exits}"
        assert "sys.stderr" not in names or module in WRITING_STDERR, f"talkcli.{module} writes to standard error"


HEAVY = [
    *("asyncio", "pyttsx3", "click", "platformdirs", "espeakng_loader"),
    *("paho", "sqlite3", "talkcli.daemon", "talkcli.fleet", "talkcli.server", "talkcli.goals.scheduler"),
]
#: Modules that would slow down every client. Importing one takes at least as long as a reply of the server.
COSTLY = ["dataclasses", "inspect", "typing", "contextlib", "random", "socket", "logging", "subprocess", "tempfile"]


@pytest.mark.parametrize(
    ("statement", "without"),
    [
        ("import talkcli", [*HEAVY, *COSTLY, "talkcli.client.client"]),
        ("import talkcli.client.client", [*HEAVY, *COSTLY]),
        ("from talkcli import Client", [*HEAVY, *COSTLY]),
        ("import talkcli.cli, talkcli.cli.plain", [*HEAVY, *COSTLY, "json", "re", "enum", "signal"]),
        ("import talkcli.protocol.lines", [*HEAVY, *COSTLY, "_json", "json", "re", "enum", "signal"]),
        ("import talkcli.cli.ask, talkcli.cli.log, talkcli.cli.say, talkcli.cli.wait", [*HEAVY, *COSTLY]),
        ("import talkcli.server.run", ["sqlite3"]),
        ("import talkcli.terminal.goals, talkcli.terminal.transcript, talkcli.cli.show, talkcli.cli.command", HEAVY),
    ],
)
def test_a_client_imports_no_slow_modules(statement: str, without: list[str]) -> None:
    code = f"import sys\nbefore = {{*sys.modules}}\n{statement}\nprint(*({{*{without!r}}} & {{*sys.modules}} - before))"
    done = subprocess.run(  # in a new process, because this one has imported everything
        [sys.executable, "-c", code], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, [], "")
