"""Record what Python processes import, and hide packages from them."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

#: Code that each Python process runs first. It records all imports, including failed ones.
_RECORD = """
import os, sys
def record(event, details):
    if event == "import":
        with open(f"{os.environ['RECORDED_IMPORTS']}/{os.getpid()}", "a") as file:
            file.write(f"{details[0]}\\n")
sys.addaudithook(record)
"""
#: Code that hides packages. It must not import anything.
_HIDE = """
import sys
(Path,) = [finder for finder in sys.meta_path if getattr(finder, "__name__", "") == "PathFinder"]
class Hiding(Path):
    @classmethod
    def find_spec(cls, name, *rest):
        return None if name.partition(".")[0] in {names!r} else super().find_spec(name, *rest)
sys.meta_path[sys.meta_path.index(Path)] = Hiding
"""


def record_imports(directory: Path, env: Mapping[str, str], without: Sequence[str] = ()) -> dict[str, str]:
    """Return an environment in which processes record their imports and don't find these packages."""
    for name in ("site", "imports"):
        (directory / name).mkdir(parents=True)
    (directory / "site" / "sitecustomize.py").write_text(_RECORD + _HIDE.format(names=[*without]))
    path = [str(directory / "site"), *filter(None, [env.get("PYTHONPATH")])]
    return {**env, "PYTHONPATH": os.pathsep.join(path), "RECORDED_IMPORTS": str(directory / "imports")}


def imported(directory: Path) -> dict[int, frozenset[str]]:
    """Return the recorded imports of each process, by process id."""
    return {int(file.name): frozenset(file.read_text().split()) for file in (directory / "imports").iterdir()}
