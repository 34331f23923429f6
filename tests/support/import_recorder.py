"""Python processes that write down what they import, and that may find some packages missing, installed or not."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

#: Runs first in each Python process, which then writes down what it imports, or tries to.
_SPY = """
import os, sys
def spy(event, details):
    if event == "import":
        with open(f"{os.environ['SPIED']}/{os.getpid()}", "a") as file:
            file.write(f"{details[0]}\\n")
sys.addaudithook(spy)
"""
#: … and finds none of these packages; it imports nothing itself, so that nothing else is different.
_HIDING = """
import sys
(Path,) = [each for each in sys.meta_path if getattr(each, "__name__", "") == "PathFinder"]
class Hiding(Path):
    @classmethod
    def find_spec(cls, name, *rest):
        return None if name.partition(".")[0] in {names!r} else super().find_spec(name, *rest)
sys.meta_path[sys.meta_path.index(Path)] = Hiding
"""


def record_imports(directory: Path, env: Mapping[str, str], without: Sequence[str] = ()) -> dict[str, str]:
    """Return the environment of processes that are spied on, and that find none of these packages."""
    for each in ("site", "spied"):
        (directory / each).mkdir(parents=True)
    (directory / "site" / "sitecustomize.py").write_text(_SPY + _HIDING.format(names=[*without]))
    path = [str(directory / "site"), *filter(None, [env.get("PYTHONPATH")])]
    return {**env, "PYTHONPATH": os.pathsep.join(path), "SPIED": str(directory / "spied")}


def imported(directory: Path) -> dict[int, frozenset[str]]:
    """Return what each of these processes has imported so far, or tried to, by its process id."""
    return {int(each.name): frozenset(each.read_text().split()) for each in (directory / "spied").iterdir()}
